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


def summarise(frames, block, cuts=()):
    accumulator = SummaryAccumulator(frames.shape[1:], block)
    blocks = [done for part in np.split(frames, cuts) for done in accumulator.add(part)]
    last, maps = accumulator.finish()
    return blocks + last, maps


def reference(frames, block):
    """Covariances straight from their definition, in float64."""
    x = frames.astype(np.float64)
    n_frames, ny, nx = x.shape
    lag, right, down = np.zeros((ny, nx)), np.full((ny, nx), np.nan), np.full((ny, nx), np.nan)
    right[:, :-1], down[:-1] = 0, 0
    freedom = 0
    for start in block_starts(n_frames, block):
        part = x[start : start + block]
        n = part.shape[0]
        d = part - part.mean(axis=0)
        lag += (d[1:] * d[:-1]).sum(axis=0) + (d**2).sum(axis=0) / n
        right[:, :-1] += (d[:, :, 1:] * d[:, :, :-1]).sum(axis=0)
        down[:-1] += (d[:, 1:] * d[:, :-1]).sum(axis=0)
        freedom += n - 1
    down[ROW_GROUP - 1 :: ROW_GROUP] = np.nan
    return lag / freedom, right / freedom, down / freedom


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32])
@pytest.mark.parametrize(("n_frames", "block"), [(100, 32), (96, 32), (7, 16), (33, 32)])
def test_against_the_definition(dtype, n_frames, block):
    frames = noise(1, (n_frames, 6, 9), dtype)
    blocks, maps = summarise(frames, block)
    starts = block_starts(n_frames, block)
    exact = frames.astype(np.int64)
    assert len(blocks) == len(starts)
    for start, sums in zip(starts, blocks, strict=True):
        np.testing.assert_array_equal(sums.block_sum, exact[start : start + block].sum(axis=0))
        np.testing.assert_array_equal(sums.block_sum_square, (exact[start : start + block] ** 2).sum(axis=0))
    lag, right, down = reference(frames, block)
    np.testing.assert_allclose(maps.lag1_covariance, lag, rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(maps.neighbour_covariance_x, right, rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(maps.neighbour_covariance_y, down, rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize("dtype", [np.uint16, np.uint32])
def test_wide_values_do_not_overflow(dtype):
    top = 65535 if dtype is np.uint16 else (1 << 24) - 1
    rng = np.random.default_rng(2)
    frames = (rng.integers(0, 2, (512, 4, 5)) * top).astype(dtype)
    frames[:, 2] = 100 + np.arange(512)[:, None] % 7  # a narrow row between wide ones
    blocks, maps = summarise(frames, 512)
    exact = frames.astype(np.int64)
    np.testing.assert_array_equal(blocks[0].block_sum_square, (exact**2).sum(axis=0))
    lag, right, down = reference(frames, 512)
    scale = float(top) ** 2
    np.testing.assert_allclose(maps.lag1_covariance, lag, rtol=1e-9, atol=1e-12 * scale)
    np.testing.assert_allclose(maps.neighbour_covariance_x, right, rtol=1e-9, atol=1e-12 * scale)
    np.testing.assert_allclose(maps.neighbour_covariance_y, down, rtol=1e-9, atol=1e-12 * scale)


def test_largest_spread_that_32_bits_hold():
    # |d| = 2047 over 512 frames is the last that fits, 2048 the first that does not; both must be exact
    for swing in (2047, 2048, 2049):
        frames = np.full((512, 2, 3), 5, np.uint16)
        frames[1:] += np.uint16(swing)
        blocks, maps = summarise(frames, 512)
        np.testing.assert_array_equal(blocks[0].block_sum_square, (frames.astype(np.int64) ** 2).sum(axis=0))
        np.testing.assert_allclose(
            maps.neighbour_covariance_x[:, :-1], frames[:, 0, 0].var(ddof=1), rtol=1e-12
        )


def test_single_row_and_single_column():
    _, row = summarise(noise(3, (20, 1, 6)), 8)
    assert np.isnan(row.neighbour_covariance_y).all()
    assert np.isfinite(row.neighbour_covariance_x[:, :-1]).all()
    _, column = summarise(noise(3, (20, 6, 1)), 8)
    assert np.isnan(column.neighbour_covariance_x).all()
    assert np.isfinite(column.neighbour_covariance_y[:-1]).all()


def test_one_frame_has_sums_and_no_covariance():
    frames = noise(4, (1, 3, 4))
    blocks, maps = summarise(frames, 8)
    np.testing.assert_array_equal(blocks[0].block_sum, frames[0])
    assert np.isnan(maps.lag1_covariance).all()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32])
def test_line_sums(dtype):
    frames = noise(6, (5, ROW_GROUP + 6, 9), dtype)
    sums = line_sums(frames)
    exact = frames.astype(np.int64)
    np.testing.assert_array_equal(sums.row_sum, exact.sum(axis=2))
    np.testing.assert_array_equal(sums.row_sum_square, (exact**2).sum(axis=2))
    np.testing.assert_array_equal(sums.column_sum[:, 0], exact[:, :ROW_GROUP].sum(axis=1))
    np.testing.assert_array_equal(sums.column_sum[:, 1], exact[:, ROW_GROUP:].sum(axis=1))


def test_line_sums_of_the_largest_dn():
    frames = np.full((1, ROW_GROUP, 300), (1 << 24) - 1, np.uint32)
    sums = line_sums(frames)
    assert sums.row_sum_square[0, 0] == 300 * ((1 << 24) - 1) ** 2
    assert sums.column_sum[0, 0, 0] == ROW_GROUP * ((1 << 24) - 1)


def test_frame_statistics_with_a_large_mean():
    frames = noise(7, (6, 10, 11)).astype(np.uint32) + np.uint32(1 << 22)
    sums = line_sums(frames)
    mean, variance = frame_statistics(sums.row_sum, sums.row_sum_square, 11)
    np.testing.assert_allclose(mean, frames.mean(axis=(1, 2)), rtol=1e-14)
    np.testing.assert_allclose(variance, frames.var(axis=(1, 2)), rtol=1e-4)
    plain = line_sums(noise(7, (6, 10, 11)))
    _, variance = frame_statistics(plain.row_sum, plain.row_sum_square, 11)
    np.testing.assert_allclose(variance, noise(7, (6, 10, 11)).var(axis=(1, 2)), rtol=1e-11)
