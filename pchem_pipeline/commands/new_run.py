"""How a run begins: from a template, or straight from camera files."""

from __future__ import annotations

import contextlib
import glob
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pchem_pipeline.base.errors import ConfigError, InputError, StoreError, quoted
from pchem_pipeline.commands.compare.settings import settings_that_differ
from pchem_pipeline.config.load import dump_config, load_config, make_config, parse_config
from pchem_pipeline.config.template import SCHEMA_NAME, commented_config, json_schema
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.run.target import Target, find_run
from pchem_pipeline.stages.table import STAGES
from pchem_pipeline.store.files import write_atomic
from pchem_pipeline.store.remote_path import RemotePath, place_of
from pchem_pipeline.store.run_store import RunStore

_YAML = (".yaml", ".yml")
#: Settings that differ, as many as a message tells.
_SHOWN = 4


def write_template(
    path: Path, files: Sequence[str], *, simulated: bool, force: bool, schema: bool = False
) -> list[Path]:
    """Write the commented YAML of a new run, and the schema of its keys if wanted; return what was written.

    Raises:
        ConfigError: the file exists, and ``force`` is not given.
    """
    if path.exists() and not force:
        raise ConfigError(f"{path} exists; choose another name, or replace it with --force")
    given = list(files) or ([] if simulated else ["frames/*.tif"])
    beside = path.with_name(SCHEMA_NAME) if schema else None
    text = commented_config(path.name, files=given, simulated=simulated, schema=schema)
    parse_config(text, str(path))
    write_atomic(path, text.encode())
    if beside is None:
        return [path]
    write_atomic(beside, json_schema().encode())
    return [path, beside]


def find_or_start(
    targets: Sequence[Path],
    store: Path | None,
    given: Mapping[str, Any],
    roi: tuple[int, int, int, int] | None = None,
    *,
    write: bool = True,
) -> tuple[Target, bool]:
    """Return the run that ``targets`` name, and whether it was made from camera files.

    One YAML file or one store is an existing run. Anything else is camera files: a YAML with the
    settings in ``given`` and the region ``roi`` is written beside the store (unless
    ``write`` is off), and used.

    Raises:
        ConfigError: options do not fit the target, or the YAML exists with other settings.
    """
    first = place_of(targets[0])
    if len(targets) == 1 and (first.suffix.lower() in _YAML or (first / ".pchem").is_dir()):
        if store is not None or given:
            names = [*(["store"] if store is not None else []), *given]
            options = ", ".join("--" + name.replace("_", "-") for name in names)
            raise ConfigError(
                f"{options}: only for camera files; {first} has its own settings, change them there"
            )
        return find_run(first), False
    missing = [path for path in targets if not path.exists() and not set("*?[") & set(str(path))]
    if missing:
        raise ConfigError(
            f"{missing[0]} does not exist; give camera files, a folder of them, or a config.yaml"
        )
    place = place_of(store or Path("run.zarr")).resolve()
    remote, path = isinstance(place, RemotePath), settings_of(place)
    config = make_config(
        {
            "run": {"store": str(place) if remote else place.name},
            "input": {"files": _file_list(targets, path.parent), "roi": roi, **given},
        },
        "the command line",
    )
    text = dump_config(config)
    if path.exists() and path.read_text(encoding="utf-8") != text and not _came_to_nothing(place, path):
        raise ConfigError(other_settings(path, config, "run"))
    if write:
        write_atomic(path, text.encode())
    return Target(config, path.parent, place, path), True


def settings_of(store: Path) -> Path:
    """Return the YAML file of a run whose store is given: beside it; of a remote one, in this folder.

    Raises:
        ConfigError: the store has the name of a YAML file.
    """
    if store.suffix.lower() in _YAML:
        raise ConfigError(f"--store {store.name}: that is the name of a YAML file; give NAME.zarr")
    name = store.name.removesuffix(".zarr") + ".yaml"
    return Path(name).resolve() if isinstance(store, RemotePath) else store.with_name(name)


def other_settings(path: Path, config: RunConfig, command: str) -> str:
    """Return in one line how the settings of a YAML file differ from those given, and the ways out.

    Args:
        path: the YAML file.
        config: what was given.
        command: the command that takes the YAML.

    Raises:
        ConfigError: the YAML is wrong.
    """
    differ = settings_that_differ(load_config(path), config)
    shown = [f"{each.name} {each.one} there, {each.other} here" for each in differ[:_SHOWN]]
    more = [f"{len(differ) - _SHOWN} more"] if len(differ) > _SHOWN else []
    keys = "; ".join([*shown, *more]) or "the same settings, written otherwise"
    return (
        f"{path} exists with other settings ({keys}); go on with those there: pchem {command} "
        f"{quoted(path)}; or edit them there, or begin another run with --store NAME.zarr"
    )


@contextlib.contextmanager
def first_try(target: Target, text: str | None) -> Iterator[None]:
    """Write the YAML of a run; where the run is refused before any work, take away what was not there before.

    Args:
        target: the run.
        text: of its YAML; None: it has one.
    """
    local = not isinstance(target.store, RemotePath)
    had_store, path = not local or target.store.exists(), target.config_path
    had_yaml = text is None or path is None or path.exists()
    if text is not None and path is not None:
        write_atomic(path, text.encode())
    try:
        yield
    except (ConfigError, InputError, StoreError):
        if not had_store and _is_empty(target.store):
            shutil.rmtree(target.store, ignore_errors=True)
            if not had_yaml and path is not None:
                path.unlink(missing_ok=True)
        raise


def _is_empty(place: Path) -> bool:
    """Tell whether no stage has done anything in a store, which may not exist."""
    if not (place / ".pchem").is_dir():
        return not place.exists()
    records = RunStore.open(place).records
    return all(records.read(name) is None for name in STAGES)


def _came_to_nothing(place: Path, path: Path) -> bool:
    """Tell whether a run was tried, finished no stage, and nobody edited its YAML since."""
    if not (place / ".pchem").is_dir():
        return False
    store = RunStore.open(place)
    records = [store.records.read(name) for name in STAGES]
    untouched = store.config_text() == path.read_text(encoding="utf-8")
    return untouched and not any(record is not None and record.finished for record in records)


def _file_list(targets: Sequence[Path], base_dir: Path) -> list[str]:
    """Return the files relative to ``base_dir``; a whole folder that the shell spelled out as one glob."""
    files = [Path(os.path.relpath(path, base_dir)) for path in targets]
    folders, suffixes = {path.parent for path in files}, {path.suffix for path in files}
    if len(files) > 8 and len(folders) == 1 and len(suffixes) == 1:
        pattern = f"*{suffixes.pop()}"
        folder = folders.pop()
        if len(list((base_dir / folder).glob(pattern))) == len(files):
            return [str(Path(glob.escape(str(folder))) / pattern)]
    return [str(path) for path in files]
