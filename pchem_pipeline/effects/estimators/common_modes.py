"""Sums of readout residuals, which show what many pixels share, and how many times a pattern is in them.

An offset b of a whole frame, row or quadrant adds b to the samples of many pixels. The readout residual ``r
= x - mu - E[K | x] / g`` follows it only in part where the peaks overlap, since some of b is taken for
charge: on average by ``alpha = Var(r) / sigma^2`` (Stein's identity for the Gaussian R of Hendrickson et
al. 2023, eq. PCD_RV_definition). Estimates of offsets are therefore means of r divided by the mean alpha.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pchem_pipeline.effects.types import AnyArray, BoolArray, Evidence, FloatArray, IntArray

#: Standard errors from which on most effects are worth a hypothesis: by chance once in 160 times, of either
#: sign once in 80. A wrong hypothesis is thrown out by the comparison that follows, and costs time only.
SIGNIFICANT = 2.5


class Multiple(NamedTuple):
    """A coefficient and its standard error, which is infinite where nothing shows it."""

    value: float
    error: float

    @property
    def sigmas(self) -> float:
        """Standard errors that it is away from zero, with its sign."""
        return self.value / self.error


def multiple_of(pattern: FloatArray, seen: FloatArray, weight: FloatArray | float = 1.0) -> Multiple:
    """Return how many times a pattern is in data of its shape and of inverse variance ``weight``."""
    information = float((weight * pattern**2).sum())
    if not (np.isfinite(information) and information > 0):
        return Multiple(0.0, np.inf)
    return Multiple(float((weight * pattern * seen).sum()) / information, information**-0.5)


def run_position(frames: IntArray, n_run: int) -> FloatArray:
    """Return where frames lie in the run: 0 the first, 1 the last; frames before the run like the first."""
    return np.asarray(frames.clip(0, n_run - 1) / max(n_run - 1, 1), np.float64)


def responsivity(evidence: Evidence) -> float:
    """Return the mean change of r per DN of a common offset, in (0, 1] (see the module's text)."""
    ratio = (evidence.readout_std / evidence.maps.read_noise_dn)[evidence.maps.usable] ** 2
    ratio = ratio[np.isfinite(ratio)]
    return float(np.clip(ratio.mean(), 0.02, 1.0)) if ratio.size else 1.0


def mean_response(evidence: Evidence, inside: BoolArray | None = None) -> float:
    """Return the mean of d(r / sd of r) by a common offset of the pixels ``inside`` (None: all), 1/DN."""
    usable = evidence.maps.usable if inside is None else evidence.maps.usable & inside
    return float(np.mean((evidence.readout_std / evidence.maps.read_noise_dn**2)[usable]))


def mean_variance(evidence: Evidence, axis: int | tuple[int, int] = (0, 1)) -> FloatArray:
    """Return the variance, DN^2, that the pixels' own noise gives to means of r over usable pixels.

    ``axis`` as in a sum over (y, x): 1 for row means, 0 for column means; NaN where no pixel is usable.
    """
    usable = evidence.maps.usable & np.isfinite(evidence.readout_std)
    n = usable.sum(axis)
    total = (np.where(usable, evidence.readout_std, 0.0) ** 2).sum(axis)
    return np.asarray(np.where(n > 0, total / np.maximum(n, 1) ** 2, np.nan), np.float64)


def successive(frames: AnyArray) -> BoolArray:
    """Return which frames follow the one before as closely as any here do, (n - 1,); of a period, all."""
    apart = np.diff(frames)
    return np.asarray(apart == apart.min(initial=apart.max(initial=1)))


def line_excess(means: AnyArray, variance: FloatArray) -> tuple[float, float]:
    """Return the variance of the lines' offsets beyond that of their pixels, and its standard error, DN^2.

    Of means of r, (n, lines), with what the pixels' noise gives to their variance, (lines,); NaN: no pixels.
    """
    good = np.isfinite(variance) & np.isfinite(means).all(axis=0)
    n_frames, n_lines = means.shape[0], int(good.sum())
    if n_lines < 2 or n_frames < 2:
        return 0.0, np.inf
    kept = means[:, good].astype(np.float64)
    kept = kept - kept.mean(axis=1, keepdims=True)
    kept -= kept.mean(axis=0)
    expected = variance[good]
    degrees = (n_frames - 1) * (n_lines - 1)
    excess = float((kept**2).sum() / degrees - expected.mean())
    return excess, float(np.sqrt(2.0 / degrees) * np.sqrt((expected**2).mean()))
