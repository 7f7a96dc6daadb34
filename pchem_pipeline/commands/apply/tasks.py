"""What the workers of ``pchem apply`` do with a piece of the frames.

What loads compiled loops is imported where it is needed: electrons are done without.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import Float32Array
from pchem_pipeline.commands.apply.characterisation import read_calibration, with_moments
from pchem_pipeline.commands.apply.settings import Job, Piece, at_limit
from pchem_pipeline.frames.stream import FrameStream
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.use.calibration import Calibration
from pchem_pipeline.use.common_modes import Offsets, Reference, estimate_offsets
from pchem_pipeline.use.electrons import add_up, electrons, read_stderr, whole_parts, with_its_errors

if TYPE_CHECKING:
    from pchem_pipeline.model.electrons.electrons import KnownPixels, NumberTables
    from pchem_pipeline.model.electrons.electrons_numba import Numbers
    from pchem_pipeline.model.histogram.count import RowHistograms
    from pchem_pipeline.use.telegraph import TelegraphJumps

#: Sums of a pixel over frames: x, x^2, the same without offsets, smallest and largest x.
N_SUMS = 6

_WHOLE = slice(None)


def offsets_of(output: RunStore, job: Job, t0: int, t1: int, rows: slice) -> Float32Array:
    """Return the offset of each sample of some rows of some frames, DN; empty where there are none."""
    if not job.removed:
        return np.zeros((0, 0, 0), np.float32)
    lines, (_, ny, nx) = (t1 - t0, len(job.modes.parts)), job.source.shape
    found: Any = {"rows": np.zeros((*lines, ny)), "columns": np.zeros((*lines, nx))}
    for name, field in job.modes.stored.items():
        some = rows if field == "readout" else _WHOLE
        found[field] = output.read(f"applied/{name}", (slice(t0, t1), some, _WHOLE))
    readout = found.pop("readout", np.float32(0.0))
    offsets = Offsets(**found).of_samples(job.modes, rows)
    offsets += readout
    return offsets


def _calibration(
    output: RunStore, job: Job, rows: slice, limits: tuple[int | None, int | None]
) -> Calibration:
    run = RunStore.open(job.run)
    extra = None if job.offset_variance is None else job.offset_variance[rows]
    found = read_calibration(run, rows, removed=job.removed, extra_variance=extra, limits=limits)
    found = with_moments(found, output, rows) if job.moments else found
    return found.without_noise(job.modes.in_noise)


def _codes(frames: NDArray[Any], job: Job, offsets: Float32Array) -> NDArray[Any]:
    """Return the codes of samples: DN, or parts of a DN without the offsets."""
    return whole_parts(frames, offsets, job.parts, job.lift) if job.removed else frames


# -- offsets of frames, rows and columns -----------------------------------------------------------


def offsets_piece(piece: Piece, output: RunStore, *, job: Job) -> dict[str, Any]:
    """Find and write the offsets of some frames; the summary has their errors."""
    calibration, source = _calibration(output, job, _WHOLE, job.cut), job.source
    if job.overscan is None:
        reference = Reference.of_pixels(calibration, job.scene)
    else:
        reference, source = Reference.of_overscan(job.overscan), source.with_overscan()
    left, largest = np.zeros(len(job.modes.parts)), 0.0
    ends, known = [0, np.iinfo(np.int64).max] if job.limits is None else list(job.limits), calibration.usable
    reached, rows = [False, False], np.zeros((2, 2, job.source.shape[1]))
    share = known / np.maximum(known.sum(axis=1, keepdims=True), 1)  # of a pixel in the mean of its row
    bias = np.where(known, calibration.bias * share, 0.0).sum(axis=1)
    with FrameStream(source, [(piece.y0, piece.y1)], job.depth, frames=(piece.t0, piece.t1)) as stream:
        for start, (frames,) in stream:
            found = estimate_offsets(frames, reference, job.modes)
            region = (slice(start, start + len(frames)), _WHOLE, _WHOLE)
            for name, field in job.modes.stored.items():
                output.write(f"applied/{name}", region, getattr(found, field).astype(np.float32))
            reached[0] |= bool((frames.min(axis=0) <= ends[0])[known].any())
            reached[1] |= bool((frames.max(axis=0) >= ends[1])[known].any())
            left += found.left.sum(axis=0)
            offsets = found.of_samples(job.modes)
            largest = max(largest, float(abs(offsets).max()))
            means, less = (np.einsum("tyx,yx->ty", each, share) for each in (frames, offsets))
            rows += [
                (each.sum(axis=0), (each**2).sum(axis=0)) for each in (means - bias, means - bias - less)
            ]
    return {"left": left.tolist(), "largest": largest, "reached": reached, "rows": rows.tolist()}


# -- histograms and exposure -----------------------------------------------------------------------


def count_piece(piece: Piece, output: RunStore, *, job: Job) -> dict[str, Any]:
    """Count the frames of some rows; write the range of their codes, and their exposure if wanted."""
    from pchem_pipeline.model.histogram.count import HistogramAccumulator

    rows = slice(piece.y0, piece.y1)
    shape = (piece.y1 - piece.y0, job.source.shape[2])
    accumulator = HistogramAccumulator(shape, job.bins, piece.t1)
    ends = np.stack([np.full(shape, np.iinfo(np.int64).max), np.full(shape, np.iinfo(np.int64).min)])
    with FrameStream(job.source, [(piece.y0, piece.y1)], job.window) as stream:
        for start, (frames,) in stream:
            offsets = offsets_of(output, job, start, start + len(frames), rows)
            codes = _codes(frames, job, offsets)
            np.minimum(ends[0], codes.min(axis=0), out=ends[0])
            np.maximum(ends[1], codes.max(axis=0), out=ends[1])
            if job.removed:
                for end, cut in zip(job.cut, (np.maximum, np.minimum), strict=True):
                    if end is not None:
                        cut(codes, np.uint32((end + job.lift) * job.parts), out=codes)
            accumulator.add(codes)
    found = accumulator.finish()
    output.write("applied_parts/range", (_WHOLE, rows, _WHOLE), ends)
    if not job.estimates:
        return {}
    _write_exposure(output, found, _calibration(output, job, rows, job.cut), job, rows)
    return {"outside": int(((found.under > 0) | (found.over > 0)).sum())}


def _write_exposure(
    output: RunStore, found: RowHistograms, calibration: Calibration, job: Job, rows: slice
) -> None:
    """Write the exposure of some rows and its errors, and what the prior of their numbers is made of."""
    from pchem_pipeline.use.exposure import estimate_exposure, mean_signal

    origin = found.origin.astype(np.int64) - job.lift * job.parts
    low, high = job.cut
    censored = np.zeros(origin.shape, np.bool_)
    if low is not None:
        censored |= found.minimum <= (low + job.lift) * job.parts
    if high is not None:
        censored |= found.maximum >= (high + job.lift) * job.parts
    wanted = "exposure" in job.kinds
    if wanted or censored.any():
        maps = estimate_exposure(found.counts, origin, calibration, job.parts)
    if job.learns_prior:
        signal = mean_signal(found.counts, origin, calibration, job.parts)
        if censored.any():  # the mean of samples that are cut off is no signal
            signal = np.where(censored, maps.exposure, signal)
        output.write("applied_parts/prior", (rows, _WHOLE), signal)
    if not wanted:
        return
    values = {
        "exposure": maps.exposure,
        "exposure_stderr": maps.stderr,
        "exposure_stderr_counting": maps.counting,
        "exposure_stderr_calibration": maps.calibration,
    }
    for name, each in values.items():
        output.write(f"applied/{name}", (rows, _WHOLE), each)


# -- samples ---------------------------------------------------------------------------------------


def convert_piece(piece: Piece, output: RunStore, *, job: Job) -> None:
    """Write electrons and electron numbers of a piece, and the sums over its frames."""
    rows = slice(piece.y0, piece.y1)
    # without offsets each sample has limits of its own
    calibration = _calibration(output, job, rows, (None, None) if job.removed else job.cut)
    tables, jumps = _lookups(output, job, calibration, rows)
    if jumps is not None:
        noise = np.full(calibration.bias.size, np.nan)
        noise[jumps.pixels] = jumps.noise
        output.write("applied_parts/jump_noise", (rows, _WHOLE), noise.reshape(calibration.shape))
    sums = np.zeros((N_SUMS, *calibration.shape))
    sums[4] = np.inf
    electron_frames = "electrons" in job.kinds
    room = np.empty((job.depth if electron_frames else 0, *calibration.shape), np.float32)
    with FrameStream(job.source, [(piece.y0, piece.y1)], job.depth, frames=(piece.t0, piece.t1)) as stream:
        for start, (frames,) in stream:
            offsets = offsets_of(output, job, start, start + len(frames), rows)
            region = (slice(start, start + len(frames)), rows, _WHOLE)
            add_up(frames, offsets, sums)
            codes = _codes(frames, job, offsets) if job.by_code else frames
            if electron_frames:
                values = electrons(frames, calibration, offsets, room)
                if jumps is not None:
                    jumps.subtract(values, codes, job.lift * job.parts)
                output.write("applied/electrons", region, values)
            if job.limits is not None:
                output.write("applied/at_adc_limit", region, at_limit(frames, job.limits).astype(np.uint8))
            if tables is not None:
                found = tables.numbers(frames, codes, job)
                output.write("applied/electron_number", region, found.number)
                output.write("applied/number_probability", region, found.probability)
                if job.expected:
                    output.write("applied/expected_number", region, found.expected)
    output.write(
        "applied_parts/sums", (slice(piece.number, piece.number + 1), _WHOLE, rows, _WHOLE), sums[None]
    )


@dataclass(frozen=True)
class _Tables:
    """Electron numbers of the codes of some rows."""

    known: KnownPixels
    prior: Any  # expected exposure, e-, (y, x); or None
    # probability that the bias is right, (y, x): one an electron off makes nearly all numbers wrong
    right_bias: Any
    tables: NumberTables  # of the codes that occur

    def numbers(self, frames: NDArray[Any], codes: NDArray[Any], job: Job) -> Numbers:
        """Return the numbers of samples (frame, y, x), given with their codes.

        Of samples at a limit of the ADC all that is known is that they lie there or beyond; less its offset
        each has a limit of its own.
        """
        found = self.tables.convert(codes, lift=job.lift * job.parts, expected=job.expected)
        if job.removed and job.limits is not None:
            at, high = at_limit(frames, job.limits), frames >= job.limits[1]
            for t in np.flatnonzero(at.any(axis=(1, 2))).tolist():
                self._censored(found, t, codes[t][at[t]], np.flatnonzero(at[t]), high[t][at[t]], job)
        return found

    def _censored(
        self, found: Numbers, t: int, codes: NDArray[Any], at: NDArray[Any], high: NDArray[Any], job: Job
    ) -> None:
        """Put in the numbers of the samples at the limits of frame t, in pixels ``at``."""
        from pchem_pipeline.model.electrons.electrons import number_tables

        code = codes.astype(np.int64) - job.lift * job.parts
        limit = np.floor(code / job.parts + 0.5)
        pixels = self.known.of(at)
        low_end, high_end = np.where(high, np.nan, limit), np.where(high, limit, np.nan)
        pixels = replace(pixels, law=replace(pixels.law, clip_low=low_end, clip_high=high_end))
        prior = None if self.prior is None else self.prior.ravel()[at]
        one = number_tables(code, code, prior, pixels, dtype=job.number_type, parts=job.parts, detailed=True)
        for kind in ("number", "expected"):
            if (values := getattr(found, kind)).size:
                values[t].reshape(-1)[at] = getattr(one, kind)
        with np.errstate(invalid="ignore"):
            found.probability[t].reshape(-1)[at] = one.right / one.mass * self.right_bias.ravel()[at]


def _lookups(
    output: RunStore, job: Job, calibration: Calibration, rows: slice
) -> tuple[_Tables | None, TelegraphJumps | None]:
    """Return the electron numbers of the codes of some rows, and the telegraph jumps; None: not wanted."""
    if not job.by_code:
        return None, None
    from pchem_pipeline.model.electrons.electrons import number_tables
    from pchem_pipeline.use.telegraph import TelegraphJumps

    ends = output.read("applied_parts/range", (_WHOLE, rows, _WHOLE)) - job.lift * job.parts
    prior, signal = None, calibration.quanta_exposure
    if job.pool is not None:
        priors = job.pool.priors(
            output.read("applied_parts/prior", (rows, _WHOLE)), read_stderr(calibration) ** 2
        )
        prior, signal = priors[..., 0], priors.mean(axis=-1)
        above = np.nan_to_num(priors - priors[..., :1]).reshape(signal.size, -1)
        law = calibration.law.with_added_exposure(above, np.full(above.shape, 1.0 / above.shape[1]))
        calibration = replace(calibration, law=law)
    elif job.prior == "run":
        prior = signal
    jumps = TelegraphJumps.of(ends[0], ends[1], prior, calibration.known, job.parts) if job.traps else None
    if "numbers" not in job.kinds:
        return None, jumps
    known = with_its_errors(calibration, signal).known
    found = number_tables(
        ends[0], ends[1], prior, known, dtype=job.number_type, parts=job.parts, detailed=True
    )
    share = np.repeat(calibration.right_bias.ravel(), np.diff(found.start))
    return _Tables(known, prior, calibration.right_bias, found._replace(right=found.right * share)), jumps
