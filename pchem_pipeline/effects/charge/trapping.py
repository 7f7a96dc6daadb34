"""Trapping: a trap in the pixel catches an electron and gives it back in a later frame.

A trap holds one electron at most (Shockley and Read 1952). Where it is empty it takes one from a sample that
has any with a chance c, whatever their number: the charge reaches it or does not (Massey et al. 2010). Where
it is full it gives the electron to a later sample, with a chance r in each. Its capacity makes it visible in
frames of one exposure, other than a lag of electrons one by one (:mod:`.charge_lag`).

With the trap full or empty, s, sample t is ``K_t + s_t - s_{t+1}``. The trap is full in a share ``pi = a / (r
+ a)`` of the frames, ``a = c P(K >= 1)``, and its states of frames l apart are correlated by ``w^l`` with ``w
= 1 - r - a``. From Poisson electrons of mean H follow the law of a sample, with ``m = (1 - pi) c``,

    ``P(k) = P(k; H) + m P(K >= 1) [P(k-1; H) - P(k; H)] + m [P(k+1; H) - P(k; H) 1(k >= 1)]``,

its mean H, its variance ``H + 2 m P(K >= 2)`` and third factorial cumulant ``-6 m P(K >= 3)``, and the
covariance of samples l frames apart, ``-r c P(K >= 2) w^(l-1)``. No charge is lost: the sum of all of these
covariances is minus the excess of the variance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.estimators.count_scores import charlier_information
from pchem_pipeline.effects.estimators.long_memory import OF_PIXEL
from pchem_pipeline.effects.estimators.pixel_law import SMALL_CHANGE, PixelLaw, typical_pixels
from pchem_pipeline.effects.estimators.regression import NEARLY_ALL, SIGNIFICANT
from pchem_pipeline.effects.framework.effect import Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import (
    AnyArray,
    BoolArray,
    EffectContext,
    Evidence,
    FloatArray,
    IntArray,
    PixelMaps,
    SampleLaw,
)
from pchem_pipeline.model.arithmetic.significance import BEYOND_DOUBT, CERTAIN, OUTLYING

# probability that the state of a trap goes back farther than the frames that are simulated for it
_RARE = 1e-6
# chances, and shares of the pixels, among which the estimator looks first
_CAPTURES = np.geomspace(0.002, 0.9, 12)
_RELEASES = np.geomspace(0.02, 0.9, 9)
_FRACTIONS = (0.03, 0.1, 0.3)
_LIMITS = (0.02, 0.95)  # of a release, and the largest of a capture


@register_effect
class Trapping(Effect):
    """Chance that an empty trap of a pixel catches an electron of a sample.

    Signature: the electron numbers vary more than Poisson and are less skewed; successive ones are opposite,
    and so are those of some further frames, the less the longer apart. Nothing in the readout residual,
    nothing between neighbours, and block means are as even as those of Poisson electrons.
    """

    tag: Literal["trapping"] = Field(default="trapping", description="name of the effect")
    plane = Plane.CHARGE
    title = "charge trapping"
    source = (
        "Shockley and Read 1952, Phys. Rev. 87, 835; Massey et al. 2010, Mon. Not. R. Astron. Soc. 401, 371"
    )
    signature = (
        "time.lag1.charge.mean", "shape.C2.mean", "shape.C3.mean", "time.lag2.charge.mean",
    )  # fmt: skip
    strength = "capture"
    separate: ClassVar[Mapping[str, str]] = {
        "overdispersed_counts": "longer runs: trapping anticorrelates electron numbers of successive frames, "
        "over-dispersion does not",
        "branching_counts": "longer runs: trapping anticorrelates electron numbers of successive frames, "
        "branching does not",
        "analog_memory": "dark frames after a bright one: traps release single electrons, memory fades "
        "within a frame",
        "dark_current_rts": "longer runs: the sum over many frames is Poisson with trapping, over-dispersed "
        "with dark-current RTS",
    }
    capture: Ratio = Field(
        ge=0,
        le=_LIMITS[1],
        description="probability that an empty trap captures an electron of a sample that has any, no unit",
    )
    release: Ratio = Field(
        default=0.3,
        ge=_LIMITS[0],
        le=_LIMITS[1],
        description="probability per frame that a full trap releases its electron, no unit",
    )
    fraction: Ratio = Field(default=1.0, ge=0, le=1, description="share of the pixels with a trap, no unit")

    #: in all pixels, fast and slow, and in a tenth of them
    typical_values = (
        {"capture": 0.03, "release": 0.4},
        {"capture": 0.3, "release": 0.06},
        {"capture": 0.3, "release": 0.3, "fraction": 0.1},
    )

    def history(self) -> int:
        """Return how many frames ago a trap was last filled or emptied whatever its state was, at most."""
        # chances above one half also make it change places, which leaves its state open
        known = min(self.release, 1.0 - abs(1.0 - self.release - self.capture))
        return math.ceil(math.log(_RARE) / math.log1p(-known)) if self.capture > 0 else 0

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return electron numbers (frame, y, x), e-, as read: less what is caught, with what is released.

        A trap that was neither filled nor emptied for as long as :meth:`history` is taken for empty, so that
        it is the same whatever block is simulated.
        """
        u = context.random.uniform(("frame", "y", "x"))
        filled = (u > 1.0 - self.capture) & (values > 0)
        if self.fraction < 1:
            filled &= context.random.uniform(("y", "x"), OF_PIXEL[0]) < self.fraction
        emptied = u < self.release
        full = _states(filled, emptied, self.history())
        return values + full[:-1] - full[1:]

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the likeliest chances by autocovariances and variances of the electron numbers, by pixel.

        Two traps of which one catches as often as the other releases have nearly the same moments: that which
        is more often empty is meant, unless the other is clearly likelier. Where it is far likelier that only
        some pixels have a trap, that is the first hypothesis.
        """
        pixels = _observed(evidence)
        if pixels is None:
            return ()
        starts = _starts(pixels)
        alike, found = _refined(pixels, starts[1.0]), []
        if alike.seen:
            other = _refined(pixels, alike.opposite(float(pixels.some.mean())))
            found = [_first_of(alike, other)]
        some = _refined(pixels, max((starts[f] for f in _FRACTIONS), key=lambda one: one.height))
        clear = some.height - max(alike.height, 0.0) > CERTAIN**2 / 2.0
        if clear and some.seen and some.fraction < NEARLY_ALL:
            found.insert(0, some)
        return [cls(capture=one.capture, release=one.release, fraction=one.fraction) for one in found]

    def details(self) -> tuple[str, ...]:
        """Return the chance of a release, and the share of the pixels where not all have a trap."""
        return ("release", "fraction") if 0.0 < self.fraction < 1.0 else ("release",)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with trapped electrons; the same one where only some pixels have a trap."""
        if self.fraction < 1:
            return model
        return model.with_counts("trapped", self.chance(np.nan_to_num(maps.quanta_exposure)))

    def chance(self, exposure: FloatArray) -> FloatArray:
        """Return m, the chance that a sample with electrons loses one, for exposures H, e-."""
        return _chance(self.capture, self.release, -np.expm1(-exposure))


def _chance(capture: float, release: float, some: FloatArray) -> FloatArray:
    """Return m, the chance that a sample with electrons loses one, given how probable it is to have any."""
    return np.asarray(capture * release / (release + capture * some))


def _states(filled: BoolArray, emptied: BoolArray, history: int) -> IntArray:
    """Return whether traps are full before and behind each frame, (frame + 1, y, x), 0 or 1.

    Args:
        filled: in which frames an empty trap is filled, (frame, y, x).
        emptied: in which frames a full trap is emptied, (frame, y, x).
        history: frames beyond which a trap is taken for empty.
    """
    start = np.zeros((1, *filled.shape[1:]), np.bool_)
    frame = np.arange(filled.shape[0] + 1)[:, None, None]
    # where both happen it changes its state; else it is known afterwards
    changes = np.concatenate([start, np.logical_xor.accumulate(filled & emptied, axis=0)])
    known = np.concatenate([start, filled ^ emptied])
    last = np.maximum.accumulate(np.where(known, frame, 0), axis=0)
    then = np.take_along_axis(np.concatenate([start, filled]) ^ changes, last, axis=0)
    full = (then ^ changes) & (last > 0) & (frame - last < history)
    return np.asarray(full, np.int64)


class _Pixels(NamedTuple):
    """What pixels with electrons show, in standard deviations of chance, and what they would show.

    Attributes:
        some: P(K >= 1), shape (n,).
        lags: autocorrelations of the electron number at lags 1, 2, 3, shape (3, n).
        score: of the second Charlier polynomial, shape (n,).
        of_lags: what covariances of P(K >= 2) make of ``lags``, (3, n).
        of_score: what a small chance m makes of ``score``, over m, shape (n,).
        excess: by what part the variance of the expected electrons grows, over m, shape (n,).
    """

    some: FloatArray
    lags: FloatArray
    score: FloatArray
    of_lags: FloatArray
    of_score: FloatArray
    excess: FloatArray

    def likelihood(self, capture: float, release: float) -> tuple[FloatArray, FloatArray]:
        """Return logarithms of the likelihood that pixels have such a trap over that of none, (n,) each.

        By all that they show, and by the autocorrelations alone.
        """
        chance = _chance(capture, release, self.some)
        left = (1.0 - release - capture * self.some) ** np.arange(3)[:, None]
        covariance = -release * capture * left
        in_time = _rise(self.lags, covariance * self.of_lags / (1.0 + chance * self.excess)).sum(axis=0)
        return in_time + _rise(self.score, chance * self.of_score), in_time


class _Trap(NamedTuple):
    """Chances of a trap, and how much likelier it makes what the pixels show, nats: all, and in time."""

    capture: float
    release: float
    fraction: float
    height: float = -math.inf
    in_time: float = -math.inf

    @property
    def seen(self) -> bool:
        """Whether it is worth a hypothesis."""
        return self.height > OUTLYING**2 / 2.0 and self.in_time > SIGNIFICANT**2 / 2.0

    def opposite(self, some: float) -> _Trap:
        """Return the trap that catches as often as this one releases, and releases as this one catches."""
        low, high = _LIMITS
        return _Trap(min(self.release / some, high), min(max(self.capture * some, low), high), self.fraction)


def _first_of(one: _Trap, other: _Trap) -> _Trap:
    """Return of two traps with nearly the same moments the emptier one, unless it is clearly less likely."""
    empty, full = sorted((one, other), key=lambda each: each.capture / each.release)
    return full if full.height - empty.height > OUTLYING**2 / 2.0 else empty


def _observed(evidence: Evidence) -> _Pixels | None:
    """Return what pixels with electrons show; None where the frames have no order, or no pixel is usable."""
    time, maps, score = evidence.time, evidence.maps, evidence.scores.get("C2")
    if time is None or score is None or time.n_pairs < 1:
        return None
    lags = np.asarray(time.lag_charge, np.float64)
    good = maps.usable & np.isfinite(score) & np.isfinite(lags).all(axis=0) & (maps.quanta_exposure > 0)
    good &= evidence.charge_std > 0
    if not good.any():
        return None
    exposure = maps.quanta_exposure[good]
    # pairs of frames of a block
    pairs = time.n_pairs * (1.0 - np.arange(3.0) / max(time.block_frames - 1, 3))
    root = np.sqrt(pairs)[:, None]
    some = -np.expm1(-exposure)
    several = some - exposure * np.exp(-exposure)
    # the expected electron number answers to the electrons by Var(k) / H
    answer = several * evidence.charge_std[good] ** 2 / exposure**2
    seen = np.asarray(score[good], np.float64)
    return _Pixels(some, lags[:, good] * root, seen, answer * root, _of_score(evidence)[good], 2.0 * answer)


def _of_score(evidence: Evidence) -> FloatArray:
    """Return what a small chance m makes of the score of the second Charlier polynomial, over m, (y, x).

    That of an excess of the variance, corrected for the other moments by pixels that stand for the others.
    """
    from pchem_pipeline.model.law.sample_law import SampleLaw

    maps = evidence.maps
    exposure, noise = maps.quanta_exposure.ravel(), (maps.read_noise_dn * maps.conversion_gain).ravel()
    found = np.zeros(exposure.size)
    for pixel, group in zip(*typical_pixels(maps), strict=True):
        law = PixelLaw(maps, int(pixel), evidence.n_frames)
        exact = (
            law.score_shift("C2", law.change(SampleLaw().with_counts("trapped", SMALL_CHANGE))) / SMALL_CHANGE
        )
        several = -np.expm1(-exposure[group]) - exposure[group] * np.exp(-exposure[group])
        by_variance = 2.0 * several * np.sqrt(charlier_information(exposure[group], noise[group]))
        by_variance /= exposure[group] ** 2
        found[group] = by_variance * exact / by_variance[group == pixel]
    return np.asarray(np.sqrt(evidence.n_frames) * found.reshape(maps.bias.shape))


def _rise(seen: FloatArray, expected: FloatArray) -> FloatArray:
    """Return the logarithm of the likelihood of normal numbers of variance 1 over that of mean 0."""
    kept = expected + np.clip(seen - expected, -BEYOND_DOUBT, BEYOND_DOUBT)
    return np.asarray(kept * expected - expected**2 / 2.0)


def _mixed(rises: FloatArray, fraction: float) -> float:
    """Return the same of all pixels of which a share has the mean."""
    if fraction >= 1.0:
        return float(rises.sum())
    return float(np.logaddexp(math.log1p(-fraction), math.log(fraction) + rises).sum())


def _starts(pixels: _Pixels) -> dict[float, _Trap]:
    """Return the likeliest trap of a grid by the share of the pixels that have one."""
    best = {fraction: _Trap(0.0, 0.0, fraction) for fraction in (1.0, *_FRACTIONS)}
    for capture in _CAPTURES:
        for release in _RELEASES:
            rises, in_time = pixels.likelihood(capture, release)
            for fraction, known in best.items():
                height = _mixed(rises, fraction)
                if height > known.height:
                    best[fraction] = _Trap(
                        float(capture), float(release), fraction, height, _mixed(in_time, fraction)
                    )
    return best


def _refined(pixels: _Pixels, start: _Trap) -> _Trap:
    """Return the likeliest trap near another; if all pixels have one, that stays so."""
    from scipy import optimize  # not for every command that knows of effects

    free = [start.capture, start.release, *([start.fraction] if start.fraction < 1.0 else [])]
    highest = [_LIMITS[1], _LIMITS[1], 1.0][: len(free)]
    lowest = [1e-5, _LIMITS[0], 1e-3][: len(free)]

    def trap(logarithms: FloatArray) -> _Trap:
        values = [float(v) for v in np.clip(np.exp(logarithms), lowest, highest)]
        capture, release, fraction = values if len(values) == 3 else (*values, 1.0)
        rises, in_time = pixels.likelihood(capture, release)
        return _Trap(capture, release, fraction, _mixed(rises, fraction), _mixed(in_time, fraction))

    options = {"xatol": 0.01, "fatol": 0.05, "maxfev": 200}
    found = optimize.minimize(
        lambda at: -trap(at).height, np.log(free), method="Nelder-Mead", options=options
    )
    return trap(found.x)
