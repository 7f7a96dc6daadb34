"""Round numbers for the ticks of an axis, and their texts."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.report.charts.chart import Axis
from pchem_pipeline.report.style.wording import power_of_ten, short, without_formulas

Ticks = list[tuple[float, str]]

#: Decades between which each multiple of a power has a text.
_FEW_DECADES = 1.2


def ticks(axis: Axis, low: float, high: float, most: int = 6) -> Ticks:
    """Return places and texts of the ticks of an axis between its ends, at most about so many."""
    if axis.ticks:
        found = [(place, without_formulas(text)) for place, text in axis.ticks]
        return [each for each in found if low <= each[0] <= high]
    return _powers(low, high, most) if axis.log else ticks_between(low, high, most, whole=axis.whole)


def ticks_between(low: float, high: float, most: int, *, whole: bool = False) -> Ticks:
    """Return multiples of 1, 2 or 5 times a power of ten."""
    rough = (high - low) / most
    power = math.floor(math.log10(rough))
    steps = [m * 10.0**power for m in (1, 2, 5, 10)]
    step = next(each for each in steps if each >= rough * (1 - 1e-9))
    if not _has_two(low, high, step):  # a single tick tells no scale
        step = next((each for each in reversed(steps) if _has_two(low, high, each)), step)
    if whole and step < 1.0:
        step, power = 1.0, 0
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    places = [round(i * step, decimals + 2) for i in range(first, last + 1)]
    if decimals > 5 or max(map(abs, places), default=0.0) >= 1e6:
        return [(place, short(place, 2)) for place in places]
    return [(place, f"{place:,.{decimals}f}".replace("-", "−")) for place in places]


def _has_two(low: float, high: float, step: float) -> bool:
    """Tell whether at least two multiples of a step lie between two ends."""
    return math.floor(high / step + 1e-9) > math.ceil(low / step - 1e-9)


def _powers(low: float, high: float, most: int) -> Ticks:
    """Return powers of ten; also their multiples where there are few."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    if math.log10(high / low) < _FEW_DECADES:
        multiples = [float(f"{m}e{p}") for p in range(first, last + 1) for m in (1, 2, 5)]
        return [(place, short(place, 1)) for place in multiples if low <= place <= high]
    every = max(1, math.ceil((last - first) / most))
    powers = [
        p
        for p in range(first, last + 1)
        if p % every == 0 and low <= 10.0**p * (1 + 1e-9) and 10.0**p <= high
    ]
    return [(float(f"1e{p}"), power_of_ten(p) or "1") for p in powers]


def scaled(values: ArrayLike, axis: Axis, low: float, high: float) -> NDArray[np.float64]:
    """Return where values lie along an axis, as parts of its length; what has no logarithm far below."""
    if axis.down:
        return 1.0 - scaled(values, replace(axis, down=False), low, high)
    values = np.asarray(values, dtype=np.float64)
    if axis.log:
        shown = np.log10(np.where(values > 0, values, np.where(np.isnan(values), np.nan, low * 1e-3)))
        return np.asarray((shown - math.log10(low)) / math.log10(high / low))
    if axis.linear_to:
        shown, start, end = (np.arcsinh(np.asarray(each) / axis.linear_to) for each in (values, low, high))
        return np.asarray((shown - start) / (end - start))
    return np.asarray((values - low) / (high - low))
