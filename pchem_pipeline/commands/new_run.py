"""How a run begins: from a template, straight from camera files, or from the runs of several exposures."""

from __future__ import annotations

import contextlib
import glob
import os
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from textwrap import shorten
from typing import Any

from pchem_pipeline.base.errors import ConfigError, InputError, StoreError, quoted
from pchem_pipeline.commands.compare.settings import settings_that_differ
from pchem_pipeline.config.load import (
    dump_config,
    load_config,
    make_config,
    parse_config,
    write_config,
    yaml_content,
)
from pchem_pipeline.config.template import SCHEMA_NAME, commented_config, json_schema
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.frames.remote import is_remote
from pchem_pipeline.run.target import Target, find_run
from pchem_pipeline.runner.session import nothing_left_of_a_refusal
from pchem_pipeline.stages.table import STAGES
from pchem_pipeline.store.files import write_atomic
from pchem_pipeline.store.remote_path import RemotePath, place_of
from pchem_pipeline.store.run_store import RunStore, stored_config

_YAML = (".yaml", ".yml")
#: Number of differing settings that a message lists.
_SHOWN = 4
_WIDTH = 70  # characters of a setting that differs


def write_template(
    path: Path, files: Sequence[str], *, simulated: bool, force: bool, schema: bool = False
) -> list[Path]:
    """Write the commented YAML of a new run, and the schema of its keys if wanted; return what was written.

    ``files`` are relative to the working directory, those in the YAML to its own folder.

    Raises:
        ConfigError: the file exists, and ``force`` is not given.
    """
    if path.exists() and not force:
        raise ConfigError(f"{path} exists; choose another name, or replace it with --force")
    given = [
        name if is_remote(name) or Path(name).is_absolute() else os.path.relpath(name, path.parent)
        for name in files
    ] or ([] if simulated else ["frames/*.tif"])
    beside = path.with_name(SCHEMA_NAME) if schema else None
    text = commented_config(path.name, files=given, simulated=simulated, schema=schema)
    parse_config(text, str(path))
    write_config(path, text)
    if beside is None:
        return [path]
    write_atomic(beside, json_schema().encode())
    return [path, beside]


def find_or_start(
    targets: Sequence[Path],
    store: Path | None,
    given: Mapping[str, Any],
    roi: tuple[int, int, int, int] | None = None,
) -> tuple[Target, bool]:
    """Return the run that ``targets`` name, and whether they are camera files.

    One YAML file or one store is an existing run. Anything else is camera files, of a run with the settings
    in ``given`` and the region ``roi``, whose YAML is beside the store. One that is there and agrees with
    these is used as it is, whatever else it sets.

    Raises:
        ConfigError: options do not fit the target, or the YAML exists with other settings.
        InputError: camera files are missing.
    """
    first = place_of(targets[0])
    if len(targets) == 1 and (first.suffix.lower() in _YAML or (first / ".pchem").is_dir()):
        if store is not None or given:
            names = [*(["store"] if store is not None else []), *given]
            words = (name.replace("frame_range", "frames").replace("_", "-") for name in names)
            options = ", ".join(f"--{name}" for name in words)
            raise ConfigError(f"{options}: only with camera files; change the settings in {first}")
        return find_run(first), False
    missing = [path for path in targets if not path.exists() and not glob.has_magic(str(path))]
    if missing:
        raise InputError(
            f"{missing[0]} does not exist; give camera files, a folder of them, or a config.yaml"
        )
    place = place_of(store or Path("run.zarr")).resolve()
    path = settings_of(place)
    region = {} if roi is None else {"roi": roi}
    stated = {"files": _file_list(targets, path.parent), **region, **given}
    anew = path.exists() and _came_to_nothing(place, path)
    return stated_run(place, {"input": stated}, "the command line", _ways("run", path), anew=anew), True


def _ways(command: str, path: Path) -> str:
    return (
        f"continue with these: pchem {command} {quoted(path)}; or edit the file, or start another run with "
        "--store NAME.zarr"
    )


def stated_run(
    place: Path, sections: Mapping[str, Mapping[str, Any]], name: str, ways: str, *, anew: bool = False
) -> Target:
    """Return the run with a store and stated sections of its YAML, which messages call ``name``.

    A YAML that is there must agree with them, whatever else it sets, unless the run is made ``anew``.

    Raises:
        ConfigError: a setting is wrong, or the YAML differs; in one line how, and ``ways`` to resolve it.
    """
    path = settings_of(place)
    store = str(place) if isinstance(place, RemotePath) else place.name
    content = {**sections, "run": {**sections.get("run", {}), "store": store}}
    config = make_config(content, name)
    if anew or not path.exists():
        return Target(config, path.parent, place, path)
    there = load_config(path)
    both = _laid_over(yaml_content(dump_config(there), str(path)), content)
    differ = settings_that_differ(there, make_config(both, "the command line", path.parent))
    if differ:
        shown = [
            f"{each.name} {shorten(each.one, _WIDTH)} in the file, {shorten(each.other, _WIDTH)} here"
            for each in differ[:_SHOWN]
        ]
        more = [f"{len(differ) - _SHOWN} more"] if len(differ) > _SHOWN else []
        raise ConfigError(f"{path} exists with other settings ({'; '.join([*shown, *more])}); {ways}")
    return Target(there, path.parent, place, path)


def settings_of(store: Path) -> Path:
    """Return the YAML file of a run whose store is given: beside it; of a remote one, in this folder.

    Raises:
        ConfigError: the store has the name of a YAML file.
    """
    if store.suffix.lower() in _YAML:
        raise ConfigError(f"--store {store.name}: this is the name of a YAML file; give NAME.zarr")
    name = store.name.removesuffix(".zarr") + ".yaml"
    return Path(name).resolve() if isinstance(store, RemotePath) else store.with_name(name)


def _laid_over(there: Any, stated: Any) -> Any:
    """Return settings with those that are stated in their place, key by key; lists of sections one by one."""
    if isinstance(there, Mapping) and isinstance(stated, Mapping):
        return {**there, **{key: _laid_over(there.get(key), value) for key, value in stated.items()}}
    sections = isinstance(there, list) and isinstance(stated, list) and len(there) == len(stated)
    if sections and all(isinstance(each, Mapping) for each in (*there, *stated)):
        return [_laid_over(one, other) for one, other in zip(there, stated, strict=True)]
    return stated


@contextlib.contextmanager
def first_try(target: Target) -> Iterator[None]:
    """Write the YAML of a run; where the run is refused before any work, take away what was not there before.

    A refusal whose cure is a setting then says where settings are, now that the YAML is gone.
    """
    path = target.config_path
    had_yaml = path is None or path.exists()
    had_run = isinstance(target.store, RemotePath) or (target.store / ".pchem").is_dir()
    if path is not None and not (path.exists() and load_config(path) == target.config):
        write_config(path, dump_config(target.config))
    try:
        with nothing_left_of_a_refusal(target.store):
            yield
    except (ConfigError, InputError, StoreError) as error:
        if had_run or had_yaml or path is None or (target.store / ".pchem").is_dir():
            raise
        path.unlink(missing_ok=True)
        named = re.search(rf"\b(?:{'|'.join(RunConfig.model_fields)})\.[a-z_]+", str(error))
        if named is None or "(--" in str(error) or target.config.input.samples:
            raise
        name = shlex.quote(path.name)
        raise type(error)(
            f"{error}; for settings without an option: pchem init {name} FILES, edit it, then pchem run "
            f"{name}"
        ) from error


def _came_to_nothing(place: Path, path: Path) -> bool:
    """Return whether a run was tried, finished no stage, and nobody edited its YAML since."""
    if not (place / ".pchem").is_dir():
        return False
    store = RunStore.open(place)
    records = [store.records.known(name) for name in STAGES]
    untouched = stored_config(place) == path.read_text(encoding="utf-8")
    return untouched and not any(record is not None and record.finished for record in records)


def _file_list(targets: Sequence[Path], base_dir: Path) -> list[str]:
    """Return the files relative to ``base_dir``; a whole folder that the shell spelled out as one glob."""
    files = [Path(os.path.relpath(path, base_dir)) for path in targets]
    folders, suffixes = {path.parent for path in files}, {path.suffix for path in files}
    if len(files) > 8 and len(folders) == 1 and len(suffixes) == 1:
        pattern = f"*{suffixes.pop()}"
        if len(list(targets[0].parent.glob(pattern))) == len(files):
            return [str(Path(glob.escape(str(folders.pop()))) / pattern)]
    return [str(path) for path in files]


# -- a run of several exposures --------------------------------------------------------------------


def find_joint(
    targets: Sequence[Path],
    bias: Sequence[Path] = (),
    store: Path | None = None,
    against: str | None = None,
    levels: Sequence[str] = (),
) -> tuple[Target, bool]:
    """Return the run of several samples that ``targets`` name, and whether they are those samples.

    One YAML file or store whose input is samples is an existing run. Several runs (YAML files or stores) are
    the samples of one whose YAML is beside the store.

    Raises:
        ConfigError: options do not fit the target, or the YAML exists with other settings.
    """
    if len(targets) == 1 and not bias:
        found = find_run(targets[0])
        if not found.config.input.samples:
            raise ConfigError(
                f"{targets[0]} is a single run; a joint fit needs several: give all runs, or a YAML with "
                "input.samples"
            )
        for name, option, value in (
            ("store", "run.store", store),
            ("against", "input.against", against),
            ("level", "input.samples", levels or None),
        ):
            if value is not None:
                raise ConfigError(f"--{name}: only with runs; {targets[0]} sets {option}, change it there")
        return found, False
    place = place_of(store or Path("joint.zarr")).resolve()
    path = settings_of(place)
    samples: list[dict[str, Any]] = [{"run": os.path.relpath(each, path.parent)} for each in targets]
    samples += [{"run": os.path.relpath(each, path.parent), "bias": True} for each in bias]
    if levels:
        against = against or "light_level"
        for sample, level in zip(samples, _light_levels(levels, len(targets), against), strict=False):
            sample["light_level"] = level
    given: dict[str, Any] = {"samples": samples}
    if against is not None or len(targets) == 1:
        given["against"] = against or "none"  # a line needs two exposures
    for each in (*targets, *bias):
        find_run(each)
    return stated_run(place, {"input": given}, "the command line", _ways("joint", path)), True


def _light_levels(levels: Sequence[str], n: int, against: str) -> list[float]:
    """Return the light levels of n runs; raise ConfigError unless they are as many numbers, and wanted."""
    if against != "light_level":
        raise ConfigError(f"--level: only with --against light_level, not {against}; omit one of them")
    if len(levels) != n:
        raise ConfigError(f"--level: {len(levels)} levels for {n} runs; give one for each, such as 0,1,2.4")
    try:
        return [float(level) for level in levels]
    except ValueError:
        raise ConfigError(f"--level: {','.join(levels)} are no numbers; give such as 0,1,2.4") from None
