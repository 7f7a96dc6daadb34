"""From the sums over tiles and the whole maps to the arrays and numbers of the group ``ensemble``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.agreement import central_window, noise_floor, rmse
from pchem_pipeline.model.components import (
    COMPONENT_CASES,
    component_widths,
    moment_errors,
    predicted_moments,
)
from pchem_pipeline.model.ensemble import electron_pmf
from pchem_pipeline.model.ensemble_binned import (
    HistogramChoice,
    electron_pmf_binned,
    epcd_dependent,
    epcd_independent,
    nuced_dependent,
    nuced_independent,
)
from pchem_pipeline.model.ensemble_settings import EnsembleSettings
from pchem_pipeline.model.pixels import FloatArray, PixelParameters
from pchem_pipeline.stages.base import StageContext
from pchem_pipeline.stages.ensemble_tile import EnsembleAxes
from pchem_pipeline.stages.plain import plain
from pchem_pipeline.variables import PARAMETERS

if TYPE_CHECKING:
    from pchem_pipeline.store.run_store import RunStore
    from pchem_pipeline.store.tiles import Tile

__all__ = ["EnsembleTotals", "moment_rows", "pixels_of", "write_result"]

#: Components are shown up to the electron number whose mass is above this.
_SMALLEST_COMPONENT = 1e-4


@dataclass(frozen=True)
class EnsembleTotals:
    """The sums over all tiles.

    Attributes:
        axes: axes of the ensemble.
        integers: total of the rows of integers.
        floats: total of the rows of floats.
        samples: chosen frames of a pixel, all frames of a pixel; (1, 1) for ready-made histograms.
    """

    axes: EnsembleAxes
    integers: NDArray[np.int64]
    floats: FloatArray
    samples: tuple[int, int]

    def count(self, name: str) -> int:
        """Return a tally that is one number."""
        return int(self.integers[self.axes.integers[name]][0])

    def counts(self, name: str) -> NDArray[np.int64]:
        """Return a tally along an axis."""
        return self.integers[self.axes.integers[name]]

    def mean(self, name: str) -> FloatArray:
        """Return the mean over the pixels of a sum."""
        return self.floats[self.axes.floats[name]] / self.count("pixels")

    def variance(self, name: str) -> FloatArray:
        """Return the variance of the mean over the pixels, from the sum of the pixels' variances."""
        return self.mean(name) / self.count("pixels")


def write_result(
    context: StageContext,
    axes: EnsembleAxes,
    tiles: list[Tile],
    rows: list[int],
    frames: tuple[int, int] | None,
) -> None:
    """Write the arrays of the group ``ensemble`` and its numbers (attributes of the group).

    The attributes are the facts (``rmse``, counts, error rates), ``moments`` (rows of Appendix A),
    ``component_cases`` (parameters held constant, a list for each row of ``component_variance``) and
    ``missing`` (part to reason).

    Args:
        context: of the stage.
        axes: axes of the ensemble.
        tiles: the finished tiles.
        rows: their rows in the sums of the tiles.
        frames: first and end of the chosen frames, or None for ready-made histograms.
    """
    n_all = context.sensor.n_frames
    samples = (1, 1) if frames is None else (frames[1] - frames[0], n_all)
    totals = EnsembleTotals(
        axes,
        sum(_row(context, "integers", number) for number in rows),
        sum(_row(context, "floats", number) for number in rows),
        samples,
    )
    maps = [pixels_of(context.store, f"fit/{name}", tiles) for name in PARAMETERS]
    pixels, mask = PixelParameters.from_maps(maps)
    settings = context.config.ensemble
    arrays, facts = _curves(totals, pixels, settings)
    numbers, electron_facts = _electrons(totals, pixels, settings)
    arrays |= numbers | _components(pixels, numbers["electron_pmf"])
    facts |= electron_facts | {
        "n_frames": None if frames is None else samples[0],
        "n_frames_all": None if frames is None else n_all,
        "first_frame": None if frames is None else frames[0],
        "n_pixels": totals.count("pixels"),
        "n_pixels_without_value": totals.count("excluded"),
        "tiles": len(tiles),
        "tiles_missing": context.n_keys - len(tiles),
    }
    for name, values in arrays.items():
        context.store.write_array(f"ensemble/{name}", values)
    per_pixel: int | NDArray[Any] = samples[0]
    if frames is None:
        per_pixel = pixels_of(context.store, "histogram/counts", tiles).sum(axis=1, dtype=np.int64)[mask]
    context.store.set_attributes(
        "ensemble",
        plain(
            facts
            | {
                "moments": moment_rows(totals, pixels, per_pixel),
                "component_cases": COMPONENT_CASES,
                "missing": _missing(context, totals, frames),
            }
        ),
    )


def pixels_of(store: RunStore, name: str, tiles: list[Tile]) -> NDArray[Any]:
    """Return the pixels of a map that lie in some tiles, in the order of the map.

    Args:
        store: the run.
        name: an array whose first dimensions are (y, x).
        tiles: the tiles.

    Returns:
        The values, pixels along the first axis.
    """
    whole = store.read(name)
    inside = np.zeros(whole.shape[:2], dtype=bool)
    for tile in tiles:
        inside[tile.region] = True
    return np.asarray(whole[inside])


def _row(context: StageContext, name: str, number: int) -> Any:
    return context.store.read(f"ensemble_tiles/{name}", (number, slice(None)))


def _choice(settings: EnsembleSettings) -> HistogramChoice:
    return HistogramChoice(settings.parameter_bins, settings.parameter_range, settings.cell_representative)


def _curves(
    totals: EnsembleTotals, pixels: PixelParameters, settings: EnsembleSettings
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the densities, raw and NUCed, and how well they agree with the data."""
    axes, choice = totals.axes, _choice(settings)
    width = axes.nuced.width
    arrays: dict[str, NDArray[Any]] = {
        "dn": axes.dn.dn.astype(np.int32),
        "counts": totals.counts("counts"),
        "counts_all": totals.counts("counts_all"),
        "density": totals.mean("share"),
        "density_all": totals.mean("share_all"),
        "epcd_exact": totals.mean("pcd"),
        "epcd_dependent": epcd_dependent(pixels, axes.dn, choice),
        "epcd_independent": epcd_independent(pixels, axes.dn, choice),
        "electrons": axes.nuced.electrons,
        "nuced_counts": totals.counts("nuced_counts"),
        "nuced_density": totals.mean("nuced_share") / width,
        "nuced_exact": totals.mean("nuced") / width,
        "nuced_dependent": nuced_dependent(pixels, axes.nuced, choice),
        "nuced_independent": nuced_independent(pixels, axes.nuced, choice),
    }
    window = central_window(arrays["counts"], settings.rmse_coverage)
    nuced_window = central_window(arrays["nuced_counts"], settings.rmse_coverage)
    ways = ("exact", "dependent", "independent")
    found = {f"epcd_{way}": rmse(arrays["density"], arrays[f"epcd_{way}"], window) for way in ways}
    found["noise_floor"] = noise_floor(totals.variance("pcd_variance"), window)
    nuced = {
        f"nuced_{way}": rmse(arrays["nuced_density"], arrays[f"nuced_{way}"], nuced_window) for way in ways
    }
    nuced["nuced_noise_floor"] = noise_floor(totals.variance("nuced_variance") / width**2, nuced_window)
    found_all = {f"epcd_{way}": rmse(arrays["density_all"], arrays[f"epcd_{way}"], window) for way in ways}
    n, n_all = totals.samples
    found_all["noise_floor"] = found["noise_floor"] * math.sqrt(n / n_all)
    ends = [window.start, window.stop - 1], [nuced_window.start, nuced_window.stop - 1]
    facts = {
        "rmse": found | nuced,
        "rmse_all_frames": found_all,
        "rmse_window_dn": [int(arrays["dn"][i]) for i in ends[0]],
        "rmse_window_electrons": [float(arrays["electrons"][i]) for i in ends[1]],
        "nuced_bin_width": width,
        "samples_beyond_dn": totals.count("outside"),
        "samples_beyond_dn_all_frames": totals.count("outside_all"),
        "samples_beyond_electrons": totals.count("nuced_outside"),
    }
    return arrays, facts


def _electrons(
    totals: EnsembleTotals, pixels: PixelParameters, settings: EnsembleSettings
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Return the electron numbers, observed and predicted, and how often they are wrong."""
    n_k = totals.axes.n_k
    arrays: dict[str, NDArray[Any]] = {
        "k": np.arange(n_k, dtype=np.int32),
        "electron_counts": totals.counts("electron_counts"),
        "electron_mass": totals.mean("electron_share"),
        "electron_pmf": electron_pmf(pixels.quanta_exposure, n_k),
        "electron_pmf_binned": electron_pmf_binned(pixels.quanta_exposure, n_k, _choice(settings)),
        "electron_pmf_map": totals.mean("electron_expected"),
    }
    mass = arrays["electron_pmf_map"]
    n_samples = max(int(arrays["electron_counts"].sum()), 1)
    facts: dict[str, Any] = {
        "expected_error_rate": float(totals.mean("error")[0]),
        "electrons_beyond": totals.count("electrons_beyond"),
        "electron_rmse": {
            name: rmse(arrays["electron_mass"], arrays[f"electron_{name}"])
            for name in ("pmf", "pmf_binned", "pmf_map")
        }
        | {"noise_floor": noise_floor(mass * (1.0 - mass) / n_samples)},
    }
    if compared := totals.count("compared"):
        sizes = totals.counts("error_sizes")
        frames = compared / totals.count("pixels")
        facts |= {
            "error_rate": 1.0 - int(sizes[0]) / compared,
            "error_rate_stderr": math.sqrt(float(totals.variance("error_variance")[0]) / frames),
            "error_sizes": [int(n) for n in sizes],
            "mean_error": totals.count("signed_error") / compared,
            "samples_compared": compared,
        }
    return arrays, facts


def _components(pixels: PixelParameters, mass: FloatArray) -> dict[str, NDArray[Any]]:
    """Return means and widths of the components that matter."""
    shown = max(2, int(np.flatnonzero(mass >= _SMALLEST_COMPONENT)[-1]) + 1)
    widths = component_widths(pixels, min(shown, mass.size))
    return {
        "component_mean": widths.mean,
        "component_variance": widths.variance,
        "nuced_component_variance": widths.nuced_variance,
    }


def moment_rows(
    totals: EnsembleTotals, pixels: PixelParameters, per_pixel: int | NDArray[Any]
) -> list[dict[str, Any]]:
    """Return the moments of Appendix A, from the maps and from the data.

    Args:
        totals: the sums.
        pixels: the pixels.
        per_pixel: samples of each pixel.

    Returns:
        Rows ``{name, quantity, unit, predicted, observed, stderr}``; terms have nothing to be observed.
    """
    expected, errors = predicted_moments(pixels), moment_errors(pixels, per_pixel)
    share, dn = totals.mean("share"), totals.axes.dn.dn
    mean = float(share @ dn / share.sum())
    variance = float(share @ (dn - mean) ** 2 / share.sum())
    nuced_mean, nuced_square = (
        float(totals.mean(name)[0] / share.sum()) for name in ("nuced_sum", "nuced_sum_square")
    )
    rows: list[tuple[str, str, str, float, float | None, float | None]] = [
        ("mean", "mean of the raw ensemble", "DN", expected.mean, mean, errors.mean),
        ("variance", "variance of the raw ensemble", "DN2", expected.variance, variance, errors.variance),
        ("variance_of_bias", "of which variance of the bias", "DN2", expected.variance_of_bias, None, None),
        ("variance_of_signal", "of which variance of H/g", "DN2", expected.variance_of_signal, None, None),
        ("mean_read_variance", "of which read noise", "DN2", expected.mean_read_variance, None, None),
        ("mean_shot_variance", "of which shot noise", "DN2", expected.mean_shot_variance, None, None),
        (
            "bias_signal_covariance",
            "of which twice the covariance of bias and H/g",
            "DN2",
            2.0 * expected.bias_signal_covariance,
            None,
            None,
        ),
        (
            "nuced_mean",
            "mean of the NUCed ensemble",
            "e-",
            expected.nuced_mean,
            nuced_mean,
            errors.nuced_mean,
        ),
        (
            "nuced_variance",
            "variance of the NUCed ensemble",
            "e-2",
            expected.nuced_variance,
            nuced_square - nuced_mean**2,
            errors.nuced_variance,
        ),
    ]
    names = ("name", "quantity", "unit", "predicted", "observed", "stderr")
    return [dict(zip(names, row, strict=True)) for row in rows]


def _missing(context: StageContext, totals: EnsembleTotals, frames: tuple[int, int] | None) -> dict[str, str]:
    """Say which parts of the ensemble this run does not have, and why."""
    missing: dict[str, str] = {}
    if frames is None:
        missing["frames"] = "the input is histograms: no choice of frames; the ensemble is of all samples"
    if totals.count("compared") == 0:
        missing["truth"] = (
            "the true electron numbers are not known"
            if context.config.simulate is None
            else "no true electron numbers were kept for these frames"
        )
    return missing
