"""Camera files of all formats in many layouts, written by the libraries of the formats."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np
import tifffile
import zarr
from astropy.io import fits
from helpers.dcimg_files import write_dcimg
from helpers.spe_files import write_spe
from numpy.typing import NDArray

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


def within(chunks: tuple[int, ...], stack: Stack) -> tuple[int, ...]:
    """Return chunks no larger than a stack."""
    if stack.ndim != 3:
        return stack.shape
    return tuple(min(sizes) for sizes in zip(chunks, stack.shape, strict=True))


def hdf5(path: Path, stack: Stack, *, order: str = "<", **options: Any) -> None:
    if "chunks" in options:
        options["chunks"] = within(options["chunks"], stack)
    with h5py.File(path, "w") as file:
        file.create_dataset("frames", data=stack.astype(stack.dtype.newbyteorder(order)), **options)


def zarr_array(path: Path, stack: Stack, *, version: int = 3, grouped: bool = False) -> None:
    if not grouped:
        zarr.create_array(path, data=stack, chunks=within((3, 21, 5), stack), zarr_format=version)
        return
    group = zarr.open_group(path, mode="w", zarr_format=version)
    group.create_array("cam/frames", data=stack, chunks=within((2, 8, 8), stack))
    group.create_array("cam/time", data=np.arange(7.0))


def raw(path: Path, stack: Stack) -> None:
    stack.astype(stack.dtype.newbyteorder("<")).tofile(path)
    path.with_name(path.name + ".json").write_text(
        json.dumps({"shape": stack.shape[-2:], "dtype": stack.dtype.name})
    )


def bit_place(packing: str, sample: int, bit: int) -> tuple[int, int]:
    """Return byte and bit in which the standards have a bit (0 the lowest) of a sample, bit by bit."""
    bits = int(packing[4:6])
    if packing.endswith("p"):  # one stream of bits, the lowest first
        return divmod(bits * sample + bit, 8)
    group, second = divmod(sample, 2)  # high bits in bytes 0 and 2, low ones in the halves of byte 1
    low = bits - 8
    return (3 * group + 1, 4 * second + bit) if bit < low else (3 * group + 2 * second, bit - low)


def packed(stack: Stack, packing: str) -> bytes:
    bits = int(packing[4:6])
    data = bytearray(stack.size * bits // 8 if packing.endswith("p") else stack.size // 2 * 3)
    for sample, value in enumerate(stack.ravel().tolist()):
        for bit in range(bits):
            byte, place = bit_place(packing, sample, bit)
            data[byte] |= (value >> bit & 1) << place
    return bytes(data)


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
    "dcimg": ("dcimg", write_dcimg),
    "dcimg, version 7": ("dcimg", partial(write_dcimg, version=7)),
    "dcimg, streamed": ("dcimg", partial(write_dcimg, version=0x2000000, row=0, footer=512)),
    "dcimg, USB": ("dcimg", partial(write_dcimg, row=None, footer=16)),
    "spe": ("spe", write_spe),
    "spe, version 3": ("spe", partial(write_spe, version=3.0)),
}


def write(folder: Path, layout: str, stack: Stack, name: str = "a") -> Path:
    suffix, writer = LAYOUTS[layout]
    folder.mkdir(exist_ok=True)
    path = folder / f"{name}.{suffix}"
    writer(path, stack)
    return path
