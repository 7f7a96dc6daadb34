"""Stage ``joint``: several exposures of the same pixels fitted together, their line, and the maps."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.variables import VARIABLES, variables_of
from pchem_pipeline.model.fit.joint import fit_joint
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import FAILED, MEANINGS, FitStatus
from pchem_pipeline.model.maps.joint_maps import LINE_MAPS, SHARED_MAPS, joint_maps
from pchem_pipeline.model.maps.maps import status_counts, summarise
from pchem_pipeline.run.stage import StageContext, open_store
from pchem_pipeline.stages.joint.samples import Sample, read_samples
from pchem_pipeline.store.files import without_nan
from pchem_pipeline.store.run_store import RunStore

if TYPE_CHECKING:
    from pchem_pipeline.store.tiles import Tile

__all__ = ["joint_tile", "run"]

_HISTOGRAM = ("counts", "origin", "under", "over")
_LINE = ("linearity_residual", "linearity_residual_stderr", "linearity_chi2", "linearity_p")
_SUSPICIOUS_SHARE = 0.2  # of pixels in poor agreement, from which the samples themselves are in doubt


def joint_tile(
    histograms: Sequence[Mapping[str, NDArray[Any]]],
    samples: Sequence[Sample],
    against: str,
    settings: FitSettings,
    adc_limits: tuple[int, int] | None,
) -> dict[str, NDArray[Any]]:
    """Return the arrays of the groups ``joint`` and ``maps`` of a tile, by path.

    Args:
        histograms: ``counts`` (y, x, bin), ``origin``, ``under`` and ``over`` (y, x) of each sample.
        samples: what they are.
        against: integration_time, light_level or none.
        settings: of the fit.
        adc_limits: first and last code of the ADC, DN, or None where they are not known.
    """
    shape = histograms[0]["counts"].shape[:2]
    outside = sum(each["under"].astype(np.int64) + each["over"] for each in histograms)
    fit = fit_joint(
        [each["counts"].reshape(-1, each["counts"].shape[2]) for each in histograms],
        [each["origin"].ravel() for each in histograms],
        dark=[sample.kind == "bias" for sample in samples],
        settings=settings,
        adc_limits=adc_limits,
        outside=np.ravel(outside),
    )
    exposed = np.array([sample.kind != "bias" for sample in samples])
    x = None
    if against != "none":
        x = np.array([np.nan if sample.x is None else sample.x for sample in samples])
    found = joint_maps(fit, x, against, exposed)
    arrays: dict[str, NDArray[Any]] = {}
    for group, content in (("joint", found.joint), ("maps", found.maps)):
        for name, values in content.items():
            path = f"{group}/{name}"
            if VARIABLES[path].dims[0] == "sample":
                arrays[path] = np.ascontiguousarray(values.T).reshape(-1, *shape)
            else:
                arrays[path] = values.reshape(shape + values.shape[1:])
    return arrays


def run(context: StageContext) -> None:
    """Fit every tile, and summarise.

    Raises:
        StoreError: histograms of a sample are missing, or the store refuses.
    """
    samples, against = read_samples(context.store)
    _create(context, len(samples), against)
    settings = context.config.fit
    if not context.executor.shares_memory:
        _compile(samples, settings)
    task = functools.partial(
        _do_tile,
        store=context.store.path,
        samples=samples,
        against=against,
        settings=settings,
        adc_limits=context.adc_limits,
    )
    done = context.run_units(context.tiles(), task)
    pixels, poor = (sum(tile.get(key, 0) for tile in done.values()) for key in ("pixels", "poor"))
    if poor > _SUSPICIOUS_SHARE * pixels:
        context.note(
            f"{poor / pixels:.0%} of the pixels do not agree with one g, mu and sigma for all samples: are "
            "they from one sensor, with the same gain, offset and temperature?"
        )
    _summarise(context, against)


def _create(context: StageContext, n_samples: int, against: str) -> None:
    """Make all arrays of the stage."""
    tile, shape = context.config.run.tile, context.sensor.shape
    for variable in variables_of("joint"):
        if variable.name in _LINE and against == "none":
            continue
        attributes: dict[str, Any] = {}
        if variable.name == "fit_status":
            attributes = {
                "flag_masks": [int(bit) for bit in MEANINGS],
                "flag_meanings": " ".join(str(bit.name).lower() for bit in MEANINGS),
            }
        if variable.dims[0] == "sample":
            context.create(variable.path, (n_samples, *shape), chunks=(n_samples, tile, tile), **attributes)
        else:
            rest = (n_samples + 3,) * (len(variable.dims) - 2)
            context.create(variable.path, (*shape, *rest), chunks=(tile, tile, *rest), **attributes)
    names = (*SHARED_MAPS, *LINE_MAPS.get(against, ()))
    context.create_maps([f"maps/{name}" for each in names for name in (each, f"{each}_stderr")])
    context.create_maps(["maps/quality"])


def _compile(samples: Sequence[Sample], settings: FitSettings) -> None:
    """Compile the kernels once, into the cache, before other processes do it all at the same time."""
    histogram = {name: np.zeros((1, 1), np.int32) for name in _HISTOGRAM[1:]}
    histogram["counts"] = np.ones((1, 1, 8), np.uint32)
    joint_tile([histogram] * len(samples), samples, "none", settings, None)


def _do_tile(
    tile: Tile,
    *,
    store: Path,
    samples: Sequence[Sample],
    against: str,
    settings: FitSettings,
    adc_limits: tuple[int, int] | None,
) -> dict[str, Any]:
    """Fit one tile; the summary counts its pixels."""
    histograms = []
    for sample in samples:
        run_store = RunStore.open(Path(sample.store))
        histograms.append({name: run_store.read(f"histogram/{name}", tile.region) for name in _HISTOGRAM})
    arrays = joint_tile(histograms, samples, against, settings, adc_limits)
    target = open_store(store)
    for path, array in arrays.items():
        region = (slice(None), *tile.region) if VARIABLES[path].dims[0] == "sample" else tile.region
        target.write(path, region, array)
    words = arrays["joint/fit_status"]
    bits = {"failed": int(FAILED), "poor": int(FitStatus.POOR_FIT)}
    counts = {name: int(np.count_nonzero(words & np.uint16(bit))) for name, bit in bits.items()}
    return {"pixels": int(words.size), **counts}


def _summarise(context: StageContext, against: str) -> None:
    """Keep the summaries of the maps and of each sample in the attributes of the groups."""
    settings, store = context.config.maps, context.store
    found: dict[str, Any] = {}
    for name in (*SHARED_MAPS, *LINE_MAPS.get(against, ())):
        summary = summarise(
            store.read(f"maps/{name}"),
            percentiles=settings.percentiles,
            outlier_sigmas=settings.outlier_sigmas,
        )
        percentiles = {f"{p:g}": value for p, value in summary.percentiles.items()}
        found[name] = without_nan(asdict(summary) | {"percentiles": percentiles})
    status = status_counts(store.read("joint/fit_status"))
    store.set_attributes("maps", {"summary": found, "fit_status": status})
