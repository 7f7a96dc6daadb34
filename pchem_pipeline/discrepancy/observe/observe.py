"""From a stack of frames, measured or simulated, to the evidence and its vector of statistics.

One function for both, so that whatever the histogram, the fit and the tables do to the data they do to the
replicates too. It is deterministic, and a function of the data only: the fit is that of the plain PCD,
whatever the model of the run.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, CodeArray, Float32Array, FloatArray, IntArray
from pchem_pipeline.base.errors import InputError, PchEmError
from pchem_pipeline.discrepancy.observe import digital, vector
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.observe.follows import follow_statistics
from pchem_pipeline.discrepancy.observe.laws import poisson
from pchem_pipeline.discrepancy.observe.misplaced import misplaced_lines
from pchem_pipeline.discrepancy.observe.sums import MINIMUM_BLOCKS, samples_beyond
from pchem_pipeline.discrepancy.observe.tables import PixelHistograms, PixelLaws, pixel_laws
from pchem_pipeline.discrepancy.observe.view import FrameView
from pchem_pipeline.discrepancy.observe.waves import Waves, waves_across
from pchem_pipeline.effects.framework.evidence import SCORES, CodeResiduals, Evidence, PixelMaps, TimeSeries
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.result import FitResult
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import FAILED, FitStatus

#: Pixels with one of these flags are left out. A poor fit is no reason: it is what is looked for. Nor is a
#: bias that may be off by one electron: all that is looked at stays nearly the same, but to choose the pixels
#: with an unambiguous sample would bias the statistics of the rest.
UNTRUSTWORTHY = FAILED | FitStatus.NOT_INFORMATIVE
MOST_OUTSIDE = 0.01  # of a pixel's samples outside of its histogram
_FINEST_STEP = 2.5  # DN per electron, the least that whole DN show
_FAR_FINER = 2.0 / 3.0  # of the step of most pixels
_ALIKE, _FEW = 1.25, 0.1  # ratio of like steps, and share of the pixels that makes a gain of their own


def observe(
    frames: CodeArray,
    numbers: IntArray,
    *,
    n_run: int,
    block_frames: int,
    exclude: BoolArray | None = None,
    start: PixelMaps | None = None,
    fitted: bool = True,
    names: Collection[str] = STATISTICS,
) -> Evidence:
    """Return the evidence of a split of the frames.

    Args:
        frames: codes (n, y, x), DN.
        numbers: their frame numbers in the run, increasing, (n,).
        n_run: frames of the whole run.
        block_frames: frames in a block; blocks begin anew where numbers are missing.
        exclude: pixels not to look at, (y, x).
        start: parameters near those of these frames, where they are known: saves time.
        fitted: take the parameters from a fit of these frames; False: take ``start`` as it is, for frames too
            few to be fitted.
        names: statistics that are wanted; waves, and pixels that follow others, are looked for only then.

    Raises:
        InputError: the frames are fewer than four blocks, or not as described.
        PchEmError: no pixel is usable.
    """
    _check(frames, numbers, block_frames)

    def asked(*families: str) -> bool:
        return any(name.startswith(families) for name in names)

    shape = frames.shape[1:]
    seen = PixelHistograms.of(frames)
    wanted = np.ones(shape, np.bool_) if exclude is None else ~exclude
    if fitted or start is None:
        result, parameters, usable = _fitted(seen, wanted.ravel(), start)
    else:
        result, parameters = None, start.columns
        usable = (wanted & start.usable).ravel() & _inside(seen)
    evidence, laws = _compared(seen, parameters, usable, (shape[0], shape[1]), result)
    maps = evidence.maps
    view = FrameView.of(frames, numbers, block_frames, laws, maps)
    edges = view.edges
    hits = [samples_beyond(frames, numbers, laws, maps.usable, above=above) for above in (True, False)]
    repeats = digital.Repeats.of(frames, numbers)
    predicted = digital.predicted_samples(frames, edges, maps.usable)
    bits = digital.previous_bits(frames, edges, maps)
    waves = waves_across(frames, numbers, laws, maps) if asked("space.sample") else Waves((), {})
    misplaced_z, misplaced = misplaced_lines(frames, seen.counts, seen.origin, maps.usable)
    z = {
        **evidence.z,
        "tail.high.clusters": _clusters(hits[0], laws, frames.shape),
        **vector.product_statistics(view),
        **vector.block_statistics(view),
        **vector.frame_statistics(view),
        **vector.line_statistics(view),
        **digital.predicted_statistics(predicted),
        **digital.bit_statistics(bits),
        **digital.nearer_statistics(frames, edges, maps),
        **(follow_statistics(frames, edges, laws, maps) if asked("space.follows", "time.follows") else {}),
        **repeats.statistics(seen, frames.shape),
        **digital.square_statistics(frames, seen, maps.usable),
        **misplaced_z,
        **waves.z,
    }
    time = _time_series(
        view,
        n_run,
        repeated=numbers[repeats.frames],
        repeated_rows=repeats.rows_in_time,
        repeated_lines={"rows": repeats.rows, "columns": repeats.columns},
        predicted=predicted,
        previous_bits=bits,
        misplaced_lines=misplaced,
        waves=waves.found,
        hits=hits[0],
        low_hits=hits[1],
    )
    return replace(evidence, time=time, z=vector.in_order(z))


def observe_histograms(
    counts: CodeArray, origin: IntArray, *, parameters: FloatArray | None = None
) -> Evidence:
    """Return the evidence of ready-made histograms (n, B) with bin 0 at ``origin``: maps (1, n), and no time.

    The parameters are (H, g, mu, sigma) of a fit of more than one histogram each, (n, 4), NaN where not
    usable; None: each histogram is fitted by itself.

    Raises:
        PchEmError: no pixel is usable.
    """
    n, seen, result = len(counts), PixelHistograms.alone(counts, origin), None
    if parameters is None:
        result, parameters, usable = _fitted(seen, np.ones(n, np.bool_))
    else:
        usable = np.asarray(np.isfinite(parameters).all(axis=1))
    return _compared(seen, parameters, usable, (1, n), result)[0]


def _check(frames: NDArray[Any], numbers: IntArray, block_frames: int) -> None:
    if frames.ndim != 3 or frames.dtype.kind != "u" or numbers.shape != frames.shape[:1] or block_frames < 1:
        raise InputError(
            f"frames {frames.dtype}{frames.shape} with {numbers.shape} numbers in blocks of {block_frames}; "
            "give unsigned frames (frame, y, x) and one number for each"
        )
    if frames.shape[0] < MINIMUM_BLOCKS * block_frames:
        raise InputError(
            f"{frames.shape[0]} frames are fewer than {MINIMUM_BLOCKS} blocks of {block_frames}; take more "
            "frames or shorter blocks"
        )


def _compared(
    seen: PixelHistograms,
    parameters: FloatArray,
    usable: BoolArray,
    shape: tuple[int, int],
    fit: FitResult | None,
) -> tuple[Evidence, PixelLaws]:
    """Compare histograms with the PCD at the parameters of a fit; None: its errors are not known."""
    laws = pixel_laws(seen, parameters, usable)
    good = laws.good
    if not good.any():
        raise PchEmError(
            f"none of the {good.size} pixels has a fit that can be relied upon; see the flags of the fit"
        )
    moments, codes = laws.moments, laws.codes
    residuals = CodeResiduals(codes.first, codes.single[0], codes.single[1], *seen.extremes(good))

    def known(values: FloatArray) -> FloatArray:
        return np.where(good, values, np.nan).reshape(shape)

    def mapped(values: FloatArray) -> Float32Array:
        return known(values).astype(np.float32)

    low, high = (np.where(good[:, None], moments[side], 0.0) for side in ("low", "high"))
    ambiguous = 0.0 if fit is None else np.mean((fit.fit_status[good] & int(FitStatus.BIAS_AMBIGUOUS)) != 0)
    evidence = Evidence(
        maps=PixelMaps.known(parameters.T, good.reshape(shape)),
        n_frames=int(seen.samples.max()),
        charge_std=known(moments["charge_std"]),
        readout_std=known(moments["readout_std"]),
        scores={name: mapped(laws.scores[:, 0, j]) for j, name in enumerate(SCORES)},
        goodness=mapped(vector.goodness_of(moments["goodness"])),
        peaks=mapped(vector.goodness_of(moments["peaks"])),
        tail_low=low[:, 0].reshape(shape).astype(np.uint32),
        tail_high=high[:, 0].reshape(shape).astype(np.uint32),
        code=residuals,
        time=None,
        z=vector.in_order(vector.sample_statistics(laws, parameters[:, 0], residuals)),
        tail_expected=np.stack([mapped(low[:, 1]), mapped(high[:, 1])]),
        covariance=None if fit is None else fit.covariance.reshape(*shape, 4, 4),
        ambiguous=float(ambiguous),
        evaluated=0.0 if fit is None else fit.evaluated(seen.counts),
    )
    return evidence, laws


def _fitted(
    seen: PixelHistograms, wanted: BoolArray, near: PixelMaps | None = None
) -> tuple[FitResult, FloatArray, BoolArray]:
    """Return the fit, its parameters (n, 4), and which pixels can be used."""
    start = None if near is None else near.columns
    # every sample counts here: what the tail guard would leave out is what is looked for
    settings = FitSettings(tail_guard=0.0, errors="information")
    outside = seen.outside.T.astype(np.int64)
    result = fit_histograms(seen.counts, seen.origin, *outside, settings=settings, start=start)
    parameters = result.columns
    usable = wanted & ((result.fit_status & UNTRUSTWORTHY) == 0) & np.isfinite(parameters).all(axis=1)
    usable &= ~_without_steps(parameters[:, 1], usable)
    return result, parameters, usable & _inside(seen)


def _without_steps(gain: FloatArray, usable: BoolArray) -> BoolArray:
    """Return which usable pixels have a comb that whole DN hardly show, where most have a coarser one, (n,).

    Of noise that hides the electrons, as in the dark, in reference columns or in noisy pixels, a few of many
    fits make such a comb by chance. In samples that it was not fitted to, it is off by hundreds of standard
    deviations.
    """
    if not usable.any():
        return np.zeros_like(usable)
    step = 1.0 / np.where(usable, gain, np.nan)
    known, most = np.sort(step[usable]), float(np.nanmedian(step))
    first, last = (np.searchsorted(known, step * ratio) for ratio in (1.0 / _ALIKE, _ALIKE))
    few = last - first - 1 < _FEW * known.size
    return np.asarray(few & (step < min(_FINEST_STEP, _FAR_FINER * most)) & (most > _FINEST_STEP))


def _inside(seen: PixelHistograms) -> BoolArray:
    """Return which histograms hold nearly all samples of their pixel, (n,)."""
    return np.asarray(seen.outside.sum(axis=1) <= MOST_OUTSIDE * seen.counts.sum(axis=1))


def fitted_maps(frames: CodeArray, exclude: BoolArray) -> tuple[PixelMaps, float]:
    """Return the plain fit of frames, from nothing, as :func:`observe` makes it, of pixels not excluded.

    With it the codes that it evaluated, see `Evidence.evaluated`.
    """
    seen = PixelHistograms.of(frames)
    fit, parameters, usable = _fitted(seen, ~exclude.ravel())
    return PixelMaps.known(parameters.T, usable.reshape(exclude.shape)), fit.evaluated(seen.counts)


def _clusters(hits: IntArray, laws: PixelLaws, shape: tuple[int, ...]) -> float:
    """Return the statistic of hits next to each other in the same frame, chance coincidences expected."""
    n, ny, nx = shape
    expected = np.zeros((ny + 2, nx + 2))
    expected[1:-1, 1:-1] = np.where(laws.good, laws.moments["high"][:, 1], 0.0).reshape(ny, nx)
    neighbours = expected[1:-1, 2:] + expected[2:, 2:] + expected[2:, 1:-1] + expected[2:, :-2]
    chance = float((expected[1:-1, 1:-1] * neighbours).sum() / n)
    keys = {(int(t), int(y), int(x)) for t, y, x in hits[:, :3]}
    pairs = sum(
        (t, y + dy, x + dx) in keys for t, y, x in keys for dy, dx in ((0, 1), (1, 1), (1, 0), (1, -1))
    )
    return poisson(pairs, chance)


def _time_series(view: FrameView, n_run: int, **others: Any) -> TimeSeries:
    """Return the time series; ``others``: its fields that are not of the view."""
    exposure, number = view.pixels.mode

    def over(values: FloatArray, count: FloatArray) -> FloatArray:
        return np.asarray(values / np.maximum(count, 1e-300) * (count > 0))

    def mapped(values: FloatArray) -> Float32Array:
        return np.where(view.pixels.usable, values, np.nan).astype(np.float32)

    def lags(name: str) -> Float32Array:
        of = [view.correlations[f"time.lag{lag}.{name}"].of_pixels for lag in (1, 2, 3)]
        return np.stack(of).astype(np.float32)

    rows, columns = (
        [over(each, number.sum(axis)).astype(np.float32) for each in sums[:2]]
        for sums, axis in ((view.rows, 1), (view.columns, 0))
    )
    blocks = mapped(view.blocks / np.diff(view.edges)[:, None, None, None])
    beside = {
        name.removeprefix("space."): seen
        for name, seen in view.correlations.items()
        if name.startswith("space.") and np.isfinite(seen.mean)
    }
    return TimeSeries(
        frames=view.numbers,
        n_run=n_run,
        block_frames=view.block_frames,
        block_start=view.numbers[view.edges[:-1]],
        frame_charge=view.halves[0].sum(axis=(0, 2)) / exposure.sum(),
        frame_readout=view.halves[1].sum(axis=(0, 2)) / number.sum(),
        frame_gain=view.gain,
        quadrant_readout=over(vector.quadrant_series(view.halves[1]), vector.quadrant_sums(number)),
        row_charge=rows[0],
        row_readout=rows[1],
        column_charge=columns[0],
        column_readout=columns[1],
        block_charge=blocks[:, 0],
        block_readout=blocks[:, 1],
        lag_charge=lags("charge"),
        lag_readout=lags("readout"),
        lag_readout_charge=view.correlations["time.cross.readout_charge"].of_pixels.astype(np.float32),
        n_pairs=view.correlations["time.lag1.charge"].count,
        neighbours={name: seen.mean for name, seen in beside.items()},
        neighbour_maps={name: seen.deviations.astype(np.float32) for name, seen in beside.items()},
        **others,
        frame_noise=view.series["noise"],
    )
