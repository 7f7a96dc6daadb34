"""``pchem joint``: bring the runs of several exposures up to their histograms, fit them together, report."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pchem_pipeline.base.errors import ConfigError, quoted
from pchem_pipeline.config.joint import JointConfig, as_run, dump_joint, load_joint, make_joint
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.run.session import Command, run_stages
from pchem_pipeline.run.target import Target, find_run
from pchem_pipeline.stages.joint.samples import check_runs, describe_samples, write_samples
from pchem_pipeline.store.files import read_json, write_atomic
from pchem_pipeline.store.remote_path import RemotePath, place_of
from pchem_pipeline.store.run_store import RunStore

__all__ = ["JointRun", "find_joint", "run_joint"]

_YAML = (".yaml", ".yml")


@dataclass(frozen=True)
class JointRun:
    """A joint fit: its settings, the YAML file that they come from, and whether that was written just now."""

    config: JointConfig
    path: Path
    is_new: bool = False

    @property
    def folder(self) -> Path:
        """Folder that its paths refer to."""
        return self.path.parent

    @property
    def store(self) -> Path:
        """Where its results are."""
        return self.folder / self.config.joint.store


def find_joint(
    targets: Sequence[Path], bias: Sequence[Path] = (), store: Path | None = None, *, write: bool = True
) -> JointRun:
    """Return the joint fit that ``targets`` name.

    One YAML file with samples, or the store of a joint fit, is an existing one. Several runs (YAML files or
    stores) make a new one: its YAML is written beside the store, unless ``write`` is off.

    Raises:
        ConfigError: options do not fit the target, or the YAML exists with other settings.
    """
    if len(targets) == 1 and not bias:
        path = _existing(targets[0])
        if path is not None:
            if store is not None:
                raise ConfigError(f"--store: only for runs; {path} has its own joint.store, change it there")
            return JointRun(load_joint(path), path.resolve())
        raise ConfigError(
            f"{targets[0]} is a single run, and a joint fit needs several; give them all, "
            "or a YAML with samples"
        )
    place = place_of(store or Path("joint.zarr")).resolve()
    path = place.with_suffix(".yaml")
    kinds = [*((each, "exposed") for each in targets), *((each, "bias") for each in bias)]
    samples = [{"run": os.path.relpath(each, path.parent), "kind": kind} for each, kind in kinds]
    name = str(place) if isinstance(place, RemotePath) else place.name
    config = make_joint({"samples": samples, "joint": {"store": name}}, "the command line")
    for each, _ in kinds:
        find_run(each)
    text, is_new = dump_joint(config), write and not path.exists()
    if path.exists() and path.read_text(encoding="utf-8") != text:
        raise ConfigError(
            f"{path} exists with other settings; use them with: pchem joint {quoted(path)}, "
            "or choose another --store"
        )
    if write:
        write_atomic(path, text.encode())
    return JointRun(config, path, is_new)


def _existing(target: Path) -> Path | None:
    """Return the YAML of a joint fit: the target itself, or what made the store that it is."""
    if target.suffix.lower() in _YAML:
        if not target.exists() or "samples:" in target.read_text(encoding="utf-8", errors="replace"):
            return target
        return None
    if target.is_dir() and "samples" in RunStore.open(target).attributes("samples"):
        written = (read_json(target / ".pchem" / "location.json") or {}).get("config")
        if written is not None and Path(written).exists():
            return Path(written)
        raise ConfigError(f"{target}: the YAML that made it ({written}) is gone; give it, or the runs again")
    return None


def run_joint(joint: JointRun, command: Command) -> None:
    """Histogram every run that needs it, fit all together, write maps and report.

    A new YAML whose samples do not belong together is taken away again, so that its name is free.

    Raises:
        ConfigError: the samples do not belong together.
        IncompleteRunError: tiles failed, or more pixels failed than the configuration allows.
        PchEmError: a stage cannot be done; the message says why.
    """
    try:
        target = _histogrammed(joint, command)
    except ConfigError:
        if joint.is_new and not joint.store.exists():
            joint.path.unlink(missing_ok=True)
        raise
    run_stages(target, ["joint", "joint_report"], command)


def _histogrammed(joint: JointRun, command: Command) -> Target:
    """Bring every sample up to its histograms and note them in the store of the joint fit."""
    config = joint.config
    targets = [find_run(joint.folder / sample.run) for sample in config.samples]
    check_runs(config, targets)
    own = replace(command, options=replace(command.options, force=False, tiles=None, roi=None))
    reporter = Reporter("off", quiet=command.quiet)
    for target in targets:
        reporter.info(f"sample {target.store.name}")
        first = ("simulate",) if target.config.simulate is not None else ()
        run_stages(target, [*first, "ingest", "histogram"], own)
    target = Target(as_run(config), joint.folder, joint.store, joint.path)
    if not command.options.dry_run:
        samples, sensor = describe_samples(config, targets)
        store = RunStore.create(joint.store)
        with store.locked():
            write_samples(store, samples, sensor, config.joint.against)
    return target
