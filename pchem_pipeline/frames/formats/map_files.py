"""Maps and stacks of images for other programs: FITS, TIFF and npz; and images that others made."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.errors import InputError, require
from pchem_pipeline.frames.formats.fits_files import FitsImage, image_cards, write_images
from pchem_pipeline.store.files import whole_file


@dataclass(frozen=True)
class MapImage:
    """A map (y, x), its name in the store, its unit (``"1"`` where there is none), and what it is."""

    name: str
    values: NDArray[Any]
    unit: str
    long_name: str


def write_fits(path: Path, maps: Sequence[MapImage], header: Mapping[str, Any]) -> list[Path]:
    """Write one FITS file with an image extension for each map, and return it.

    The header gives keywords of the primary header (at most 8 characters each); None is left out.

    Raises:
        StoreError: the folder cannot be written.
        MissingDependencyError: astropy is not installed.
    """
    cards: list[Any] = [(key, value) for key, value in header.items() if value is not None]
    images = [FitsImage((), (), np.dtype(np.uint8), cards)]
    for image in maps:
        cards = image_cards(image.name, image.unit, image.long_name)
        images.append(FitsImage([image.values], image.values.shape, image.values.dtype, cards))
    write_images(path, images)
    return [path]


def write_tiff(folder: Path, maps: Sequence[MapImage], suffix: str = ".tif") -> list[Path]:
    """Write a TIFF file ``<name>.tif`` for each map, float32 or integers, and return the files.

    Raises:
        StoreError: the folder cannot be written.
    """
    import tifffile

    written = []
    for image in maps:
        path = folder / f"{image.name}{suffix}"
        values = image.values.astype(np.float32) if image.values.dtype.kind == "f" else image.values
        words = {"name": image.name, "unit": image.unit, "long_name": image.long_name}
        with whole_file(path) as part:
            tifffile.imwrite(part, values, description=json.dumps(words), photometric="minisblack")
        written.append(path)
    return written


def write_npz(path: Path, arrays: Mapping[str, Any]) -> list[Path]:
    """Write arrays into one npz file, each under its name, and return the file.

    Raises:
        StoreError: the folder cannot be written.
    """
    with whole_file(path) as part:
        np.savez_compressed(part, allow_pickle=False, **arrays)
    return [path]


def write_tiff_cube(
    path: Path,
    blocks: Iterable[NDArray[Any]],
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
    about: Mapping[str, Any],
) -> None:
    """Write a page for each image: an ImageJ stack, or BigTIFF where that is too small.

    Blocks (any number of images, rows, columns) make up the shape (images, rows, columns); ``about`` says
    what the images are, as JSON data.

    Raises:
        StoreError: the folder cannot be written.
    """
    import tifffile

    images = (image for block in blocks for image in np.ascontiguousarray(block, dtype))
    n, rows, columns = shape
    size = n * rows * columns * dtype.itemsize
    with whole_file(path) as part:
        # beyond this a TIFF file needs offsets of 64 bits
        if size + (1 << 25) < 1 << 32 and dtype.str[1:] in ("u1", "u2", "f4"):
            frames = {"axes": "TZCYXS", "Info": json.dumps(about), "unit": "pixel"}
            # all axes: a last one of one column would be taken for samples of a pixel
            options = {"shape": (n, 1, 1, rows, columns, 1), "dtype": dtype, "photometric": "minisblack"}
            tifffile.imwrite(part, images, imagej=True, metadata=frames, **options)
        else:
            with tifffile.TiffWriter(part, bigtiff=True) as file:
                for image in images:
                    file.write(image, photometric="minisblack", contiguous=True, metadata=about)


def read_image(path: Path) -> FloatArray:
    """Return an image (y, x), or a stack of images (image, y, x), from npy, TIFF or FITS.

    Raises:
        InputError: there is no such file, or it is no image.
    """
    if path.suffix.lower() not in (".npy", ".tif", ".tiff", ".fits", ".fit", ".fts"):
        raise InputError(f"{path}: give an image as .npy, .tif or .fits")
    if path.exists() and not path.is_file():
        raise InputError(f"{path}: not a regular file")
    try:
        values = np.squeeze(np.asarray(_read_any(path), np.float64))
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file") from error
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{path}: cannot be read as an image ({error}); write it again") from error
    if values.ndim not in (2, 3):
        raise InputError(f"{path}: an array of {values.ndim} axes; an image needs two, a sequence three")
    return values


def _read_any(path: Path) -> Any:
    if path.suffix.lower() == ".npy":
        with path.open("rb") as stream:
            return npy_format.read_array(stream)  # it opens no pickles, and does not offer to
    if path.suffix.lower().startswith(".tif"):
        import tifffile

        return tifffile.imread(path)
    require("astropy.io.fits", "fits", "FITS files")
    from astropy.io import fits

    return fits.getdata(path)
