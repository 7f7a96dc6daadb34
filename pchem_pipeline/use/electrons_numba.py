"""Loops over the samples of calibrated frames."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel

__all__ = ["add_up", "subtract_and_scale", "whole_parts"]

Float32Array = NDArray[np.float32]


@kernel
def subtract_and_scale(
    frames: NDArray[Any],
    gain: Float32Array,
    bias: Float32Array,
    offsets: Float32Array,
    out: Float32Array,
) -> None:
    """Fill ``g (x - mu - b)``.

    Args:
        frames: DN, shape (frame, y, x).
        gain: e-/DN, shape (y, x).
        bias: DN, shape (y, x).
        offsets: b of each sample, DN, shape of the frames, or (0, 0, 0): none.
        out: out, e-.
    """
    for t in range(frames.shape[0]):
        for y in range(frames.shape[1]):
            for x in range(frames.shape[2]):
                out[t, y, x] = gain[y, x] * (np.float32(frames[t, y, x]) - bias[y, x])
            if offsets.shape[0] > 0:
                for x in range(frames.shape[2]):
                    out[t, y, x] -= gain[y, x] * offsets[t, y, x]


@kernel
def add_up(
    frames: NDArray[Any],
    offsets: Float32Array,
    sums: NDArray[np.float64],
) -> None:
    """Add x, x^2 and, where there are offsets, those of x - b of each pixel to its sums, and see its range.

    Args:
        frames: DN, shape (frame, y, x).
        offsets: b, DN, as in `subtract_and_scale`.
        sums: out, shape (6, y, x): x, x^2, the same without offsets (they stay where there are none), and
            the smallest and largest x.
    """
    for t in range(frames.shape[0]):
        for y in range(frames.shape[1]):
            for x in range(frames.shape[2]):
                value = np.float64(frames[t, y, x])
                sums[0, y, x] += value
                sums[1, y, x] += value * value
                sums[4, y, x] = min(sums[4, y, x], value)
                sums[5, y, x] = max(sums[5, y, x], value)
                if offsets.shape[0] > 0:
                    value -= offsets[t, y, x]
                    sums[2, y, x] += value
                    sums[3, y, x] += value * value


@kernel
def whole_parts(
    frames: NDArray[Any],
    offsets: Float32Array,
    parts: int,
    lift: int,
    out: NDArray[np.uint32],
) -> None:
    """Fill ``x - b`` in whole parts of a DN, ``lift`` DN higher so that none is negative.

    Args:
        frames: DN, shape (frame, y, x).
        offsets: b, DN, shape of the frames.
        parts: codes in a DN.
        lift: DN.
        out: out, shape of the frames.
    """
    for t in range(frames.shape[0]):
        for y in range(frames.shape[1]):
            for x in range(frames.shape[2]):
                value = np.float64(frames[t, y, x]) + lift - offsets[t, y, x]
                out[t, y, x] = np.uint32(max(value * parts + 0.5, 0.0))
