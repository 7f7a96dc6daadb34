"""Camera files of a test: opened, read, and refused."""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray

from pchem_pipeline.base.errors import ExitCode, InputError
from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.sequence import FrameSequence
from pchem_pipeline.frames.settings import InputSettings


def opened(path: Path, **settings: Any) -> FrameSequence:
    return open_frames(InputSettings(files=(path.name,), **settings), path.parent)


def read(path: Path, **settings: Any) -> NDArray[Any]:
    return opened(path, **settings).read()


def check_reads(reader: FrameSequence, stack: NDArray[Any]) -> None:
    """Assert that a reader gives these frames, whole and in windows, as does what another process gets."""
    n, rows, _ = stack.shape
    assert (reader.shape, reader.dtype) == (stack.shape, stack.dtype.newbyteorder("="))
    windows = [(0, 1, 0, rows), (n - 1, n, rows - 1, rows), (n // 3, n - 1, rows // 4, rows // 2 + 1)]
    windows += [(0, n, rows // 5, max(1, rows - 1)), (n // 2, n // 2, 0, 1)]
    for each in (reader, pickle.loads(pickle.dumps(reader))):
        np.testing.assert_array_equal(each.read(), stack)
        for t0, t1, y0, y1 in windows:
            np.testing.assert_array_equal(each.read(t0, t1, y0, y1), stack[t0:t1, y0:y1])


def refused(words: str, path: Path, use: Callable[..., Any] = read, **settings: Any) -> None:
    """Assert that a file is refused where it is opened and read, in one line, with exit code 4."""
    with pytest.raises(InputError, match=words) as caught:
        use(path, **settings)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_code == ExitCode.INPUT == 4


def not_opened(words: str, path: Path, **settings: Any) -> None:
    """Assert that a file is refused already where it is opened; see `refused`."""
    refused(words, path, opened, **settings)


def overwrite(path: Path, at: int, content: bytes) -> None:
    with path.open("r+b") as file:
        file.seek(at)
        file.write(content)


def write_hdf5(path: Path, **arrays: Any) -> Path:
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values
    return path


def write_fits(path: Path, data: NDArray[Any], **cards: Any) -> Path:
    """Write an image with these cards, which may be values with their comments."""
    image = fits.PrimaryHDU(data)
    image.header.update(cards)
    image.writeto(path)
    return path
