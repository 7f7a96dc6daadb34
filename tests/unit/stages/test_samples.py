"""Samples of a joint fit must come from one sensor."""

from types import SimpleNamespace

import pytest

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.frames.camera import CameraFacts
from pchem_pipeline.stages.samples import _same_sensor


def sample(name, serial):
    """Return the run of an exposure whose files name a camera."""
    sensor = SimpleNamespace(shape=(4, 4), ny=4, nx=4, camera=CameraFacts(serial=serial))
    target = SimpleNamespace(config=SimpleNamespace(input=SimpleNamespace(roi=None)))
    return SimpleNamespace(where=name, sensor=sensor, bit_depth=12, target=target, content=name)


def test_exposures_of_two_cameras_are_refused():
    first = sample("input.samples.0 (a.yaml)", "A1")
    with pytest.raises(ConfigError, match=r"1 \(b\.yaml\) is of the camera of serial number B2, .* of A1;"):
        _same_sensor([first], sample("input.samples.1 (b.yaml)", "B2"))
    for serial in ("A1", None):
        _same_sensor([first], sample("input.samples.1 (b.yaml)", serial))
