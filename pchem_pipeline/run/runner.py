"""The stages in their order: what is up to date, what is stale and why, and doing what is needed."""

from __future__ import annotations

import hashlib
import importlib
import os
import platform
import time
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from typing import Any, cast

from pchem_pipeline.base.errors import StoreError, quoted
from pchem_pipeline.compute.environment import peak_rss_bytes
from pchem_pipeline.config.load import setting_of
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.run.declared import DECLARED, Declaration
from pchem_pipeline.run.stage import StageContext, StageModule, identity_of
from pchem_pipeline.store.records import StageRecord, fingerprint_of
from pchem_pipeline.store.run_store import RunStore

__all__ = [
    "JOINT_STAGES",
    "OPTIONAL_STAGES",
    "STAGES",
    "StageState",
    "cpu_seconds",
    "declaration_of",
    "execute",
    "load_stage",
    "pipeline_of",
    "setting_values",
    "status",
]

#: Every stage of a run, in the order of the data.
STAGES = ("simulate", "ingest", "histogram", "fit", "maps", "ensemble", "report")

#: Stages that are run on demand only.
OPTIONAL_STAGES = ("electrons", "discrepancy", "methods")

#: Stages of a joint fit of several runs, which has a store of its own.
JOINT_STAGES = ("joint", "joint_report")

_LIBRARIES = ("numpy", "scipy", "numba", "zarr", "dask", "tifffile", "astropy", "h5py", "matplotlib")


@dataclass(frozen=True)
class StageState:
    """How far a stage is.

    Attributes:
        stage: its name.
        state: missing, partial, stale, complete or failed.
        why: reason, for people.
        done: finished units.
        total: units of the complete stage (0 where not known yet).
    """

    stage: str
    state: str
    why: str = ""
    done: int = 0
    total: int = 0

    def words(self) -> str:
        """Return the state as ``pchem status`` prints it."""
        count = f" {self.done} of {self.total}" if self.state == "partial" and self.total else ""
        return f"{self.state}{count}" + (f" - {self.why}" if self.why else "")


def load_stage(name: str) -> StageModule:
    """Import the module of a stage (its libraries come with it, and only they)."""
    return cast("StageModule", importlib.import_module(DECLARED[name].module))


def declaration_of(name: str) -> Declaration:
    """Return what a stage declares, without the libraries of its module."""
    return DECLARED[name]


def pipeline_of(config: RunConfig) -> tuple[str, ...]:
    """Return the stages that a configuration has: ``simulate`` only where it is asked for."""
    return STAGES if config.simulate is not None else STAGES[1:]


def fingerprint_content(stage: StageModule | Declaration, context: StageContext) -> dict[str, Any]:
    """Return all that decides the result of a stage, as JSON data."""
    upstream: dict[str, str | None] = {}
    for name in stage.UPSTREAM:
        record = context.store.records.read(name)
        upstream[name] = None if record is None else _state_of_record(context.store, record)
    return {
        "stage": stage.NAME,
        "version": stage.VERSION,
        "settings": setting_values(stage.NAME, context, stage),
        "upstream": upstream,
        "input": identity_of(stage, context),
    }


def setting_values(
    name: str, context: StageContext, stage: StageModule | Declaration | None = None
) -> dict[str, Any]:
    """Return the settings that a stage reads, as JSON data."""
    keys = (stage or DECLARED[name]).SETTINGS
    return {key: setting_of(context.config, key) for key in keys}


def _state_of_record(store: RunStore, record: StageRecord) -> str:
    """Return the fingerprint of a stage; for one that lacks units, also which it has."""
    done = store.records.done(record.stage, record.fingerprint)
    if len(done) >= record.keys > 0:
        return record.fingerprint
    return f"{record.fingerprint}+{hashlib.sha256(' '.join(sorted(done)).encode()).hexdigest()[:16]}"


def status(stage: StageModule | Declaration, context: StageContext) -> StageState:
    """Return how far a stage is under the present configuration and input."""
    record = context.store.records.read(stage.NAME)
    if record is None:
        return StageState(stage.NAME, "missing")
    done = len(context.store.records.done(stage.NAME, record.fingerprint))
    content = fingerprint_content(stage, context)
    if fingerprint_of(content) != record.fingerprint and not _grew(content, record):
        return StageState(
            stage.NAME, "stale", "; ".join(differences(record.content, content)), done, record.keys
        )
    if done < record.keys or record.keys == 0:
        reason = f"{len(record.failed)} failed: {next(iter(record.failed.values()))}" if record.failed else ""
        return StageState(stage.NAME, "partial", reason, done, record.keys)
    if not record.finished:
        return StageState(stage.NAME, "partial", "interrupted", done, record.keys)
    return StageState(stage.NAME, "complete", "", done, record.keys)


def _grew(content: dict[str, Any], record: StageRecord) -> bool:
    """Tell whether the only change is that upstream stages finished more units of the same work.

    Tiled stages then keep what they have and do the rest; undivided ones start again.
    """
    if record.keys == 1 or {**content, "upstream": 0} != {**record.content, "upstream": 0}:
        return False
    old, new = record.content.get("upstream", {}), content["upstream"]
    return all(_base(old.get(name)) == _base(new[name]) for name in new)


def _base(fingerprint: str | None) -> str | None:
    return None if fingerprint is None else fingerprint.partition("+")[0]


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Say in words why two fingerprint contents differ."""
    words: list[str] = []
    if old.get("version") != new["version"]:
        words.append(f"algorithm version {old.get('version')} -> {new['version']}")
    before: dict[str, Any] = old.get("settings", {})
    for key in sorted(before.keys() | new["settings"].keys()):
        words += _changes(key, before.get(key), new["settings"].get(key))
    for name in new["upstream"]:
        if old.get("upstream", {}).get(name) != new["upstream"][name]:
            words.append(f"{name} was done again")
    if old.get("input") != new["input"]:
        words += _input_changes(old.get("input"), new["input"])
    return words


def _input_changes(old: Any, new: Any) -> list[str]:
    """Say which facts of the input changed; digests are no words."""
    facts = {**(old or {}), **(new or {})}
    if "content" in facts:
        return ["the content of the input changed"]
    return _changes("input", old or {}, new or {})


def _changes(key: str, old: Any, new: Any) -> list[str]:
    if isinstance(old, dict) and isinstance(new, dict):
        return [
            word
            for name in sorted(old.keys() | new.keys())
            for word in _changes(f"{key}.{name}", old.get(name), new.get(name))
        ]
    return [] if old == new else [f"{key} {old} -> {new}"]


def execute(name: str, context: StageContext) -> StageState:
    """Bring a stage up to date and return its state.

    Units that fail make the state ``failed``; the others are kept.

    Raises:
        PchEmError: the stage cannot be done.
    """
    clock = time.perf_counter(), cpu_seconds()
    stage = load_stage(name)
    before = status(stage, context)
    chosen = context.options.tiles is not None or context.options.roi is not None
    if chosen and before.state == "complete":
        context.selected(())  # refuses tiles and regions that the sensor does not have
    if before.state == "complete" and not context.options.force:
        context.reporter.info(f"{name}: up to date")
        return before
    for upstream in stage.UPSTREAM:
        if context.store.records.read(upstream) is None:
            place = quoted(context.store.path)
            raise StoreError(f"{name} needs {upstream} first; run: pchem {upstream} {place}")
    if context.options.dry_run:
        context.reporter.info(f"{name}: {before.words()} -> would run")
        return before
    if name == "histogram" and context.swept is not None:
        clock = context.swept.clock
    return _perform(stage, context, before, restart=not chosen, clock=clock)


def _perform(
    stage: StageModule,
    context: StageContext,
    before: StageState,
    *,
    restart: bool,
    clock: tuple[float, float],
) -> StageState:
    """Run a stage that is not up to date, and keep its record whatever happens.

    The clock (wall, CPU) started before the state was looked at: hashing the input is part of the work.
    """
    records = context.store.records
    content = fingerprint_content(stage, context)
    old = records.read(stage.NAME)
    # a stage that was stopped before its first unit may lack arrays
    resumes = before.state in ("partial", "complete") and old is not None and old.keys > 0
    if resumes and context.options.force and restart:
        resumes = False
    context.stage, context.failed, context.notes, context.n_keys = stage.NAME, {}, [], 0
    context.fingerprint = old.fingerprint if resumes and old is not None else fingerprint_of(content)
    context.fresh = not resumes and not context.is_swept
    if context.fresh:
        records.forget(stage.NAME)
        for path in stage.WRITES:
            context.store.delete(path)
    record = StageRecord(
        stage.NAME,
        stage.VERSION,
        context.fingerprint,
        content,
        keys=old.keys if resumes and old is not None else 0,
        started=datetime.now(UTC).isoformat(timespec="seconds"),
        versions=_versions(),
    )
    records.write(record)
    context.reporter.event("start", stage=stage.NAME, why=before.words())
    wall, cpu = clock
    try:
        stage.run(context)
        record = replace(record, finished=True)
    finally:
        record = replace(
            record,
            keys=context.n_keys or record.keys,
            seconds=time.perf_counter() - wall + (old.seconds if resumes and old is not None else 0.0),
            cpu_seconds=cpu_seconds() - cpu + (old.cpu_seconds if resumes and old is not None else 0.0),
            peak_rss_bytes=peak_rss_bytes(),
            failed=context.failed,
            notes=tuple(context.notes),
        )
        records.write(record)
    return _finish(stage, context, record)


def _finish(stage: StageModule, context: StageContext, record: StageRecord) -> StageState:
    """Say how a stage ended."""
    done = len(context.store.records.done(stage.NAME, record.fingerprint))
    context.reporter.info(
        f"{stage.NAME}: {done} of {record.keys} units in {record.seconds:.1f} s "
        f"({record.cpu_seconds:.1f} s CPU, peak {record.peak_rss_bytes / 2**20:.0f} MiB)",
        stage=stage.NAME,
        seconds=record.seconds,
        peak_rss_bytes=record.peak_rss_bytes,
    )
    if not context.failed:
        return StageState(stage.NAME, "complete" if done >= record.keys else "partial", "", done, record.keys)
    key, reason = next(iter(context.failed.items()))
    why = f"{len(context.failed)} of {record.keys} units failed, first {key}: {reason}"
    context.reporter.warning(f"{stage.NAME}: {why}")
    return StageState(stage.NAME, "failed", why, done, record.keys)


def cpu_seconds() -> float:
    """Return the CPU time of this process and its finished children."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version(), "pchem-pipeline": _version("pchem-pipeline")}
    return found | {name: text for name in _LIBRARIES if (text := _version(name))}


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""
