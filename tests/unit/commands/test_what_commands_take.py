"""What commands refuse before they write, which frames they take for the same, and tables for others."""

import numpy as np
import pytest
from helpers.camera_files import write_hdf5

from pchem_pipeline.base.errors import ConfigError, InputError
from pchem_pipeline.commands.apply.source import open_like_run
from pchem_pipeline.commands.compare.compare import _data_digest
from pchem_pipeline.commands.compare.history import PixelStates, _cell
from pchem_pipeline.commands.demo import hidden_effect, run_demo
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.effects.framework.region import Region, When
from pchem_pipeline.model.maps.defects import Defect
from pchem_pipeline.report.comparison import DefectChange, by_change
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.stage import Command
from pchem_pipeline.run.target import Target
from pchem_pipeline.store.records import StageRecord
from pchem_pipeline.store.run_store import RunStore


def test_another_dataset_of_the_same_file_holds_other_frames(tmp_path):
    sensor = SensorInfo("frames", 9, 4, 4, "uint16", 12, None, "copy", {"digest": "d"})
    digests = []
    for number, dataset in enumerate(("dark/frames", "dark/frames", "light/frames")):
        store = RunStore.create(tmp_path / f"{number}.zarr")
        content = {"settings": {"input.dataset": dataset}}
        store.records.write(StageRecord("ingest", 1, "f", content, finished=True))
        digests.append(_data_digest(store, sensor))
    assert digests[0] == digests[1] != digests[2]


def test_labels_are_no_formulas_of_a_spreadsheet():
    labels = ["=1+1", "@SUM(A1)", "-2+cmd|'/C x'!A0", "+1 V (high)", "-20 °C", "-5.5", "night 3"]
    assert [_cell(label) for label in labels] == [
        "'=1+1", "'@SUM(A1)", "'-2+cmd|'/C x'!A0", "'+1 V (high)", *labels[4:]
    ]  # fmt: skip


def test_a_pixel_has_a_new_defect_unless_what_it_is_seen_in_agrees_within_the_errors_that_are_known():
    def states(exposure, stderr, noise, kinds):
        maps = [np.array([values], np.float64) for values in (exposure, stderr, noise, [0.01] * 5)]
        nothing = np.zeros((2, 1, 5), np.uint8)
        return PixelStates(np.array([kinds], np.uint16), (maps[0], maps[1]), (maps[2], maps[3]), *nothing)

    hot, noisy, stuck = int(Defect.HOT), int(Defect.NOISY), int(Defect.STUCK)
    first = states([1, 5.4, 1, 1, 6], [0.1] * 5, [0.2, 0.2, 0.2, 0.38, 0.2], [0, 0, 0, 0, hot])
    now = states(
        [1, 6, 6, 60, np.nan], [0.1, 0.1, 0.1, np.nan, np.nan], [0.4, 0.2, 0.2, 0.4, np.nan],
        [noisy, hot, hot, hot | noisy, stuck],
    )  # fmt: skip
    changes = [(0, "", "noisy"), (2, "", "hot"), (3, "", "hot noisy"), (4, "hot", "stuck")]
    assert now.changes_since(first) == tuple(DefectChange(0, *each) for each in changes)
    back = first.changes_since(now)
    assert [(each.x, each.now, each.before) for each in back] == changes
    assert {fate: len(each) for fate, each in by_change(back).items()} == {
        "new": 0, "gone": 3, "of another kind": 1
    }  # fmt: skip
    # of the same histograms a common fit is as good
    assert now.changes_since(first, lambda y, x: np.where(x == 2, 0.0, 1.0)) == (
        DefectChange(0, 2, "", "hot"),
    )
    # what the data leave open differs by chance, unless the histograms do
    good = states([1] * 5, [0.1] * 5, [0.2] * 5, [0] * 5)
    flagged = states([1] * 5, [0.1] * 5, [0.2] * 5, [0, 256, 256, 128, 128])
    assert flagged.changes_since(good) == ()
    confirm = np.array([0.0, 0.5, 1e-9, np.nan, 0.0])
    assert flagged.changes_since(good, lambda y, x: confirm[x]) == (
        DefectChange(0, 2, "", "flagged"), DefectChange(0, 4, "", "not_fitted")
    )  # fmt: skip
    assert now.defects() == {"stuck": 1, "saturated": 0, "dead": 0, "hot": 3, "noisy": 2}


@pytest.mark.parametrize(
    ("folder", "asked", "said"),
    [
        ("x", "rownoise@columns=2:5", r"'rownoise': no such effect; pchem info lists them; .*columns=A:B"),
        ("x", "row_noise@colums=2:5", "columns=A:B"),
        ("x", "row_noise@columns=2:9000", "the sensor has"),
        ("x", "clipping", "has no typical strength"),
        (".", "row_noise", "is not empty; choose another folder"),
    ],
)
def test_what_cannot_be_hidden_and_a_folder_of_something_else_are_refused(tmp_path, folder, asked, said):
    (tmp_path / "mine.txt").touch()
    with pytest.raises(ConfigError, match=said):
        run_demo(tmp_path / folder, Command(), hidden=asked, size=8, n_frames=60, seed=1)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_an_effect_can_be_hidden_in_a_place():
    effect = hidden_effect("row_noise@columns=2:5,frames=10:20", 12, 60)
    everywhere = hidden_effect("row_noise", 12, 60).model_dump()["row_noise_dn"]
    assert effect.model_dump()["row_noise_dn"] == pytest.approx(everywhere * (4 * 6) ** 0.5)
    assert effect.region == Region(columns=((2, 5),))
    assert effect.when == When(range=((10, 20),))


def test_frames_of_another_size_are_refused_and_of_another_dataset_taken(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sensor = SensorInfo("frames", 5, 4, 4, "uint16", None, None, "copy", {}, whole=(8, 9))
    config = RunConfig.model_validate({"input": {"files": ["a.npy"], "roi": [2, 6, 3, 7]}})
    target = Target(config, tmp_path, tmp_path / "run.zarr")
    frames = np.arange(3 * 8 * 9, dtype=np.uint16).reshape(3, 8, 9)
    given = {"whole": frames, "region": frames[:, 2:6, 3:7], "other": np.zeros((3, 12, 12), np.uint16)}
    for name, dn in given.items():
        np.save(f"{name}.npy", dn)
    for name in ("whole", "region"):
        found = open_like_run(target, sensor, [f"{name}.npy"])
        np.testing.assert_array_equal(found.read(), frames[:, 2:6, 3:7])
    words = r"other.npy: frames of 12 x 12 .* \[2, 6, 3, 7\] of frames of 8 x 9"
    with pytest.raises(InputError, match=words):
        open_like_run(target, sensor, ["other.npy"])
    dark = np.full((5, 4, 4), 100, np.uint16)
    light = dark + 20
    write_hdf5(tmp_path / "night.h5", **{"dark/frames": dark, "light/frames": light})
    sensor = SensorInfo("frames", 5, 4, 4, "uint16", None, None, "copy", {})
    for own, other, found in (
        ("dark/frames", None, dark),
        ("dark/frames", "light/frames", light),
        (None, "light/frames", light),
    ):
        config = RunConfig.model_validate({"input": {"files": ["a.h5"], "dataset": own}})
        target = Target(config, tmp_path, tmp_path / "run.zarr")
        frames = open_like_run(target, sensor, ["night.h5"], other)
        np.testing.assert_array_equal(frames.read(), found)
    with pytest.raises(InputError, match=r"several datasets: .*; choose one with input\.dataset"):
        open_like_run(target, sensor, ["night.h5"])
