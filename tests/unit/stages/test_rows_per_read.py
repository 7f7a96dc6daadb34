"""Readers say which rows come together; the stages that read frames keep to it."""

from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
import zarr
from astropy.io import fits

from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.settings import InputSettings

STACK = np.random.default_rng(8).integers(0, 4096, (6, 32, 48)).astype(np.uint16)


def rows_per_read(path: Path, **settings: object) -> int:
    with open_frames(InputSettings(files=(path.name,), **settings), path.parent) as reader:
        return reader.rows_per_read


@pytest.mark.parametrize(
    ("options", "rows"),
    [
        ({}, 1),
        ({"compression": "zlib", "rowsperstrip": 4}, 4),
        ({"compression": "zlib", "rowsperstrip": 32}, 32),
        ({"compression": "zlib", "tile": (16, 16)}, 16),
        ({"compression": "zlib", "tile": (64, 64)}, 32),
    ],
)
def test_strips_and_tiles_of_tiff(tmp_path: Path, options: dict[str, object], rows: int) -> None:
    tifffile.imwrite(tmp_path / "a.tif", STACK, photometric="minisblack", **options)
    assert rows_per_read(tmp_path / "a.tif") == rows


def test_the_largest_of_several_files_counts(tmp_path: Path) -> None:
    for name, rows in (("a.tif", 4), ("b.tif", 16)):
        stack = STACK + (name == "b.tif")
        tifffile.imwrite(
            tmp_path / name, stack, photometric="minisblack", compression="zlib", rowsperstrip=rows
        )
    with open_frames(InputSettings(files=("*.tif",)), tmp_path) as reader:
        assert reader.rows_per_read == 16


@pytest.mark.parametrize(
    ("chunks", "rows"), [(None, 1), ((1, 32, 48), 1), ((2, 8, 48), 8), ((1, 32, 24), 32)]
)
def test_chunks_of_hdf5(tmp_path: Path, chunks: tuple[int, ...] | None, rows: int) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("frames", data=STACK, chunks=chunks)
    assert rows_per_read(tmp_path / "a.h5") == rows


@pytest.mark.parametrize(("tile", "rows"), [(None, 1), ((1, 8, 48), 8), ((1, 32, 48), 32)])
def test_tiles_of_compressed_fits(tmp_path: Path, tile: tuple[int, ...] | None, rows: int) -> None:
    image = fits.CompImageHDU(STACK, compression_type="RICE_1", tile_shape=tile)
    fits.HDUList([fits.PrimaryHDU(), image]).writeto(tmp_path / "a.fits")
    assert rows_per_read(tmp_path / "a.fits") == rows


def test_chunks_of_zarr(tmp_path: Path) -> None:
    zarr.create_array(tmp_path / "a.zarr", data=STACK, chunks=(2, 16, 16))
    assert rows_per_read(tmp_path / "a.zarr") == 16
