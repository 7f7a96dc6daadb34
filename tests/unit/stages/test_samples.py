"""Samples of a joint fit must come from one sensor."""

from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
import zarr
from astropy.io import fits

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.frames.camera import CameraFacts
from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.target import Target
from pchem_pipeline.stages.samples import OpenSample, _same_sensor


def sample(name, serial=None, file="one", **settings):
    """Return the run of an exposure of a file, which may name a camera."""
    config = RunConfig.model_validate({"input": {"files": ["a.h5"], "bit_depth": 12, **settings}})
    identity = {"files": [{"xxh3_128": file}]}
    sensor = SensorInfo(
        kind="frames", n_frames=9, ny=4, nx=4, dtype="uint16", bit_depth=12, integration_time=None,
        mode="copy", identity=identity, camera=CameraFacts(serial=serial),
    )  # fmt: skip
    return OpenSample(name, Target(config, Path(), Path(name)), None, sensor, name)


def test_exposures_of_two_cameras_are_refused():
    first = sample("sample a.yaml", "A1", "other")
    with pytest.raises(ConfigError, match=r"b\.yaml has camera serial number B2, .* A1;"):
        _same_sensor([first], sample("sample b.yaml", "B2"))
    for serial in ("A1", None):
        _same_sensor([first], sample("sample b.yaml", serial))


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ({"dataset": "dark/frames"}, {"dataset": "light/frames"}),
        ({"frame_range": (0, 300)}, {"frame_range": (300, 600)}),
        ({"file": "one"}, {"file": "two"}),
    ],
)
def test_exposures_in_one_file_are_told_apart(one, other):
    """Two datasets of an HDF5 file, or two ranges of frames of one stack."""
    _same_sensor([sample("a", **one)], sample("b", **other))
    with pytest.raises(ConfigError, match="b has the same frames as a; list each sample once"):
        _same_sensor([sample("a", **one)], sample("b", **one))


def test_ranges_that_overlap_hold_the_same_frames():
    for taken in ((200, 600), None):
        with pytest.raises(ConfigError, match="has the same frames"):
            _same_sensor([sample("a", frame_range=(0, 300))], sample("b", frame_range=taken))


STACK = np.random.default_rng(8).integers(0, 4096, (6, 32, 48)).astype(np.uint16)


def rows_per_read(path, **settings):
    reader = open_frames(InputSettings(files=(path.name,), **settings), path.parent)
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
def test_strips_and_tiles_of_tiff(tmp_path, options, rows):
    tifffile.imwrite(tmp_path / "a.tif", STACK, photometric="minisblack", **options)
    assert rows_per_read(tmp_path / "a.tif") == rows


def test_the_largest_of_several_files_counts(tmp_path):
    for name, rows in (("a.tif", 4), ("b.tif", 16)):
        stack = STACK + (name == "b.tif")
        tifffile.imwrite(
            tmp_path / name, stack, photometric="minisblack", compression="zlib", rowsperstrip=rows
        )
    reader = open_frames(InputSettings(files=("*.tif",)), tmp_path)
    assert reader.rows_per_read == 16


@pytest.mark.parametrize(
    ("chunks", "rows"), [(None, 1), ((1, 32, 48), 1), ((2, 8, 48), 8), ((1, 32, 24), 32)]
)
def test_chunks_of_hdf5(tmp_path, chunks, rows):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("frames", data=STACK, chunks=chunks)
    assert rows_per_read(tmp_path / "a.h5") == rows


@pytest.mark.parametrize(("tile", "rows"), [(None, 1), ((1, 8, 48), 8), ((1, 32, 48), 32)])
def test_tiles_of_compressed_fits(tmp_path, tile, rows):
    image = fits.CompImageHDU(STACK, compression_type="RICE_1", tile_shape=tile)
    fits.HDUList([fits.PrimaryHDU(), image]).writeto(tmp_path / "a.fits")
    assert rows_per_read(tmp_path / "a.fits") == rows


def test_chunks_of_zarr(tmp_path):
    zarr.create_array(tmp_path / "a.zarr", data=STACK, chunks=(2, 16, 16))
    assert rows_per_read(tmp_path / "a.zarr") == 16
