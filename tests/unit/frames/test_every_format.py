"""What holds for every format and coding: read exactly, by any window, thread and process, or refused."""

from __future__ import annotations

import json
import os
import pickle
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
import zarr
from astropy.io import fits
from helpers.camera_files import not_opened, opened, read, refused
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.writing import write_frames

Array = NDArray[Any]
SHAPE = (7, 17, 19)


def tiff(**options: Any) -> Callable[[Path, Array], Any]:
    return lambda path, stack: tifffile.imwrite(path, stack, photometric="minisblack", **options)


def hdf5(**options: Any) -> Callable[[Path, Array], None]:
    def write(path: Path, stack: Array) -> None:
        with h5py.File(path, "w") as file:
            file.create_dataset("frames", data=stack, **options)

    return write


def image(kind: Any, **options: Any) -> Callable[[Path, Array], Any]:
    return lambda path, stack: fits.HDUList([fits.PrimaryHDU(), kind(stack, **options)]).writeto(path)


def raw(path: Path, stack: Array) -> None:
    stack.astype(stack.dtype.newbyteorder(">")).tofile(path)
    facts = {"shape": stack.shape, "dtype": stack.dtype.name, "byte_order": "big"}
    path.with_name(path.name + ".json").write_text(json.dumps(facts))


#: name of a coding, which begins with the suffix of its files -> what writes one
WRITE: dict[str, Callable[[Path, Array], Any]] = {
    "tif": tiff(),
    "tif, big-endian": tiff(byteorder=">"),
    "tif, zlib": tiff(compression="zlib"),
    "tif, zlib, big-endian": tiff(compression="zlib", byteorder=">"),
    "fits": lambda path, stack: fits.PrimaryHDU(stack).writeto(path),
    "fits, extension": image(fits.ImageHDU, name="SCI"),
    "fits, Rice": image(fits.CompImageHDU, compression_type="RICE_1"),
    "fits, gzip": image(fits.CompImageHDU, compression_type="GZIP_2"),
    "h5": hdf5(),
    "h5, gzip": hdf5(compression="gzip", shuffle=True),
    "zarr": lambda path, stack: zarr.create_array(path, data=stack),
    "npy": np.save,
    "npy, big-endian": lambda path, stack: np.save(path, stack.astype(stack.dtype.newbyteorder(">"))),
    "raw": raw,
    "ser": lambda path, stack: write_frames("ser", path, [stack], stack.shape, stack.dtype),
}
every_coding = pytest.mark.parametrize("coding", WRITE)
SIGNED = [coding for coding in WRITE if coding != "ser"]


def drawn(dtype: Any = "uint16", seed: int = 15) -> Array:
    """Return frames of any numbers of a type, its first and last among them."""
    ends = np.iinfo(dtype)
    stack = np.random.default_rng(seed).integers(ends.min, ends.max, SHAPE, dtype=dtype, endpoint=True)
    stack[0, 0, :2] = ends.min, ends.max
    return stack


def written(folder: Path, coding: str, stack: Array, name: str = "a") -> Path:
    path = folder / f"{name}.{coding.partition(',')[0]}"
    WRITE[coding](path, stack)
    return path


@every_coding
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "uint32"])
def test_every_window_is_read_exactly(tmp_path: Path, coding: str, dtype: str) -> None:
    if (coding, dtype) == ("ser", "uint32"):
        pytest.skip("SER has at most 16 bits")
    stack = drawn(dtype)
    reader = opened(written(tmp_path, coding, stack))
    assert (reader.shape, reader.dtype) == (SHAPE, np.dtype(dtype))
    again = pickle.loads(pickle.dumps(reader))
    for t0, t1, y0, y1 in [(0, 7, 0, 17), (0, 1, 0, 17), (1, 6, 5, 6), (6, 7, 16, 17), (2, 7, 3, 11)]:
        for each in (reader, again):
            np.testing.assert_array_equal(each.read(t0, t1, y0, y1), stack[t0:t1, y0:y1])


@every_coding
def test_files_of_single_frames_are_in_natural_order(tmp_path: Path, coding: str) -> None:
    stack = drawn()
    for i, frame in enumerate(stack):
        written(tmp_path, coding, frame[None] if coding == "ser" else frame, f"f{i + 7}")
    np.testing.assert_array_equal(read(tmp_path), stack)


@every_coding
def test_many_threads_on_one_reader(tmp_path: Path, coding: str) -> None:
    stack = drawn()
    for name, part in (("a1", stack[:4]), ("a2", stack[4:])):
        written(tmp_path, coding, part, name)
    reader = opened(tmp_path)
    rng = np.random.default_rng(4)
    windows = [
        (*np.sort(rng.choice(8, 2, replace=False)), *np.sort(rng.choice(18, 2, replace=False)))
        for _ in range(120)
    ]

    def task(window: tuple[int, int, int, int]) -> bool:
        t0, t1, y0, y1 = map(int, window)
        return bool((reader.read(t0, t1, y0, y1) == stack[t0:t1, y0:y1]).all())

    with ThreadPoolExecutor(6) as pool:
        assert all(pool.map(task, windows))


@every_coding
def test_a_file_that_vanishes(tmp_path: Path, coding: str) -> None:
    path = written(tmp_path, coding, drawn())
    reader = opened(path)
    path.rename(tmp_path / "gone")
    with pytest.raises(InputError, match=r"disappeared while it was being read; restore"):
        reader.read()


@pytest.mark.parametrize("coding", [coding for coding in WRITE if coding[:2] != "h5" and coding != "zarr"])
def test_a_file_that_shrinks(tmp_path: Path, coding: str) -> None:
    path = written(tmp_path, coding, drawn())
    reader = opened(path)
    os.truncate(path, path.stat().st_size // 2)
    words = r"(was truncated|size of the file changed) while it was being read; restore"
    with pytest.raises(InputError, match=words):
        reader.read()


@pytest.mark.parametrize("coding", SIGNED)
@pytest.mark.parametrize("bits", [16, 32])
def test_signed_samples(tmp_path: Path, coding: str, bits: int) -> None:
    """They are refused, unless none is negative, or the settings say what was taken off."""
    stored, unsigned, top = drawn(f"int{bits}"), f"uint{bits}", 1 << (bits - 1)
    path = written(tmp_path, coding, stored)
    words = rf"signed samples \(int{bits}\).*set input.dtype: {unsigned}.*--offset {top}"
    not_opened(words, path)
    if coding != "raw":  # whose type the settings say
        refused("negative samples", path, dtype=unsigned)
    refused(r"negative samples \(down to -\d+ DN, with the offset of 1000\)", path, offset=1000)
    if bits == 16:
        not_opened("offset", path, offset=top + 1)
    np.testing.assert_array_equal(read(path, offset=top), stored.astype(np.int64) + top)
    plain = np.abs(stored >> 1)
    np.testing.assert_array_equal(read(written(tmp_path, coding, plain, "plain"), dtype=unsigned), plain)


@pytest.mark.parametrize("coding", [coding for coding in SIGNED if coding not in ("raw", "fits, Rice")])
def test_floating_point_samples_are_refused(tmp_path: Path, coding: str) -> None:
    not_opened("floating-point samples", written(tmp_path, coding, drawn().astype(np.float32)))


@pytest.mark.parametrize("coding", ["fits", "fits, gzip", "h5", "h5, gzip", "zarr", "npy"])
def test_further_axes(tmp_path: Path, coding: str) -> None:
    stack = drawn()
    for name, values in (("inner", stack[:, None]), ("outer", stack[None])):
        path = written(tmp_path, coding, values, name)
        np.testing.assert_array_equal(read(path)[1:, 2:5], stack[1:, 2:5])
    not_opened("2 axes before rows and columns", written(tmp_path, coding, np.stack([stack, stack]), "two"))
