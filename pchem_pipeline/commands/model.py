"""``pchem model``: the versions of a run's model, which of them is in force, and what rests on each."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

from pchem_pipeline.base.errors import ConfigError, quoted
from pchem_pipeline.config.load import dump_config, load_config, write_model
from pchem_pipeline.discrepancy.verdict import parameters_of, read_verdict
from pchem_pipeline.effects.framework.compose import effect_words
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.settings import ModelSettings
from pchem_pipeline.run.model_versions import (
    ModelVersion,
    keep_in_force,
    model_in_force,
    model_of,
    model_versions,
    verdict_version,
    version_with,
)
from pchem_pipeline.run.target import Target
from pchem_pipeline.runner.session import run_status
from pchem_pipeline.stages.table import STAGES
from pchem_pipeline.store.remote_path import place_of
from pchem_pipeline.store.run_store import RunStore

_SEARCH = "discrepancy"


def _listed(target: Target) -> list[tuple[ModelVersion, bool, list[str]]]:
    """Return each version, one that is only in the YAML last; is it in force; which stages rest on it."""
    store = target.stored()
    current = model_in_force(store, target.config.model)
    versions = {version.number: version for version in (*model_versions(store), current)}
    states = run_status(target)
    return [
        (version, number == current.number, [state.stage for state in states if state.model == number])
        for number, version in versions.items()
    ]


def model_lines(target: Target) -> list[str]:
    """Return a table of the versions of the model of a run."""
    rows = [("model", "source", "explained", "results", "effects")]
    for version, current, results in _listed(target):
        closed = "" if version.closed_fraction is None else f"{100 * version.closed_fraction:.1f} %"
        source = f"verdict on {version.parent}" if version.source == "verdict" else version.source
        number = f"{'*' if current else ' '} {version.number}"
        rows.append((number, source, closed, ", ".join(results) or "-", _words(version)))
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]) - 1)]
    return ["  ".join([*map(str.ljust, row, widths), row[-1]]) for row in rows]


def _words(version: ModelVersion) -> str:
    """Return the model in words, with the strengths of its effects."""
    try:
        effects = version.effects
    except ConfigError:
        return ", ".join(str(effect.get("tag")) for effect in version.model["effects"])
    aside = [f"without {len(version.settings.set_aside_e)} intervals"] if version.settings.set_aside_e else []
    return " + ".join(["plain model", *map(_effect_words, effects), *aside])


def _effect_words(effect: Effect) -> str:
    if not effect.strength:
        return effect_words(effect)
    strength = parameters_of(effect, {})[effect.strength]
    tag, *place = effect_words(effect).partition(" in ")
    return f"{tag} {strength.value:.4g} {strength.unit}".rstrip() + "".join(place)


def use_model(target: Target, number: int) -> str:
    """Put a version of the model in force; return which results are stale.

    Raises:
        ConfigError: there is no such version, or the YAML is no configuration.
        LockedError: another process works on the run.
        StoreError: there is no run, or it or the file beside the YAML cannot be written.
    """
    store = target.stored(writable=True)
    with store.locked():
        before = _kept(store, target)
        version = version_with(store, number)
        changed, file = _put_in_force(store, target, version)
    if before.number == number:
        words = f"model {number} is already in use: {_words(version)}"
    else:
        words = _change_words(changed, before, version, file)
    return "\n".join([words, *_stale_lines(changed)])


def _change_words(target: Target, before: ModelVersion, version: ModelVersion, file: Path | None) -> str:
    """Say which version is in force now, the file that holds it, and how to go back to the one before."""
    place = quoted(_yaml_of(target) or target.store)
    held = "" if file is None else f" (in {file})"
    back = f"to go back: pchem model {place} --use {before.number}"
    return f"model {version.number} is now in use: {_words(version)}{held}; {back}"


def _stale_lines(target: Target) -> list[str]:
    """Say which results are stale, and what does them again."""
    stale = [state.stage for state in run_status(target) if state.state == "stale"]
    place = quoted(_yaml_of(target) or target.store)
    usual = [name for name in stale if not STAGES[name].on_demand]
    lines = [f"stale: {', '.join(usual)}; to update: pchem run {place}"] if usual else []
    lines += [f"stale: {name}; to update: pchem {name} {place}" for name in stale if name not in usual]
    return lines or ["nothing is stale"]


def _yaml_of(target: Target) -> Path | None:
    """Return the YAML of a run, if it exists and is of this run; a copied store names that of the first."""
    path = target.config_path
    if path is None or not path.exists():
        return None
    written = place_of(load_config(path).run.store, path.parent)
    return path if written.resolve() == place_of(target.store).resolve() else None


def _kept(store: RunStore, target: Target) -> ModelVersion:
    """Return the version in force; a new model section in the YAML becomes one, too."""
    path = _yaml_of(target)
    if path is not None:
        keep_in_force(store, model_in_force(store, load_config(path).model))
    return keep_in_force(store, model_in_force(store, target.config.model))


def _put_in_force(store: RunStore, target: Target, version: ModelVersion) -> tuple[Target, Path | None]:
    """Put a version in force, for the YAML first, which may be refused; return run and file of the model."""
    settings, path = version.settings, _yaml_of(target)
    file = None if path is None else write_model(path, settings)
    config = target.config.model_copy(update={"model": settings})
    store.write_config(dump_config(config))
    keep_in_force(store, version)
    return replace(target, config=config), file


def adopt_verdict(target: Target) -> tuple[Target, str]:
    """Make the model of a run's verdict a version, and put it in force, in the store and for the YAML.

    Return the run with that model, and what changed and how to go back; empty where nothing changes.

    Raises:
        ConfigError: the YAML is no configuration.
        LockedError: another process works on the run.
        StoreError: the store or the file beside the YAML cannot be written.
    """
    store = target.stored(writable=True)
    with store.locked():
        before = _kept(store, target)
        start, found = model_of(store, _SEARCH), read_verdict(store.path)
        if start is None or found is None:
            return target, ""
        aside = found.set_aside or start.model["set_aside_e"]
        settings = ModelSettings.model_validate({"effects": found.model_effects, "set_aside_e": aside})
        closed = found.closed_in_model if math.isfinite(found.closed_in_model) else None
        version = verdict_version(store, settings, start, group=_SEARCH, closed_fraction=closed)
        if version.digest == before.digest:
            return target, ""
        changed, file = _put_in_force(store, target, version)
        return changed, _change_words(changed, before, version, file)


def models_json(target: Target) -> str:
    """Return the versions of the model of a run as one line of JSON."""
    names = ("number", "model", "source", "parent", "closed_fraction", "made", "digest")
    listed = [
        {name: getattr(version, name) for name in names} | {"current": current, "results": results}
        for version, current, results in _listed(target)
    ]
    return json.dumps({"models": listed})
