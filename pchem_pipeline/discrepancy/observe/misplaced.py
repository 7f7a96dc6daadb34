"""Rows and columns of single frames whose samples belong to other pixels.

Lines change places, come a sample early or late, or lose one on the way: every sample is then one of another
pixel. The statistic is the gain of log likelihood by a small share of lines at other places, less that of
lines put together from samples of different frames, whatever the histograms are.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, CodeArray, Float32Array, FloatArray, IntArray
from pchem_pipeline.discrepancy.observe.digital import MOST_PAIRED
from pchem_pipeline.discrepancy.observe.observe_numba import N_PLACES, STEPS, compare_codes, compare_rows
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.model.arithmetic.significance import CERTAIN
from pchem_pipeline.model.histogram.count import histogram_frames

Lines = Literal["rows", "columns"]

_SHARE = 1e-3  # of the lines, for which the statistic is the best one
_CHANCE = 4.0  # variance of the sum where hardly a line is likely anywhere else: one or two of them
_STEPS = 40
_FARTHEST = 60.0  # logarithm of a ratio: beyond it nothing changes


def misplaced_lines(
    frames: CodeArray, counts: NDArray[Any], origin: IntArray, usable: BoolArray
) -> tuple[dict[str, float], dict[str, FloatArray]]:
    """Return the statistics of misplaced rows and columns, and their shares by place.

    Frames are codes (frame, y, x), DN; histograms of their pixels are (y * x, B), with bin 0 at ``origin``.
    The shares, by "rows" and "columns" where these stand out, are the likeliest ones of lines from each of
    :data:`~.evidence.PLACES`, less those by chance, shape (6,).
    """
    z: dict[str, float] = {}
    shares: dict[str, FloatArray] = {}
    if min(usable.shape) < 2:
        return z, shares
    chosen = frames[:: max(1, -(-frames.size // MOST_PAIRED))]
    of_rows = _Table.of(counts, origin, usable)
    for lines in get_args(Lines):
        table = of_rows.along(lines)
        turned = _turned(chosen, lines)
        strides = 0, max(1, len(turned) // turned.shape[2])
        gain, chance = (table.compared(turned, each, whole=False)[0] for each in strides)
        beyond = float((gain.sum() - chance.sum()) / np.sqrt(2.0 * (chance**2).sum() + _CHANCE))
        z[f"space.misplaced.{lines}"] = beyond
        if beyond > CERTAIN:
            seen, mixed = (_shares(table.compared(turned, each, whole=True)[1]) for each in strides)
            shares[lines] = np.maximum(seen - mixed, 0.0)
    return z, shares


def own_lines(frames: CodeArray, usable: BoolArray, effects: Iterable[Effect]) -> CodeArray:
    """Return frames in which lines that effects likely misplaced are those of other frames, drawn at random.

    Each sample in a pixel's histogram is then of that pixel, and their number stays.
    """
    found = frames
    for effect in effects:
        for lines, share in effect.displaced().items():
            inside = usable if effect.region is None else usable & effect.region.mask(usable.shape)
            if share.any() and inside.any() and min(usable.shape) > 1:
                # the histograms of the first pass hold the misplaced samples, too
                for _ in range(2):
                    moved = _moved(frames, found, inside, lines, share)
                    found = _turned(with_others(_turned(frames, lines), moved), lines)
    return found


def _moved(
    frames: NDArray[Any], own: NDArray[Any], usable: BoolArray, lines: Lines, share: FloatArray
) -> BoolArray:
    """Return which lines are likelier misplaced than not, (frame, line), by the histograms of ``own``."""
    histograms = histogram_frames(own)
    counts = histograms.counts.reshape(usable.size, -1)
    table = _Table.of(counts, histograms.origin.ravel().astype(np.int64), usable).along(lines)
    ratios = table.compared(_turned(frames, lines), 0, whole=True)[1].astype(np.float64)
    likelier = (np.exp(np.minimum(ratios, _FARTHEST)) * share).sum(axis=2)
    return np.asarray(likelier > 1.0 - share.sum())


def with_others(frames: NDArray[Any], moved: BoolArray) -> NDArray[Any]:
    """Return frames (frame, line, sample) with some lines replaced by those of others, drawn at random."""
    found, rng = frames.copy(), np.random.default_rng(0)
    for y in np.flatnonzero(moved.any(axis=0) & ~moved.all(axis=0)):
        gone, left = np.flatnonzero(moved[:, y]), np.flatnonzero(~moved[:, y])
        found[gone, y] = frames[rng.choice(left, gone.size), y]
    return found


def _turned(values: NDArray[Any], lines: Lines) -> NDArray[Any]:
    """Return frames (frame, y, x) with the lines in the place of the rows."""
    return np.ascontiguousarray(values if lines == "rows" else values.swapaxes(1, 2))


@dataclass(frozen=True)
class _Table:
    """Likelihood ratios of the codes of pixels (see ``compare_rows``), the lines in the place of the rows."""

    first: IntArray  # DN of the first code, (y, x)
    ratios: Float32Array  # (y, x, B, 4)

    @classmethod
    def of(cls, counts: NDArray[Any], origin: IntArray, usable: BoolArray) -> _Table:
        """Return it of rows, for histograms (y * x, B) whose bins begin at ``origin``, DN."""
        some = np.flatnonzero((counts > 0).any(axis=0))
        # one more on either side stands for all codes beyond
        real = np.pad(counts[:, some[0] : some[-1] + 1], ((0, 0), (1, 1))) + np.float32(0.5)
        # in place: of a window of many pixels these are the largest arrays of all that observe it
        real /= real.sum(axis=1, keepdims=True)
        own = np.log(real, out=real).astype(np.float32).reshape(*usable.shape, -1)
        del real
        first = (origin + some[0] - 1).reshape(usable.shape)
        ratios = np.empty((*own.shape, len(STEPS)), np.float32)
        compare_codes(own, first, usable, ratios)
        return cls(first, ratios)

    def along(self, lines: Lines) -> _Table:
        """Return it with the lines in the place of the rows."""
        if lines == "rows":
            return self
        order = [STEPS.index((dx, dy)) for dy, dx in STEPS]
        ratios = np.take(self.ratios.swapaxes(0, 1), order, axis=-1)
        return _Table(np.ascontiguousarray(self.first.T), ratios)

    def compared(self, lines: NDArray[Any], stride: int, *, whole: bool) -> tuple[FloatArray, Float32Array]:
        """Return what a share of misplaced rows gains each, and likelihood ratios (frame, y, N_PLACES)."""
        ratios = np.empty((*lines.shape[:2], N_PLACES), np.float32)
        gains = np.empty(lines.shape[:2])
        compare_rows(lines, self.first, self.ratios, stride, _SHARE, whole, ratios, gains)
        return gains, ratios


def _shares(ratios: Float32Array) -> FloatArray:
    """Return the likeliest shares of lines that come from each place, by expectation and maximisation."""
    likelihood = np.exp(np.minimum(ratios.reshape(-1, N_PLACES).astype(np.float64), _FARTHEST))
    share = np.full(N_PLACES, _SHARE)
    for _ in range(_STEPS):
        weighted = likelihood * share
        share = (weighted / (1.0 - share.sum() + weighted.sum(axis=1, keepdims=True))).mean(axis=0)
    return np.asarray(share)
