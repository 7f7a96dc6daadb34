"""Sums and covariances against numpy."""

import numpy as np
import pytest

from pchem_pipeline.model.histogram.summaries import (
    ROW_GROUP,
    SummaryAccumulator,
    block_starts,
    frame_statistics,
    line_sums,
)


def noise(seed, shape, dtype=np.uint16):
    rng = np.random.default_rng(seed)
    return np.rint(rng.normal(100, 6, shape[1:]) + rng.normal(0, 12, shape)).astype(dtype)


def summarise(frames, block):
    accumulator = SummaryAccumulator(frames.shape[1:], block)
    blocks = accumulator.add(frames)
    last, maps = accumulator.finish()
    return [*blocks, *last], maps


def assert_as_defined(frames, block, scale=1.0):
    """Compare sums and covariances with those straight from their definition, in int64 and float64."""
    blocks, maps = summarise(frames, block)
    exact, (n_frames, ny, nx) = frames.astype(np.int64), frames.shape
    lag, right, down = np.zeros((ny, nx)), np.full((ny, nx), np.nan), np.full((ny, nx), np.nan)
    right[:, :-1], down[:-1] = 0, 0
    freedom = 0
    for start, sums in zip(block_starts(n_frames, block), blocks, strict=True):
        part = exact[start : start + block]
        np.testing.assert_array_equal(sums["block_sum"], part.sum(axis=0))
        np.testing.assert_array_equal(sums["block_sum_square"], (part**2).sum(axis=0))
        d = part - part.mean(axis=0)
        lag += (d[1:] * d[:-1]).sum(axis=0) + (d**2).sum(axis=0) / len(part)
        right[:, :-1] += (d[:, :, 1:] * d[:, :, :-1]).sum(axis=0)
        down[:-1] += (d[:, 1:] * d[:, :-1]).sum(axis=0)
        freedom += len(part) - 1
    down[ROW_GROUP - 1 :: ROW_GROUP] = np.nan
    expected = {"lag1_covariance": lag, "neighbour_covariance_x": right, "neighbour_covariance_y": down}
    for name, values in expected.items():
        np.testing.assert_allclose(maps[name], values / freedom, rtol=1e-9, atol=1e-9 * scale, err_msg=name)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32])
@pytest.mark.parametrize(("n_frames", "block"), [(100, 32), (96, 32), (7, 16), (33, 32)])
def test_against_the_definition(dtype, n_frames, block):
    assert_as_defined(noise(1, (n_frames, 6, 9), dtype), block)


@pytest.mark.parametrize("dtype", [np.uint16, np.uint32])
def test_wide_values_do_not_overflow(dtype):
    top = 65535 if dtype is np.uint16 else (1 << 24) - 1
    frames = (np.random.default_rng(2).integers(0, 2, (512, 4, 5)) * top).astype(dtype)
    frames[:, 2] = 100 + np.arange(512)[:, None] % 7  # a narrow row between wide ones
    assert_as_defined(frames, 512, scale=1e-3 * float(top) ** 2)


def test_largest_spread_that_32_bits_hold():
    # |d| = 2047 over 512 frames is the last that fits, 2048 the first that does not; both must be exact
    for swing in (2047, 2048, 2049):
        frames = np.full((512, 2, 3), 5, np.uint16)
        frames[1:] += np.uint16(swing)
        blocks, maps = summarise(frames, 512)
        np.testing.assert_array_equal(
            blocks[0]["block_sum_square"], (frames.astype(np.int64) ** 2).sum(axis=0)
        )
        np.testing.assert_allclose(
            maps["neighbour_covariance_x"][:, :-1], frames[:, 0, 0].var(ddof=1), rtol=1e-12
        )


def test_a_single_row_column_or_frame_has_no_covariance_across_it():
    for shape in ((20, 1, 6), (20, 6, 1)):
        assert_as_defined(noise(3, shape), 8)
    frames = noise(4, (1, 3, 4))
    blocks, maps = summarise(frames, 8)
    np.testing.assert_array_equal(blocks[0]["block_sum"], frames[0])
    assert np.isnan(maps["lag1_covariance"]).all()


@pytest.mark.parametrize(
    "frames",
    [
        *(noise(6, (5, ROW_GROUP + 6, 9), dtype) for dtype in (np.uint8, np.uint16, np.uint32)),
        np.full((1, ROW_GROUP + 1, 300), (1 << 24) - 1, np.uint32),  # the largest DN
    ],
    ids=lambda frames: f"{frames.dtype}-{frames.max()}",
)
def test_line_sums(frames):
    sums = line_sums(frames)
    exact = frames.astype(np.int64)
    np.testing.assert_array_equal(sums["row_sum"], exact.sum(axis=2))
    np.testing.assert_array_equal(sums["row_sum_square"], (exact**2).sum(axis=2))
    np.testing.assert_array_equal(sums["column_sum"][:, 0], exact[:, :ROW_GROUP].sum(axis=1))
    np.testing.assert_array_equal(sums["column_sum"][:, 1], exact[:, ROW_GROUP:].sum(axis=1))


@pytest.mark.parametrize(("level", "near"), [(0, 1e-11), (1 << 22, 1e-4)])
def test_frame_statistics(level, near):
    frames = noise(7, (6, 10, 11), np.uint32) + np.uint32(level)
    sums = line_sums(frames)
    mean, variance = frame_statistics(sums["row_sum"], sums["row_sum_square"], 11)
    np.testing.assert_allclose(mean, frames.mean(axis=(1, 2)), rtol=1e-14)
    np.testing.assert_allclose(variance, frames.var(axis=(1, 2)), rtol=near)
