"""Arrays whose last axis is time are told by their samples, where the format does not say."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.plain_camera import LAYOUTS, PlainCamera
from numpy.typing import NDArray

from pchem_pipeline.frames.inspect import survey
from pchem_pipeline.frames.settings import InputSettings

#: hardly any pattern: 5 % in the light, a DN in the bias
SPREAD = (0.05, 0.005, 0.05, 1.0)


def notes_on(path: Path, frames: NDArray[np.float64]) -> list[str]:
    codes = np.rint(frames).clip(0, 65535).astype(np.uint16)
    if path.suffix == ".npy":
        np.save(path, codes)
    else:
        with h5py.File(path, "w") as file:
            file.create_dataset("data", data=codes, chunks=(1, *codes.shape[1:]), compression="gzip")
    _, report = survey(InputSettings(files=(path.name,)), path.parent)
    return [note for note in report.notes if "last axis" in note]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_time_is_told_from_columns(tmp_path: Path, layout: str) -> None:
    frames = PlainCamera(0.3, 2.0, 10.0, (40, 48), 500, SPREAD, layout).frames(3).astype(np.float64)
    rng = np.random.default_rng(5)
    wandering = np.linspace(0.0, 4.0, 500)[:, None, None] + rng.normal(0.0, 0.5, (500, 1, 1))
    of_rows = rng.normal(0.0, 2.0, (500, 40, 1))
    path = tmp_path / "stack.npy"
    for added in (0.0, wandering, of_rows):
        assert notes_on(path, frames + added) == []
    [note] = notes_on(path, np.moveaxis(frames, 0, -1))
    assert note == (
        "stack.npy: read as 40 frames of 48 x 500 pixels, but by its samples the last axis looks like time; "
        "if it is, save numpy.moveaxis(array, -1, 0)"
    )


def test_it_is_said_of_hdf5_and_not_where_there_is_nothing_to_see(tmp_path: Path) -> None:
    frames = PlainCamera(0.3, 2.0, 10.0, (40, 48), 500, SPREAD).frames(3).astype(np.float64)
    path = tmp_path / "stack.h5"
    assert notes_on(path, frames) == []
    assert len(notes_on(path, np.moveaxis(frames, 0, -1))) == 1
    assert notes_on(path, np.random.default_rng(1).normal(100.0, 3.0, (40, 48, 500))) == []
    assert notes_on(path, frames[:4]) == []
    assert notes_on(path, np.full((40, 48, 500), 7.0)) == []
