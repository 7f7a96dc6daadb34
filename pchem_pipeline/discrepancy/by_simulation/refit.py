"""The parameter maps under a grown model, and how far the effects had moved them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.discrepancy.verdict import Discrepancy
from pchem_pipeline.effects.framework.added_exposure import AddedExposure, added_exposures
from pchem_pipeline.effects.framework.compose import marginal_model, pixel_maps
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
from pchem_pipeline.model.fit.grown import fit_grown, marginal_mass
from pchem_pipeline.model.histogram.count import histogram_frames

__all__ = ["Refit", "expected_codes", "refit_maps", "with_steady_exposure"]

_UNITS = {"quanta_exposure": "e-", "conversion_gain": "e-/DN", "bias": "DN", "read_noise_dn": "DN"}


@dataclass(frozen=True)
class Refit:
    """Maps fitted with effects.

    Attributes:
        maps: H, g, mu, sigma of the pixels themselves.
        moved: by parameter: median change against the maps before, the same in standard errors of a pixel,
            and the unit.
        covariance: of (H, g, mu, sigma) of each pixel, shape (y, x, 4, 4).
    """

    maps: PixelMaps
    moved: Mapping[str, Mapping[str, Any]]
    covariance: NDArray[np.float64]


def refit_maps(
    frames: NDArray[np.unsignedinteger],
    maps: PixelMaps,
    effects: Sequence[Effect],
    covariance: NDArray[np.float64],
    added: AddedExposure | None = None,
) -> Refit:
    """Fit the pixels of some frames with effects in their law.

    Args:
        frames: (frame, y, x), DN.
        maps: plain fit of the same frames; pixels that are not usable stay so.
        effects: of the grown model.
        covariance: of the plain fit, shape (y, x, 4, 4).
        added: exposure that the effects add to each pixel; None: it counts as part of H.

    Returns:
        New maps; the old ones where the effects cannot be fitted with.
    """
    shape = maps.usable.shape
    old = (maps.quanta_exposure, maps.conversion_gain, maps.bias, maps.read_noise_dn)
    flat = tuple(values.ravel() for values in old)
    try:
        law = marginal_model(effects, pixel_maps(flat, maps.usable), added)
    except ConfigError:
        return Refit(maps, {}, covariance)
    histograms = histogram_frames(frames)
    counts = histograms.counts.reshape(-1, histograms.counts.shape[2])
    fit = fit_grown(counts, histograms.origin.ravel(), flat, law, warm=True)
    new = (fit.quanta_exposure, fit.conversion_gain, fit.bias, fit.read_noise_dn)
    good = maps.usable.ravel() & np.isfinite(np.stack(new)).all(axis=0)
    exposure, gain, bias, noise = (np.where(good, values, np.nan).reshape(shape) for values in new)
    stderr = np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2)).T
    moved = {
        name: _change(after[good] - before[good], error[good], unit)
        for (name, unit), before, after, error in zip(_UNITS.items(), flat, new, stderr, strict=True)
    }
    new_maps = PixelMaps(exposure, gain, bias, noise, good.reshape(shape))
    return Refit(new_maps, moved, fit.covariance[:, :4, :4].reshape(*shape, 4, 4))


def with_steady_exposure(
    found: Discrepancy,
    plain: Evidence,
    stack: NDArray[np.unsignedinteger],
    numbers: NDArray[np.int64],
    seen: NDArray[np.int64],
) -> Discrepancy:
    """Return what was found with that taken out of H which the effects of the model add to single pixels.

    It is looked for in all frames, since those are fitted in the end, and nothing else is drawn from it. The
    replicates of the search are simulated with the pixels' mean exposure: which ones blink is drawn anew.

    Args:
        found: a result with the maps of the last refit.
        plain: evidence of the frames that were fitted.
        stack: (frame, y, x), DN.
        numbers: of its frames in the run, shape (frame,).
        seen: positions of the frames that were fitted.
    """
    assert plain.covariance is not None
    try:
        added = added_exposures(found.model, stack, numbers, plain.maps)
    except ConfigError as error:
        left_out = {**found.verdict.left_out, "added exposure": str(error)}
        return replace(found, verdict=found.verdict.model_copy(update={"left_out": left_out}))
    if added is None:
        return found
    fit = refit_maps(stack[seen], plain.maps, found.model, plain.covariance, added)
    return replace(found, maps=fit.maps, added=added)


def expected_codes(
    maps: PixelMaps, effects: Sequence[Effect], codes: NDArray[np.integer], n_samples: int
) -> NDArray[np.float64] | None:
    """Return the samples that a grown model expects at each code, all usable pixels together.

    Args:
        maps: parameters of the pixels under the model.
        effects: of the model.
        codes: successive DN, shape (c,).
        n_samples: of each pixel.

    Returns:
        Shape (c,); None where the effects give no law.
    """
    usable = maps.usable.ravel()
    every = (maps.quanta_exposure, maps.conversion_gain, maps.bias, maps.read_noise_dn)
    flat = tuple(values.ravel()[usable] for values in every)
    try:
        law = marginal_model(effects, pixel_maps(flat, usable[usable]))
    except ConfigError:
        return None
    return np.asarray(n_samples * marginal_mass(law, flat, codes, far_tails=False).sum(axis=0))


def _change(difference: NDArray[np.float64], stderr: NDArray[np.float64], unit: str) -> dict[str, Any]:
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = difference / stderr
    finite = ratio[np.isfinite(ratio)]
    return {
        "median": float(np.median(difference)) if difference.size else 0.0,
        "in_stderr": float(np.median(finite)) if finite.size else 0.0,
        "unit": unit,
    }
