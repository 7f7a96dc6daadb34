"""Stacks from a simulator of their own (plain numpy), and their summaries as a quick look takes them."""

from collections.abc import Callable
from typing import Any

import numpy as np

from pchem_pipeline.discrepancy.quick.codes import CodeSample
from pchem_pipeline.discrepancy.quick.sums import StackSums
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.model.histogram.count import histogram_frames
from pchem_pipeline.model.histogram.odd_frames import MovedFrames, frame_scores, left_out, odd_frames
from pchem_pipeline.model.histogram.spectrum import FrameSpectrum
from pchem_pipeline.model.histogram.summaries import (
    ROW_GROUP,
    SummaryAccumulator,
    block_starts,
    frame_statistics,
    line_sums,
)

Array = np.ndarray[Any, Any]
GAIN, EXPOSURE, READ_NOISE = 0.125, 1.0, 0.3


def stack(
    rng: np.random.Generator,
    shape: tuple[int, int, int],
    moved: Callable[[Array], Array] = lambda dn: dn,
    *,
    exposure: float | Array = EXPOSURE,
    read_noise: float = READ_NOISE,
    charge: Callable[[Array], Array] = lambda electrons: electrons,
) -> Array:
    """Frames of independent pixels, 8 DN per electron; ``moved`` changes DN before rounding."""
    electrons = charge(rng.poisson(exposure, shape).astype(float))
    dn = (electrons + read_noise * rng.standard_normal(shape)) / GAIN
    bias = 200.0 + 4.0 * rng.standard_normal(shape[1:])
    return np.clip(np.rint(moved(dn + bias)), 0, 65535).astype(np.uint16)


def sums_of(frames: Array, block: int = 256) -> StackSums:
    """The summaries as the stage ``histogram`` makes them; odd frames are in none of the sums."""
    lines = line_sums(frames)
    mean, variance = frame_statistics(lines["row_sum"], lines["row_sum_square"], frames.shape[2])
    _, digest = np.unique([hash(frame.tobytes()) for frame in frames], return_inverse=True)
    level = np.median(lines["row_sum"] - np.median(lines["row_sum"], axis=0), axis=1) / frames.shape[2]
    scores = frame_scores(lines["row_sum"], lines["row_sum_square"], frames.shape[2])
    moved = MovedFrames()
    for part in np.array_split(frames[:, :ROW_GROUP], -(-len(frames) // 256)):
        moved.add(part)
    odd = odd_frames(level, variance, digest, frames[0].size, scores=scores, moved=moved.found)
    numbers = np.setdiff1d(np.arange(len(frames)), left_out(odd, len(frames)))
    frames = frames[numbers]
    n, ny, nx = frames.shape
    summaries = SummaryAccumulator((ny, nx), block)
    blocks = summaries.add(frames)
    rest, covariances = summaries.finish()
    blocks += rest
    lines = line_sums(frames)
    starts = block_starts(n, block)
    spectrum = FrameSpectrum((min(ny, ROW_GROUP), nx))
    spectrum.add(frames[:, :ROW_GROUP])
    return StackSums(
        numbers,
        starts.size,
        np.diff(np.append(starts, n)),
        np.stack([each["block_sum"] for each in blocks]),
        np.stack([each["block_sum_square"] for each in blocks]),
        lines["row_sum"],
        np.arange(starts.size),
        lines["column_sum"],
        mean,
        variance,
        covariances["lag1_covariance"],
        covariances["neighbour_covariance_x"],
        covariances["neighbour_covariance_y"],
        odd,
        spectrum.line(),
    )


def maps_of(shape: tuple[int, int], exposure: float = EXPOSURE, read_noise: float = READ_NOISE) -> PixelMaps:
    """The true parameters, as if they had been fitted."""
    sigma = np.hypot(read_noise / GAIN, 12**-0.5)
    values = [np.full(shape, value) for value in (exposure, GAIN, 200.0, sigma)]
    return PixelMaps(*values, np.ones(shape, bool))


def codes_of(frames: Array, exposure: float = EXPOSURE, read_noise: float = READ_NOISE) -> CodeSample:
    """Histograms of all pixels, with the parameters to start from: moments of each pixel."""
    found = histogram_frames(frames)
    n = found.origin.size
    bias = frames.mean(axis=0).ravel() - exposure / GAIN
    sigma = np.hypot(read_noise / GAIN, 12**-0.5)
    start = np.stack([np.full(n, exposure), np.full(n, GAIN), bias, np.full(n, sigma)], axis=1)
    return CodeSample(found.counts.reshape(n, -1), found.origin.ravel(), start)


def added(part: Any, values: Any) -> Callable[[Array], Array]:
    """Return what adds values, DN, to a part (an index) of samples before they are rounded."""

    def moved(dn: Array) -> Array:
        dn[part] += values
        return dn

    return moved
