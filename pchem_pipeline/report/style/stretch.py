"""Drawing a map with the Beta(2,2) stretch of Appendix C: colours by rank, a colour bar in physical units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.maps.maps import display_transform
from pchem_pipeline.model.maps.ordered import Ordered
from pchem_pipeline.report.style.wording import short

FloatArray = NDArray[np.float64]

#: Colour levels at which the colour bar is labelled, and the share of pixels below each.
STRETCH_LEVELS = (0.0, 0.25, 0.5, 0.75, 1.0)


@dataclass(frozen=True)
class StretchedMap:
    """A map as it is drawn.

    Attributes:
        colour: level of each pixel in 0..1, NaN where there is no value; shape (y, x).
        levels: levels at which the colour bar is labelled.
        labels: physical values at these levels, as text.
    """

    colour: FloatArray
    levels: tuple[float, ...]
    labels: tuple[str, ...]


def stretch_map(
    values: NDArray[Any], stretch: Literal["beta", "linear"] = "beta", ordered: Ordered | None = None
) -> StretchedMap:
    """Return colour levels of a map and the labels of its colour bar.

    ``beta`` is the transform of Hendrickson et al. 2023, Appendix C: the level is the Beta(2,2) quantile of
    the value's rank, so that the levels 0, 1/4, 1/2, 3/4, 1 are the minimum, the 15.6, 50 and 84.4 %
    quantiles and the maximum. ``linear`` runs from the 1st to the 99th percentile; values beyond have the
    end colours.

    Args:
        values: map (y, x), or some of its rows and columns; NaN where there is no value.
        stretch: which of the two.
        ordered: all values of the map; None: these.
    """
    full = np.asarray(values, dtype=np.float64)
    known = ordered or Ordered.of(full)
    if known.size == 0:
        return StretchedMap(np.full(full.shape, np.nan), (), ())
    if known.values[0] == known.values[-1]:
        colour = np.where(np.isfinite(full), 0.5, np.nan)
        return StretchedMap(colour, (0.5,), (short(float(known.values[0])),))
    level = np.asarray(STRETCH_LEVELS)
    if stretch == "beta":
        physical = known.quantiles(level**2 * (3.0 - 2.0 * level))
        return StretchedMap(display_transform(full, known), STRETCH_LEVELS, _labels(physical))
    low, high = known.quantiles([0.01, 0.99]).tolist()
    span = high - low if high > low else 1.0
    physical = low + level * span
    signs = ["≤ ", "", "", "", "≥ "]
    labels = tuple(sign + text for sign, text in zip(signs, _labels(physical), strict=True))
    return StretchedMap(np.clip((full - low) / span, 0.0, 1.0), STRETCH_LEVELS, labels)


def _labels(physical: FloatArray) -> tuple[str, ...]:
    """Return texts with as many digits as tell the middle labels apart."""
    texts: list[str] = []
    for digits in range(3, 8):
        texts = [short(float(value), digits) for value in physical]
        if len(set(texts)) == len(set(physical.tolist())):
            break
    return tuple(texts)
