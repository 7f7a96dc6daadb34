"""Ranges, bins and scales of axes that a handful of odd pixels cannot wreck, and colours of maps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.wording import short
from pchem_pipeline.model.maps.maps import display_edges
from pchem_pipeline.model.maps.ordered import Ordered
from pchem_pipeline.report.charts.chart import SHADES

#: A positive range that spans more than this factor is drawn on a logarithmic axis.
DECADES = 30.0


@dataclass(frozen=True)
class DisplayRange:
    """What part of the values is drawn, between the ends of the axis."""

    low: float
    high: float
    n_outside: int  # finite values beyond the ends, which are not drawn
    n_missing: int  # values that are NaN or infinite
    logarithmic: bool  # whether the drawn part spans decades

    def remark(self) -> str:
        """Return a note on what is not drawn, e.g. ``3 outside the axis; 5 without a value``."""
        counts = ((self.n_outside, "outside the axis"), (self.n_missing, "without a value"))
        return "; ".join(f"{n:,} {words}" for n, words in counts if n)


def finite(values: NDArray[Any]) -> FloatArray:
    """Return the finite values as a flat float64 array."""
    flat = np.asarray(values, dtype=np.float64).ravel()
    return flat[np.isfinite(flat)]


def robust_range(values: NDArray[Any] | Ordered) -> DisplayRange:
    """Choose the range of an axis from the bulk of the values.

    It is the range between the 1st and the 99th percentile, widened by 0.3 of it on each side (on a
    logarithmic axis by 0.3 of its decades), and cut to the values that occur. NaN and infinities are counted,
    not drawn.
    """
    known = Ordered.of(values)
    if known.size == 0:
        return DisplayRange(0.0, 1.0, 0, known.n_missing, False)
    smallest, largest = float(known.values[0]), float(known.values[-1])
    bulk_low, bulk_high = known.quantiles([0.01, 0.99]).tolist()
    logarithmic = bulk_low > 0 and bulk_high / bulk_low > DECADES
    if logarithmic:
        bulk_low, bulk_high = np.log([bulk_low, bulk_high])
        smallest = max(smallest, float(np.finfo(np.float64).tiny))
    margin = 0.3 * (bulk_high - bulk_low)
    low, high = bulk_low - margin, bulk_high + margin
    if logarithmic:
        low, high = np.exp([low, high])
    low, high = max(float(low), smallest), min(float(high), largest)
    if not high > low:
        pad = max(abs(low) * 0.05, 1e-9)
        low, high = low - pad, high + pad
    return DisplayRange(
        low, high, known.n_below(low) + known.n_above(high), known.n_missing, bool(logarithmic)
    )


def histogram_edges(values: NDArray[Any] | Ordered, shown: DisplayRange, most: int) -> FloatArray:
    """Return the edges of 6 to ``most`` bins of values of any shape, by the rule of Freedman and Diaconis."""
    known = Ordered.of(values).within(shown.low, shown.high)
    low, high = shown.low, shown.high
    if shown.logarithmic:
        known = Ordered(np.log(known.values))
        low, high = float(np.log(low)), float(np.log(high))
    bins = 6
    if known.size > 1:
        q25, q75 = known.quantiles([0.25, 0.75])
        width = 2.0 * float(q75 - q25) / known.size ** (1.0 / 3.0)
        bins = int(np.clip(np.ceil((high - low) / width), 6, most)) if width > 0 else 6
    edges = np.linspace(low, high, bins + 1)
    return np.exp(edges) if shown.logarithmic else edges


#: Levels at which the bar of colours is labelled.
_LEVELS = np.array([0.0, 0.25, 0.5, 0.75, 1.0])


def map_colours(known: Ordered) -> tuple[FloatArray, tuple[tuple[float, str], ...]]:
    """Return the values between the colours of a map, and places and texts of the bar of its colours.

    The level of a colour is the Beta(2,2) quantile of the value's rank, so that the levels 0, 1/4, 1/2, 3/4,
    1 are the minimum, the 15.6, 50 and 84.4 % quantiles and the maximum (Hendrickson et al. 2023, Appendix
    C).
    """
    if known.size == 0:
        return np.zeros(SHADES - 1), ()
    lowest = float(known.values[0])
    if lowest == known.values[-1]:
        middle = np.where(np.arange(SHADES - 1) < SHADES // 2, lowest, np.inf)
        return middle, ((0.5, short(lowest)),)
    edges = display_edges(known, np.arange(1, SHADES) / SHADES)
    texts = _labels(known.quantiles(_LEVELS**2 * (3.0 - 2.0 * _LEVELS)))
    return edges, tuple(zip(_LEVELS.tolist(), texts, strict=True))


def _labels(physical: FloatArray) -> list[str]:
    """Return texts with as many digits as tell the middle labels apart."""
    for digits in range(3, 8):
        texts = [short(float(value), digits) for value in physical]
        if len(set(texts)) == len(set(physical.tolist())):
            break
    return texts
