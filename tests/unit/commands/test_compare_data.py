"""Which runs come from the same frames, and what their history says."""

import csv

import numpy as np

from pchem_pipeline.commands.compare.compare import _data_digest
from pchem_pipeline.commands.compare.history import PixelStates, history_csv
from pchem_pipeline.report.comparison import HistoryRow, RunFacts
from pchem_pipeline.run.sensor import SensorInfo
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
    run = RunFacts("A", "=x.zarr", (8, 8), 9, "", summary={})
    rows = [HistoryRow(label, "", None, np.nan, run) for label in labels]
    cells = [line[0] for line in csv.reader(history_csv(rows).splitlines()[1:])]
    assert cells == ["'=1+1", "'@SUM(A1)", "'-2+cmd|'/C x'!A0", "'+1 V (high)", *labels[4:]]
    assert {line["run"] for line in csv.DictReader(history_csv(rows).splitlines())} == {"'=x.zarr"}


def test_a_pixel_is_newly_hot_unless_its_exposure_agrees_within_the_errors_that_are_known():
    exposure = np.array([[1.0, 6.0, 6.0, 60.0]])
    nothing = np.zeros((2, 1, 4), np.uint8)
    hot = PixelStates(exposure > 5.5, exposure, np.array([[0.1, 0.1, 0.1, np.nan]]), *nothing)
    before = np.array([[1.0, 5.4, 1.0, 1.0]])
    first = PixelStates(before > 5.5, before, np.full((1, 4), 0.1), *nothing)
    assert hot.new_since(first) == ((0, 2), (0, 3))
    assert first.new_since(hot) == ()
