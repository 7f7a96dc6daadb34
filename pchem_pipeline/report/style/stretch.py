"""Colours of a map by the rank of its pixels (the Beta(2,2) stretch of Appendix C) or by their values."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.maps.maps import display_edges
from pchem_pipeline.model.maps.ordered import Ordered
from pchem_pipeline.report.charts.chart import SHADES
from pchem_pipeline.report.style.wording import short

FloatArray = NDArray[np.float64]

Bar = tuple[tuple[float, str], ...]

#: Levels at which the bar of colours is labelled.
_LEVELS = np.array([0.0, 0.25, 0.5, 0.75, 1.0])


def map_colours(known: Ordered, stretch: Literal["beta", "linear"] = "beta") -> tuple[FloatArray, Bar]:
    """Return the values between the colours of a map, and places and texts of the bar of its colours.

    ``beta``: the level of a colour is the Beta(2,2) quantile of the value's rank, so that the levels 0, 1/4,
    1/2, 3/4, 1 are the minimum, the 15.6, 50 and 84.4 % quantiles and the maximum (Hendrickson et al. 2023,
    Appendix C). ``linear`` runs from the 1st to the 99th percentile; values beyond have the end colours.

    Args:
        known: the values.
        stretch: which of the two.
    """
    if known.size == 0:
        return np.zeros(SHADES - 1), ()
    lowest = float(known.values[0])
    if lowest == known.values[-1]:
        middle = np.where(np.arange(SHADES - 1) < SHADES // 2, lowest, np.inf)
        return middle, ((0.5, short(lowest)),)
    if stretch == "beta":
        edges = display_edges(known, np.arange(1, SHADES) / SHADES)
        texts = _labels(known.quantiles(_LEVELS**2 * (3.0 - 2.0 * _LEVELS)))
        return edges, tuple(zip(_LEVELS.tolist(), texts, strict=True))
    low, high = known.quantiles([0.01, 0.99]).tolist()
    high = high if high > low else low + 1.0
    signs = ["≤ ", "", "", "", "≥ "]
    texts = [sign + text for sign, text in zip(signs, _labels(low + _LEVELS * (high - low)), strict=True)]
    return np.linspace(low, high, SHADES + 1)[1:-1], tuple(zip(_LEVELS.tolist(), texts, strict=True))


def _labels(physical: FloatArray) -> list[str]:
    """Return texts with as many digits as tell the middle labels apart."""
    texts: list[str] = []
    for digits in range(3, 8):
        texts = [short(float(value), digits) for value in physical]
        if len(set(texts)) == len(set(physical.tolist())):
            break
    return texts
