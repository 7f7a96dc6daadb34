"""Which codes to compare: all, those without one peak that is understood least, those near the peaks.

Where no known effect brings the model to the data, something unknown is in them, and likely in one place: a
peak that was cut by a trigger, samples between the peaks. A fit to all codes bends every parameter towards
it. So the comparison is repeated on fewer codes (a side band, as where a background is fitted beside a bump),
and what is named must be found in all of these views.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.by_likelihood.sets import SetComparison, saturated

__all__ = ["Interval", "doubtful_peaks", "electrons_of", "inside", "valleys"]

FloatArray = NDArray[np.float64]

_RESOLVED = 0.3  # e-: read noise above which there are no valleys
_HALF_PEAK = 0.25  # e-: half width of what counts as a peak
_MOST_SHARE = 0.3  # of the samples that may be set aside
_LEAST_SHARE = 1e-3


@dataclass(frozen=True)
class Interval:
    """Codes by their place on a pixel's comb, e-; None: no limit."""

    low: float | None
    high: float | None

    def holds(self, electrons: FloatArray) -> NDArray[np.bool_]:
        """Tell which places lie in it."""
        found = np.ones(electrons.shape, np.bool_)
        if self.low is not None:
            found &= electrons >= self.low
        if self.high is not None:
            found &= electrons < self.high
        return found


def electrons_of(origin: NDArray[np.int64], width: int, parameters: FloatArray) -> FloatArray:
    """Return ``(x - mu) g`` of every code, e-, shape (n, B), of pixels with (H, g, mu, sigma)."""
    codes = origin[:, None] + np.arange(width)
    return np.asarray((codes - parameters[:, 2:3]) * parameters[:, 1:2])


def inside(intervals: tuple[Interval, ...], electrons: FloatArray) -> NDArray[np.bool_]:
    """Tell which codes lie in one of the intervals, shape (n, B)."""
    found = np.zeros(electrons.shape, np.bool_)
    for interval in intervals:
        found |= interval.holds(electrons)
    return found


def doubtful_peaks(sets: SetComparison, electrons: FloatArray) -> list[Interval]:
    """Return peaks of few samples, those first without which the plain law fits best.

    Args:
        sets: with all codes.
        electrons: place of every code, e-, shape (n, B).
    """
    total = float(sets.train.sum())
    cumulative = [float(sets.train[electrons < k + 0.5].sum()) / total for k in range(_last(electrons) + 1)]
    ranked: list[tuple[float, Interval]] = []
    for k, below in enumerate(cumulative):
        before = cumulative[k - 1] if k else 0.0
        candidates = {Interval(None if k == 0 else k - 0.5, k + 0.5): below - before}
        if k:
            candidates[Interval(k - 0.5, None)] = 1.0 - before
        for interval, share in candidates.items():
            if _LEAST_SHARE < share < _MOST_SHARE:
                ranked.append((_gap(sets, sets.kept & ~interval.holds(electrons)), interval))
    return [interval for _, interval in sorted(ranked, key=lambda pair: pair[0])]


def valleys(sets: SetComparison, electrons: FloatArray, sigma_e: float) -> tuple[Interval, ...]:
    """Return the codes between the peaks; none where peaks are not resolved or little would be left."""
    if sigma_e > _RESOLVED:
        return ()
    found = tuple(Interval(k + _HALF_PEAK, k + 1.0 - _HALF_PEAK) for k in range(-1, _last(electrons) + 1))
    share = float(sets.train[inside(found, electrons)].sum()) / float(sets.train.sum())
    return found if share < _MOST_SHARE else ()


def _gap(sets: SetComparison, kept: NDArray[np.bool_]) -> float:
    """Return the gap of the plain law among some codes, nats per sample of all."""
    view = replace(sets.on(kept, sets.start), test=sets.train)
    return float(saturated(view.train, kept).sum() - view.fit(()).score) / float(sets.train.sum())


def _last(electrons: FloatArray) -> int:
    """Return the electron number of the last code of most pixels."""
    return max(int(np.median(electrons[:, -1])), 1)
