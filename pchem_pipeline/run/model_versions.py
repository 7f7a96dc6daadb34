"""The model of a run as an artefact: numbered versions, of which one is in force.

A version is made from the section ``model`` of the YAML, or by a verdict of the search for a discrepancy. It
lies in the store, ``model/0002.json``, with the arrays that belong to it in the group ``model/0002``; it is
written whole and never changed, and the same model makes no second one. ``model/current.json`` names the
version in force. The stages read it and nothing that a later stage wrote; what they make of it names it in
its fingerprint by its digest, in its record by its number.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
from pydantic import ValidationError

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.errors import ConfigError, StoreError, error_words
from pchem_pipeline.effects.framework.compose import AddedExposure
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.settings import ModelSettings
from pchem_pipeline.store.files import fingerprint_of, read_record, write_record
from pchem_pipeline.store.run_store import RunStore

_GROUP = "model"
_EXPOSURE, _WEIGHT = "added_exposure", "added_weight"
_CURE = "delete it; the model is then taken from the YAML"
Region = tuple[slice, slice]


@dataclass(frozen=True)
class AddedArrays:
    """Place of the exposure that effects of a model add to single pixels.

    Attributes:
        group: of the store, with ``added_exposure`` and ``added_weight``.
        rows, columns: of the window that they cover, first and end.
        effects: those that add it, as JSON data: it counts for nothing under a model without them.
        digest: of the arrays.
    """

    group: str
    rows: tuple[int, int]
    columns: tuple[int, int]
    effects: tuple[dict[str, Any], ...]
    digest: str

    @classmethod
    def of_group(cls, store: RunStore, group: str) -> AddedArrays | None:
        """Return those of a group; None where it has none."""
        values = store.attributes(f"{group}/{_EXPOSURE}")
        if not values:
            return None
        rows, columns = (tuple(values[name]) for name in ("rows", "columns"))
        return cls(group, rows, columns, tuple(values["effects"]), values["digest"])

    def attributes(self) -> dict[str, Any]:
        """Return what stands with the arrays, of which :meth:`of_group` makes it again."""
        return {name: value for name, value in asdict(self).items() if name != "group"}


@dataclass(frozen=True)
class ModelVersion:
    """One version of the model.

    Attributes:
        number: from 1.
        model: the section of the YAML, as JSON data.
        digest: of the section and of the arrays.
        source: config | verdict.
        parent: number of the version in force before; of a verdict, the one that the search started from.
        closed_fraction: of a verdict, the fraction of the gap that it closed.
        made: UTC time, ISO 8601; empty while it is not in the store.
        added: exposure that the effects add to pixels; None: it counts as part of H.
    """

    number: int
    model: dict[str, Any]
    digest: str
    source: str = "config"
    parent: int | None = None
    closed_fraction: float | None = None
    made: str = ""
    added: AddedArrays | None = None

    @property
    def settings(self) -> ModelSettings:
        """The section of the YAML.

        Raises:
            ConfigError: an effect came from a package that is no longer there.
        """
        try:
            return ModelSettings.model_validate(self.model)
        except ValidationError as error:
            raise ConfigError(
                f"model {self.number} of the run: {error_words(error)}; install the missing package, or use "
                "another version: pchem model --use"
            ) from error

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Its effects, in their order."""
        return self.settings.effects

    def holds(self, settings: ModelSettings) -> bool:
        """Return whether it is the model of these settings, whatever they were written with."""
        if self.model == settings.model_dump(mode="json"):
            return True
        try:
            return self.settings == settings
        except ConfigError:
            return False


def _next_version(
    versions: Sequence[ModelVersion], settings: ModelSettings, added: AddedArrays | None, **facts: Any
) -> ModelVersion:
    model = settings.model_dump(mode="json")
    digest = fingerprint_of({"model": model, "added_exposure": None if added is None else added.digest})
    number = versions[-1].number + 1 if versions else 1
    return ModelVersion(number, model, digest, added=added, **facts)


def model_versions(store: RunStore) -> tuple[ModelVersion, ...]:
    """Return the versions of a run, by number.

    Raises:
        StoreError: a version is damaged.
    """
    folder = store.path / _GROUP
    found = []
    for place in sorted(folder.glob("[0-9]*.json")) if folder.is_dir() else ():
        content: Any = read_record(place, _CURE)
        try:
            added = None if content["added"] is None else AddedArrays(**content["added"])
            found.append(ModelVersion(**{**content, "added": added}))
        except (KeyError, TypeError) as error:
            raise StoreError(f"{place} is damaged ({error}); {_CURE}") from error
    return tuple(found)


def version_with(store: RunStore, number: int) -> ModelVersion:
    """Return a version of a run.

    Raises:
        ConfigError: there is no such version.
    """
    versions = {version.number: version for version in model_versions(store)}
    if number not in versions:
        have = ", ".join(map(str, versions)) or "none"
        raise ConfigError(f"{store.path} has no model {number}; it has: {have}")
    return versions[number]


def with_digest(versions: Sequence[ModelVersion], digest: str | None) -> ModelVersion | None:
    """Return the version with a digest; None where there is none."""
    return next((version for version in versions if version.digest == digest), None)


def model_in_force(store: RunStore, settings: ModelSettings) -> ModelVersion:
    """Return the version that the section ``model`` of a configuration means; reads only.

    It is the current one where that is what the section says, else the latest that is; else a new one, which
    takes over what the latest version knows of the exposure that the same effects add.
    """
    versions = model_versions(store)
    number = (read_record(store.path / _GROUP / "current.json") or {}).get("number")
    fitting = [version for version in versions if version.holds(settings)]
    if fitting:
        return next((version for version in fitting if version.number == number), fitting[-1])
    effects = [effect.model_dump(mode="json") for effect in settings.effects]
    known = [v.added for v in versions if v.added is not None and all(e in effects for e in v.added.effects)]
    return _next_version(versions, settings, known[-1] if known else None, parent=number)


def verdict_version(
    store: RunStore,
    settings: ModelSettings,
    start: ModelVersion,
    *,
    group: str = "",
    closed_fraction: float | None = None,
) -> ModelVersion:
    """Return the version that a verdict with these settings makes: one that is there, or new; reads only.

    The search began with ``start``, closed a fraction of the gap, and left in ``group`` of the store what the
    effects add to pixels (empty: nothing).
    """
    versions = model_versions(store)
    added = AddedArrays.of_group(store, group) if group else None
    facts = {"source": "verdict", "parent": start.number, "closed_fraction": closed_fraction}
    new = _next_version(versions, settings, added, **facts)
    return with_digest(versions, new.digest) or new


def keep_in_force(store: RunStore, version: ModelVersion) -> ModelVersion:
    """Put a version in force, and into the store where it is not there yet; return it as it is there.

    Raises:
        StoreError: the store refuses.
    """
    found = {each.number: each for each in (*model_versions(store), version)}
    found = {number: each if each.made else _keep(store, each) for number, each in found.items()}
    place = store.path / _GROUP / "current.json"
    if read_record(place) != {"number": version.number}:
        write_record(place, {"number": version.number})
    return found[version.number]


def _keep(store: RunStore, version: ModelVersion) -> ModelVersion:
    """Write a version: its arrays, then what makes it one."""
    name = f"{_GROUP}/{version.number:04}"
    store.delete(name)  # what a command that was killed may have left
    if version.added is not None and not version.added.group.startswith(f"{_GROUP}/"):
        for array in (_WEIGHT, _EXPOSURE):
            values = store.read(f"{version.added.group}/{array}")
            store.write_array(f"{name}/{array}", values, version.added.attributes())
        version = replace(version, added=replace(version.added, group=name))
    version = replace(version, made=datetime.now(UTC).isoformat(timespec="seconds"))
    write_record(store.path / f"{name}.json", asdict(version))
    return version


# -- what results rest on ------------------------------------------------------------------------


def model_of(store: RunStore, stage: str) -> ModelVersion | None:
    """Return the version that the stored result of a stage which reads the model rests on.

    That is the model of its maps, whatever the configuration says by now.

    Raises:
        StoreError: the result is there, but not what it rests on.
    """
    record = store.records.read(stage)
    if record is None:
        if store.has(stage):
            raise StoreError(f"{store.path}: {stage} has lost its record; {store.cure(stage)}")
        return None
    version = model_of_content(store, record.content)
    if version is None and (record.content.get("input") or {}).get("model"):
        raise StoreError(f"{store.path / _GROUP}: the model used by {stage} is missing; run again")
    return version


def model_of_content(store: RunStore, content: dict[str, Any]) -> ModelVersion | None:
    """Return the version that stands in what decided a result; None where none does."""
    given = content.get("input") or {}
    return with_digest(model_versions(store), given["model"]) if "model" in given else None


# -- exposure that effects add to single pixels ---------------------------------------------------


def write_added_exposure(
    store: RunStore,
    group: str,
    added: AddedExposure | None,
    effects: Sequence[Effect],
    rows: tuple[int, int],
    columns: tuple[int, int],
) -> None:
    """Keep in a group what effects add, (j, y, x), in a window of the sensor, or that they add nothing."""
    for name in (_EXPOSURE, _WEIGHT):
        store.delete(f"{group}/{name}")
    if added is None:
        return
    exposure, weight = (np.ascontiguousarray(values, np.float64) for values in added)
    digest = hashlib.sha256(exposure.tobytes() + weight.tobytes()).hexdigest()
    adding = [e for e in effects if type(e).added_exposure is not Effect.added_exposure]
    kept = tuple(e.model_dump(mode="json") for e in adding)
    store.write_array(f"{group}/{_WEIGHT}", weight)
    facts = AddedArrays(group, rows, columns, kept, digest)
    store.write_array(f"{group}/{_EXPOSURE}", exposure, facts.attributes())


def read_added_exposure(
    store: RunStore, version: ModelVersion | None, region: Region | None = None
) -> AddedExposure | None:
    """Return what the effects of a model add to the pixels of a region, or of all of the sensor.

    None where that is nothing, or where the model is a plain one (None).
    """
    if version is None or version.added is None:
        return None
    shape = store.array("histogram/origin").shape
    windows = (version.added.rows, version.added.columns)
    wanted, inside, place = [], [], []
    for (first, end), given, n in zip(windows, region or (slice(None), slice(None)), shape, strict=True):
        start, stop, _ = given.indices(n)
        low, high = max(first, start), min(end, stop)
        if low >= high:
            return None
        wanted.append(stop - start)
        inside.append(slice(low - first, high - first))
        place.append(slice(low - start, high - start))
    found: list[FloatArray] = []
    for name in (_EXPOSURE, _WEIGHT):
        part = store.read(f"{version.added.group}/{name}", (slice(None), *inside))
        whole = np.zeros((part.shape[0], *wanted))
        if name == _WEIGHT:
            whole[0] = 1.0
        whole[(slice(None), *place)] = part
        found.append(whole)
    return AddedExposure(*found)
