"""Synthetic reports: a sensor drawn from distributions, its fits as the truth plus noise."""

import functools
from dataclasses import replace
from typing import Any

import numpy as np
from helpers.quick_stacks import stack, sums_of
from scipy.stats import norm, poisson

from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.model.maps.defects import Defects, Moments, find_defects
from pchem_pipeline.report.data import PixelFit, ReportData
from pchem_pipeline.report.figures.ensemble import case_name
from pchem_pipeline.report.figures.stability import stability_figures

PARAMETERS = ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn")


def true_maps(shape: tuple[int, int], seed: int = 1) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    ny, nx = shape
    y, x = np.mgrid[:ny, :nx] / max(ny, nx, 2)
    exposure = np.exp(rng.normal(np.log(2.0), 0.25, shape) + 0.2 * np.sin(5 * x))
    hot = rng.random(shape) < 0.004
    exposure[hot] *= rng.uniform(3, 25, int(hot.sum()))
    read_noise_e = 0.3 * np.exp(rng.normal(0, 0.1, shape)) + (rng.random(shape) < 0.02) * rng.exponential(
        0.06, shape
    )
    gain = 0.095 * (1 + 0.02 * rng.standard_normal(shape) + 0.01 * y)
    bias = 100 + 1.5 * rng.standard_normal(shape) + 2 * rng.standard_normal(nx)[None, :]
    return {
        "quanta_exposure": exposure,
        "conversion_gain": gain,
        "bias": bias,
        "read_noise_dn": read_noise_e / gain,
        "read_noise_e": read_noise_e,
    }


def draw_dn(maps: dict[str, np.ndarray], n: int, seed: int = 2) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    h, g, mu, sigma = (maps[name] for name in PARAMETERS)
    k = rng.poisson(h, (n, *h.shape))
    analog = np.sqrt(np.maximum(sigma**2 - 1 / 12, 0.01))
    return np.rint(k / g + mu + analog * rng.standard_normal(k.shape)).astype(np.int64), k


def pixel_fit(
    maps: dict[str, np.ndarray], y: int, x: int, label: str, n: int = 17_750, seed: int = 3
) -> PixelFit:
    one = {name: values[y : y + 1, x : x + 1] for name, values in maps.items()}
    dn = draw_dn(one, n, seed + 1000 * y + x)[0].ravel()
    values = {name: float(v[0, 0]) for name, v in one.items()}
    errors = dict(zip(PARAMETERS, (0.012, 0.0003, 0.06, 0.03), strict=True)) | {"read_noise_e": 0.0025}
    counts = np.bincount(dn - dn.min())
    return PixelFit(label, y, x, int(dn.min()), counts, values, errors, goodness_p=0.31)


def gaussian_mixture(x: np.ndarray, maps: dict[str, np.ndarray], n_k: int = 80) -> np.ndarray:
    """Mean over the first 400 pixels of the PCD, by plain sums."""
    h, g, mu, s = (maps[name].ravel()[:400, None] for name in PARAMETERS)
    terms = (poisson.pmf(k, h) * norm.pdf(x, mu + k / g, s) for k in range(n_k))
    return sum(term.mean(axis=0) for term in terms)  # type: ignore[return-value]


def ensemble_arrays(
    maps: dict[str, np.ndarray], n: int = 50
) -> tuple[dict[str, np.ndarray], dict[str, object]]:
    dn, _ = draw_dn(maps, n)
    axis = np.arange(dn.min(), dn.max() + 1)
    counts = np.bincount((dn - dn.min()).ravel(), minlength=axis.size)
    exact = gaussian_mixture(axis.astype(float), maps)
    electrons = (dn - maps["bias"]) * maps["conversion_gain"]
    step = float(np.median(maps["conversion_gain"]))
    edges = np.arange(electrons.min() - step / 2, electrons.max() + 1.5 * step, step)
    nuced_counts = np.histogram(electrons, edges)[0]
    centre = edges[:-1] + step / 2
    nuced = {**maps, "conversion_gain": np.ones_like(maps["bias"]), "bias": np.zeros_like(maps["bias"])}
    nuced["read_noise_dn"] = maps["read_noise_e"]
    nuced_exact = gaussian_mixture(centre, nuced)
    k_hat = np.clip(np.rint(electrons), 0, None).astype(int)
    k = np.arange(k_hat.max() + 1)
    k_counts = np.bincount(k_hat.ravel(), minlength=k.size)
    pmf = poisson.pmf(k[:, None], maps["quanta_exposure"].ravel()).mean(axis=1)
    grown = np.linspace(1.0, 1 / 16, 16)[:, None] * (0.1 * np.arange(13)) ** 2
    arrays = {
        "dn": axis,
        "counts": counts,
        "density": counts / counts.sum(),
        "epcd_exact": exact,
        "epcd_stderr": 0.01 * np.sqrt(exact / counts.sum()),
        "epcd_dependent": exact * 1.01,
        "epcd_independent": np.convolve(exact, np.ones(5) / 5, "same"),
        "electrons": centre,
        "nuced_counts": nuced_counts,
        "nuced_density": nuced_counts / nuced_counts.sum() / step,
        "nuced_exact": nuced_exact,
        "nuced_dependent": nuced_exact * 1.01,
        "nuced_independent": nuced_exact * 0.98,
        "k": k,
        "electron_counts": k_counts,
        "electron_mass": k_counts / k_counts.sum(),
        "electron_pmf": pmf,
        "electron_pmf_map": pmf * 1.005,
        "component_variance": np.mean(maps["read_noise_dn"] ** 2) + grown,
        "nuced_component_variance": np.full(13, np.mean(maps["read_noise_e"] ** 2)),
    }
    rmse = {"epcd_exact": 1.3e-4, "epcd_dependent": 1.5e-4, "epcd_independent": 8.3e-4, "noise_floor": 1.2e-4}
    rmse |= {f"nuced_{name.removeprefix('epcd_')}": 1.6 * value for name, value in rmse.items()}
    return arrays, {"rmse": rmse, "n_frames": n, "error_rate": 0.107}


CASES = tuple(
    case_name([s for bit, s in ((1, "H"), (2, "g"), (4, "mu"), (8, "sigma2")) if i & bit]) for i in range(16)
)


def defects_of(maps, status) -> Defects:
    """Return the defects that maps show, without the moments of pixels whose gain is not known."""
    nothing = np.empty(0)
    moments = Moments(nothing.astype(np.int64), nothing.astype(np.int64), nothing, nothing, nothing)
    return find_defects(maps, status, moments, None, light=False, sigmas=6.0)


@functools.cache
def report_data(shape: tuple[int, int] = (48, 64), *, failed: float = 0.01, seed: int = 1) -> ReportData:
    """A whole report of a sensor of which a share of the pixels failed."""
    rng = np.random.default_rng(seed + 10)
    truth = true_maps(shape, seed)
    bad = rng.random(shape) < failed
    maps: dict[str, np.ndarray] = {}
    relative = {"quanta_exposure": 0.006, "conversion_gain": 0.003, "bias": 6e-4}
    for name, values in truth.items():
        error = relative.get(name, 0.008) * np.abs(values)
        maps[name] = np.where(bad, np.nan, values + error * rng.standard_normal(shape))
        maps[f"{name}_stderr"] = np.where(bad, np.nan, error)
    maps["charge_rate"] = maps["quanta_exposure"] / 4.87
    maps["charge_rate_stderr"] = maps["quanta_exposure_stderr"] / 4.87
    status = np.where(bad, int(FitStatus.TOO_FEW_BINS), 0).astype(np.uint16)
    status[bad & (rng.random(shape) < 0.5)] = int(FitStatus.GAIN_NOT_IDENTIFIED)
    status[~bad & (rng.random(shape) < 0.01)] |= int(FitStatus.POOR_FIT)
    status[~bad & (rng.random(shape) < 0.006)] |= int(FitStatus.BIAS_AMBIGUOUS)
    arrays, facts = ensemble_arrays(truth)
    labels = [f"{n} read noise, {e} exposure" for n in ("low", "high") for e in ("low", "high")]
    places = rng.integers(0, shape, (4, 2))
    pixels = [pixel_fit(truth, int(y), int(x), label) for (y, x), label in zip(places, labels, strict=True)]
    return ReportData(
        title="demo sensor",
        shape=shape,
        n_frames=17_750,
        integration_time=4.87,
        maps=maps,
        fit={
            "fit_status": status,
            "goodness_p": np.where(bad, np.nan, rng.random(shape)),
            "goodness_q": np.where(bad, np.nan, 1.0),
            "goodness_chi2": np.where(bad, np.nan, rng.chisquare(60.0, shape)),
            "goodness_dof": np.where(bad, 0.0, 60.0),
            "outlier_share": (rng.random(shape) < 0.01) / 17_750,
            "likelihood_gap": np.where(bad, np.nan, 300.0),
        },
        pixels=pixels,
        defects=defects_of(maps, status),
        misfits={
            "tested": int((~bad).sum()),
            "misfits": 0,
            "false_discovery_rate": 0.05,
            "tail_guard": 1e-3,
            "pixels_with_outliers": 3,
            "largest_outlier_share": 5.6e-5,
            "worst": [{"y": 0, "x": 0, "chi2": 99.0, "dof": 60.0, "p": 1e-3, "q": 0.7}],
        },
        ensemble=arrays,
        ensemble_facts=facts,
        component_cases=CASES,
        moments=[
            dict(zip(("quantity", "unit", "predicted", "observed", "stderr"), row, strict=True))
            for row in (
                ("mean, raw", "DN", 121.34, 121.32, 0.02),
                ("variance, raw", "DN2", 251.3, 250.9, 0.4),
            )
        ],
        truth=truth,
        config_yaml="input:\n  files: [frames/*.tif]\nfit:\n  algorithm: newton\n",
        run={
            "name": "demo.zarr",
            "started": "2026-01-02T03:04:05Z",
            "seed": 1,
            "versions": {"numpy": np.__version__},
        },
        inputs=[{"name": "frame_0001.tif", "size": 524_288, "hash": "xxh3_128:0123456789abcdef"}],
        stages=[
            {"stage": "histogram", "state": "complete", "seconds": 12.3, "peak_memory_bytes": 512_000_000},
            {"stage": "fit", "state": "complete", "seconds": 45.6, "peak_memory_bytes": 256_000_000},
        ],
    )


def with_stability(shape: tuple[int, int], **changes: Any) -> ReportData:
    """The same with what 300 frames of independent pixels tell of its stability."""
    sums = sums_of(stack(np.random.default_rng(2), (300, *shape)))
    return replace(report_data(shape), stability=stability_figures(sums), **changes)
