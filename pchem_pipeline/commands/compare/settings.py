"""Settings and versions that differ between two runs."""

from __future__ import annotations

import json
from typing import Any

from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.report.comparison import Setting
from pchem_pipeline.run.fingerprint import changes
from pchem_pipeline.stages.table import STAGES
from pchem_pipeline.store.run_store import RunStore

#: Settings that decide results by another way than a stage's list.
_BESIDE = {
    "input.integration_time": ("maps",),
    "input.kind": ("maps", "report"),
    "input.files": ("ingest",),
    "input.samples": ("fit",),
    "model.effects": ("fit",),
    "model.set_aside_e": ("fit",),
}


def settings_that_differ(one: RunConfig, other: RunConfig) -> list[Setting]:
    """Return the settings that differ, each with the stages whose results it decides."""
    left, right = (config.model_dump(mode="json", by_alias=True) for config in (one, other))
    return [
        Setting(name, _text(before), _text(after), _readers(name))
        for name, before, after in changes(left, right)
    ]


def versions_that_differ(one: RunStore, other: RunStore) -> list[Setting]:
    """Return the versions of algorithms and programs that differ between the stages of two runs."""
    left, right = _versions(one), _versions(other)
    return [
        Setting(name, _text(left.get(name)), _text(right.get(name)))
        for name in sorted(left.keys() | right.keys())
        if left.get(name) != right.get(name)
    ]


def _versions(store: RunStore) -> dict[str, Any]:
    """Return the versions of a run; of a program all that its stages were done with."""
    found: dict[str, set[str]] = {}
    for stage in STAGES:
        record = store.records.read(stage)
        if record is not None and stage not in ("report", "electrons", "discrepancy"):
            found.setdefault(f"algorithm of {stage}", set()).add(str(record.version))
            for name, version in record.versions.items():
                found.setdefault(name, set()).add(version)
    return {name: ", ".join(sorted(versions)) for name, versions in found.items()}


def _text(value: Any) -> str:
    if value is None:
        return "not set"
    return value if isinstance(value, str) and value else json.dumps(value, ensure_ascii=False)


def _readers(name: str) -> tuple[str, ...]:
    """Return the stages that read a setting, itself or its section."""
    return _BESIDE.get(name) or tuple(
        name_of_stage
        for name_of_stage, stage in STAGES.items()
        if any(name == key or name.startswith(f"{key}.") for key in stage.settings)
    )
