"""Per-pixel histograms against numpy, their windows, and the choice of the number of bins."""

import numpy as np
import pytest

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.model.histogram.count import choose_bins, counts_dtype, histogram_frames, pixels_by_range


def pcd_like(seed, shape, dtype=np.uint16):
    rng = np.random.default_rng(seed)
    bias = rng.normal(100, 6, shape[1:])
    return np.rint(bias + 11 * (rng.poisson(1.5, shape) + rng.normal(0, 0.3, shape))).astype(dtype)


def test_what_fits_is_in_the_middle_of_its_window():
    frames = pcd_like(2, (300, 3, 4)) + np.uint16(1000)
    result = histogram_frames(frames, bins=256)
    left = result.minimum - result.origin
    right = result.origin + 255 - result.maximum
    assert np.all((right - left >= 0) & (right - left <= 1))


def test_window_near_zero_does_not_begin_below_it():
    frames = np.tile(np.array([0, 3, 1], np.uint16)[:, None, None], (1, 2, 2))
    result = histogram_frames(frames, bins=32)
    assert np.all(result.origin == 0)
    np.testing.assert_array_equal(result.counts[0, 0, :4], [1, 1, 0, 1])


def test_a_late_glitch_is_counted_as_over_and_moves_nothing():
    frames = pcd_like(4, (600, 2, 2))
    clean = histogram_frames(frames, bins=160)
    frames[450, 0, 1] = 4000
    frames[500, 0, 1] = 1
    result = histogram_frames(frames, bins=160)
    assert (result.under[0, 1], result.over[0, 1]) == (1, 1)
    assert result.counts[0, 1].sum() == 598
    assert (result.minimum[0, 1], result.maximum[0, 1]) == (1, 4000)
    np.testing.assert_array_equal(result.counts[[0, 1, 1], [0, 0, 1]], clean.counts[[0, 1, 1], [0, 0, 1]])


def test_an_early_glitch_does_not_take_the_window_with_it():
    frames = pcd_like(5, (600, 1, 2))
    frames[0] = 4095
    result = histogram_frames(frames, bins=160)
    assert np.all(result.over == 1)
    assert np.all(result.under == 0)
    assert np.all(result.counts.sum(axis=2) == 599)


def test_more_than_24_bits_are_refused():
    frames = np.full((3, 2, 2), 1 << 24, np.uint32)
    with pytest.raises(InputError, match="more than 24 bits"):
        histogram_frames(frames, bins=32)


def test_counts_are_wide_enough():
    assert (counts_dtype(65535), counts_dtype(65536)) == (np.uint16, np.uint32)
    assert histogram_frames(np.zeros((70_000, 1, 1), np.uint8), bins=32).counts.max() == 70_000


@pytest.mark.parametrize(
    ("ranges", "most", "expected"),
    [
        ({1: 100}, 1024, 32),
        ({60: 100}, 1024, 144),
        ({60: 100, 200: 1}, 1024, 416),  # a hot pixel gets its window
        ({60: 100, 290: 1}, 1024, 144),  # its need of 608 is above 4 * 144 and 512: wild
        ({100: 100, 290: 1}, 1024, 608),
        ({60: 100, 1025: 3}, 1024, 144),  # hopeless pixels do not decide
        ({1025: 100, 60: 3}, 1024, 1024),
        ({700: 100}, 1024, 1024),
        ({65: 5}, 64, 64),
    ],
)
def test_bins_are_as_many_as_nearly_all_pixels_need(ranges, most, expected):
    pixels = np.zeros(most + 2, np.int64)
    pixels[list(ranges)] = list(ranges.values())
    assert choose_bins(pixels, most) == expected


def test_single_glitches_are_left_out_of_the_range_but_hot_pixels_are_not():
    frames = pcd_like(7, (256, 4, 4))
    ordered = np.sort(frames.astype(int), axis=0)
    expected = np.bincount((ordered[-4] - ordered[3] + 1).ravel(), minlength=1026)
    np.testing.assert_array_equal(pixels_by_range(frames, 1024), expected)
    plain = choose_bins(pixels_by_range(frames, 1024), 1024)
    frames[3, 1, 1], frames[90, 1, 1], frames[100, 2, 2] = 4000, 0, 65535
    assert choose_bins(pixels_by_range(frames, 1024), 1024) == plain
    frames[::20, 3, 3] += 60
    assert choose_bins(pixels_by_range(frames, 1024), 1024) > plain
    assert choose_bins(pixels_by_range(np.full((1, 2, 2), 9, np.uint16), 1024), 1024) == 32


def test_typical_window_leaves_room_for_a_hundred_times_more_frames():
    result = histogram_frames(pcd_like(9, (25_600, 3, 3)))
    assert not result.over.any()
    assert not result.under.any()
    assert result.counts.shape[2] <= 256
