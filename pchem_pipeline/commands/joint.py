"""``pchem joint``: write the run whose samples are the runs of several exposures, and do it."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from pchem_pipeline.base.errors import ConfigError, InputError, StoreError
from pchem_pipeline.commands.first_screen import run_to_first_screen
from pchem_pipeline.commands.new_run import settings_of, settings_there, ways_out
from pchem_pipeline.config.load import dump_config, make_config, write_config
from pchem_pipeline.run.target import Target, find_run
from pchem_pipeline.runner.session import Command
from pchem_pipeline.stages.table import pipeline_of
from pchem_pipeline.store.remote_path import RemotePath, place_of


def find_joint(
    targets: Sequence[Path],
    bias: Sequence[Path] = (),
    store: Path | None = None,
    against: str | None = None,
    *,
    write: bool = True,
) -> tuple[Target, bool]:
    """Return the run of several samples that ``targets`` name, and whether its YAML was written just now.

    One YAML file or store whose input is samples is an existing one. Several runs (YAML files or stores) make
    a new one: its YAML is written beside the store, unless ``write`` is off.

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
        for option, value in (("run.store", store), ("input.against", against)):
            if value is not None:
                name = option.partition(".")[2]
                raise ConfigError(f"--{name}: only with runs; {targets[0]} sets {option}, change it there")
        return found, False
    place = place_of(store or Path("joint.zarr")).resolve()
    remote, path = isinstance(place, RemotePath), settings_of(place)
    runs = [*targets, *bias]
    samples: list[dict[str, Any]] = [{"run": os.path.relpath(each, path.parent)} for each in runs]
    for sample in samples[len(targets) :]:
        sample["bias"] = True
    given: dict[str, Any] = {"samples": samples}
    if against is not None or len(targets) == 1:
        given["against"] = against or "none"  # a line needs two exposures
    content = {"run": {"store": str(place) if remote else place.name}, "input": given}
    config = make_config(content, "the command line")
    for each in runs:
        find_run(each)
    is_new = write and not path.exists()
    if path.exists():
        config = settings_there(path, content, ways_out("joint", path))
    if is_new:
        write_config(path, dump_config(config))
    return Target(config, path.parent, place, path), is_new


def run_joint(
    target: Target,
    command: Command,
    say: Callable[[str], None],
    *,
    is_new: bool = False,
    strict: bool = False,
) -> None:
    """Do every stage of a run of several samples, and what their own runs need for it.

    The new YAML of a run that is refused is taken away again, so that its name is free.

    Raises:
        ConfigError: the samples do not belong together.
        IncompleteRunError: tiles failed, or more pixels failed than the configuration allows.
        PchEmError: a stage cannot be done; the message says why.
    """
    try:
        run_to_first_screen(target, pipeline_of(target.config), command, say, strict=strict)
    except (ConfigError, InputError, StoreError):
        if is_new and target.config_path is not None and not (target.store / ".pchem").is_dir():
            target.config_path.unlink(missing_ok=True)
        raise
