"""What the pixel inspector shows, as plain values: packed maps with their words, and some pixels in full."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.report.inspector.packing import PackedMap


@dataclass(frozen=True)
class MapEntry:
    """A map that the inspector can show.

    Attributes:
        path: ``group/name`` of the stored array.
        label: words for the list of maps.
        unit: unit as the store writes it.
        sentence: the array's own sentence.
        kind: ``value``, ``stderr``, ``bits`` (each bit has a word) or ``words`` (each number has one).
        words: number or bit to words, for the last two.
        packed: the map; None where it is not in the file or where ``same_as`` says it all.
        same_as: path of a map that this one is a multiple of, and the factor.
    """

    path: str
    label: str
    unit: str
    sentence: str
    kind: str = "value"
    words: Mapping[int, str] = field(default_factory=dict)
    packed: PackedMap | None = None
    same_as: tuple[str, float] | None = None


@dataclass(frozen=True)
class PixelSample:
    """Pixels that are in the file in full.

    Attributes:
        index: ``y * nx + x`` of each, shape (n,).
        exact: path of a map to its values at these pixels, shape (n,).
        origin: DN of the first bin of each histogram, shape (n,).
        counts: their histograms.
        deciding: parameters that decide electron numbers, where these are not the fitted ones: (4, n).
        masses: probability of each bin under a model with effects, of as many of the first pixels.
        reasons: why pixels are here, with their indices, e.g. ``"poorest goodness of fit"``.
    """

    index: NDArray[np.int64]
    exact: Mapping[str, NDArray[np.float64]]
    origin: NDArray[np.int64]
    counts: list[NDArray[np.integer[Any]]]
    deciding: NDArray[np.float64] | None = None
    masses: list[NDArray[np.float64]] = field(default_factory=list)
    reasons: tuple[tuple[str, tuple[int, ...]], ...] = ()


@dataclass(frozen=True)
class InspectorData:
    """All that the inspector holds.

    Attributes:
        maps: in the order of the list; those not packed are shown by ``pchem view`` only.
        sample: the pixels in full.
        kept_to: how true the packed maps are: a part of a standard error, in words.
        command: what shows every pixel.
    """

    maps: tuple[MapEntry, ...]
    sample: PixelSample
    kept_to: str
    command: str
