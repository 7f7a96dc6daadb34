"""One command from start to end: find the run, lock it, bring its stages up to date, say how it ended."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from pkgutil import resolve_name

from pchem_pipeline.base.errors import ConfigError, IncompleteRunError, InputError, StoreError
from pchem_pipeline.compute.executor import make_executor
from pchem_pipeline.compute.memory import keep_to_limit
from pchem_pipeline.config.load import dump_config, effects_file, found_model
from pchem_pipeline.run.fingerprint import StageState, status
from pchem_pipeline.run.model_versions import keep_in_force, model_in_force
from pchem_pipeline.run.progress import ProgressFile, Reporter
from pchem_pipeline.run.signals import stop_on_signals
from pchem_pipeline.run.stage import Command, StageContext
from pchem_pipeline.run.target import Target
from pchem_pipeline.runner.execute import execute
from pchem_pipeline.stages.samples import check_samples, sample_targets
from pchem_pipeline.stages.table import STAGES, pipeline_of
from pchem_pipeline.store.files import write_record
from pchem_pipeline.store.remote_path import RemotePath
from pchem_pipeline.store.run_store import RunStore


def with_overrides(target: Target, command: Command) -> Target:
    """Return the target with the command line's compute settings."""
    given = {"workers": command.workers, "backend": command.backend, "max_memory": command.max_memory}
    changes = {key: value for key, value in given.items() if value is not None}
    return target.changed("compute", **changes) if changes else target


def cropped(target: Target, command: Command) -> tuple[Target, Command]:
    """Turn the region of the command line into a crop of the input, where there is one."""
    if command.roi is None:
        return target, command
    return target.changed("input", roi=command.roi), replace(command, roi=None)


def up_to(last: str, stages: Sequence[str]) -> Sequence[str]:
    """Return the stages up to and with ``last``.

    Raises:
        ConfigError: the run has no such stage.
    """
    if last not in stages:
        raise ConfigError(f"--until {last}: the stages of this run are {', '.join(stages)}")
    return stages[: stages.index(last) + 1]


def run_stages(target: Target, stages: Sequence[str], command: Command) -> list[StageState]:
    """Bring ``stages`` up to date, in order, and return their states.

    Failed tiles stop nothing: the stages after them work on the others, and the error comes at the end.

    Raises:
        IncompleteRunError: tiles failed, or more pixels failed than the configuration allows.
        PchEmError: a stage cannot be done; the message says why.
    """
    _bring_samples(target, stages, command)
    if command.dry_run:
        return _dry_run(target, stages, command)
    with working_run(target, command) as context:
        states: list[StageState] = []
        try:
            states.extend(_execute(name, context, stages) for name in stages)
        except (InputError, StoreError):  # one that lacks what a failed one should have written says so, too
            if all(state.state != "failed" for state in states):
                raise
        context.reporter.event("end", states={state.stage: state.words() for state in states})
        failed = [f"{state.stage}: {state.why}" for state in states if state.state == "failed"]
        if failed:
            raise IncompleteRunError("; ".join(failed) + "; finished units are kept, run again to retry")
        for words in filter(None, (STAGES[name].status_words for name in stages)):
            _check_failed_pixels(context, words)
    return states


@contextlib.contextmanager
def nothing_left_of_a_refusal(place: Path) -> Iterator[None]:
    """Remove a store that was not there before, where a run is refused and no stage has done anything."""
    existed = isinstance(place, RemotePath) or place.exists()
    try:
        yield
    except (ConfigError, InputError, StoreError):
        if not existed and _is_empty(place):
            shutil.rmtree(place, ignore_errors=True)
        raise


def _is_empty(place: Path) -> bool:
    """Return whether no stage has done anything in a store, which may be bare or not exist."""
    # where the write of a chunk failed, zarr may still be writing others
    if place.exists() and not {each.name for each in place.iterdir()} <= {"zarr.json", "model", ".pchem"}:
        return False
    if not (place / ".pchem").is_dir():
        return True
    records = RunStore.open(place).records
    return all(records.known(name) is None for name in STAGES)


def _bring_samples(target: Target, stages: Sequence[str], command: Command) -> None:
    """Bring the runs of samples up to their histograms, where a run has several and looks at its input."""
    if not target.config.input.samples or not any(STAGES[name].reads_input for name in stages):
        return
    of_sample = replace(command, force=False, roi=None)
    reporter = Reporter("off", quiet=command.quiet)
    for sample in sample_targets(target.config, target.base_dir):
        reporter.info(f"sample {sample.store.name}")
        run_stages(sample, up_to("histogram", pipeline_of(sample.config)), of_sample)
    if not command.dry_run:
        check_samples(target.config, target.base_dir)


def _execute(name: str, context: StageContext, stages: Sequence[str]) -> StageState:
    """Bring a stage up to date; with those after it, where one pass does the work of all."""
    of_files = not context.config.input.samples
    passes = [STAGES[later].single_pass for later in stages if name in STAGES[later].upstream]
    with context.reporter.compilation(name, context.config.compute.max_memory):
        for single_pass in filter(None, passes if of_files else ()):
            resolve_name(single_pass)(context)
        return execute(name, context)


@contextlib.contextmanager
def at_work(target: Target, store: RunStore, reporter: Reporter, command: Command) -> Iterator[StageContext]:
    """Lock a store, and yield what those need who work on it; signals are requests to stop meanwhile.

    Raises:
        LockedError: another process works on it.
        PchEmError: the workers cannot be had.
    """
    with store.locked(), stop_on_signals() as stop:
        executor = make_executor(target.config.compute, reporter.warning, stop.check)
        place = target.config_path
        with contextlib.closing(executor):
            yield StageContext(
                target.config, target.base_dir, store, executor, reporter, stop, command, config_path=place
            )


@contextlib.contextmanager
def working_run(target: Target, command: Command) -> Iterator[StageContext]:
    """Open and lock the run, and yield what its stages need; a new one that is refused is taken away again.

    Raises:
        LockedError: another process works on the run.
        PchEmError: the store or the workers cannot be had.
    """
    config, target = target.config, with_overrides(target, command)
    keep_to_limit(target.config.compute.max_memory)
    with contextlib.ExitStack() as stack:
        stack.enter_context(nothing_left_of_a_refusal(target.store))
        store = RunStore.create(target.store)
        progress_file = ProgressFile(store.path)
        reporter = command.reporter(progress_file)
        stack.callback(reporter.close)
        context = stack.enter_context(at_work(target, store, reporter, command))
        if (path := target.config_path) is not None:
            found = found_model(path)
            if found is not None and found.model == target.config.model:
                reporter.info(f"the model is from {effects_file(path).name}, not from {path.name}")
        progress_file.show({"stage": ""})
        store.write_config(dump_config(config))  # what a single command was given is no setting of the run
        keep_in_force(store, model_in_force(store, target.config.model))
        yaml = {} if target.config_path is None else {"config": str(target.config_path)}
        location = {"base_dir": str(target.base_dir), **yaml}  # to which its paths refer
        write_record(store.path / ".pchem" / "location.json", location)
        yield context


def run_status(target: Target, command: Command | None = None) -> list[StageState]:
    """Return the state of every stage, of those on demand where they were run, without changing anything.

    ``command`` is about to work on the run; None: nothing is asked for.
    """
    stages = pipeline_of(target.config)
    if not any((target.store / each).exists() for each in ("zarr.json", ".pchem/stages")):
        return [StageState(name, "missing") for name in stages]
    store = RunStore.open(target.store)
    context = StageContext(target.config, target.base_dir, store, command=command or Command())
    done = (target.store / ".pchem" / "stages" / f"{name}.json" for name in STAGES if STAGES[name].on_demand)
    stages += tuple(place.stem for place in done if place.exists())
    states: list[StageState] = []
    stale: set[str] = set()
    for name in stages:
        stage = STAGES[name]
        state = status(stage, context)
        above = [upstream for upstream in (*stage.upstream, *stage.follows) if upstream in stale]
        if above and state.state in ("complete", "partial"):
            state = replace(state, state="stale", why=f"{above[0]} is stale")
        if state.state == "stale":
            stale.add(name)
        states.append(state)
    return states


def _dry_run(target: Target, stages: Sequence[str], command: Command) -> list[StageState]:
    """Print what would be done and, if known, the time and memory it takes; write nothing."""
    chosen = Command(settings=command.settings)
    known = {state.stage: state for state in run_status(target, chosen)}
    states = [known.get(name, StageState(name, "missing")) for name in stages]
    reporter = Reporter("off", quiet=command.quiet)
    todo = [state.stage for state in states if state.state != "complete" or command.force]
    for state in states:
        words = "would run" if state.stage in todo else "nothing to do"
        reporter.info(f"{state.stage}: {words} ({state.words()})")
    target = with_overrides(target, command)
    for plan in filter(None, (STAGES[name].plan for name in todo)):
        for line in resolve_name(plan)(target.config, target.base_dir, todo):
            reporter.info(line)
    return states


def _check_failed_pixels(context: StageContext, name: str) -> None:
    """Raise an error if more pixels have no value than allowed, unless only some tiles were chosen."""
    if context.command.roi is not None:
        return
    from pchem_pipeline.model.fit.status import FAILED, MEANINGS, FitStatus

    words = context.store.read(name)
    words = words[(words & int(FitStatus.EXCLUDED)) == 0]
    failed = int(((words & int(FAILED)) != 0).sum())
    allowed = context.config.run.allowed_failed_pixels
    if failed > allowed * words.size:
        reasons = [(int(((words & int(bit)) != 0).sum()), MEANINGS[bit]) for bit in FAILED]
        raise IncompleteRunError(
            f"{failed} of {words.size} pixels have no value, above run.allowed_failed_pixels ({allowed:g}); "
            f"most frequent reason: {max(reasons)[1]}"
        )
