"""What decides the result of a stage: how far it is, what is stale, and why."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pkgutil import resolve_name
from typing import Any

from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.config.load import setting_of, states
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.run.declaration import Stage
from pchem_pipeline.run.model_versions import model_of_content, model_versions
from pchem_pipeline.run.stage import StageContext
from pchem_pipeline.store.files import DESCRIPTION, digest_of, fingerprint_of
from pchem_pipeline.store.records import StageRecord
from pchem_pipeline.store.remote_path import RemotePath
from pchem_pipeline.store.run_store import RunStore

_NEWS = {f"input.{name}": f"new result of pchem {name}" for name in ("discrepancy", "methods")}


@dataclass(frozen=True)
class StageState:
    """How far a stage is."""

    stage: str
    state: str  # missing, partial, stale, complete or failed
    why: str = ""  # reason, for people
    done: int = 0  # finished units
    total: int = 0  # units of the complete stage (0 where not known yet)
    model: int | None = None  # number of the version of the model that its result rests on; None: of none

    def words(self) -> str:
        """Return the state as ``pchem status`` prints it."""
        count = f" {self.done} of {self.total}" if self.state == "partial" and self.total else ""
        return f"{self.state}{count}" + (f" - {self.why}" if self.why else "")


def fingerprint_content(stage: Stage, context: StageContext) -> dict[str, Any]:
    """Return all that decides the result of a stage, as JSON data."""
    return {
        "stage": stage.name,
        "version": stage.version,
        "settings": setting_values(stage, context),
        "upstream": {name: _state_of_result(context.store, name) for name in stage.upstream},
        "input": None if stage.identity is None else resolve_name(stage.identity)(context),
    }


def setting_values(stage: Stage, context: StageContext) -> dict[str, Any]:
    """Return the settings that a stage reads, as JSON data; of the tiles what they are."""
    found = {key: setting_of(context.config, key) for key in stage.settings}
    if found.get("run.tile") == "auto":
        rows, columns = context.tile
        found["run.tile"] = rows if rows == columns else [rows, columns]
    return found


def _state_of_result(store: RunStore, stage: str) -> str | None:
    """Return the fingerprint of a stage; for one that lacks units, also which it has; None: no record."""
    if (record := store.records.known(stage)) is None:
        return None
    done = store.records.done(stage, record.fingerprint)
    if len(done) >= record.keys > 0:
        return record.fingerprint
    return f"{record.fingerprint}+{hashlib.sha256(' '.join(sorted(done)).encode()).hexdigest()[:16]}"


def status(stage: Stage, context: StageContext) -> StageState:
    """Return how far a stage is under the present configuration and input."""
    try:
        record = context.store.records.read(stage.name)
        if record is None:
            return StageState(stage.name, "missing")
        done = len(context.store.records.done(stage.name, record.fingerprint))
        state, why = _state(stage, context, record, done)
    except StoreError as error:  # a description or a record is damaged: what rests on it is done again
        return StageState(stage.name, "stale", str(error).partition("; ")[0])
    return StageState(stage.name, state, why, done, record.keys, rests_on(record, context.store))


def _state(stage: Stage, context: StageContext, record: StageRecord, done: int) -> tuple[str, str]:
    """Return the state of a stage that was begun, and why."""
    if stage.upstream and "sensor" not in context.store.attributes("frames"):
        return "stale", "the run has no input"  # ingest was killed while it was done again
    written = not stage.writes or stage.may_write_nothing or context.store.has(stage.writes[0])
    if done and not written:
        return "stale", f"{stage.writes[0]} is missing in the store"  # a hand took it out
    if name := changed_file(record, context.store):
        return "stale", f"{name} is missing or has changed"
    content = fingerprint_content(stage, context)
    if fingerprint_of(content) != record.fingerprint and not _grew(content, record):
        numbers = {each.digest: each.number for each in (context.model, *model_versions(context.store))}
        return "stale", "; ".join(differences(record.content, content, numbers, context.config))
    if done < record.keys or record.keys == 0:
        failed = record.failed
        return "partial", f"{len(failed)} failed: {next(iter(failed.values()))}" if failed else ""
    return ("complete", "") if record.finished else ("partial", "interrupted")


def changed_file(record: StageRecord, store: RunStore) -> str:
    """Return a file or array of a stage's result that is missing or not as it was written; empty: none.

    Raises:
        StoreError: the description of a group is damaged.
    """
    for group in sorted({name.partition("/")[0] for name in record.files if name.endswith(DESCRIPTION)}):
        if not store.has(group):
            return f"{group}/{DESCRIPTION}"
    remote = isinstance(store.path, RemotePath)
    for name, digest in record.files.items():
        if remote and "." not in name:
            continue  # an array, of whose chunks each would be a request
        if digest != digest_of(store.path / name):
            return name
    return ""


def rests_on(record: StageRecord, store: RunStore) -> int | None:
    """Return the number of the model that a result rests on; None where it rests on none, or on one unknown.

    A stage that does not read the model uses the model of its upstream stages.
    """
    if record.model is not None:
        return record.model
    if (version := model_of_content(store, record.content)) is not None:
        return version.number
    for name, fingerprint in record.content.get("upstream", {}).items():
        upstream = store.records.known(name)
        if upstream is None or _base(fingerprint) != upstream.fingerprint:
            continue
        if (number := rests_on(upstream, store)) is not None:
            return number
    return None


def _grew(content: dict[str, Any], record: StageRecord) -> bool:
    """Return whether the only change is that upstream stages finished more units of the same work.

    Tiled stages then keep what they have and do the rest; undivided ones start again.
    """
    if record.keys == 1 or {**content, "upstream": 0} != {**record.content, "upstream": 0}:
        return False
    old, new = record.content.get("upstream", {}), content["upstream"]
    return all(_base(old.get(name)) == _base(new[name]) for name in new)


def _base(fingerprint: str | None) -> str | None:
    return None if fingerprint is None else fingerprint.partition("+")[0]


def differences(
    old: dict[str, Any],
    new: dict[str, Any],
    models: Mapping[Any, int] | None = None,
    config: RunConfig | None = None,
) -> list[str]:
    """Say in words why two fingerprint contents differ, and what keeps a result whose default has changed.

    ``models`` are the numbers of models by digest; without ``config``, of which the new content is, nothing
    is said of defaults.
    """
    words: list[str] = []
    if old.get("version") != new["version"]:
        words.append(f"algorithm version {old.get('version')} -> {new['version']}")
    for key, was, now in changes(old.get("settings", {}), new["settings"]):
        default = config is not None and was is not None and not states(config, key)
        keep = f" (the default; {key}: {was} in the YAML keeps the result)" if default else ""
        words.append(f"{key} {was} -> {now}{keep}")
    before = old.get("upstream", {})
    if renewed := [name for name, state in new["upstream"].items() if before.get(name) != state]:
        words.append(f"new {', '.join(renewed)}")
    if old.get("input") != new["input"]:
        words += _input_changes(old.get("input") or {}, new["input"] or {}, models or {})
    return words


def _input_changes(old: Any, new: Any, models: Mapping[Any, int]) -> list[str]:
    """Say which facts of the input changed; digests are no words."""
    if "content" in {**old, **new}:
        return ["the input has changed"]
    before, after = (models.get(facts.get("model"), "unknown") for facts in (old, new))
    words = [] if old.get("model") == new.get("model") else [f"model {before} -> {after}"]
    others = changes({**old, "model": None}, {**new, "model": None}, "input")
    return words + [_NEWS.get(key, f"{key} {was} -> {now}") for key, was, now in others]


def changes(old: Any, new: Any, key: str = "") -> list[tuple[str, Any, Any]]:
    """Return the entries that differ, key by key: their dotted names, what they were and what they are.

    A section that only one has is one entry.
    """
    if isinstance(old, dict) and isinstance(new, dict):
        return [
            change
            for name in sorted(old.keys() | new.keys())
            for change in changes(old.get(name), new.get(name), f"{key}.{name}" if key else name)
        ]
    return [] if old == new else [(key, old, new)]
