"""Frames to be calibrated are opened as the run's own were."""

import h5py
import numpy as np
import pytest

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.commands.apply.source import open_like_run
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.target import Target


def test_a_region_of_frames_of_another_size_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sensor = SensorInfo("frames", 5, 4, 4, "uint16", None, None, "copy", {}, whole=(8, 9))
    config = RunConfig.model_validate({"input": {"files": ["a.npy"], "roi": [2, 6, 3, 7]}})
    target = Target(config, tmp_path, tmp_path / "run.zarr")
    frames = np.arange(3 * 8 * 9, dtype=np.uint16).reshape(3, 8, 9)
    given = {"whole": frames, "region": frames[:, 2:6, 3:7], "other": np.zeros((3, 12, 12), np.uint16)}
    for name, dn in given.items():
        np.save(f"{name}.npy", dn)
    for name in ("whole", "region"):
        with open_like_run(target, sensor, [f"{name}.npy"]) as found:
            np.testing.assert_array_equal(found.read(), frames[:, 2:6, 3:7])
    with pytest.raises(
        InputError, match=r"other.npy: frames of 12 x 12 .* \[2, 6, 3, 7\] of frames of 8 x 9"
    ):
        open_like_run(target, sensor, ["other.npy"])


def test_the_dataset_of_other_frames_may_be_another(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    dark, light = np.full((2, 5, 4, 4), 100, np.uint16)
    light += 20
    with h5py.File("night.h5", "w") as file:
        file["dark/frames"], file["light/frames"] = dark, light
    sensor = SensorInfo("frames", 5, 4, 4, "uint16", None, None, "copy", {})
    for own, given, found in (
        ("dark/frames", None, dark),
        ("dark/frames", "light/frames", light),
        (None, "light/frames", light),
    ):
        config = RunConfig.model_validate({"input": {"files": ["a.h5"], "dataset": own}})
        target = Target(config, tmp_path, tmp_path / "run.zarr")
        with open_like_run(target, sensor, ["night.h5"], given) as frames:
            np.testing.assert_array_equal(frames.read(), found)
    with pytest.raises(InputError, match=r"several datasets: .*; choose one with input\.dataset"):
        open_like_run(target, sensor, ["night.h5"])
