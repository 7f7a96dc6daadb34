"""Any window of any stack in any format equals the same slice of the whole array."""

import tempfile
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.frames.writing import WRITERS, write_frames

DTYPES = ("uint8", "uint16", "uint32")


@st.composite
def stacks(draw):
    shape = draw(st.tuples(st.integers(2, 9), st.integers(1, 12), st.integers(1, 12)))
    dtype = draw(st.sampled_from(DTYPES))
    seed = draw(st.integers(0, 2**32 - 1))
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, shape, dtype=dtype, endpoint=True)


def window(data, length, least=0):
    start = data.draw(st.integers(0, length - least))
    return start, data.draw(st.integers(start + least, length))


def check(data, path, stack, **more):
    """Compare drawn windows, with a drawn region and range, with slices of the array."""
    n, rows, columns = stack.shape
    t, y, x = window(data, n, 2), window(data, rows, 1), window(data, columns, 1)
    region = data.draw(st.booleans())
    if region:
        more |= {"roi": (*y, *x), "frame_range": t}
        stack = stack[slice(*t), slice(*y), slice(*x)]
    reader = open_frames(InputSettings(files=(str(path),), **more), path.parent, check_duplicates=False)
    assert reader.shape == stack.shape
    for _ in range(3):
        (t0, t1), (y0, y1) = window(data, stack.shape[0]), window(data, stack.shape[1])
        np.testing.assert_array_equal(reader.read(t0, t1, y0, y1), stack[t0:t1, y0:y1])


@settings(max_examples=60, deadline=None)
@given(data=st.data(), stack=stacks(), format=st.sampled_from(sorted(WRITERS)))
def test_windows_of_what_we_write(data, stack, format):
    if format == "ser" and stack.dtype.itemsize == 4:
        stack = stack.astype(np.uint16)
    size = data.draw(st.integers(1, len(stack)))
    with tempfile.TemporaryDirectory() as folder:
        for first in range(0, len(stack), size):
            part = stack[first : first + size]
            write_frames(format, Path(folder) / "in" / f"{first}", iter([part]), part.shape, part.dtype)
        check(data, Path(folder) / "in", stack, format=format)
