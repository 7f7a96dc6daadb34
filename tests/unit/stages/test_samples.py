"""Samples of a joint fit must come from one sensor."""

from pathlib import Path

import pytest

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.frames.camera import CameraFacts
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
