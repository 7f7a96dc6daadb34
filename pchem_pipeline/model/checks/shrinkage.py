"""What the pixels of a sensor, taken together, say about each one's read noise, and so about its fit.

Whether a fit can be trusted depends on the true read noise: the peaks fade as ``exp(-2 pi^2 s_e^2)``. Where
most pixels of a sensor are ambiguous, those that come out quiet by chance look clear, and they are the very
ones whose estimates are off, which no look at one pixel alone can tell.

The scatter of all pixels beyond their standard errors says how much the true read noises differ, and an
estimate is drawn towards the middle by as much as it is likely to be chance (James and Stein 1961; Efron and
Morris 1973). A pixel is :attr:`~pchem_pipeline.model.fit.status.FitStatus.WEAKLY_IDENTIFIED` if, with the
read noise found so, its likelihood gap is too small, its read noise too high, or its standard errors rough.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.model.arithmetic.statistics import robust_sd
from pchem_pipeline.model.fit.settings import FitSettings

#: Largest change of the logarithm of a pixel's information over one standard error of its read noise. Beyond,
#: the likelihood is no parabola, and 'estimate -+ 2 standard errors' holds the truth in 90 % instead of 95 %.
LOOSEST = 0.9

_LOOSEST_ALONE = 2.0  # the same of a pixel by itself: far beyond its like, it is on a wrong maximum
_FEWEST = 30  # pixels that make a pool
# Squared standard errors below which the scatter of estimates is taken for chance: where it matters they are
# known to some 15 %, and the scatter has heavy tails.
_CHANCE = 1.3
_LEAST_GAP = 0.3  # nats: a smaller gap says nothing of its slope


@dataclass(frozen=True)
class _Prior:
    """Where the truths of a sensor's pixels lie: their middle, and the variance of what they differ by."""

    centre: float
    variance: float

    @classmethod
    def of(cls, values: FloatArray, errors: FloatArray) -> _Prior:
        centre = float(np.median(values))
        scatter = robust_sd(values, centre)
        return cls(centre, max(0.0, scatter**2 - _CHANCE * float(np.median(errors)) ** 2))

    def shrunk(self, values: FloatArray, errors: FloatArray) -> FloatArray:
        """Return the values that are likely, given the estimates."""
        share = self.variance / np.maximum(self.variance + errors**2, np.finfo(np.float64).tiny)
        return self.centre + share * (values - self.centre)


class Judged(NamedTuple):
    """What the judgement looks at, of n pixels, NaN where there is no value."""

    noise: FloatArray  # s_e, e-, shape (n,)
    stderr: FloatArray  # its standard error, e-, shape (n,)
    gap: FloatArray  # likelihood gap, nats, shape (n,)

    @classmethod
    def join(cls, parts: Sequence[Judged]) -> Judged:
        """Return the pixels of several parts."""
        return cls(*map(np.concatenate, zip(*parts, strict=True)))

    @property
    def known(self) -> BoolArray:
        """Which pixels have all three, shape (n,)."""
        return np.isfinite(self.noise) & np.isfinite(self.gap) & (self.noise > 0) & (self.stderr > 0)

    def of(self, pixels: BoolArray | slice) -> Judged:
        """Return some of the pixels."""
        return Judged(*(each[pixels] for each in self))

    def looseness(self) -> tuple[FloatArray, FloatArray]:
        """Return the logarithm of ``8 pi^2 s_e stderr(s_e)``, and its standard error.

        That is the change over one standard error of the logarithm of the information, which goes as
        ``exp(-4 pi^2 s_e^2)``; the standard error goes as ``exp(2 pi^2 s_e^2)``.
        """
        slope = 2.0 / self.noise + 4.0 * np.pi**2 * self.noise
        return np.log(8.0 * np.pi**2 * self.noise * self.stderr), slope * self.stderr


@dataclass(frozen=True)
class NoisePool:
    """What the pixels of a sensor have in common."""

    noise: _Prior  # where their read noises lie, e-
    looseness: _Prior  # where the logarithms of their looseness lie
    gap_slope: float  # change of the logarithm of the likelihood gap with the read noise, 1/e-, not positive

    @classmethod
    def of(cls, pixels: Judged) -> NoisePool | None:
        """Return the pool of these pixels; None where fewer than 30 have a value."""
        some = pixels.of(pixels.known)
        if some.noise.size < _FEWEST:
            return None
        noise = _Prior.of(some.noise, some.stderr)
        near = np.abs(some.noise - noise.centre) <= 3.0 * robust_sd(some.noise, noise.centre)
        return cls(noise, _Prior.of(*some.looseness()), _slope(some.of(near), noise.centre))

    def reasons(self, pixels: Judged, settings: FitSettings) -> tuple[BoolArray, BoolArray]:
        """Return which pixels have rough errors or too much noise, and which too small a gap, (n,) each.

        False for those without a value; ``gap_threshold`` and ``read_noise_limit`` are the limits.
        """
        weak, ambiguous = np.zeros((2, pixels.noise.size), np.bool_)
        known = pixels.known
        some = pixels.of(known)
        noise = self.noise.shrunk(some.noise, some.stderr)
        log_gap = np.log(np.maximum(some.gap, 1e-12)) + self.gap_slope * (noise - some.noise)
        looseness, error = some.looseness()
        loose = self.looseness.shrunk(looseness, error) > np.log(LOOSEST)
        loose |= looseness > np.log(_LOOSEST_ALONE)
        ambiguous[known] = log_gap < np.log(max(settings.gap_threshold, 1e-12))
        weak[known] = loose | (noise > settings.read_noise_limit)
        return weak, ambiguous


def _slope(pixels: Judged, centre: float) -> float:
    """Return the slope of the log gap over the read noise: between 0 and that of the peaks' contrast.

    The square of that contrast goes as ``exp(-4 pi^2 s_e^2)``.
    """
    off = pixels.noise - pixels.noise.mean()
    square = float(off @ off)
    if square == 0.0:
        return 0.0
    slope = float(off @ np.log(np.maximum(pixels.gap, _LEAST_GAP))) / square
    return min(0.0, max(slope, -8.0 * np.pi**2 * centre))


def noise_of(
    gain: FloatArray,
    sigma: FloatArray,
    gain_stderr: FloatArray,
    sigma_stderr: FloatArray,
    correlation: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return s_e = g sigma and its standard error by the delta method, e-, shape (n,)."""
    by_gain, by_sigma = sigma * gain_stderr, gain * sigma_stderr
    with np.errstate(invalid="ignore"):
        variance = by_gain**2 + by_sigma**2 + 2.0 * correlation * by_gain * by_sigma
        return gain * sigma, np.sqrt(np.maximum(variance, 0.0))
