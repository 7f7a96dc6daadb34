"""The answer does not depend on how frames and rows are cut."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pchem_pipeline.model.histogram.count import HistogramAccumulator
from pchem_pipeline.model.histogram.summaries import ROW_GROUP, SummaryAccumulator


@st.composite
def stacks(draw, rows):
    """Frames of any kind: quiet, drifting, with jumps and glitches, over the whole range of the type."""
    dtype = draw(st.sampled_from([np.uint8, np.uint16, np.uint32]))
    top = min(np.iinfo(dtype).max, (1 << 24) - 1)
    shape = (draw(st.integers(1, 40)), draw(rows), draw(st.integers(1, 5)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    level = draw(st.integers(0, top))
    values = level + rng.normal(0, draw(st.sampled_from([0.0, 2.0, 20.0])), shape)
    values += np.linspace(0, draw(st.integers(-200, 200)), shape[0])[:, None, None]
    glitches = rng.random(shape) < draw(st.sampled_from([0.0, 0.01, 0.3]))
    values[glitches] = rng.integers(0, top + 1, int(glitches.sum()))
    return np.clip(np.rint(values), 0, top).astype(dtype)


def cuts(draw, start, end):
    return sorted(draw(st.sets(st.integers(start, end), max_size=4)))


def count(parts, bins):
    histograms = HistogramAccumulator(parts[0].shape[1:], bins, sum(part.shape[0] for part in parts))
    for part in parts:
        histograms.add(part)
    return histograms.finish()


def assert_same(one, other):
    assert one.keys() == other.keys()
    for name, expected in one.items():
        np.testing.assert_array_equal(other[name], expected, err_msg=name)


def joined(bands):
    return {name: np.concatenate([band[name] for band in bands]) for name in bands[0]}


@settings(deadline=None, max_examples=100)
@given(st.data(), stacks(st.integers(1, 6)))
def test_histograms_do_not_depend_on_blocks_and_bands(data, frames):
    bins = data.draw(st.sampled_from([32, 48, 256]))
    first = data.draw(st.integers(1, frames.shape[0]))
    whole = vars(count(np.split(frames, [first]), bins))
    times = [first, *cuts(data.draw, first, frames.shape[0])]
    rows = cuts(data.draw, 1, max(1, frames.shape[1] - 1))
    bands = [band for band in np.split(frames, rows, axis=1) if band.shape[1]]
    parts = [vars(count(np.split(np.ascontiguousarray(b), times), bins)) for b in bands]
    assert_same(whole, joined(parts))


@settings(deadline=None, max_examples=100)
@given(st.data(), stacks(st.integers(1, 4)))
def test_histograms_are_exact(data, frames):
    bins = data.draw(st.sampled_from([32, 64, 512]))
    times = cuts(data.draw, 1, frames.shape[0])
    result = count(np.split(frames, times), bins)
    values = frames.astype(np.int64)
    np.testing.assert_array_equal(result.minimum, values.min(axis=0))
    np.testing.assert_array_equal(result.maximum, values.max(axis=0))
    np.testing.assert_array_equal(result.under, (values < result.origin).sum(axis=0))
    np.testing.assert_array_equal(result.over, (values >= result.origin + bins).sum(axis=0))
    fits = values.max(axis=0) - values.min(axis=0) < bins
    assert not (result.under + result.over)[fits].any()
    for y, x in np.ndindex(result.origin.shape):
        k = values[:, y, x] - result.origin[y, x]
        inside = k[(k >= 0) & (k < bins)]
        np.testing.assert_array_equal(result.counts[y, x], np.bincount(inside, minlength=bins))


def summarise(parts, block):
    accumulator = SummaryAccumulator(parts[0].shape[1:], block)
    blocks = [done for part in parts for done in accumulator.add(part)]
    last, maps = accumulator.finish()
    return blocks + last, maps


@settings(deadline=None, max_examples=40)
@given(st.data(), stacks(st.sampled_from([1, 2, 5, ROW_GROUP, ROW_GROUP + 1, 2 * ROW_GROUP + 3])))
def test_summaries_do_not_depend_on_reading_and_bands(data, frames):
    block = data.draw(st.integers(2, 45))
    blocks, maps = summarise([frames], block)
    times = cuts(data.draw, 0, frames.shape[0])
    borders = [row for row in (ROW_GROUP, 2 * ROW_GROUP) if row < frames.shape[1]]
    borders = [row for row in borders if data.draw(st.booleans())]
    bands = [summarise(np.split(part, times), block) for part in np.split(frames, borders, axis=1)]
    # equal to the bit: the sums are of integers, and the rest is done for each pixel by itself
    assert_same(maps, joined([band[1] for band in bands]))
    for expected, *parts in zip(blocks, *(band[0] for band in bands), strict=True):
        assert_same(expected, joined(parts))
