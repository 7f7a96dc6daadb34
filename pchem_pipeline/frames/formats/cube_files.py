"""Stacks of images of any type for other programs: TIFF that ImageJ reads, and FITS cubes."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.frames.formats.fits import write_image
from pchem_pipeline.store.files import whole_file

#: Bytes above which a TIFF file needs offsets of 64 bits.
_LARGEST_TIFF = 1 << 32


@dataclass(frozen=True)
class Cube:
    """An array and what it is.

    Attributes:
        name: as in the store.
        blocks: arrays (any number of images, rows, columns), in order.
        shape: (images, rows, columns) of all together; FITS takes a map of (rows, columns), too.
        dtype: type of the samples.
        unit: physical unit.
        long_name: one sentence.
        facts: provenance, as JSON data.
    """

    name: str
    blocks: Iterable[NDArray[Any]]
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    unit: str
    long_name: str
    facts: Mapping[str, Any]


def write_tiff_cube(path: Path, cube: Cube) -> None:
    """Write a page for each image: an ImageJ stack, or BigTIFF where that is too small.

    Raises:
        StoreError: the folder cannot be written.
    """
    import tifffile

    size = int(np.prod(cube.shape)) * cube.dtype.itemsize
    about = {
        "name": cube.name,
        "unit": cube.unit,
        "long_name": cube.long_name,
        "provenance": dict(cube.facts),
    }
    images = (image for block in cube.blocks for image in np.ascontiguousarray(block, cube.dtype))
    options: dict[str, Any] = {"shape": cube.shape, "dtype": cube.dtype, "photometric": "minisblack"}
    with whole_file(path) as part:
        if size + (1 << 25) < _LARGEST_TIFF and cube.dtype.str[1:] in ("u1", "u2", "f4"):
            frames = {"axes": "TYX", "Info": json.dumps(about), "unit": "pixel"}
            tifffile.imwrite(part, images, imagej=True, metadata=frames, **options)
        else:
            tifffile.imwrite(part, images, bigtiff=True, metadata=about, **options)


def write_fits_cube(path: Path, cube: Cube) -> None:
    """Write an image of the axes of the array, the unit in ``BUNIT``, the provenance as ``HISTORY``.

    Raises:
        StoreError: the folder cannot be written.
        MissingDependencyError: astropy is not installed.
    """
    cards = {
        "BUNIT": cube.unit,
        "OBJECT": cube.name,
        "COMMENT": cube.long_name,
        "CREATOR": "pchem-pipeline",
        "HISTORY": json.dumps(dict(cube.facts)),
    }
    write_image(path, cube.blocks, cube.shape, cube.dtype, cards)
