"""From the sums over tiles and the whole maps to the arrays and numbers of the group ``ensemble``."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.effects.framework.compose import model_words
from pchem_pipeline.model.ensemble.components import (
    COMPONENT_CASES,
    EnsembleMoments,
    moment_errors,
    predicted_moments,
)
from pchem_pipeline.model.maps.pixels import PixelParameters
from pchem_pipeline.run.stage import StageContext
from pchem_pipeline.stages.ensemble.curves import components, curves, electron_numbers, error_rates
from pchem_pipeline.stages.ensemble.tile import EnsembleAxes, EnsembleTotals
from pchem_pipeline.stages.fit.fitted_model import fitted_effects
from pchem_pipeline.store.files import without_nan

if TYPE_CHECKING:
    from pchem_pipeline.store.run_store import RunStore
    from pchem_pipeline.store.tiles import Tile

__all__ = ["moment_rows", "pixels_of", "write_result"]


def write_result(
    context: StageContext,
    axes: EnsembleAxes,
    tiles: list[Tile],
    rows: list[int],
    frames: tuple[int, int] | None,
    truth: tuple[int, int, int] | None,
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
        truth: row, column and frame of the input's origin in the simulation, or None.
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
    arrays, facts = curves(totals, pixels, settings)
    numbers, electron_facts = electron_numbers(totals, pixels, settings)
    arrays |= numbers | components(pixels, numbers["electron_pmf"])
    true = _true_pixels(context, tiles, mask, truth)
    facts |= electron_facts | error_rates(totals, pixels, true)
    facts |= {
        "n_frames": None if frames is None else samples[0],
        "n_frames_all": None if frames is None else n_all,
        "first_frame": None if frames is None else frames[0],
        "n_pixels": totals.count("pixels"),
        "n_pixels_without_value": totals.count("excluded"),
        "tiles": len(tiles),
        "tiles_missing": context.n_keys - len(tiles),
    }
    if axes.grown:
        facts["model"] = model_words(fitted_effects(context.store))
    for name, values in arrays.items():
        context.store.write_array(f"ensemble/{name}", values)
    per_pixel: int | NDArray[Any] = samples[0]
    if frames is None:
        per_pixel = pixels_of(context.store, "histogram/counts", tiles).sum(axis=1, dtype=np.int64)[mask]
    context.store.set_attributes(
        "ensemble",
        without_nan(
            facts
            | {
                "moments": moment_rows(totals, pixels, per_pixel),
                "component_cases": COMPONENT_CASES,
                "missing": _missing(context, totals, frames),
            }
        ),
    )


def _true_pixels(
    context: StageContext,
    tiles: list[Tile],
    mask: NDArray[np.bool_],
    truth: tuple[int, int, int] | None,
) -> PixelParameters | None:
    """Return the true parameters of the pixels with a value, if they are all that made the frames."""
    simulated = context.config.simulate
    if truth is None or simulated is None or simulated.effects:
        return None
    y0, x0, _ = truth
    ny, nx = context.sensor.shape
    region = (slice(y0, y0 + ny), slice(x0, x0 + nx))
    maps = [pixels_of(context.store, f"truth/{name}", tiles, region)[mask] for name in PARAMETERS]
    true, known = PixelParameters.from_maps(maps)
    return true if known.all() else None


def pixels_of(
    store: RunStore, name: str, tiles: list[Tile], region: tuple[slice, slice] | None = None
) -> NDArray[Any]:
    """Return the pixels of a map that lie in some tiles, in the order of the map.

    Args:
        store: the run.
        name: an array whose first dimensions are (y, x).
        tiles: the tiles.
        region: part of the array that is the sensor; None: all of it.

    Returns:
        The values, pixels along the first axis.
    """
    whole = store.read(name, region)
    inside = np.zeros(whole.shape[:2], dtype=bool)
    for tile in tiles:
        inside[tile.region] = True
    return np.asarray(whole[inside])


def _row(context: StageContext, name: str, number: int) -> Any:
    return context.store.read(f"ensemble_tiles/{name}", (number, slice(None)))


def moment_rows(
    totals: EnsembleTotals, pixels: PixelParameters, per_pixel: int | NDArray[Any]
) -> list[dict[str, Any]]:
    """Return the moments of Appendix A, from the maps and from the data.

    Under a grown model mean and variance are those of its masses, and what its effects add to the variance
    that the parameters explain is a term of its own.

    Args:
        totals: the sums.
        pixels: the pixels.
        per_pixel: samples of each pixel.

    Returns:
        Rows ``{name, quantity, unit, predicted, observed, stderr}``; terms have nothing to be observed.
    """
    plain_ones, errors = predicted_moments(pixels), moment_errors(pixels, per_pixel)
    expected = _grown_moments(totals, plain_ones) if totals.axes.grown else plain_ones
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
    if totals.axes.grown:
        added = expected.variance - plain_ones.variance
        rows.insert(7, ("effects", "of which the effects of the model", "DN2", added, None, None))
    names = ("name", "quantity", "unit", "predicted", "observed", "stderr")
    return [dict(zip(names, row, strict=True)) for row in rows]


def _grown_moments(totals: EnsembleTotals, plain_ones: EnsembleMoments) -> EnsembleMoments:
    """Return the moments with those replaced that the effects of the model change."""
    mass, dn = totals.mean("pcd"), totals.axes.dn.dn
    whole = mass.sum()
    mean = float(mass @ dn / whole)
    nuced_mean, nuced_square = (
        float(totals.mean(f"nuced_predicted_{name}")[0] / whole) for name in ("sum", "sum_square")
    )
    return replace(
        plain_ones,
        mean=mean,
        variance=float(mass @ (dn - mean) ** 2 / whole),
        nuced_mean=nuced_mean,
        nuced_variance=nuced_square - nuced_mean**2,
    )


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
