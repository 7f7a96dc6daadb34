"""What the workers of ``pchem apply`` do with a piece of the frames.

What loads compiled loops is imported where it is needed: electrons are done without.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.commands.apply.characterisation import read_calibration, with_moments, write_moments
from pchem_pipeline.commands.apply.settings import Job, Piece
from pchem_pipeline.frames.stream import FrameStream
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.run.stage import open_store
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.use.calibration import Calibration
from pchem_pipeline.use.common_modes import Offsets, estimate_offsets
from pchem_pipeline.use.electrons import add_up, electrons, read_stderr, whole_parts, with_its_errors

if TYPE_CHECKING:
    from pchem_pipeline.model.electrons.electrons import NumberTables
    from pchem_pipeline.model.histogram.count import RowHistograms

#: Sums of a pixel over frames: x, x^2, the same without offsets, smallest and largest x.
N_SUMS = 6

_WHOLE = slice(None)


def offsets_of(output: RunStore, job: Job, t0: int, t1: int, rows: slice) -> NDArray[np.float32]:
    """Return the offset of each sample of some rows of some frames, DN; empty where there are none."""
    if not job.removed:
        return np.zeros((0, 0, 0), np.float32)
    frames = slice(t0, t1)
    names = ("row_offset", "column_offset", *(("wave_offset",) if len(job.modes.waves) else ()))
    found = Offsets(*(output.read(f"applied/{name}", (frames, _WHOLE, _WHOLE)) for name in names))
    return found.of_samples(job.modes, rows)


def _calibration(job: Job, rows: slice) -> Calibration:
    run = RunStore.open(job.run)
    extra = None if job.offset_variance is None else job.offset_variance[rows]
    found = read_calibration(run, rows, removed=job.removed, extra_variance=extra, top=job.top)
    return with_moments(found, open_store(job.output), rows) if job.moments else found


def _codes(frames: NDArray[Any], job: Job, offsets: NDArray[np.float32]) -> NDArray[Any]:
    """Return the codes of samples: DN, or parts of a DN without the offsets."""
    return whole_parts(frames, offsets, job.parts, job.lift) if job.removed else frames


# -- errors of the calibration ---------------------------------------------------------------------


def moments_piece(
    piece: Piece, *, job: Job, settings: FitSettings, adc_limits: tuple[int, int] | None
) -> dict[str, Any]:
    """Write the errors of the calibration of some rows."""
    rows = slice(piece.y0, piece.y1)
    write_moments(RunStore.open(job.run), open_store(job.output), rows, settings, adc_limits)
    return {}


# -- offsets of frames, rows and columns -----------------------------------------------------------


def offsets_piece(piece: Piece, *, job: Job) -> dict[str, Any]:
    """Find and write the offsets of some frames; the summary tells how well they are known."""
    output = open_store(job.output)
    calibration = _calibration(job, _WHOLE)
    left, largest = np.zeros(len(job.modes.parts)), 0.0
    with FrameStream(job.source, [(piece.y0, piece.y1)], job.depth, frames=(piece.t0, piece.t1)) as stream:
        for start, (frames,) in stream:
            found = estimate_offsets(frames, job.scene, calibration, job.modes)
            region = (slice(start, start + len(frames)), _WHOLE, _WHOLE)
            output.write("applied/row_offset", region, found.rows.astype(np.float32))
            output.write("applied/column_offset", region, found.columns.astype(np.float32))
            if len(job.modes.waves):
                output.write("applied/wave_offset", region, found.waves.astype(np.float32))
            left += found.left.sum(axis=0)
            largest = max(largest, float(abs(found.of_samples(job.modes)).max()))
    return {"left": left.tolist(), "largest": largest}


# -- histograms and exposure -----------------------------------------------------------------------


def count_piece(piece: Piece, *, job: Job) -> dict[str, Any]:
    """Count the frames of some rows; write the range of their codes, and their exposure if wanted."""
    from pchem_pipeline.model.histogram.count import HistogramAccumulator

    output = open_store(job.output)
    rows = slice(piece.y0, piece.y1)
    shape = (piece.y1 - piece.y0, job.source.shape[2])
    accumulator = HistogramAccumulator(shape, job.bins, piece.t1)
    with FrameStream(job.source, [(piece.y0, piece.y1)], job.window) as stream:
        for start, (frames,) in stream:
            offsets = offsets_of(output, job, start, start + len(frames), rows)
            accumulator.add(_codes(frames, job, offsets))
    found = accumulator.finish()
    ends = np.stack([found.minimum, found.maximum]).astype(np.int64)
    output.write("applied_parts/range", (_WHOLE, rows, _WHOLE), ends)
    if not job.estimates:
        return {}
    _write_exposure(output, found, _calibration(job, rows), job, rows)
    return {"outside": int(((found.under > 0) | (found.over > 0)).sum())}


def _write_exposure(
    output: RunStore, found: RowHistograms, calibration: Calibration, job: Job, rows: slice
) -> None:
    """Write the exposure of some rows and its errors, and what the prior of their numbers is made of."""
    from pchem_pipeline.use.exposure import estimate_exposure, mean_signal

    origin = found.origin.astype(np.int64) - job.lift * job.parts
    if job.learns_prior:
        signal = mean_signal(found.counts, origin, calibration, job.parts)
        output.write("applied_parts/prior", (rows, _WHOLE), signal)
    if "exposure" not in job.kinds:
        return
    maps = estimate_exposure(found.counts, origin, calibration, job.parts)
    values = {
        "exposure": maps.exposure,
        "exposure_stderr": maps.stderr,
        "exposure_stderr_counting": maps.counting,
        "exposure_stderr_calibration": maps.calibration,
    }
    for name, each in values.items():
        output.write(f"applied/{name}", (rows, _WHOLE), each)


# -- samples ---------------------------------------------------------------------------------------


def convert_piece(piece: Piece, *, job: Job) -> dict[str, Any]:
    """Write electrons and electron numbers of a piece, and the sums over its frames."""
    output = open_store(job.output)
    rows = slice(piece.y0, piece.y1)
    calibration = _calibration(job, rows)
    tables = _tables(output, job, calibration, rows) if "numbers" in job.kinds else None
    sums = np.zeros((N_SUMS, *calibration.shape))
    sums[4] = np.inf
    electron_frames = "electrons" in job.kinds
    room = np.empty((job.depth if electron_frames else 0, *calibration.shape), np.float32)
    with FrameStream(job.source, [(piece.y0, piece.y1)], job.depth, frames=(piece.t0, piece.t1)) as stream:
        for start, (frames,) in stream:
            offsets = offsets_of(output, job, start, start + len(frames), rows)
            region = (slice(start, start + len(frames)), rows, _WHOLE)
            add_up(frames, offsets, sums)
            if electron_frames:
                output.write("applied/electrons", region, electrons(frames, calibration, offsets, room))
            if tables is not None:
                _write_numbers(output, tables, _codes(frames, job, offsets), job, region)
    output.write(
        "applied_parts/sums", (slice(piece.number, piece.number + 1), _WHOLE, rows, _WHOLE), sums[None]
    )
    return {}


def _tables(output: RunStore, job: Job, calibration: Calibration, rows: slice) -> NumberTables:
    """Return the electron numbers of the codes of some rows."""
    from pchem_pipeline.model.electrons.electrons import number_tables

    ends = output.read("applied_parts/range", (_WHOLE, rows, _WHOLE)) - job.lift * job.parts
    prior, signal = None, calibration.quanta_exposure
    if job.prior_map is not None:
        prior = signal = job.prior_map[rows]
    elif job.pool is not None:
        priors = job.pool.priors(
            output.read("applied_parts/prior", (rows, _WHOLE)), read_stderr(calibration) ** 2
        )
        prior, signal = priors[..., 0], priors.mean(axis=-1)
        above = np.nan_to_num(priors - priors[..., :1]).reshape(signal.size, -1)
        law = calibration.law.with_added_exposure(above, np.full(above.shape, 1.0 / above.shape[1]))
        calibration = replace(calibration, law=law)
    elif job.prior == "run":
        prior = signal
    known = with_its_errors(calibration, signal).known
    found = number_tables(
        ends[0], ends[1], prior, known, dtype=job.number_type, parts=job.parts, detailed=True
    )
    # a bias that is an electron off makes nearly all numbers wrong
    share = np.repeat(calibration.right_bias.ravel(), np.diff(found.start))
    return replace(found, right=found.right * share)


def _write_numbers(
    output: RunStore, tables: NumberTables, codes: NDArray[Any], job: Job, region: tuple[slice, ...]
) -> None:
    found = tables.convert(codes, lift=job.lift * job.parts, expected=job.expected)
    output.write("applied/electron_number", region, found.number)
    output.write("applied/number_probability", region, found.probability)
    if job.expected:
        output.write("applied/expected_number", region, found.expected)
