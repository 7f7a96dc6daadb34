"""A small run with a report, written array by array: no stage is run and no kernel compiled."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from helpers.report_material import draw_dn, report_data
from helpers.without_pictures import page_without_pictures

from pchem_pipeline.config.load import dump_config
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.inspector import InspectorData, PixelSample
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.stages.report.inspector import inspector_data, read_maps
from pchem_pipeline.stages.report.pixels import choose_inspected
from pchem_pipeline.stages.report.stored import read_histograms
from pchem_pipeline.store.records import StageRecord
from pchem_pipeline.store.run_store import RunStore


def write_run(folder: Path, data: ReportData, *, n_frames: int = 400) -> RunStore:
    """Write what the inspector reads of a run whose fit is that of ``data``."""
    store = RunStore.create(folder / "run.zarr")
    store.write_config(dump_config(RunConfig.model_validate({"input": {"files": ["frames/*.tif"]}})))
    ny, nx = data.shape
    identity = {"files": [], "digest": ""}
    SensorInfo("frames", n_frames, ny, nx, "uint16", 14, None, "copy", identity).write(store)
    for name, values in data.maps.items():
        store.write_array(f"maps/{name}", values)
    store.write_array("fit/fit_status", data.fit["fit_status"])
    store.write_array("fit/goodness_p", data.fit["goodness_p"])
    dn, _ = draw_dn(dict(data.truth), n_frames, seed=5)
    origin = dn.min(axis=0)
    counts = np.zeros((ny, nx, int((dn - origin).max()) + 1), np.uint16)
    y, x = np.mgrid[:ny, :nx]
    for frame in dn - origin:
        counts[y, x, frame] += 1
    store.create_array("histogram/counts", counts.shape, chunks=(32, 32, counts.shape[2]), dtype=np.uint16)
    store.write("histogram/counts", (slice(None),) * 3, counts)
    store.write_array("histogram/origin", origin.astype(np.int32))
    return store


def inspector_of(
    store: RunStore, maps: Mapping[str, Any], fit: Mapping[str, Any], shown: Sequence[tuple[int, int]] = ()
) -> InspectorData:
    """Return the inspector of a run that was fitted with the PCD."""
    shape, (index, reasons) = maps["bias"].shape, choose_inspected(maps, fit, shown)
    entries, exact = read_maps(store, shape, index)
    held = read_histograms(store, index, shape)
    sample = PixelSample(index, exact, held.origin, held.counts, reasons=reasons)
    return inspector_data(store.path.name, shape, entries, sample)


def make_run(
    folder: Path,
    shape: tuple[int, int] = (70, 90),
    *,
    failed: float = 0.02,
    n_frames: int = 400,
    **changes: object,
) -> RunStore:
    """Write a run of a simulated sensor with its report."""
    data = replace(report_data(shape, failed=failed), **changes)  # type: ignore[arg-type]
    store = write_run(folder, data, n_frames=n_frames)
    inspector = inspector_of(store, data.maps, data.fit, [(0, 0)])
    page = page_without_pictures(replace(data, inspector=lambda: inspector, pixels=data.pixels[:1]))
    store.write_file("report.html", page.encode())
    for stage in ("histogram", "fit", "maps", "ensemble", "report"):
        store.records.write(StageRecord(stage, 1, "made", {}, finished=True))
    return store
