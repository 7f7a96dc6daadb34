"""The parameter maps under a model with effects, and sensors to simulate whose fits come out like them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.base.errors import ConfigError, PchEmError
from pchem_pipeline.discrepancy.by_simulation.sensor.population import (
    MANY_MISTAKEN,
    Posterior,
    clipped_mean,
    posterior_of,
    posterior_of_estimates,
    shrinkage_bias,
)
from pchem_pipeline.discrepancy.observe.observe import MOST_OUTSIDE
from pchem_pipeline.discrepancy.verdict import Moved
from pchem_pipeline.effects.framework.compose import AddedExposure, PixelPlaces, pixel_maps, sample_law
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.result import FitResult
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.shared import to_theta
from pchem_pipeline.model.histogram.count import histogram_frames
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.replaced_samples import ReplacedSamples
from pchem_pipeline.model.law.sample_law import SampleLaw

# of the parameters of a pixel, in their order
_UNITS = {"quanta_exposure": "e-", "conversion_gain": "e-/DN", "bias": "DN", "read_noise_dn": "DN"}

_LEAST_LEFT = 0.2  # of the fitted exposure, or variance of the read noise, without what effects add to it
_FEWEST_CODES = 3  # that a pixel must have shown
# near their plain fit pixels arrive in some ten evaluations, or hardly ever; a fit within 0.005 of its error
_SEARCHED = FitSettings(max_iterations=60, tolerance=1e-5)
# pixels that are fitted before all others, and the share of them that a law must fit
_PROBED, _LEAST_FITTED = 24, 0.25
# share of them that another start must fit clearly better for all pixels to be fitted from it
_OFTEN_BETTER = 0.05
#: Of each electron number in a law: with as many a thousand pixels take minutes from one start.
_MOST_COMPONENTS = 64
# nats by which a bias an electron off must be likelier under a law that the plain fit did not know
CLEARLY = 4.0
# where all samples count, whatever the law expects
_CONTEST = _SEARCHED.model_copy(update={"tail_guard": 0.0})
# lowest samples of a pixel that may have led it astray, and e- below the next one
_FEW_SAMPLES, _FAR_BELOW = 3, 0.5


class NotFittedError(PchEmError):
    """Hardly a pixel can be fitted with a law: its effects, so strong, are not in the data."""


@dataclass(frozen=True)
class Refit:
    """Maps fitted with effects.

    Attributes:
        maps: H, g, mu, sigma of the pixels themselves.
        moved: by parameter: change against the maps before, of the pixels on which the effects act.
        covariance: of (H, g, mu, sigma) of each pixel, shape (y, x, 4, 4).
        components: of the law of a sample, with all effects.
        evaluated: codes at which its fits evaluated the likelihood, see `FitResult.evaluated`.
        added: exposure that the effects add to H of each pixel, (j, y, x); None: it counts as part of H.
    """

    maps: PixelMaps
    moved: Mapping[str, Moved]
    covariance: FloatArray
    components: int = 1
    evaluated: float = 0.0
    added: AddedExposure | None = None


def refit_maps(
    frames: NDArray[np.unsignedinteger],
    maps: PixelMaps,
    effects: Sequence[Effect],
    covariance: FloatArray,
    added: AddedExposure | None = None,
    numbers: IntArray | None = None,
) -> Refit:
    """Fit the pixels of some frames with effects in their law; if these give none, the old maps stay.

    Args:
        frames: (frame, y, x), DN.
        maps: plain fit of the same frames; pixels that are not usable stay so.
        effects: of the model.
        covariance: of the plain fit, shape (y, x, 4, 4).
        added: exposure that the effects add to each pixel; None: it counts as part of H.
        numbers: of the frames in the run, shape (frame,); None: 0, 1, 2, ...

    Raises:
        NotFittedError: almost no pixel can be fitted, or each would take seconds.
    """
    shape = maps.usable.shape
    plain = maps.flat
    try:
        numbers = np.arange(frames.shape[0]) if numbers is None else numbers
        law = sample_law(effects, pixel_maps(plain.maps, maps.usable), added, _places(maps, numbers))
    except ConfigError:
        return Refit(maps, {}, covariance)
    if law.components > _MOST_COMPONENTS:
        raise NotFittedError(f"each peak would have {law.components} components")
    histograms = histogram_frames(frames)
    counts = histograms.counts.reshape(-1, histograms.counts.shape[2])
    near = plain.columns
    if added is not None:
        mean = (added.flat().exposure_e * added.flat().weight).sum(axis=0)
        near[:, 0] = np.maximum(near[:, 0] - mean, _LEAST_LEFT * near[:, 0])

    evaluated = 0.0

    def fitted(some: NDArray[np.intp], start: FloatArray = near) -> FitResult:
        nonlocal evaluated
        origin = histograms.origin.ravel()[some]
        found = fit_histograms(counts[some], origin, law=law.of(some), start=start[some], settings=_SEARCHED)
        evaluated += found.evaluated(counts[some])
        return found

    acted_on = _acted_on(effects, (shape[0], shape[1])).ravel()
    # an effect of a part of the sensor leads no other pixels astray
    known = np.flatnonzero(plain.usable & acted_on)
    known = known if known.size else np.flatnonzero(plain.usable)
    probed = known[:: max(1, known.size // _PROBED)]
    probe = fitted(probed)
    if np.mean(np.isfinite(probe.bias)) < _LEAST_FITTED:
        raise NotFittedError("almost no pixel can be fitted with it")
    fit = fitted(np.arange(len(near)))
    shifted = (shift_bias_by_electrons(near, electrons) for electrons in (-1.0, 1.0))
    for start in (*shifted, _of_usual_noise(near, fit.columns)):
        if np.mean(_likelier(fitted(probed, start), probe)) > _OFTEN_BETTER:
            other = fitted(known, start)
            better = np.flatnonzero(_likelier(other, fit.of(known)))
            fit = fit.with_pixels(known[better], other.of(better))
    astray, start = multistart(counts, histograms.origin.ravel(), law, fit.columns)
    inside = plain.usable[astray] & acted_on[astray]
    if inside.any():
        fit = fit.with_pixels(astray[inside], fitted(astray[inside], start))
    good = plain.usable & np.isfinite(fit.columns).all(axis=1)
    stderr = np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2))
    inside = good & acted_on
    moved = changes(plain.columns[inside], fit.columns[inside], stderr[inside])
    new_maps = PixelMaps.known(fit.maps, good.reshape(shape))
    covariance = fit.covariance[:, :4, :4].reshape(*shape, 4, 4)
    return Refit(new_maps, moved, covariance, law.components, evaluated, added)


def _acted_on(effects: Sequence[Effect], shape: tuple[int, int]) -> BoolArray:
    """Return the pixels, (y, x), on which any of the effects acts; all where there is none."""
    regions = [effect.region for effect in effects]
    inside = [np.ones(shape, np.bool_) if region is None else region.mask(shape) for region in regions]
    return np.asarray(np.logical_or.reduce(inside)) if inside else np.ones(shape, np.bool_)


def shift_bias_by_electrons(start: FloatArray, electrons: float) -> FloatArray:
    """Return parameters (n, 4) whose bias is lower, and exposure higher, by so many electrons."""
    off = start.copy()
    off[:, 0] = np.maximum(start[:, 0] + electrons, _LEAST_LEFT * start[:, 0])
    off[:, 2] -= electrons / start[:, 1]
    return off


def multistart(
    counts: NDArray[Any], origin: NDArray[np.integer], law: SampleLaw, now: FloatArray
) -> tuple[NDArray[np.intp], FloatArray]:
    """Find pixels whose bias a few samples below all others led astray, and what is likelier under a law.

    The PCD has no place for a sample far below its peaks: a fit lowers the bias by electrons for it. Pixels
    with some are fitted anew, begun at the fit with the tail guard and an electron beside that.

    Args:
        counts: histograms, (n, B).
        origin: DN of bin 0, (n,).
        law: of the samples of these pixels.
        now: (H, g, mu, sigma) as fitted with it, (n, 4).

    Returns:
        Those that are clearly likelier elsewhere, (m,); and all parameters, theirs from there, (n, 4).
    """
    found, seen = now.copy(), np.cumsum(counts, axis=1)
    lowest = np.stack([np.argmax(seen > k, axis=1) for k in range(_FEW_SAMPLES + 1)], axis=1)
    apart = np.diff(lowest, axis=1).max(axis=1) * now[:, 1]
    some = np.flatnonzero(apart > _FAR_BELOW)
    if not some.size:
        return some, found
    guarded = fit_histograms(counts[some], origin[some]).columns

    def fitted(start: FloatArray) -> FitResult:
        return fit_histograms(counts[some], origin[some], law=law.of(some), start=start, settings=_CONTEST)

    first = best = fitted(now[some])
    for start in (guarded, shift_bias_by_electrons(guarded, -1.0), shift_bias_by_electrons(guarded, 1.0)):
        fit = fitted(start)
        better = np.flatnonzero(fit.log_likelihood > best.log_likelihood)
        best = best.with_pixels(better, fit.of(better))
    moved = _likelier(best, first)
    found[some[moved]] = best.columns[moved]
    return some[moved], found


def _of_usual_noise(near: FloatArray, fitted: FloatArray) -> FloatArray:
    """Return parameters (n, 4) with the gain and the read noise of most pixels, bias and mean of each."""
    found = np.where(np.isfinite(fitted), fitted, near)
    found[:, 0] *= np.nanmedian(fitted[:, 1]) / found[:, 1]
    found[:, [1, 3]] = np.nanmedian(fitted[:, [1, 3]], axis=0)
    return found


def _likelier(one: FitResult, other: FitResult) -> BoolArray:
    """Return which pixels a fit explains clearly better than another one, shape (n,)."""
    with np.errstate(invalid="ignore"):
        return np.asarray(one.log_likelihood > other.log_likelihood + CLEARLY)


def expected_codes(
    maps: PixelMaps,
    effects: Sequence[Effect],
    codes: NDArray[np.integer],
    numbers: IntArray,
    added: AddedExposure | None = None,
) -> FloatArray | None:
    """Return the samples, (c,), that a model expects at each code in all usable pixels; None: it has no law.

    Args:
        maps: parameters of the pixels under the model.
        effects: of the model.
        codes: successive DN, shape (c,).
        numbers: of the frames in the run, one sample of each pixel in each.
        added: see :class:`Refit`.
    """
    usable = maps.usable.ravel()
    own = maps.flat.of(usable)
    try:
        places = _places(maps, numbers).of(usable)
        law = sample_law(effects, own, None if added is None else added.flat().of(usable), places)
    except ConfigError:
        return None
    return np.asarray(numbers.size * sample_mass(law, own, codes, smallest=1e-50).sum(axis=0))


def _places(maps: PixelMaps, numbers: IntArray) -> PixelPlaces:
    """Return the places of all pixels, in frames of some numbers."""
    ny, nx = maps.usable.shape
    return PixelPlaces.of_block(None, (ny, nx), numbers)


def changes(before: FloatArray, after: FloatArray, stderr: FloatArray) -> dict[str, Moved]:
    """Return the medians over the pixels of the changes of their parameters; all arguments (n, 4)."""
    found = {}
    with np.errstate(invalid="ignore", divide="ignore"):
        ratios = (after - before) / stderr
    for (name, unit), difference, ratio in zip(_UNITS.items(), (after - before).T, ratios.T, strict=True):
        finite = ratio[np.isfinite(ratio)]
        found[name] = Moved(
            median=float(np.median(difference)) if difference.size else 0.0,
            in_stderr=float(np.median(finite)) if finite.size else 0.0,
            unit=unit,
        )
    return found


@dataclass(frozen=True)
class Sensor:
    """The distribution of the true parameters of the pixels: simulated sensors whose fits come out alike."""

    posterior: Posterior  # of the pixels that can be simulated
    drawn: BoolArray  # which those are, shape (y, x)
    usable: BoolArray  # pixels whose fit can be relied upon, shape (y, x)
    lost: float = 0.0  # bias of log sigma_R^2, which is corrected

    def draw(self, seed: int) -> PixelMaps:
        """Return maps that may be the true ones; ``usable`` are those that can be simulated."""
        values = np.full((*self.drawn.shape, 4), np.nan)
        values[self.drawn] = self.posterior.draw(np.random.default_rng(seed))
        return PixelMaps.known(np.moveaxis(values, -1, 0), self.drawn)

    def refitted(self, before: PixelMaps, after: PixelMaps) -> Sensor:
        """Return it under another model: each pixel moves as its fit does, one without a fit as most do.

        Raises:
            NotFittedError: no pixel is fitted before and after.
        """
        both = (before.usable & after.usable)[self.drawn]
        _require(both)
        old, new = (to_theta(fit.of(self.drawn).columns[both]) for fit in (before, after))
        change = np.tile(np.median(new - old, axis=0), (both.size, 1))
        change[both] = new - old
        return replace(self, posterior=self.posterior.moved(change), usable=after.usable)

    def corrected(self, wanted: PixelMaps, simulated: PixelMaps) -> Sensor:
        """Return sensors of which plain fits come out as wanted, given those of one that was simulated.

        An effect of which the law knows only a part (what a neighbour adds) is in the fitted parameters,
        mostly the read noise, and simulated on top would be there twice.

        Raises:
            NotFittedError: no pixel is fitted in both.
        """
        both = wanted.usable & simulated.usable
        _require(both)
        change = clipped_mean(to_theta(wanted.of(both).columns) - to_theta(simulated.of(both).columns))
        # variances add up, their logarithms do not
        change[3] = np.log(max(2.0 - np.exp(-change[3]), _LEAST_LEFT))
        return replace(self, posterior=self.posterior.moved(change))

    def usual(self, seed: int) -> PixelMaps:
        """Return the same of the pixels whose fit can be relied upon."""
        maps = self.draw(seed)
        return replace(maps, usable=self.usable & self.drawn)


def _require(pixels: BoolArray) -> None:
    """Raise a NotFittedError unless there is one of these pixels."""
    if not pixels.any():
        raise NotFittedError("no pixel can be fitted with it")


def learn_sensor(
    frames: NDArray[np.unsignedinteger],
    numbers: IntArray,
    fit: Refit,
    effects: Sequence[Effect],
    mistaken: float,
    lost: float | None = None,
    before: NDArray[np.unsignedinteger] | None = None,
) -> Sensor:
    """Learn what the pixels' true parameters may be.

    Args:
        frames: that were fitted, (frame, y, x), DN.
        numbers: theirs in the run, shape (frame,).
        fit: of them with the effects.
        effects: of the model.
        mistaken: share of pixels whose bias may be off by an electron.
        lost: see :class:`Sensor`; None: not known yet.
        before: frames before effects replaced samples, from which the replacements are; None: ``frames``.

    Raises:
        NotFittedError: no pixel tells anything.
    """
    maps = fit.maps
    usable = maps.usable.ravel()
    parameters = maps.flat.columns
    covariance, places = fit.covariance.reshape(-1, 4, 4), _places(maps, numbers)
    law = _law_of_all(effects, parameters, places, fit.added)
    if law is None or law.free_satellites:
        drawn = usable
        _require(np.asarray(np.isfinite(covariance[drawn]).all(axis=(1, 2))))
        posterior = posterior_of_estimates(parameters[drawn], covariance[drawn])
        lost = lost or 0.0
    else:
        histograms = histogram_frames(frames)
        counts = histograms.counts.reshape(-1, histograms.counts.shape[2])
        outside = (histograms.under + histograms.over).ravel()
        drawn = (counts > 0).sum(axis=1) >= _FEWEST_CODES
        drawn &= (outside <= MOST_OUTSIDE * counts.sum(axis=1)) | usable
        _require(drawn)
        origin = histograms.origin.ravel().astype(np.int64)
        replaced = _replaced(effects, frames if before is None else before, places, origin, counts.shape[1])
        posterior = posterior_of(
            counts[drawn],
            origin[drawn],
            parameters[drawn],
            law.of(drawn),
            None if replaced is None else replaced.of(drawn),
            mistaken=mistaken,
        )
        if lost is None:
            known = mistaken <= MANY_MISTAKEN
            lost = shrinkage_bias(posterior, counts[drawn].sum(axis=1), law.of(drawn)) if known else 0.0
    return Sensor(
        posterior.moved(np.array([0.0, 0.0, 0.0, lost])), drawn.reshape(maps.usable.shape), maps.usable, lost
    )


def _replaced(
    effects: Sequence[Effect],
    before: NDArray[np.unsignedinteger],
    places: PixelPlaces,
    origin: NDArray[np.integer],
    n_codes: int,
) -> ReplacedSamples | None:
    """Return what effects make of the samples of all pixels, at the codes of histograms; None: nothing.

    Of several that replace samples of a pixel the last one counts.
    """
    rules = [(effect, effect.replacement(before)) for effect in effects]
    found = [(effect, rule) for effect, rule in rules if rule is not None]
    if not found:
        return None
    value = before.reshape(len(before), -1).astype(np.int32)
    excess, share = np.zeros(value.shape[1], np.int64), np.zeros(value.shape[1])
    for effect, rule in found:
        inside = rule.inside.ravel() & places.inside(effect)
        value[:, inside] = rule.value.reshape(value.shape)[:, inside]
        excess[inside], share[inside] = rule.excess, rule.share * places.share(effect)
    return ReplacedSamples.by(value, excess, share, origin, n_codes)


def _law_of_all(
    effects: Sequence[Effect], parameters: FloatArray, places: PixelPlaces, added: AddedExposure | None
) -> SampleLaw | None:
    """Return the law of all pixels, those without parameters as their middle; None where there is none."""
    middle = np.nanmedian(parameters, axis=0)
    full = np.where(np.isfinite(parameters), parameters, middle)
    try:
        return sample_law(effects, pixel_maps(list(full.T), np.ones(len(full), np.bool_)), added, places)
    except ConfigError:
        return None
