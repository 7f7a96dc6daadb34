"""Bring a stage up to date, and keep a record of what was done."""

from __future__ import annotations

import platform
import time
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from pkgutil import resolve_name

from pchem_pipeline.base.errors import StoreError, quoted
from pchem_pipeline.compute.environment import cpu_seconds, peak_rss_bytes, versions_of
from pchem_pipeline.run.declaration import Stage
from pchem_pipeline.run.fingerprint import StageState, changed_file, fingerprint_content, rests_on, status
from pchem_pipeline.run.stage import StageContext
from pchem_pipeline.stages.table import STAGES
from pchem_pipeline.store.files import DESCRIPTION, digest_of, fingerprint_of
from pchem_pipeline.store.records import StageRecord
from pchem_pipeline.store.remote_path import RemotePath

_LIBRARIES = ("numpy", "scipy", "numba", "zarr", "dask", "tifffile", "astropy", "h5py", "matplotlib")


def execute(name: str, context: StageContext) -> StageState:
    """Bring a stage up to date and return its state.

    Units that fail make the state ``failed``; the others are kept.

    Raises:
        PchEmError: the stage cannot be done.
    """
    clock = time.perf_counter(), cpu_seconds()  # hashing the input is part of the work
    stage = STAGES[name]
    before = status(stage, context)
    if before.state == "complete" and not context.command.force:
        context.selected(())  # refuses regions that the sensor does not have
        context.reporter.info(f"{name}: up to date")
        return before
    records = {upstream: context.store.records.known(upstream) for upstream in stage.upstream}
    for upstream, record in records.items():
        if record is None:
            place = quoted(context.config_path or context.store.path)
            raise StoreError(f"{name} needs {upstream} first; run: pchem {upstream} {place}")
    if records:
        context.selected(())
    for record in filter(None, records.values()):
        if file := changed_file(record, context.store):
            raise StoreError(
                f"{context.store.path}: {file} is missing or has changed; {context.store.cure(file)}"
            )
    if before.state == "stale":
        context.reporter.info(f"{name}: running again: {before.why}")
    if context.prepared is not None and name == context.prepared.stages[-1]:
        clock = context.prepared.clock
    return _perform(stage, context, before, clock)


def _perform(
    stage: Stage, context: StageContext, before: StageState, clock: tuple[float, float]
) -> StageState:
    """Run a stage that is not up to date, and keep its record whatever happens; the clock is wall, CPU."""
    records, restart = context.store.records, context.command.roi is None
    content = fingerprint_content(stage, context)
    old = records.known(stage.name)
    # a stage that was stopped before its first unit may lack arrays
    resumes = before.state in ("partial", "complete") and old is not None and old.keys > 0
    if before.state == "stale" and not restart and old is not None:
        # chosen tiles mend chunks, and keep the rest
        same = fingerprint_of(content) == old.fingerprint
        resumes = same and not changed_file(old, context.store).endswith(DESCRIPTION)
    resumed = old if resumes and not (context.command.force and restart) else None
    context.stage, context.failed, context.notes, context.n_keys = stage.name, {}, [], 0
    context.fingerprint = fingerprint_of(content) if resumed is None else resumed.fingerprint
    context.fresh = resumed is None and not context.is_prepared
    record = StageRecord(
        stage.name,
        stage.version,
        context.fingerprint,
        content,
        keys=0 if resumed is None else resumed.keys,
        started=datetime.now(UTC).isoformat(timespec="seconds"),
        versions={"python": platform.python_version(), **versions_of("pchem-pipeline", *_LIBRARIES)},
    )
    record = replace(record, model=rests_on(record, context.store))
    records.write(record)
    begun = False

    def begin() -> None:
        """Give up what the stage left before: markers first, a stage that is killed then has begun anew."""
        nonlocal begun
        if context.fresh and not begun:
            records.unmark_all(stage.name)
            for path in stage.writes:
                context.store.delete(path)
        begun = True

    context.begin = begin
    context.reporter.event("start", stage=stage.name, why=before.words())
    wall, cpu = clock
    try:
        resolve_name(stage.run)(context)
        begin()
        record = replace(record, finished=True, files=written_files(stage, context.store.path))
    finally:
        record = replace(
            record,
            keys=context.n_keys or record.keys,
            seconds=time.perf_counter() - wall + (0.0 if resumed is None else resumed.seconds),
            cpu_seconds=cpu_seconds() - cpu + (0.0 if resumed is None else resumed.cpu_seconds),
            peak_rss_bytes=peak_rss_bytes(),
            failed=context.failed,
            notes=tuple(context.notes),
        )
        if begun and (old is not None or record.finished or record.keys):
            records.write(record)
        elif begun or old is None:
            records.forget(stage.name)  # it was refused before it did anything, and leaves no trace
        else:
            records.write(old)  # nor does it take anything away
    return _finish(stage, context, record, time.perf_counter() - wall, cpu_seconds() - cpu)


def _finish(
    stage: Stage, context: StageContext, record: StageRecord, seconds: float, cpu: float
) -> StageState:
    """Say how a stage ended: the time of this command, and of all commands where that is longer."""
    done = len(context.store.records.done(stage.name, record.fingerprint))
    some = "" if done >= record.keys else f"{done} of {record.keys} units, "
    earlier = f"; {record.seconds:.1f} s with earlier commands" if record.seconds > seconds + 0.1 else ""
    context.reporter.info(
        f"{stage.name}: {some}{seconds:.1f} s "
        f"({cpu:.1f} s CPU, peak {record.peak_rss_bytes / 2**20:.0f} MiB{earlier})",
        stage=stage.name,
        seconds=seconds,
        peak_rss_bytes=record.peak_rss_bytes,
    )
    if not context.failed:
        return StageState(stage.name, "complete" if done >= record.keys else "partial", "", done, record.keys)
    key, reason = next(iter(context.failed.items()))
    why = f"{len(context.failed)} of {record.keys} units failed, first {key}: {reason}"
    return StageState(stage.name, "failed", why, done, record.keys)


def written_files(stage: Stage, folder: Path) -> dict[str, str]:
    """Return the files beside arrays that a stage wrote, its arrays and their descriptions, with digests."""
    places = [folder / name for name in stage.files]
    if not isinstance(folder, RemotePath):  # where each would be a request
        for name in stage.writes:
            for description in (folder / name).glob(DESCRIPTION if "/" in name else f"*/{DESCRIPTION}"):
                places += [description, description.parent]
    found = {place.relative_to(folder).as_posix(): digest_of(place) for place in places}
    return {name: digest for name, digest in found.items() if digest is not None}
