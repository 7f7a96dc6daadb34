"""Samples of a joint fit must come from one sensor."""

from pathlib import Path

import numpy as np
import pytest
import zarr
from astropy.io import fits
from helpers import layouts
from helpers.camera_files import opened

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.frames.camera import CameraFacts
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.target import Target
from pchem_pipeline.stages.samples import OpenSample, same_sensor


def sample(name, serial=None, file="one", setup=None, **settings):
    """Return the run of an exposure of a file, which may name a camera."""
    config = RunConfig.model_validate({"input": {"files": ["a.h5"], "bit_depth": 12, **settings}})
    identity = {"files": [{"xxh3_128": file}]}
    sensor = SensorInfo(
        kind="frames", n_frames=9, ny=4, nx=4, dtype="uint16", bit_depth=12, integration_time=None,
        mode="copy", identity=identity, camera=CameraFacts(serial=serial, setup=setup or {}),
    )  # fmt: skip
    return OpenSample(name, Target(config, Path(), Path(name)), None, sensor, name)


def test_exposures_of_two_cameras_are_refused():
    first = sample("sample a.yaml", "A1", "other")
    with pytest.raises(ConfigError, match=r"b\.yaml: serial number B2, but sample a\.yaml has A1;"):
        same_sensor([first, sample("sample b.yaml", "B2")])
    for serial in ("A1", None):
        same_sensor([first, sample("sample b.yaml", serial)])


def test_exposures_of_two_settings_are_refused_and_of_two_image_types_not():
    first = sample("sample a.yaml", None, "other", {"READMODE": "quiet", "IMAGETYP": "flat"})
    with pytest.raises(ConfigError, match=r"b\.yaml: READMODE = fast, but sample a\.yaml has quiet;"):
        same_sensor([first, sample("sample b.yaml", setup={"READMODE": "fast", "IMAGETYP": "flat"})])
    same_sensor([first, sample("sample b.yaml", setup={"READMODE": "quiet", "IMAGETYP": "dark"})])


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
    same_sensor([sample("a", **one), sample("b", **other)])
    with pytest.raises(ConfigError, match="b has the same frames as a; list each sample once"):
        same_sensor([sample("a", **one), sample("b", **one)])
    # ranges that overlap hold the same frames
    for taken in ((200, 600), None):
        with pytest.raises(ConfigError, match="has the same frames"):
            same_sensor([sample("a", frame_range=(0, 300)), sample("b", frame_range=taken)])


STACK = np.random.default_rng(8).integers(0, 4096, (6, 32, 48)).astype(np.uint16)


def rice(path, stack, tile_shape):
    fits.CompImageHDU(stack, compression_type="RICE_1", tile_shape=tile_shape).writeto(path)


@pytest.mark.parametrize(
    ("name", "writer", "options", "rows"),
    [
        ("a.tif", layouts.tiff, {}, 1),
        ("a.tif", layouts.tiff, {"compression": "zlib", "rowsperstrip": 4}, 4),
        ("a.tif", layouts.tiff, {"compression": "zlib", "rowsperstrip": 32}, 32),
        ("a.tif", layouts.tiff, {"compression": "zlib", "tile": (16, 16)}, 16),
        ("a.tif", layouts.tiff, {"compression": "zlib", "tile": (64, 64)}, 32),
        ("a.h5", layouts.hdf5, {}, 1),
        *(("a.h5", layouts.hdf5, {"chunks": chunks}, rows)
          for chunks, rows in (((1, 32, 48), 1), ((2, 8, 48), 8), ((1, 32, 24), 32))),
        *(("a.fits", rice, {"tile_shape": tile}, rows)
          for tile, rows in ((None, 1), ((1, 8, 48), 8), ((1, 32, 48), 32))),
        ("a.zarr", lambda path, stack: zarr.create_array(path, data=stack, chunks=(2, 16, 16)), {}, 16),
    ],
)  # fmt: skip
def test_rows_that_are_decoded_together(tmp_path, name, writer, options, rows):
    writer(tmp_path / name, STACK, **options)
    assert opened(tmp_path / name).rows_per_read == rows


def test_the_largest_of_several_files_counts(tmp_path):
    for name, rows in (("a.tif", 4), ("b.tif", 16)):
        layouts.tiff(tmp_path / name, STACK + (name == "b.tif"), compression="zlib", rowsperstrip=rows)
    assert opened(tmp_path / "*.tif").rows_per_read == 16
