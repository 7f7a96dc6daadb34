"""Overscan: pixels without electrons, which tell their bias and noise, and the offsets of frames and rows."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE


@dataclass(frozen=True)
class Overscan:
    """What the overscan of a run says; maps are NaN outside of it, and in pixels that never change.

    Attributes:
        bias: mean of the codes of each pixel, DN, shape (y, x).
        read_noise_dn: their standard deviation, quantisation and what rows and frames share included, DN.
        n_frames: frames that tell it.
        frame_variance: of the offsets that frames have, DN^2.
        row_variance: of those that rows have beside, new in each frame, DN^2.
    """

    bias: FloatArray
    read_noise_dn: FloatArray
    n_frames: int
    frame_variance: float
    row_variance: float

    @classmethod
    def measured(cls, frames: Iterable[FloatArray], where: BoolArray) -> Overscan:
        """Return that of the samples of frames in the pixels ``where`` (y, x), in C order, DN, (pixel,)."""
        rows: list[FloatArray] = []
        first, total, square = np.zeros((3, int(where.sum())))
        for values in frames:
            first = first if rows else values  # from which codes differ by little
            total += values - first
            square += (values - first) ** 2
            rows.append(_row_sums(values - first, where))
        n = len(rows)
        bias, noise = np.full((2, *where.shape), np.nan)
        square -= total**2 / n
        alive = square > 0.0
        bias[where] = np.where(alive, first + total / n, np.nan)
        noise[where] = np.sqrt(np.where(alive, square, np.nan) / (n - 1))
        number = np.isfinite(bias).sum(axis=1)
        known = number > 0
        means = np.array(rows)[:, known] / number[known]
        scatter = np.nansum(noise**2, axis=1)[known] / number[known] ** 2
        found = _variances(means - means.mean(axis=0), scatter, number[known], n - 1)
        return cls(bias, noise, n, *found)

    @property
    def stderr(self) -> tuple[FloatArray, FloatArray]:
        """Standard errors of bias and read noise, DN, shape (y, x) each."""
        n = self.n_frames
        return self.read_noise_dn / np.sqrt(n), self.read_noise_dn / np.sqrt(2.0 * (n - 1))

    @property
    def shared_variance(self) -> float:
        """Variance that a sample has from its frame and its row, DN^2."""
        return self.frame_variance + self.row_variance

    @property
    def own_variance(self) -> FloatArray:
        """Variance that the pixels share with no other, DN^2, shape (y, x)."""
        return np.maximum(self.read_noise_dn**2 - self.shared_variance, QUANTISATION_VARIANCE)

    def variances_in(self, frames: Iterable[FloatArray]) -> tuple[float, float]:
        """Return the variances of the offsets that other frames, and their rows, have from the bias, DN^2.

        Of the pixels with a bias; frames as in `measured`.
        """
        where = np.isfinite(self.bias)
        number, bias = where.sum(axis=1), self.bias[where]
        known = number > 0
        rows = np.array([_row_sums(values - bias, where) for values in frames])[:, known] / number[known]
        own = np.where(where, self.own_variance, 0.0).sum(axis=1)[known] / number[known] ** 2
        return _parted(rows, own, len(rows))


def _row_sums(values: FloatArray, where: BoolArray) -> FloatArray:
    """Return the sums of the rows, (y,)."""
    return np.bincount(np.nonzero(where)[0], values, len(where)).astype(np.float64)


def _variances(rows: FloatArray, scatter: FloatArray, number: IntArray, degrees: int) -> tuple[float, float]:
    """Return the variances of the offsets of frames and rows, DN^2, from samples that include them.

    ``rows`` as in `_parted`; ``scatter`` is the sum of the variances of a row's samples, over the square of
    their ``number``, shape (row,).
    """
    if number.size < 2:
        return 0.0, 0.0
    # the mean of a row has all of what it shares, its samples' scatter one part in their number
    alone = 1.0 - float((1.0 / number).mean())
    excess = float((rows**2).sum()) / (degrees * number.size) - float(scatter.mean())
    shared = max(excess / alone, 0.0) if alone > 0.0 else 0.0
    return _parted(rows, scatter - shared / number, degrees)


def _parted(rows: FloatArray, own: FloatArray, degrees: int) -> tuple[float, float]:
    """Return the variances of the offsets of frames and of rows, DN^2; 0 where a single row tells none.

    ``rows`` are their means less those over the frames, (frame, row), with as many ``degrees`` of freedom of
    the frames; ``own`` is the variance that the pixels' own noise gives to each, (row,).
    """
    if own.size < 2:
        return 0.0, 0.0
    of_frame = rows.mean(axis=1)
    within = float(((rows - of_frame[:, None]) ** 2).sum()) / (degrees * (own.size - 1))
    between = float((of_frame**2).sum()) / degrees
    return max(between - within / own.size, 0.0), max(within - float(own.mean()), 0.0)
