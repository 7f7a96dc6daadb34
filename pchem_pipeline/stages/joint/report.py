"""Stage ``joint_report``: the page, the numbers and the figures of a joint fit."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.base.variables import variables_of
from pchem_pipeline.config.joint import dump_joint, load_joint
from pchem_pipeline.config.load import dump_config
from pchem_pipeline.model.fit.status import FAILED, MEANINGS
from pchem_pipeline.report.data import ReportData, Sample, Samples
from pchem_pipeline.report.figures.catalogue import FIGURE_NAMES
from pchem_pipeline.report.figures.samples import middle
from pchem_pipeline.report.pages.pictures import DrawAll
from pchem_pipeline.report.pages.report import render_report
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.stage import WHOLE, StageContext, Unit, open_store
from pchem_pipeline.stages.joint.samples import read_samples
from pchem_pipeline.stages.report.drawing import draw_by_workers
from pchem_pipeline.store.files import without_nan

if TYPE_CHECKING:
    from pchem_pipeline.config.tree import RunConfig
    from pchem_pipeline.store.run_store import RunStore

__all__ = ["gather_joint", "run"]

_NOT_SHOWN = ("covariance",)


def run(context: StageContext) -> None:
    """Write the report of a joint fit.

    Raises:
        StoreError: an array is missing or the store cannot be written.
    """
    draw = draw_by_workers(context.executor.workers, context.reporter, context.stage)
    task = functools.partial(_write, context.store.path, context.config, context.config_path, draw)
    context.run_units([WHOLE], task, unit_name="report")


def _write(
    path: Path, config: RunConfig, config_path: Path | None, draw: DrawAll | None, unit: Unit
) -> dict[str, Any]:
    """Gather, draw and write; files of figures that this fit does not have any more are removed."""
    store = open_store(path)
    data = gather_joint(store, config, config_path)
    rendered = render_report(data, config.report, draw)
    for name, content in rendered.figures.items():
        store.write_file(f"figures/{name}", content)
    for old in (path / "figures").glob("*.*"):
        if old.name not in rendered.figures and old.stem in FIGURE_NAMES:
            old.unlink(missing_ok=True)
    store.write_file("report.json", (json.dumps(_numbers(store, data), indent=2) + "\n").encode())
    store.write_file("report.html", rendered.html.encode())
    return {"figures": len(rendered.figures)}


def gather_joint(store: RunStore, config: RunConfig, config_path: Path | None) -> ReportData:
    """Read all that the report of a joint fit shows.

    Args:
        store: of the joint fit.
        config: as its stages see it.
        config_path: its YAML file, where there is one.

    Raises:
        StoreError: arrays are missing.
    """
    samples, against = read_samples(store)
    sensor = SensorInfo.read(store)
    record = store.records.read("joint")
    groups: dict[str, dict[str, Any]] = {
        group: {
            v.name: store.read(v.path)
            for v in variables_of(group)
            if v.name not in _NOT_SHOWN and store.has(v.path)
        }
        for group in ("joint", "maps")
    }
    groups["maps"].pop("quality", None)
    joint = groups["joint"]
    names = ("quanta_exposure", "mean", "variance", "linearity_residual", "linearity_p")
    found = tuple(Sample(each.name, each.kind, each.x, each.n_frames) for each in samples)
    notes = () if record is None else record.notes
    return ReportData(
        title=config.run.title or store.path.name,
        shape=sensor.shape,
        n_frames=sensor.n_frames,
        maps=groups["maps"],
        fit={name: joint[name] for name in ("fit_status", "goodness_p") if name in joint},
        status_words={int(bit): text for bit, text in MEANINGS.items()},
        failed_mask=int(FAILED),
        config_yaml=_settings(config, config_path),
        stages=[{"stage": "joint", "notes": list(notes)}],
        samples=Samples(found, against, {name: joint[name] for name in names if name in joint}),
    )


def _settings(config: RunConfig, config_path: Path | None) -> str:
    """Return the YAML of the joint fit; that of its stages where its file is gone."""
    if config_path is None:
        return dump_config(config)
    try:
        return dump_joint(load_joint(config_path))
    except ConfigError:
        return dump_config(config)


def _numbers(store: RunStore, data: ReportData) -> dict[str, Any]:
    """Return the numbers of the report for other programs."""
    found = data.samples
    assert found is not None
    rows = []
    for i, sample in enumerate(found.samples):
        centre, error, _, _ = middle(found.arrays["quanta_exposure"][i])
        row: dict[str, Any] = {
            "name": sample.name,
            "kind": sample.kind,
            found.against if found.against != "none" else "x": sample.x,
            "n_frames": sample.n_frames,
            "quanta_exposure": {"median": centre, "median_stderr": error},
        }
        if "linearity_residual" in found.arrays:
            rest, rest_error, _, _ = middle(found.arrays["linearity_residual"][i])
            row["linearity_residual"] = {"median": rest, "median_stderr": rest_error}
        rows.append(row)
    attributes = store.attributes("maps")
    notes = [note for stage in data.stages for note in stage["notes"]]
    content = {"title": data.title, "against": found.against, "samples": rows, "notes": notes}
    numbers: dict[str, Any] = without_nan(
        {**content, "maps": attributes["summary"], "fit_status": attributes["fit_status"]}
    )
    return numbers
