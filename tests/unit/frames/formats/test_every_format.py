"""What holds in every format and layout: frames come back exactly, damaged or signed samples are refused."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np
import pytest
import tifffile
import zarr
from astropy.io import fits
from helpers.camera_files import not_opened, opened, read, refused
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError

SHAPE = (6, 21, 34)
WINDOWS = [(0, 1, 0, 21), (2, 5, 3, 4), (1, 6, 15, 21), (5, 6, 20, 21), (0, 6, 4, 17), (3, 3, 0, 2)]
Stack = NDArray[Any]


def npy(path: Path, stack: Stack, *, version: tuple[int, int] = (1, 0), order: str = "<") -> None:
    with path.open("wb") as stream:
        np.lib.format.write_array(stream, stack.astype(stack.dtype.newbyteorder(order)), version=version)


def tiff(path: Path, stack: Stack, **options: Any) -> None:
    tifffile.imwrite(path, stack, **{"photometric": "minisblack"} | options)


def tiff_pages(path: Path, stack: Stack, **options: Any) -> None:
    """Write each frame by itself, without words on how many there are."""
    whole = {key: options.pop(key) for key in ("bigtiff", "byteorder") if key in options}
    with tifffile.TiffWriter(path, **whole) as writer:
        for frame in stack.reshape(-1, *stack.shape[-2:]):
            writer.write(frame, photometric="minisblack", metadata=None, **options)


def fits_image(path: Path, stack: Stack, *, extension: bool = False) -> None:
    units = [fits.PrimaryHDU(), fits.ImageHDU(stack, name="SCI")] if extension else [fits.PrimaryHDU(stack)]
    fits.HDUList(units).writeto(path)


def fits_compressed(path: Path, stack: Stack, kind: str) -> None:
    options: dict[str, Any] = {"tile_shape": (1, *stack.shape[1:])} if kind == "HCOMPRESS_1" else {}
    fits.CompImageHDU(stack, compression_type=kind, **options).writeto(path)


def hdf5(path: Path, stack: Stack, *, order: str = "<", **options: Any) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("frames", data=stack.astype(stack.dtype.newbyteorder(order)), **options)


def zarr_array(path: Path, stack: Stack, *, version: int = 3, grouped: bool = False) -> None:
    if not grouped:
        chunks = (3, 21, 5) if stack.ndim == 3 else stack.shape
        zarr.create_array(path, data=stack, chunks=chunks, zarr_format=version)
        return
    group = zarr.open_group(path, mode="w", zarr_format=version)
    group.create_array("cam/frames", data=stack, chunks=(2, 8, 8))
    group.create_array("cam/time", data=np.arange(7.0))


def raw(path: Path, stack: Stack) -> None:
    stack.astype(stack.dtype.newbyteorder("<")).tofile(path)
    path.with_name(path.name + ".json").write_text(
        json.dumps({"shape": stack.shape[-2:], "dtype": stack.dtype.name})
    )


#: by the name of a layout: suffix, and what writes it
LAYOUTS: dict[str, tuple[str, Callable[[Path, Stack], None]]] = {
    "npy": ("npy", npy),
    "npy, version 2, big-endian": ("npy", partial(npy, version=(2, 0), order=">")),
    "npy, version 3": ("npy", partial(npy, version=(3, 0))),
    "tiff": ("tif", tiff),
    "bigtiff": ("tif", partial(tiff, bigtiff=True)),
    "tiff, big-endian": ("tif", partial(tiff, byteorder=">")),
    "bigtiff, big-endian": ("tif", partial(tiff, byteorder=">", bigtiff=True)),
    "tiff, no metadata": ("tif", partial(tiff, metadata=None)),
    "tiff, strips": ("tif", partial(tiff, rowsperstrip=5)),
    "tiff, tiles": ("tif", partial(tiff, tile=(16, 16))),
    "tiff, tiles, big-endian": ("tif", partial(tiff, tile=(16, 16), byteorder=">")),
    "tiff, zlib": ("tif", partial(tiff, compression="zlib")),
    "tiff, zlib, strips, predictor": (
        "tif",
        partial(tiff, compression="zlib", predictor=True, rowsperstrip=4),
    ),
    "tiff, zlib, tiles, predictor": ("tif", partial(tiff, compression="zlib", predictor=True, tile=(16, 32))),
    "tiff, zlib, big-endian": ("tif", partial(tiff, compression="zlib", byteorder=">", rowsperstrip=4)),
    "tiff, lzw": ("tif", partial(tiff, compression="lzw")),
    "tiff, packbits": ("tif", partial(tiff, compression="packbits")),
    "tiff, imagej": ("tif", partial(tiff, imagej=True)),
    "tiff, imagej, time": ("tif", partial(tiff, imagej=True, metadata={"axes": "TYX"})),
    "tiff, ome": ("tif", partial(tiff, ome=True, metadata={"axes": "TYX"})),
    "tiff, ome, depth": ("tif", partial(tiff, ome=True, metadata={"axes": "ZYX"})),
    "bigtiff, ome, zlib": (
        "tif",
        partial(tiff, ome=True, bigtiff=True, compression="zlib", metadata={"axes": "TYX"}),
    ),
    "tiff, one directory": ("tif", partial(tiff, truncate=True)),
    "tiff, separate planes": ("tif", partial(tiff, planarconfig="separate")),
    "tiff, white is zero": ("tif", partial(tiff, photometric="miniswhite")),
    "tiff pages": ("tif", tiff_pages),
    "tiff pages, strips": ("tif", partial(tiff_pages, rowsperstrip=5)),
    "tiff pages, tiles": ("tif", partial(tiff_pages, tile=(16, 16))),
    "tiff pages, zlib": ("tif", partial(tiff_pages, compression="zlib")),
    "bigtiff pages, big-endian": ("tif", partial(tiff_pages, byteorder=">", bigtiff=True)),
    "fits": ("fits", fits_image),
    "fits, extension": ("fits", partial(fits_image, extension=True)),
    **{f"fits, {kind}": ("fits", partial(fits_compressed, kind=kind)) for kind in ("RICE_1", "GZIP_2")},
    "fits, HCOMPRESS_1": ("fits", partial(fits_compressed, kind="HCOMPRESS_1")),
    "hdf5": ("h5", hdf5),
    "hdf5, big-endian": ("hdf5", partial(hdf5, order=">")),
    "hdf5, chunks": ("h5", partial(hdf5, chunks=(2, 8, 8))),
    "hdf5, gzip, shuffle": ("h5", partial(hdf5, chunks=(1, 21, 34), compression="gzip", shuffle=True)),
    "hdf5, bitshuffle": ("h5", partial(hdf5, chunks=(3, 10, 34), **hdf5plugin.Bitshuffle())),
    "hdf5, blosc2": ("h5", partial(hdf5, chunks=(3, 10, 34), **hdf5plugin.Blosc2(cname="zstd"))),
    "hdf5, zstd": ("h5", partial(hdf5, chunks=(3, 10, 34), **hdf5plugin.Zstd())),
    "zarr": ("zarr", zarr_array),
    "zarr, version 2": ("zarr", partial(zarr_array, version=2)),
    "zarr, group": ("zarr", partial(zarr_array, grouped=True)),
    "zarr, group, version 2": ("zarr", partial(zarr_array, version=2, grouped=True)),
    "raw": ("raw", raw),
}
#: layouts without samples of 32 bits
AT_MOST_16 = ("tiff, imagej", "tiff, imagej, time", "fits, HCOMPRESS_1")


def write(folder: Path, layout: str, stack: Stack, name: str = "a") -> Path:
    suffix, writer = LAYOUTS[layout]
    folder.mkdir(exist_ok=True)
    path = folder / f"{name}.{suffix}"
    writer(path, stack)
    return path


def drawn(top: int, dtype: Any) -> Stack:
    stack = np.random.default_rng(11).integers(0, top, SHAPE, dtype=dtype, endpoint=True)
    stack[0, 0, :2] = 0, top
    return stack


@pytest.mark.parametrize(
    ("layout", "dtype"),
    [
        (layout, dtype)
        for layout in LAYOUTS
        for dtype in (np.uint8, np.uint16, np.uint32)
        if not (dtype is np.uint32 and layout in AT_MOST_16)
    ],
)
def test_frames_are_read_exactly(tmp_path: Path, layout: str, dtype: type) -> None:
    # beyond that HCOMPRESS loses
    stack = drawn(
        60_000 if (layout, dtype) == ("fits, HCOMPRESS_1", np.uint16) else np.iinfo(dtype).max, dtype
    )
    reader = opened(write(tmp_path, layout, stack))
    assert (reader.shape, reader.dtype) == (stack.shape, np.dtype(dtype))
    np.testing.assert_array_equal(reader.read(), stack)
    for each in (reader, pickle.loads(pickle.dumps(reader))):
        for t0, t1, y0, y1 in WINDOWS:
            np.testing.assert_array_equal(each.read(t0, t1, y0, y1), stack[t0:t1, y0:y1])


@pytest.mark.parametrize("layout", ["npy", "tiff", "fits", "fits, RICE_1", "hdf5"])
def test_single_frames_and_stacks_are_joined_in_natural_order(tmp_path: Path, layout: str) -> None:
    stack = drawn(4095, np.uint16)
    for name, frames in (("f7", stack[0]), ("f9", stack[1]), ("f10", stack[2:5]), ("f11", stack[5])):
        write(tmp_path, layout, frames, name)
    np.testing.assert_array_equal(read(tmp_path), stack)


@pytest.mark.parametrize("kept", [9, 60, 100, 129, 2879, 2880, 3380, 0.15, 0.5, 0.9, 0.95])
@pytest.mark.parametrize(
    "layout",
    [
        "npy", "tiff", "tiff pages", "tiff pages, strips", "tiff pages, tiles", "tiff pages, zlib",
        "bigtiff pages, big-endian", "fits", "fits, RICE_1", "hdf5",
    ],
)  # fmt: skip
def test_a_file_that_was_cut_is_refused(tmp_path: Path, layout: str, kept: float) -> None:
    path = write(tmp_path, layout, drawn(4095, np.uint16))
    data = path.read_bytes()
    path.write_bytes(data[: kept if kept > 1 else int(len(data) * kept)])
    refused(rf"{path.name}: .*(truncated|not a valid|no image)", path)


@pytest.mark.parametrize(
    "layout",
    ["npy", "tiff", "tiff, zlib", "fits", "fits, RICE_1", "hdf5", "hdf5, gzip, shuffle", "zarr", "raw"],
)
def test_signed_samples_are_read_with_an_offset_or_where_none_is_negative(
    tmp_path: Path, layout: str
) -> None:
    stack = drawn(65535, np.uint16)
    path = write(tmp_path, layout, (stack.astype(np.int32) - 32768).astype(np.int16))
    not_opened(r"signed samples .*--offset 32768", path)
    with opened(path, offset=32768) as frames:
        np.testing.assert_array_equal(frames.read(), stack)
    with (
        opened(path, offset=1000) as frames,
        pytest.raises(InputError, match=r"negative samples \(down to -\d+ DN, with the offset of 1000\)"),
    ):
        frames.read()
    not_opened("offset", path, offset=32769)
    if layout == "raw":
        return
    refused("negative samples", path, dtype="uint16")
    small = (stack // 2).astype(np.int16)
    path = write(tmp_path / "small", layout, small)
    refused(r"signed samples \(int16\).*input.dtype: uint16", path)
    np.testing.assert_array_equal(read(path, dtype="uint16"), small)
    path = write(tmp_path / "large", layout, small.astype(np.int32))
    np.testing.assert_array_equal(read(path, dtype="uint32"), small)
    refused("floating-point samples", write(tmp_path / "float", layout, small.astype(np.float32)))


@pytest.mark.parametrize("layout", ["npy", "fits", "hdf5", "zarr, version 2"])
def test_axes_before_rows_and_columns_are_frames_if_all_but_one_are_of_length_one(
    tmp_path: Path, layout: str
) -> None:
    stack = drawn(65535, np.uint16)
    for name, index in (("a", np.s_[:, None]), ("b", np.s_[None])):
        np.testing.assert_array_equal(read(write(tmp_path, layout, stack[index], name)), stack)
    refused("2 axes before rows and columns", write(tmp_path, layout, np.stack([stack, stack]), "c"))
