"""Blocks of frames as they stream by: every frame once, whatever the bands, the blocks and the threads."""

import threading
import time
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pchem_pipeline.frames.stream import FrameStream


class _Source:
    def __init__(self, frames, then=lambda t0: None):
        self._frames, self.shape, self.dtype = frames, frames.shape, frames.dtype
        self.rows_per_read, self._then = 1, then

    def read_into(self, buffer, t0, t1, y0=0, y1=None):
        buffer[...] = self._frames[t0:t1, y0:y1]
        self._then(t0)


FRAMES = np.arange(21 * 7 * 3, dtype=np.uint16).reshape(21, 7, 3)


@given(
    step=st.integers(1, 30),
    frames=st.tuples(st.integers(0, 21), st.integers(0, 21)).map(sorted).map(tuple),
    threads=st.integers(1, 4),
    cuts=st.lists(st.integers(0, 7), min_size=2, unique=True).map(sorted),
)
def test_every_frame_of_every_band_comes_once(step, frames, threads, cuts):
    bands = list(pairwise(cuts))
    with FrameStream(_Source(FRAMES), bands, step, frames=frames, threads=threads) as stream:
        assert stream.bands == bands
        blocks = [(t0, [part.copy() for part in parts]) for t0, parts in stream]
        assert all(part.shape[0] for _, parts in blocks for part in parts)
    t, last = frames
    for t0, parts in blocks:
        assert t0 == t
        end = min(t0 - t0 % step + step, last)  # blocks end at multiples of the step
        for rows, part in zip(bands, parts, strict=True):
            np.testing.assert_array_equal(part, FRAMES[t0:end, slice(*rows)])
        t = end
    assert t == last


def test_the_next_block_is_read_while_one_is_used():
    reading = threading.Event()
    source = _Source(FRAMES, lambda t0: reading.set() if t0 == 4 else None)
    with FrameStream(source, [(0, 7)], 4) as stream:
        for t0, (part,) in stream:
            if t0 == 0:
                assert reading.wait(10)
            np.testing.assert_array_equal(part, FRAMES[t0 : t0 + 4])  # not overwritten meanwhile


@pytest.mark.parametrize("threads", [1, 3])
def test_a_broken_reader_is_heard(threads):
    def broken(t0):
        if t0 >= 4:
            raise OSError("gone")

    seen, source = [], _Source(FRAMES, broken)
    with pytest.raises(OSError, match="gone"), FrameStream(source, [(0, 3)], 4, threads=threads) as stream:
        seen.extend(t0 for t0, _ in stream)
    assert seen == [0]


def test_no_thread_outlives_the_stream():
    before = threading.active_count()
    with FrameStream(_Source(FRAMES, lambda _: time.sleep(0.02)), [(0, 7)], 2) as stream:
        next(iter(stream))  # the block behind it is being read
        assert threading.active_count() > before
    assert threading.active_count() == before
