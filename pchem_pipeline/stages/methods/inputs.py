"""What a comparison of methods is given and leaves: settings, other runs of the same pixels, its result."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic_core import to_jsonable_python

from pchem_pipeline.base.errors import ConfigError, InputError, StoreError, quoted
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.store.files import read_json
from pchem_pipeline.store.run_store import RunStore

if TYPE_CHECKING:
    from pchem_pipeline.methods.settings import MethodsSettings
    from pchem_pipeline.run.stage import StageContext

#: File of the result in the folder of a run.
METHODS_FILE = "methods.json"


def read_methods(store: RunStore) -> dict[str, Any] | None:
    """Return the content of ``methods.json`` of a run, or None where there is none.

    Raises:
        StoreError: it cannot be read.
    """
    result = read_json(store.path / METHODS_FILE)
    if result is not None and not (isinstance(result, dict) and "study" in result):
        raise StoreError(f"{store.path / METHODS_FILE} is damaged; run pchem methods with --force")
    return result


def chosen_settings(context: StageContext) -> dict[str, Any]:
    """Return what the command line chooses, as JSON data; unasked, what it chose for the last result.

    The result of a command with ``--pixels`` is thereby up to date until another one is asked for, whatever
    the YAML says.
    """
    if context.options.settings is not None:
        chosen: dict[str, Any] = to_jsonable_python(dict(context.options.settings))
        return chosen
    record = context.store.records.known("methods")
    kept = {} if record is None else record.content.get("input") or {}
    return dict(kept.get("chosen", {}))


def methods_settings(context: StageContext) -> MethodsSettings:
    """Return the settings of the comparison."""
    section = context.config.methods
    return type(section).model_validate({**section.model_dump(), **chosen_settings(context)})


def other_samples(context: StageContext) -> dict[str, Any]:
    """Return which histograms of other runs join a comparison, for its fingerprint; never raises."""
    found: dict[str, Any] = {}
    for name in methods_settings(context).with_runs:
        path = context.base_dir / name
        try:
            record = RunStore.open(path).records.read("histogram")
        except StoreError:
            record = None
        found[name] = None if record is None else record.fingerprint
    return found


def open_other_runs(store: RunStore, base_dir: Path, names: tuple[str, ...]) -> list[RunStore]:
    """Return the stores of other runs.

    Args:
        store: the run that they are compared with.
        base_dir: folder to which relative names refer.
        names: as in ``methods.with_runs``.

    Raises:
        ConfigError: a run is listed twice, or is the run itself.
        InputError: a run is of other pixels or another ADC, or holds the same frames as another.
        StoreError: a run is missing or has no histograms.
    """
    here = SensorInfo.read(store)
    seen: dict[str, str] = {here.identity.get("digest", ""): store.path.name}
    paths = {store.path.resolve()}
    found = []
    for name in names:
        path = base_dir / name
        if path.resolve() in paths:
            what = "is the run itself" if path.resolve() == store.path.resolve() else "is listed twice"
            raise ConfigError(f"methods.with_runs: {name} {what}; give each sample once")
        paths.add(path.resolve())
        other = RunStore.open(path)
        if not other.has("histogram/counts"):
            raise StoreError(f"{path} has no histograms yet; run: pchem histogram {quoted(path)}")
        there = SensorInfo.read(other)
        _same_pixels(here, there, name)
        digest = there.identity.get("digest", "")
        if digest and digest in seen:
            raise InputError(
                f"{name} has the same frames as {seen[digest]}; give a sample at another exposure"
            )
        seen[digest] = name
        found.append(other)
    return found


def _same_pixels(here: SensorInfo, there: SensorInfo, name: str) -> None:
    """Refuse samples of other sensors."""
    if here.shape != there.shape:
        raise InputError(
            f"{name} has {there.ny} x {there.nx} pixels, this run {here.ny} x {here.nx}; samples must have "
            "the same pixels (see input.roi)"
        )
    if None not in (here.bit_depth, there.bit_depth) and here.bit_depth != there.bit_depth:
        raise InputError(
            f"{name} has {there.bit_depth} bits, this run {here.bit_depth}; samples must be from the same "
            "sensor"
        )
