"""Which runs come from the same frames."""

from pchem_pipeline.commands.compare.compare import _data_digest
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
