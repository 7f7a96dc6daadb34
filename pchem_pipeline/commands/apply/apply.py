"""``pchem apply``: from frames and a run to calibrated frames, piece by piece."""

from __future__ import annotations

import contextlib
import functools
import shutil
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from pchem_pipeline import __version__
from pchem_pipeline.base.errors import ConfigError, IncompleteRunError, StoreError
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.base.wording import count
from pchem_pipeline.commands.apply.characterisation import (
    check_run,
    doubtful_pixels,
    moments_piece,
    read_calibration,
    with_moments,
)
from pchem_pipeline.commands.apply.files import check_names, write_files
from pchem_pipeline.commands.apply.finish import finish_maps
from pchem_pipeline.commands.apply.settings import ApplySettings, Job, Piece, at_limit
from pchem_pipeline.commands.apply.source import (
    check_camera,
    check_level,
    limits_of,
    open_gain,
    open_like_run,
    overscan_of,
    some_of,
)
from pchem_pipeline.commands.apply.tasks import N_SUMS, convert_piece, count_piece, offsets_piece
from pchem_pipeline.compute.memory import keep_to_limit
from pchem_pipeline.effects.framework.compose import model_words
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.frames.identity import quick_identity
from pchem_pipeline.frames.sequence import FrameSequence
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.stage import Command, StageContext, Task
from pchem_pipeline.run.target import Target
from pchem_pipeline.runner.session import at_work, with_overrides
from pchem_pipeline.stages.fit.fitted_model import fitted_effects
from pchem_pipeline.stages.overscan import overscan_samples
from pchem_pipeline.store.files import fingerprint_of, read_json
from pchem_pipeline.store.records import StageRecord
from pchem_pipeline.store.remote_path import local_path, place_of
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.store.tiles import equal_rows
from pchem_pipeline.use.calibration import PEAKS_OVERLAP_E, Calibration
from pchem_pipeline.use.common_modes import CommonModes, scene_of
from pchem_pipeline.use.electrons import read_stderr
from pchem_pipeline.use.overscan import Overscan

#: Name of the work in the records of the output.
STAGE = "apply"
_VERSION = 5
_PRODUCT = "calibrated frames"
_CHUNK_SAMPLES, _CHUNK_ROWS, _CHUNK_COLUMNS, _CHUNK_FRAMES = 1 << 20, 64, 256, 256
_SEGMENT_SAMPLES = 1 << 27
#: Frames from which the scene, or the variances of the offsets in the overscan, are estimated.
_SCENE_FRAMES = 256
#: Share of the samples at a limit of the ADC beyond which offsets are not known: with 6 % of them the stated
#: probabilities of electron numbers are as right as without, with 32 % they are 0.1 too high.
_MOST_CUT = 0.2


def apply_to_frames(
    target: Target, files: Sequence[str | Path], output: Path, wanted: ApplySettings, command: Command
) -> list[Path]:
    """Write other frames of the sensor of a run in physical units; return what was written.

    The output is a zarr store, or a folder of TIFF or FITS files, see `write_files`; ``command.force``
    replaces one that exists. A command that was stopped continues where it was, and gives the same.

    Raises:
        InputError: the frames do not fit the run.
        StoreError: the run is not finished, or the output is something else.
        ConfigError: the output exists with other settings.
    """
    target = with_overrides(target, command)
    keep_to_limit(target.config.compute.max_memory)
    run = target.stored()
    reporter = command.reporter()
    with contextlib.ExitStack() as stack:
        stack.callback(reporter.close)
        stack.enter_context(reporter.compilation(STAGE, target.config.compute.max_memory))
        job, calibration, content, remarks = _make_job(run, target, files, wanted)
        output = place_of(output) if wanted.format == "zarr" else local_path(output)
        if wanted.format == "fits":
            check_names(job.source, output)
        place = output if wanted.format == "zarr" else output.with_name(f".{output.name}.unfinished.zarr")
        if wanted.format != "zarr" and _is_done(output, content, command):
            reporter.info(f"apply: {output} is up to date")
            return sorted(output.iterdir())
        store, fresh = _output_store(place, content, force=command.force)
        context = stack.enter_context(at_work(target, store, reporter, command))
        context.stage, context.fresh, context.fingerprint = STAGE, fresh, fingerprint_of(content)
        for remark in remarks:
            reporter.warning(remark)
        _do(context, job, calibration)
        if wanted.format == "zarr":
            how = f'xarray.open_zarr("{output}", group="applied", consolidated=False)'
            reporter.info(f"apply: open it with {how}")
            return [output]
        written = write_files(store, output, wanted.format, job.source, content)
    shutil.rmtree(place, ignore_errors=True)
    return written


def _offsets_to_remove(
    effects: Sequence[Effect], target: Target, frames: FrameSequence, reference: str
) -> tuple[CommonModes, Overscan | None]:
    """Return the offsets that are subtracted, and the overscan where they are measured there."""
    modes = CommonModes() if reference == "none" else CommonModes.of_model(effects, frames.shape[1:])
    if reference != "overscan":
        return modes, None
    overscan = overscan_of(target, frames)
    if not modes.removed:
        samples = overscan_samples(frames, np.isfinite(overscan.bias), _SCENE_FRAMES)
        modes = CommonModes.of_overscan(overscan, samples)
    return modes, overscan


def _make_job(
    run: RunStore, target: Target, files: Sequence[str | Path], wanted: ApplySettings
) -> tuple[Job, Calibration, dict[str, Any], list[str]]:
    """Return the job of the workers, the calibration, what decides the result, as JSON data, and remarks."""
    digest = check_run(run)
    sensor = SensorInfo.read(run)
    frames = open_like_run(target, sensor, files, wanted.dataset)
    limits = limits_of(frames, sensor)
    effects = fitted_effects(run)
    modes, overscan = _offsets_to_remove(effects, target, frames, wanted.reference)
    some, cut = some_of(frames if overscan is None else frames.with_overscan()), 0.0
    if limits is not None:
        cut = float(np.mean(at_limit(some, limits)))
    kept = ", ".join(modes.removed) if cut > _MOST_CUT and overscan is None else ""
    if kept:
        modes = CommonModes()
    calibration = read_calibration(run, limits=limits or (None, None), removed=modes.removed)
    # a bias that moved is measured in the overscan
    drift = 0.0 if overscan is None else float(np.nanmean(some.mean(axis=0) - overscan.bias))
    remarks = check_camera(frames, sensor) + check_level(some - drift, calibration, frames.paths[0])
    if why := open_gain(calibration.fit_status):
        remarks.append(
            f"{target.store.name}: {why}: values and errors can be far off; take several exposures"
        )
    if kept:
        remarks.append(
            f"{kept} not subtracted: {100 * cut:.0f} % of the samples are at a limit of the ADC, which hides "
            "their offset; the read noise includes it, and errors and probabilities allow for it"
        )
    if modes.left:
        remarks.append(
            f"{', '.join(modes.left)}: only at certain times of the characterisation, so not subtracted"
        )
    known = calibration.usable
    noise = (calibration.conversion_gain * calibration.read_noise_dn)[known]
    overlap = int((noise > PEAKS_OVERLAP_E).sum())
    numbers = "numbers" in wanted.kinds
    if numbers and overlap:
        remarks.append(
            f"{overlap} of {known.sum()} pixels have a read noise above {PEAKS_OVERLAP_E} e-: their most "
            "probable electron number is often wrong; use expected_number"
        )
    trapped = int(np.count_nonzero(known.ravel() & (calibration.own_satellites > 0.0).all(axis=1)))
    traps = trapped > 0 and "electrons" in wanted.kinds and wanted.reference != "none"
    if traps:
        remarks.append(
            f"telegraph jumps subtracted in {count(trapped, 'pixel')}; a change of the light that looks like "
            "one is subtracted, too (less of it with --prior flat; to keep all: --reference none)"
        )
    depth, *_ = _chunks(frames.shape)
    if wanted.format != "zarr":  # files are written by blocks of whole frames
        depth = max(1, min(depth, (1 << 26) // (frames.shape[1] * frames.shape[2])))
    job = Job(
        target.store,
        frames,
        wanted.kinds,
        wanted.prior,
        limits=limits,
        modes=modes,
        overscan=overscan,
        depth=depth,
        traps=traps,
        expected=numbers and overlap > 0,
    )
    # outputs of versions without this setting are continued
    settings = {name: value for name, value in asdict(wanted).items() if name != "dataset" or value}
    content = {
        "product": _PRODUCT,
        "version": _VERSION,
        "program": __version__,
        "run": target.store.name,
        "run_digest": digest,
        "model": model_words(effects),
        "frames": quick_identity(frames.paths)["files"],
        "settings": {**settings, "kinds": list(wanted.kinds)},
    }
    return job, calibration, content, remarks


# -- the output ------------------------------------------------------------------------------------


def _is_done(output: Path, content: dict[str, Any], command: Command) -> bool:
    """Return whether a folder of files is what is wanted."""
    if not output.exists() or (output.is_dir() and not any(output.iterdir())):
        return False
    found = read_json(output / "provenance.json") if output.is_dir() else None
    return _is_wanted(output, found or {}, content, force=command.force)


def _is_wanted(output: Path, found: dict[str, Any], content: dict[str, Any], *, force: bool) -> bool:
    """Return whether an output is the wanted one; raise ConfigError unless it is, or may be replaced."""
    if found == content and not force:
        return True
    if found.get("product") != _PRODUCT:
        raise ConfigError(f"{output} exists and has no calibrated frames; choose another --output")
    if not force:
        raise ConfigError(
            f"{output} exists and was made from other frames or with other settings; choose another "
            "--output, or replace it with --force"
        )
    return False


def _output_store(place: Path, content: dict[str, Any], *, force: bool) -> tuple[RunStore, bool]:
    """Return the store that is written, and whether it is begun anew; raise ConfigError for another one."""
    names = {each.name for each in place.iterdir()} if place.is_dir() else set()
    begun = {name for name in names if not name.startswith(".zarr.json.")}  # not what a killed process left
    if "zarr.json" not in begun and (begun or (place.exists() and not place.is_dir())):
        _is_wanted(place, {}, content, force=force)
    if not begun <= {"zarr.json", ".pchem"}:
        found: dict[str, Any] = {}
        with contextlib.suppress(StoreError):
            found = RunStore.open(place).attributes("applied").get("provenance", {})
        if _is_wanted(place, found, content, force=force):
            return RunStore.open(place, writable=True), False
    store = RunStore.create(place)
    for group in ("applied", "applied_parts"):
        store.delete(group)
    store.records.forget(STAGE)
    record = StageRecord(STAGE, _VERSION, fingerprint_of(content), content)
    store.set_attributes("applied", {"provenance": content, "title": _PRODUCT})
    store.records.write(record)
    return store, True


def _chunks(shape: tuple[int, int, int]) -> tuple[int, int, int]:
    """Return frames, rows and columns of a chunk."""
    rows, columns = min(shape[1], _CHUNK_ROWS), min(shape[2], _CHUNK_COLUMNS)
    depth = max(1, min(_CHUNK_SAMPLES // (rows * columns), _CHUNK_FRAMES, shape[0]))
    return depth, rows, columns


def _create(context: StageContext, job: Job, *names: str, **facts: Any) -> None:
    """Make arrays over whole rows of the sensor; ``facts`` are those of `StageContext.create`."""
    lengths = dict(zip(("frame", "y", "x"), job.source.shape, strict=True)) | facts.pop("lengths", {})
    chunks = {"frame": job.depth, "y": _chunks(job.source.shape)[1]} | facts.pop("chunks", {})
    context.create(*names, lengths=lengths, chunks=chunks, **facts)


def _create_converted(context: StageContext, job: Job, n_segments: int) -> None:
    """Make the arrays of the frames, and of the sums over them."""
    columns = {"x": _chunks(job.source.shape)[2]}
    if "electrons" in job.kinds:
        _create(context, job, "applied/electrons", chunks=columns)
    if job.traps:
        _create(context, job, "applied_parts/jump_noise")
    if job.limits is not None:
        _create(context, job, "applied/at_adc_limit", chunks=columns)
    if "numbers" in job.kinds:
        largest = int(np.iinfo(job.number_type).max)
        # not missing_value: xarray would turn the integers into floats
        facts = {"dtype": job.number_type, "no_number": largest, "largest_number": largest - 1}
        _create(context, job, "applied/electron_number", chunks=columns, **facts)
        others = ["number_probability", *(["expected_number"] if job.expected else [])]
        _create(context, job, *(f"applied/{name}" for name in others), chunks=columns)
    lengths = {"segment": n_segments, "sum": N_SUMS}
    _create(context, job, "applied_parts/sums", lengths=lengths, chunks={"segment": 1})


# -- the work --------------------------------------------------------------------------------------


def _do(context: StageContext, job: Job, calibration: Calibration) -> None:
    """Bring the output up to date."""
    record = context.store.records.read(STAGE)
    if record is not None and record.finished and not context.fresh:
        context.store.delete("applied_parts")  # what a failure after the last step may have left
        context.reporter.info(f"apply: {context.store.path} is up to date")
        return
    job, calibration = _with_moments(context, job, calibration)
    calibration = calibration.without_noise(job.modes.in_noise)
    if job.removed:
        job = _with_offsets(context, job, calibration)
    if job.counts:
        job = _counted(context, job, calibration)
    if job.converts:
        _converted(context, job)
    finish_maps(context.store, job, calibration, context.reporter)
    if record is not None:
        context.store.records.write(replace(record, finished=True, keys=context.n_keys))
    context.store.delete("applied_parts")


def _do_pieces(
    context: StageContext, pieces: Sequence[Piece], task: Task[Piece], **how: Any
) -> dict[str, dict[str, Any]]:
    """Do the pieces as `StageContext.run_units` does; raise IncompleteRunError where some failed."""
    done = context.run_units(pieces, task, **how)
    if context.failed:
        key, reason = next(iter(context.failed.items()))
        raise IncompleteRunError(
            f"{len(context.failed)} pieces failed, first {key}: {reason}; finished pieces are kept, run "
            "again to retry"
        )
    return done


def _rows_of_band(context: StageContext, job: Job, bytes_of_pixel: int) -> int:
    """Return the rows that a worker takes at a time: whole chunks."""
    _, ny, nx = job.source.shape
    rows = _chunks(job.source.shape)[1]
    fitting = max(1, context.band_bytes // (bytes_of_pixel * nx * rows))
    shared = max(1, -(-ny // (rows * context.executor.workers)))  # one for each worker
    return rows * min(fitting, shared)


def _with_moments(context: StageContext, job: Job, calibration: Calibration) -> tuple[Job, Calibration]:
    """Compute the errors of the calibration where the curvature of its likelihood is not enough."""
    run = RunStore.open(job.run)
    if not doubtful_pixels(run, calibration).any():
        return job, calibration
    _, ny, _ = job.source.shape
    rows = _chunks(job.source.shape)[1]
    lengths = {"row": 3, "column": 3, "side": 2, "quantity": 4}
    _create(context, job, "applied_parts/covariance", "applied_parts/rivals", lengths=lengths)
    task = functools.partial(moments_piece, job=job, settings=context.config.fit)
    pieces = [Piece("errors", *band, 0, 1) for band in equal_rows(ny, rows)]
    _do_pieces(context, pieces, task, unit_name="band")
    return replace(job, moments=True), with_moments(calibration, context.store)


def _with_offsets(context: StageContext, job: Job, calibration: Calibration) -> Job:
    """Find the offsets of frames, rows and columns; return the job that takes them away."""
    n, ny, nx = job.source.shape
    if job.overscan is None:
        chosen = np.unique(np.linspace(0, n - 1, _SCENE_FRAMES).astype(int)).tolist()
        mean = sum(job.source.read(t, t + 1)[0].astype(np.float64) for t in chosen) / len(chosen)
        job = replace(job, scene=scene_of(np.asarray(mean), calibration))
    parts = job.modes.parts
    waves = job.modes.waves
    lengths, whole = {"part": len(parts), "wave": len(waves), "coefficient": 2}, {"y": ny}
    facts: dict[str, dict[str, Any]] = {
        "wave_offset": {
            "cycles_per_row": waves[:, 0].tolist(),
            "cycles_per_column": waves[:, 1].tolist(),
            "part": waves[:, 3].astype(int).tolist(),
        },
        "readout_offset": {"chunks": {"x": _chunks(job.source.shape)[2]}},
    }
    for name in job.modes.stored:
        own = {"lengths": lengths, "removed": list(job.removed)} | facts.get(name, {"chunks": whole})
        _create(context, job, f"applied/{name}", **own)
    context.store.write_array("applied/offset_part", parts)
    length = job.depth * max(1, -(-_SEGMENT_SAMPLES // (8 * ny * nx * job.depth)))
    pieces = [Piece("offsets", 0, ny, t0, min(t0 + length, n)) for t0 in range(0, n, length)]
    done = _do_pieces(context, pieces, functools.partial(offsets_piece, job=job), unit_name="piece")
    found = [summary for key, summary in done.items() if key.startswith("offsets-")]
    left = sum((np.array(each["left"]) for each in found), start=np.zeros(len(parts))) / n
    lift = int(np.ceil(max(float(each["largest"]) for each in found))) + 1 if found else 0
    # codes are cut to quarters of a DN: their own rounding is part of what is not known
    variance = np.tensordot(left, parts, 1) + QUANTISATION_VARIANCE / 4**2
    reached = (any(each["reached"][0] for each in found), any(each["reached"][1] for each in found))
    rows = np.sum([each["rows"] for each in found], axis=0)
    return replace(job, parts=4, lift=lift, offset_variance=variance, reached=reached, row_sums=rows)


def _counted(context: StageContext, job: Job, calibration: Calibration) -> Job:
    """Count the frames; return the job with the type of the electron numbers."""
    from pchem_pipeline.model.electrons.electrons import number_type  # loads compiled loops
    from pchem_pipeline.stages.histogram.histogram import bins_of

    n, ny, _ = job.source.shape
    most = context.config.histogram.max_bins
    # the first 64 frames set the width of the histograms
    bins = job.parts * bins_of(job.source, 64, most // job.parts, _CHUNK_ROWS)
    job = replace(job, bins=min(most, bins), window=min(job.window, n))
    ends = ("", "_stderr", "_stderr_counting", "_stderr_calibration")
    names = [f"applied/exposure{end}" for end in ends] if "exposure" in job.kinds else []
    names += ["applied_parts/prior"] if job.learns_prior else []
    _create(context, job, "applied_parts/range", *names, lengths={"end": 2})
    bytes_of_pixel = 10 * job.bins + 2 * job.window * job.source.dtype.itemsize + 200
    step = _rows_of_band(context, job, bytes_of_pixel)
    _do_pieces(
        context,
        [Piece("count", *band, 0, n) for band in equal_rows(ny, step)],
        functools.partial(count_piece, job=job),
        unit_name="band",
        unit_bytes=bytes_of_pixel * step * job.source.shape[2],
    )
    if not job.by_code:
        return job
    if job.learns_prior:
        from pchem_pipeline.use.exposure import ExposurePool  # loads compiled loops

        noise = read_stderr(calibration) ** 2
        job = replace(job, pool=ExposurePool.of(context.store.read("applied_parts/prior"), noise, n))
    top = context.store.read("applied_parts/range", (slice(1, 2), slice(None), slice(None)))[0]
    known = calibration.usable
    dn = top[known] / job.parts - job.lift
    reach = (dn - calibration.bias[known]) * calibration.conversion_gain[known]
    reach += 9.0 * (calibration.read_noise_dn * calibration.conversion_gain)[known]
    return replace(job, number_type=number_type(float(reach.max(initial=0.0))))


def _converted(context: StageContext, job: Job) -> None:
    """Write the frames."""
    n, ny, nx = job.source.shape
    codes = 0
    if job.by_code:
        ends = context.store.read("applied_parts/range")
        codes = int(np.ceil((ends[1] - ends[0] + 1).mean()))
    bytes_of_pixel = 24 * (job.depth + codes) + 400
    step = _rows_of_band(context, job, bytes_of_pixel)
    # independent of the workers, so that the sums are, too
    rows = _chunks(job.source.shape)[1]
    length = job.depth * max(1, -(-_SEGMENT_SAMPLES // (rows * nx * job.depth)))
    starts = range(0, n, length)
    _create_converted(context, job, len(starts))
    pieces = [
        Piece("write", *band, t0, min(t0 + length, n), number)
        for number, t0 in enumerate(starts)
        for band in equal_rows(ny, step)
    ]
    task = functools.partial(convert_piece, job=job)
    _do_pieces(context, pieces, task, unit_name="piece", unit_bytes=bytes_of_pixel * step * nx)
