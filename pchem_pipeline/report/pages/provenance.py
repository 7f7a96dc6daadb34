"""The tables of what was run on what: settings, stages, input files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.pages.tables import Row, Table

_SECTION = "provenance"


def provenance_tables(data: ReportData) -> list[Table]:
    """Return the tables of what was run on what."""
    return [table for make in (_run, _stages, _inputs) if (table := make(data)).rows]


def size_text(size: float) -> str:
    """Return a number of bytes in MB or GB."""
    return (
        f"{size / 1e9:.2f} GB"
        if size >= 1e9
        else f"{size / 1e6:.1f} MB"
        if size >= 1e5
        else f"{size / 1e3:.1f} kB"
    )


def _flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            rows += _flat(value, f"{prefix}{key}: ")
        elif isinstance(value, Sequence) and not isinstance(value, str):
            rows.append((f"{prefix}{key}", ", ".join(str(item) for item in value)))
        else:
            rows.append((f"{prefix}{key}", "not known" if value is None else str(value)))
    return rows


def _run(data: ReportData) -> Table:
    rows = ({"item": item, "value": value} for item, value in _flat(data.run))
    return Table.of("run", "Run", "Program and settings of this report.", rows, _SECTION)


def _stages(data: ReportData) -> Table:
    words = "Wall time, CPU time and largest resident memory of a process."
    return Table.of("stages", "Stages", words, map(_stage_row, data.stages), _SECTION)


def _stage_row(stage: Mapping[str, Any]) -> Row:
    def seconds(key: str) -> str:
        return f"{float(stage[key]):.1f} s" if stage.get(key) is not None else ""

    memory = stage.get("peak_memory_bytes")
    return {
        "stage": str(stage.get("stage", "")),
        "state": str(stage.get("state", "")),
        "wall": seconds("seconds"),
        "CPU": seconds("cpu_seconds"),
        "peak memory": f"{float(memory) / 2**20:.0f} MiB" if memory else "",
        "started (UTC)": str(stage.get("started", "")),
    }


#: Files beyond this number are counted, not listed.
_MOST_FILES = 200


def _inputs(data: ReportData) -> Table:
    more = len(data.inputs) - _MOST_FILES
    words = f" The first {_MOST_FILES} of {len(data.inputs):,} files." if more > 0 else ""
    return Table.of(
        "inputs",
        "Input files",
        f"Names, sizes and content hashes of the files that were read.{words}",
        (
            {
                "file": str(entry.get("name", "")),
                "size": size_text(float(entry["size"])) if entry.get("size") is not None else "",
                "hash": str(entry.get("hash", "")),
            }
            for entry in data.inputs[:_MOST_FILES]
        ),
        _SECTION,
    )
