"""One command from start to end: find the run, lock it, bring its stages up to date, say how it ended."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from pchem_pipeline.base.errors import ConfigError, IncompleteRunError, StoreError
from pchem_pipeline.compute.executor import Notices, SerialExecutor, make_executor
from pchem_pipeline.config.load import dump_config, load_config, make_config, parse_config
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.run.progress import ProgressMode, Reporter
from pchem_pipeline.run.runner import (
    JOINT_STAGES,
    OPTIONAL_STAGES,
    StageState,
    declaration_of,
    execute,
    pipeline_of,
    status,
)
from pchem_pipeline.run.signals import StopRequest, stop_on_signals
from pchem_pipeline.run.stage import Options, StageContext
from pchem_pipeline.store.files import read_json, write_json
from pchem_pipeline.store.progress_file import Beacon
from pchem_pipeline.store.remote_path import place_of
from pchem_pipeline.store.run_store import RunStore

__all__ = ["Command", "Target", "cropped", "find_run", "run_stages", "run_status", "up_to", "working_run"]


@dataclass(frozen=True)
class Target:
    """A run: its configuration, the folder its paths refer to, its store, and its YAML file if it has one."""

    config: RunConfig
    base_dir: Path
    store: Path
    config_path: Path | None = None

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages of this run, in order."""
        return pipeline_of(self.config)

    def changed(self, section: str, **values: object) -> Target:
        """Return the same run with other values in a section of its configuration."""
        content = self.config.model_dump(by_alias=True)
        content[section] = {**content[section], **values}
        return replace(self, config=make_config(content, "the command line"))


@dataclass(frozen=True)
class Command:
    """What the command line asked for, beside the configuration.

    Attributes:
        options: force, dry run, tiles, region.
        workers: overrides ``compute.workers``.
        backend: overrides ``compute.backend``.
        progress: auto | on | off.
        quiet: say warnings only.
        log_json: file for JSON lines.
        max_memory: overrides ``compute.max_memory``, MiB.
    """

    options: Options = field(default_factory=Options)
    workers: int | None = None
    backend: str | None = None
    progress: ProgressMode = "auto"
    quiet: bool = False
    log_json: Path | None = None
    max_memory: int | None = None


def find_run(path: Path) -> Target:
    """Return the run that a YAML file or a store belongs to.

    Raises:
        ConfigError: neither a YAML file nor a store, or its content is wrong.
        StoreError: the store is damaged.
    """
    path = place_of(path)
    if path.is_dir():
        store = RunStore.open(path)
        text = store.config_text()
        if text is None:
            raise StoreError(f"{path} holds no configuration; give the YAML file that made it")
        location = read_json(path / ".pchem" / "location.json") or {}
        written = location.get("config")
        return Target(
            parse_config(text, str(path)),
            Path(location.get("base_dir", path.parent)),
            path,
            None if written is None else Path(written),
        )
    if path.suffix.lower() not in (".yaml", ".yml"):
        what = "is neither a YAML file nor a run" if path.exists() else "does not exist"
        raise ConfigError(f"{path} {what}; give a config.yaml or the store of a run")
    config = load_config(path)
    base_dir = path.resolve().parent
    return Target(config, base_dir, place_of(config.run.store, base_dir), path.resolve())


def with_overrides(target: Target, command: Command) -> Target:
    """Return the target with the command line's compute settings."""
    given = {"workers": command.workers, "backend": command.backend, "max_memory": command.max_memory}
    changes = {key: value for key, value in given.items() if value is not None}
    return target.changed("compute", **changes) if changes else target


def cropped(target: Target, command: Command) -> tuple[Target, Command]:
    """Turn the region of the command line into a crop of the input, where there is one."""
    roi = command.options.roi
    if roi is None:
        return target, command
    return target.changed("input", roi=roi), replace(command, options=replace(command.options, roi=None))


def up_to(last: str, stages: Sequence[str]) -> Sequence[str]:
    """Return the stages up to and with ``last``.

    Raises:
        ConfigError: the run has no such stage.
    """
    if last not in stages:
        raise ConfigError(f"--until {last}: this run does {', '.join(stages)}")
    return stages[: stages.index(last) + 1]


def run_stages(target: Target, stages: Sequence[str], command: Command) -> list[StageState]:
    """Bring ``stages`` up to date, in order, and return their states.

    Failed tiles stop nothing: the stages after them work on the others, and the error comes at the end.

    Raises:
        IncompleteRunError: tiles failed, or more pixels failed than the configuration allows.
        PchEmError: a stage cannot be done; the message says why.
    """
    if command.options.dry_run:
        return _dry_run(target, stages, command)
    with working_run(target, command) as context:
        states = [_execute(name, context, stages) for name in stages]
        context.reporter.event("end", states={state.stage: state.words() for state in states})
        failed = [f"{state.stage}: {state.why}" for state in states if state.state == "failed"]
        if failed:
            raise IncompleteRunError("; ".join(failed) + "; the rest is kept, run again to retry")
        for name in ("fit", "joint"):
            if name in stages:
                _check_failed_pixels(context, f"{name}/fit_status")
    return states


def _execute(name: str, context: StageContext, stages: Sequence[str]) -> StageState:
    """Bring a stage up to date; where the input and the histograms are wanted, by one pass over the files."""
    if name == "ingest" and "histogram" in stages:
        from pchem_pipeline.stages.histogram.single_pass import sweep_input

        sweep_input(context)
    return execute(name, context)


@contextlib.contextmanager
def working_run(target: Target, command: Command) -> Iterator[StageContext]:
    """Open and lock the run, and yield what its stages need.

    Raises:
        LockedError: another process works on the run.
        PchEmError: the store or the workers cannot be had.
    """
    target = with_overrides(target, command)
    store = RunStore.create(target.store)
    beacon = Beacon(store.path)
    reporter = Reporter(command.progress, quiet=command.quiet, log=command.log_json, beacon=beacon)
    with contextlib.ExitStack() as stack:
        stack.callback(reporter.close)
        stack.enter_context(store.locked())
        beacon.show({"stage": ""})
        stop = stack.enter_context(stop_on_signals())
        store.write_config(dump_config(target.config))
        write_json(store.path / ".pchem" / "location.json", _location(target))
        executor = make_executor(target.config.compute, Notices(reporter.warning, stop.check))
        stack.callback(executor.close)
        yield StageContext(
            target.config,
            target.base_dir,
            store,
            executor,
            reporter,
            stop,
            options=command.options,
            config_path=target.config_path,
        )


def _location(target: Target) -> dict[str, str]:
    """Return where the run's paths refer to, and its YAML file."""
    place = {"base_dir": os.fspath(target.base_dir)}
    return place if target.config_path is None else {**place, "config": os.fspath(target.config_path)}


def run_status(target: Target) -> list[StageState]:
    """Return the state of every stage, and of ``electrons`` where it was run, without changing anything."""
    stages = pipeline_of(target.config)
    if not (target.store / "zarr.json").exists():
        return [StageState(name, "missing") for name in stages]
    context = _reading_context(target, Reporter("off", quiet=True), Options())
    if context.store.records.read(JOINT_STAGES[0]) is not None:
        stages = JOINT_STAGES
    stages += tuple(name for name in OPTIONAL_STAGES if context.store.records.read(name) is not None)
    states: list[StageState] = []
    stale: set[str] = set()
    for name in stages:
        stage = declaration_of(name)
        state = status(stage, context)
        # what a simulation writes, ingest reads
        above = [upstream for upstream in stage.UPSTREAM or ("simulate",) if upstream in stale]
        if above and state.state in ("complete", "partial"):
            state = StageState(name, "stale", f"{above[0]} is stale", state.done, state.total)
        if state.state == "stale":
            stale.add(name)
        states.append(state)
    return states


def _dry_run(target: Target, stages: Sequence[str], command: Command) -> list[StageState]:
    """Say what would be done, without writing anything."""
    states = {state.stage: state for state in run_status(target)}
    reporter = Reporter("off", quiet=command.quiet)
    for name in stages:
        state = states.get(name, StageState(name, "missing"))
        runs = _is_to_do(states, name, command)
        reporter.info(f"{name}: {state.words()}" + (" -> would run" if runs else " -> nothing to do"))
    for line in _plan(target, [name for name in stages if _is_to_do(states, name, command)], command):
        reporter.info(line)
    return [states.get(name, StageState(name, "missing")) for name in stages]


def _is_to_do(states: Mapping[str, StageState], name: str, command: Command) -> bool:
    return name not in states or states[name].state != "complete" or command.options.force


def _plan(target: Target, todo: Sequence[str], command: Command) -> list[str]:
    """Say what it takes to go through the camera files, where that is to be done and they are there."""
    from pchem_pipeline.frames.histogram_files import is_histogram_input

    target = with_overrides(target, command)
    config = target.config
    if "histogram" not in todo or "simulate" in todo or is_histogram_input(config.input, target.base_dir):
        return []
    from pchem_pipeline.stages.histogram.dry_run import make_plan

    return make_plan(config, target.base_dir).words()


def _reading_context(target: Target, reporter: Reporter, options: Options) -> StageContext:
    store = RunStore.open(target.store)
    return StageContext(
        target.config, target.base_dir, store, SerialExecutor(), reporter, StopRequest(), options=options
    )


def _check_failed_pixels(context: StageContext, name: str) -> None:
    """Complain if more pixels have no value than the configuration allows."""
    from pchem_pipeline.model.fit.status import FAILED

    words = context.store.read(name)
    failed = int(((words & int(FAILED)) != 0).sum())
    allowed = context.config.run.allowed_failed_pixels
    if failed > allowed * words.size:
        raise IncompleteRunError(
            f"{failed} of {words.size} pixels have no value, above run.allowed_failed_pixels ({allowed:g}); "
            "the report lists the reasons"
        )
