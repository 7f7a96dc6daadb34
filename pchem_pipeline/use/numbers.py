"""Electron numbers of samples under the law of their own pixel, with the probability that they are right."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.law.inputs import pack
from pchem_pipeline.model.maps.pixels import FloatArray
from pchem_pipeline.use import levels_numba
from pchem_pipeline.use.calibration import Calibration
from pchem_pipeline.use.levels_numba import NO_PRIOR

__all__ = ["NO_PRIOR", "NumberTables", "Numbers", "number_tables", "number_type"]

IntArray = NDArray[np.int64]


@dataclass(frozen=True)
class Numbers:
    """Electron numbers of samples, each array (frame, y, x).

    Attributes:
        number: the most probable one; the largest value of the type where a pixel has no calibration.
        probability: that it is right.
        expected: E[k | x], e-; empty where it was not asked for.
    """

    number: NDArray[np.unsignedinteger[Any]]
    probability: NDArray[np.float32]
    expected: NDArray[np.float32]


@dataclass(frozen=True)
class NumberTables:
    """What each code of each pixel says of the electron number.

    Attributes:
        shape: rows and columns.
        first: first code of each pixel, shape (n,).
        start: place of its first code in the tables, shape (n + 1,).
        number: most probable number at each code.
        probability: that it is right.
        expected: E[k | x], e-.
    """

    shape: tuple[int, int]
    first: IntArray
    start: IntArray
    number: NDArray[np.unsignedinteger[Any]]
    probability: NDArray[np.float32]
    expected: NDArray[np.float32]

    def convert(self, frames: NDArray[np.unsignedinteger[Any]], *, expected: bool, lift: int = 0) -> Numbers:
        """Return the electron numbers of samples, which must lie within the codes of their pixels.

        Args:
            frames: codes, shape (frame, y, x).
            expected: whether the mean is wanted, too.
            lift: by which the codes were raised.
        """
        n_frames, n = frames.shape[0], self.first.size
        number = np.empty((n_frames, n), self.number.dtype)
        probability = np.empty((n_frames, n), np.float32)
        mean = np.empty((n_frames, n) if expected else (0, 0), np.float32)
        tables = (self.first + lift, self.start, self.number, self.probability, self.expected)
        levels_numba.convert_frames(frames.reshape(n_frames, n), *tables, expected, number, probability, mean)
        shape = (n_frames, *self.shape)
        return Numbers(
            number.reshape(shape), probability.reshape(shape), mean.reshape(shape) if expected else mean
        )


def number_type(largest: float) -> np.dtype[Any]:
    """Return uint8 where all electron numbers fit, one being kept for 'none', else uint16."""
    return np.dtype(np.uint8 if largest < np.iinfo(np.uint8).max else np.uint16)


def number_tables(
    minimum: NDArray[np.integer[Any]],
    maximum: NDArray[np.integer[Any]],
    prior: FloatArray | None,
    calibration: Calibration,
    *,
    dtype: np.dtype[Any],
    parts: int = 1,
) -> NumberTables:
    """Return the electron number of each code that pixels have shown.

    The most probable k has the largest ``P(k; H) P(x | k)``; that it is right has the probability of its
    share in the sum over all k. Without a prior all k are alike beforehand.

    Args:
        minimum: smallest code of each pixel, shape (y, x).
        maximum: largest code, likewise.
        prior: exposure of each pixel, e-, shape (y, x); NaN: no numbers for the pixel; None: no prior.
        calibration: of these pixels.
        dtype: of the numbers; its largest value means none.
        parts: codes in a DN.
    """
    n = minimum.size
    first = np.ascontiguousarray(minimum.ravel(), np.int64)
    sizes = np.maximum(maximum.ravel().astype(np.int64) - first + 1, 0)
    start = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    number = np.empty(start[-1], np.uint16)
    probability, expected = (np.empty(start[-1], np.float32) for _ in range(2))
    missing = int(np.iinfo(dtype).max)
    weights = np.full(n, NO_PRIOR) if prior is None else np.ascontiguousarray(prior.ravel(), np.float64)
    levels_numba.fill_tables(
        first,
        start,
        parts,
        weights,
        calibration.columns,
        calibration.own_satellites,
        pack([calibration.law], n),
        missing - 1,
        missing,
        number,
        probability,
        expected,
    )
    shape = (minimum.shape[0], minimum.shape[1])
    return NumberTables(shape, first, start, number.astype(dtype), probability, expected)
