"""``pchem ingest --append``: further frames of a finished run, without reading the old ones again.

Histograms and summaries are continued, and equal those of all frames counted at once, to the bit.
What depends on them becomes stale; the next fit starts from the old answer. The pass changes the arrays in
place: one that is stopped leaves the run without histograms, and the same command then counts all frames.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

from pchem_pipeline.base.errors import InputError, StoreError, quoted
from pchem_pipeline.compute.environment import cpu_seconds
from pchem_pipeline.frames.identity import digest_of, quick_identity
from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.resolve import input_paths
from pchem_pipeline.frames.sequence import FrameSequence
from pchem_pipeline.run.fingerprint import StageState, setting_values
from pchem_pipeline.run.input import ingested_identity, keep_identity, known_identity
from pchem_pipeline.run.stage import Command, Prepared, StageContext, allowed_bytes
from pchem_pipeline.run.target import Target
from pchem_pipeline.runner.execute import execute
from pchem_pipeline.runner.session import run_stages, run_status, working_run
from pchem_pipeline.stages.fit.fit import keep_fit
from pchem_pipeline.stages.histogram.arrays import extend_arrays, single_pass_bytes
from pchem_pipeline.stages.histogram.counting import CountJob, StackCounter
from pchem_pipeline.stages.histogram.single_pass import PREPARED, hashed_frames
from pchem_pipeline.stages.table import STAGES
from pchem_pipeline.store.files import remove_files, write_record

#: exists while the arrays are neither of the old nor of all frames
_BEGUN = ".pchem/appending.json"


def append_frames(target: Target, command: Command) -> list[StageState]:
    """Add the frames of new files to a finished run; return the states of ``ingest`` and ``histogram``.

    ``input.files`` of the run name the old files and, after them, the new ones.

    Raises:
        InputError: the old files are not the files of the run, or the new frames do not fit them.
        StoreError: the run is not finished as far as its histograms, or was made with other settings.
    """
    begun = target.store / _BEGUN
    if command.dry_run:
        return run_stages(target, PREPARED, command)
    if begun.exists() and any(state.state != "complete" for state in run_status(target)[: len(PREPARED)]):
        states = run_stages(target, PREPARED, command)
        remove_files(begun)
        return states
    with working_run(target, command) as context:
        clock = time.perf_counter(), cpu_seconds()
        _check_run(context)
        paths = input_paths(context.config.input, context.base_dir)
        quick = quick_identity(paths)
        added, kept = _added(context, paths, quick)
        if not added:
            context.reporter.info("ingest: no new files")
            return []
        frames = open_frames(context.config.input, context.base_dir)
        _check_frames(context, frames, added)
        keep_fit(context)
        files = kept["files"] + _go_on(context, frames, added)["files"]
        keep_identity(context, quick, {"files": files, "digest": digest_of(files)})
        context.prepared = Prepared(PREPARED, frames, clock)
        states = [execute(name, context) for name in PREPARED]
        remove_files(begun)
        return states


def _check_run(context: StageContext) -> None:
    """Refuse a run that has no whole histograms, or that was made with other settings."""
    store = context.store
    for name in PREPARED:
        record = store.records.read(name)
        if record is None or not (record.finished and store.records.has_all(record)):
            raise StoreError(f"{store.path}: {name} is not complete; run: pchem run {quoted(store.path)}")
        if record.content.get("settings") != setting_values(STAGES[name], context):
            raise StoreError(
                f"{store.path}: {name} was made with other settings; to process all frames again: pchem run "
                f"{quoted(store.path)}"
            )
    lacks = context.config.histogram.summaries and not store.has("summary/open_sums")
    lacks |= ingested_identity(context) is None
    if context.sensor.kind != "frames" or lacks:
        raise StoreError(
            f"{store.path}: frames cannot be appended to ready-made histograms or runs of earlier versions; "
            f"run all again: pchem run {quoted(store.path)} --force"
        )


def _added(
    context: StageContext, paths: list[Path], quick: dict[str, Any]
) -> tuple[list[Path], dict[str, Any]]:
    """Return the files that the run does not know, and the identity of those that it knows."""
    known = ingested_identity(context) or {}
    before = known["quick"]["files"]
    now = quick["files"][: len(before)]
    same = now == before
    facts = [[(file["name"], file["size"]) for file in files] for files in (now, before)]
    if not same and facts[0] == facts[1]:
        # touched, or copied elsewhere: their content counts
        same = known_identity(context)["files"][: len(before)] == known["identity"]["files"]
    if not same:
        raise InputError(
            f"the first {len(before)} files of input.files differ from the files of the run; new files must "
            "follow them in the order of their names; to run all again: pchem run "
            f"{quoted(context.store.path)}"
        )
    return paths[len(before) :], known["identity"]


def _check_frames(context: StageContext, frames: FrameSequence, added: list[Path]) -> None:
    """Refuse frames of another kind, or too few old ones, or too little memory."""
    sensor, place = context.sensor, context.store.path
    if frames.shape[1:] != sensor.shape or frames.dtype.name != sensor.dtype:
        raise InputError(
            f"{added[0]}: the frames differ from the run: {frames.shape[1:]} {frames.dtype}, the run has "
            f"{sensor.shape} {sensor.dtype}"
        )
    if frames.shape[0] <= sensor.n_frames:
        raise InputError(f"{added[0]}: input.frame_range excludes the new frames; correct it")
    reader, first, _, _ = next(frames.pieces(sensor.n_frames, sensor.n_frames + 1))
    if first != 0 or reader.paths[0] not in added:
        raise InputError(f"{added[0]}: does not follow the frames of the run; correct input.files")
    window = context.config.histogram.window_frames
    if sensor.n_frames < window:
        raise StoreError(
            f"{place}: the run has {sensor.n_frames} frames, fewer than histogram.window_frames ({window}), "
            f"which set the bins; run all again: pchem run {quoted(place)}"
        )
    bins = context.store.array("histogram/counts").shape[2]
    need = single_pass_bytes(context.config, frames.shape, frames.dtype, bins)
    if need > allowed_bytes(context.config, context.config.compute.count()):
        raise StoreError(
            f"{place}: appending needs {need >> 20} MiB; allow this (--max-memory), or run all again: pchem "
            f"run {quoted(place)}"
        )


def _go_on(context: StageContext, frames: FrameSequence, added: list[Path]) -> dict[str, Any]:
    """Count the new frames; return the identity of their files."""
    config, store, workers = context.config, context.store, context.config.compute.count()
    bins = store.array("histogram/counts").shape[2]
    copies = config.input.mode == "copy"
    job = CountJob(store.path, frames.shape, bins, config.histogram, copies)
    step = config.histogram.window_frames
    if copies:
        step = math.lcm(step, store.array("frames/dn").chunks[0])
    done = context.sensor.n_frames
    with hashed_frames(context, frames, step, added, done) as stream:
        counter = StackCounter(job, stream.bands, workers)
        counter.resume(done)
        write_record(store.path / _BEGUN, {"frames": done})
        for name in PREPARED:
            store.records.forget(name)
        extend_arrays(context, frames.shape, bins)
        counter.count(stream, context.stop.check)
        return stream.identity()
