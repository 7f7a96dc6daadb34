"""The parameter maps under a model with effects, and a sensor to simulate whose fit comes out like them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.effects.framework.added_exposure import AddedExposure
from pchem_pipeline.effects.framework.compose import PixelPlaces, pixel_maps, sample_law
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.histogram.count import histogram_frames
from pchem_pipeline.model.law.mass import sample_mass

__all__ = ["Refit", "equivalent_sensor", "expected_codes", "refit_maps"]

FloatArray = NDArray[np.float64]

_UNITS = {"quanta_exposure": "e-", "conversion_gain": "e-/DN", "bias": "DN", "read_noise_dn": "DN"}

_FEWEST = 100  # pixels from which a covariance is worth something
_FAR = 4.0  # robust standard deviations: pixels beyond say nothing about how the others scatter
_MAD = 1.4826
# scatter beyond the errors in any direction, in units of the errors' variance, below which it is chance
_CHANCE = 0.05


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
    numbers: NDArray[np.int64] | None = None,
) -> Refit:
    """Fit the pixels of some frames with effects in their law.

    Args:
        frames: (frame, y, x), DN.
        maps: plain fit of the same frames; pixels that are not usable stay so.
        effects: of the model.
        covariance: of the plain fit, shape (y, x, 4, 4).
        added: exposure that the effects add to each pixel; None: it counts as part of H.
        numbers: of the frames in the run, shape (frame,); None: 0, 1, 2, ...

    Returns:
        New maps; the old ones where the effects cannot be fitted with.
    """
    shape = maps.usable.shape
    old = (maps.quanta_exposure, maps.conversion_gain, maps.bias, maps.read_noise_dn)
    flat = tuple(values.ravel() for values in old)
    try:
        numbers = np.arange(frames.shape[0]) if numbers is None else numbers
        places = PixelPlaces.of_block(None, (shape[0], shape[1]), numbers)
        law = sample_law(effects, pixel_maps(flat, maps.usable), added, places)
    except ConfigError:
        return Refit(maps, {}, covariance)
    histograms = histogram_frames(frames)
    counts = histograms.counts.reshape(-1, histograms.counts.shape[2])
    near = np.stack(flat, axis=1)
    fit = fit_histograms(counts, histograms.origin.ravel(), law=law, start=near)
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


def expected_codes(
    maps: PixelMaps, effects: Sequence[Effect], codes: NDArray[np.integer], numbers: NDArray[np.int64]
) -> NDArray[np.float64] | None:
    """Return the samples that a model expects at each code, all usable pixels together.

    Args:
        maps: parameters of the pixels under the model.
        effects: of the model.
        codes: successive DN, shape (c,).
        numbers: of the frames in the run, one sample of each pixel in each.

    Returns:
        Shape (c,); None where the effects give no law.
    """
    usable = maps.usable.ravel()
    every = (maps.quanta_exposure, maps.conversion_gain, maps.bias, maps.read_noise_dn)
    flat = tuple(values.ravel()[usable] for values in every)
    try:
        shape = maps.usable.shape
        places = PixelPlaces.of_block(None, (shape[0], shape[1]), numbers).of(usable)
        law = sample_law(effects, pixel_maps(flat, usable[usable]), places=places)
    except ConfigError:
        return None
    return np.asarray(numbers.size * sample_mass(law, flat, codes, far_tails=False).sum(axis=0))


def _change(difference: NDArray[np.float64], stderr: NDArray[np.float64], unit: str) -> dict[str, Any]:
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = difference / stderr
    finite = ratio[np.isfinite(ratio)]
    return {
        "median": float(np.median(difference)) if difference.size else 0.0,
        "in_stderr": float(np.median(finite)) if finite.size else 0.0,
        "unit": unit,
    }


def equivalent_sensor(maps: PixelMaps, covariance: FloatArray) -> PixelMaps:
    """Return maps that scatter as the true parameters do, given fitted ones.

    Fitted parameters scatter more than the true ones: by their errors. A simulation that took them for the
    truth would, fitted again, scatter by those errors twice, and every statistic that looks at how pixels
    differ would deviate without any effect, the more the worse a pixel's peaks are resolved.

    In ``(log H, log g, mu, log sigma)``, where errors are nearly Gaussian, the covariance over the pixels is
    ``C = T + mean(E_i)`` with the truth's T and the errors' E_i. Each pixel is moved by the map of optimal
    transport from N(m, T + E_i) to N(m, T), which is linear and moves no pixel further than needed (Dowson
    and Landau 1982). Where the errors are small against the scatter, nothing changes.

    Args:
        maps: fitted.
        covariance: of (H, g, mu, sigma), shape (y, x, 4, 4); a pixel without a finite one stays.

    Returns:
        Maps with the same usable pixels.
    """
    values = np.stack(
        [np.log(maps.quanta_exposure), np.log(maps.conversion_gain), maps.bias, np.log(maps.read_noise_dn)],
        axis=-1,
    )
    slope = np.stack(
        [
            1.0 / maps.quanta_exposure,
            1.0 / maps.conversion_gain,
            np.ones(maps.bias.shape),
            1.0 / maps.read_noise_dn,
        ],
        axis=-1,
    )
    error = covariance * slope[..., :, None] * slope[..., None, :]
    known = maps.usable & np.isfinite(error).all(axis=(-2, -1)) & np.isfinite(values).all(axis=-1)
    if known.sum() < _FEWEST:
        return maps
    x, e = values[known], error[known]
    centre = np.median(x, axis=0)
    off = x - centre
    usual = (np.abs(off) < _FAR * _MAD * np.median(np.abs(off), axis=0)).all(axis=1)
    typical = e[usual].mean(axis=0)
    truth = _scatter_beyond(np.cov(off[usual], rowvar=False), typical)
    moved = np.einsum("nij,nj->ni", _transport(truth, e), off)
    x = np.where(usual[:, None], centre + moved, x)
    found = values.copy()
    found[known] = x
    return PixelMaps(
        np.exp(found[..., 0]), np.exp(found[..., 1]), found[..., 2], np.exp(found[..., 3]), maps.usable
    )


def _scatter_beyond(scatter: FloatArray, error: FloatArray) -> FloatArray:
    """Return what is left of a covariance when that of the errors is taken off, at least nothing."""
    root = np.linalg.cholesky(error)
    white = np.linalg.solve(root, np.linalg.solve(root, scatter).T)
    sizes, axes = np.linalg.eigh((white + white.T) / 2.0)
    left = np.where(sizes > 1.0 + _CHANCE, sizes - 1.0, 0.0)
    factor = root @ axes
    return np.asarray((factor * left) @ factor.T)


def _transport(truth: FloatArray, error: FloatArray) -> FloatArray:
    """Return the optimal transport from N(0, T + E_i) to N(0, T) for each E_i, shape (n, 4, 4)."""
    scale = np.sqrt(np.diagonal(error, axis1=1, axis2=2).mean(axis=0))
    truth, error = truth / np.outer(scale, scale), error / np.outer(scale, scale)
    root = _power(truth, 0.5)
    middle = _power(root @ (truth + error) @ root, -0.5)
    return np.asarray(root @ middle @ root * scale[:, None] / scale[None, :])


def _power(matrix: FloatArray, exponent: float) -> FloatArray:
    """Return a power of symmetric matrices without negative eigenvalues; directions without size stay so."""
    sizes, axes = np.linalg.eigh(matrix)
    least = 1e-12 * sizes[..., -1:]
    powers = np.where(sizes > least, np.maximum(sizes, np.maximum(least, 1e-300)) ** exponent, 0.0)
    return np.asarray((axes * powers[..., None, :]) @ np.swapaxes(axes, -1, -2))
