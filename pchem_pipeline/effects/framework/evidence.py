"""What a stack of frames shows beyond the PCD, as an effect's estimator is given it.

Every sample x of a pixel with a fitted PCD is split in two (Hendrickson et al. 2023, eqs. gamma_nk,
update_eqns): the **charge** channel ``k = E[K | x]``, the expected electron number, and the **readout**
channel ``r = x - mu - k / g``, what is left. Both are functions of the code alone, so tables do it. An effect
of the light or the dark current shows in one, an effect of the electronics in the other, and a coupling of
the two in their products. The evidence is a set of sums over one subset of the frames (a *split*); it holds
no samples.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.base.arrays import BoolArray, Float32Array, FloatArray, IntArray
from pchem_pipeline.model.law.parameters import PixelParameters

#: Per-pixel efficient scores: products of Hermite (readout) and Charlier (charge) polynomials beyond the four
#: that are the PCD's own parameters.
SCORES = ("C2", "C3", "He3", "He4", "He2C1", "He1C2", "He2C2", "He3C1")
#: Hits of particles that are listed at most.
MOST_HITS = 20_000
#: Whose samples a misplaced line holds: those of the line after or before it, its own a sample early or late,
#: or that from some sample on only, as where one is lost or delivered twice.
PLACES = ("next", "before", "early", "late", "lost", "twice")


@dataclass(frozen=True)
class PixelMaps(PixelParameters):
    """Fitted parameters of the pixels, each (y, x); NaN where not ``usable``: a fit to be relied upon."""

    usable: BoolArray

    @classmethod
    def known(cls, parameters: Iterable[ArrayLike], usable: BoolArray) -> PixelMaps:
        """Return maps of (H, g, mu, sigma) in the shape of ``usable``, NaN where that is False."""
        exposure, gain, bias, sigma = (
            np.where(usable, np.asarray(each, np.float64).reshape(usable.shape), np.nan)
            for each in parameters
        )
        return cls(exposure, gain, bias, sigma, usable)

    def of(self, pixels: Any) -> PixelMaps:
        """Return some pixels, by any index of the maps."""
        return PixelMaps.known([each[pixels] for each in self.maps], self.usable[pixels])

    @property
    def flat(self) -> PixelMaps:
        """The pixels in one axis."""
        return PixelMaps.known(self.maps, self.usable.reshape(-1))


@dataclass(frozen=True)
class CodeResiduals:
    """Counts per absolute DN, summed over the usable pixels.

    Attributes:
        first: DN of the first element.
        observed: samples seen, shape (n_codes,).
        expected: samples expected from the fitted PCDs (exact rounded mass), shape (n_codes,).
        minimum, maximum: smallest and largest DN seen in the usable pixels.
    """

    first: int
    observed: FloatArray
    expected: FloatArray
    minimum: int
    maximum: int


@dataclass(frozen=True)
class PredictedSamples:
    """Samples beside what their neighbours predict for them, in their own frame and in others.

    Attributes:
        equal_z: by how many standard deviations they equal the prediction of their own frame more often.
        thresholds: DN, increasing, shape (n,); none where they are as often equal as chance makes them.
        above: samples that exceed the prediction of their own frame by more, shape (n,).
        above_chance: those that exceed one, two, three given predictions of other frames, as means over the
            choices, shape (3, n).
    """

    equal_z: float
    thresholds: IntArray
    above: FloatArray
    above_chance: FloatArray


@dataclass(frozen=True)
class PreviousBits:
    """Normal equations of samples on the bits of the one read before in the row, beyond its value.

    Differences of successive frames are regressed, each over its pixel's standard deviation.

    Attributes:
        product: of the bits with the samples, the least significant first, 1/DN, shape (b,).
        square: of the bits with each other, 1/DN^2, shape (b, b).
        variance: of the samples, no unit.
    """

    product: FloatArray
    square: FloatArray
    variance: float


class Wave(NamedTuple):
    """A wave over frames, rows and columns.

    Attributes:
        amplitude: of the sine in standardised residuals, no unit.
        per_frame: cycles per frame; None: its phase is new in every frame.
        per_row, per_column: cycles.
        phase: of the sine at row, column and frame 0, rad.
        excess: log of the inverse chance of such a power, less the log of the number of places where it could
            have been.
    """

    amplitude: float
    per_frame: float | None
    per_row: float
    per_column: float
    phase: float
    excess: float

    @property
    def alternates(self) -> bool:
        """Whether it repeats itself after two rows and columns, or frames, as circuits that take turns do."""
        space = self.per_row, self.per_column
        cycles = space if any(space) else (self.per_frame,)
        return all(each is not None and abs(2.0 * each - round(2.0 * each)) < 1e-5 for each in cycles)


@dataclass(frozen=True)
class TimeSeries:
    """What is kept along time; None of it exists for ready-made histograms.

    Frames come in blocks of ``block_frames`` consecutive ones; blocks may be far apart. Lagged products never
    cross the edge of a block. Means of rows, columns and quadrants without usable pixels are 0.

    Attributes:
        frames: frame numbers in the run, increasing, shape (n,).
        n_run: number of frames of the whole run.
        block_frames: frames in a block (the last one may be shorter).
        block_start: frame number of the first frame of each block, shape (n_blocks,).
        frame_charge: sum over usable pixels of (k - H) over that of H: relative deviation of H, shape (n,).
        frame_readout: mean of r over the usable pixels, DN, shape (n,).
        frame_gain: slope of r against k - H over the usable pixels of a frame, in units of 1/g: relative
            deviation of the gain (DN/e-) of each frame, shape (n,).
        quadrant_readout: mean of r of each quadrant, DN (top left and right, bottom left and right), (n, 4).
        row_charge, row_readout: means of k - H, e-, and of r, DN, of each row, shape (n, y).
        column_charge, column_readout: the same of each column, shape (n, x).
        block_charge, block_readout: the same of each pixel in each block, shape (n_blocks, y, x).
        lag_charge: autocorrelation of k in each pixel at lags 1, 2, 3, after the frame's common mode was
            removed as for the neighbours, and without the bias of a centred series, shape (3, y, x).
        lag_readout: autocorrelation of r, shape (3, y, x).
        lag_readout_charge: correlation of r at t with k at t - 1, shape (y, x).
        n_pairs: number of pairs of frames behind a lag-1 correlation.
        neighbours: correlation of neighbouring pixels in the same frame, mean over all pairs of usable
            pixels: "x.kk", "x.rr", "x.rk" (readout of one with charge of the other, both ways) and the same
            for "y", with the mean taken after the frame's common mode was removed.
        neighbour_maps: by the same names the correlation of each pixel with the next one along the axis, over
            its standard error by chance, shape (y, x); NaN without one.
        repeated: frame numbers that are, sample by sample, the frame before, shape (n_repeated,).
        repeated_rows: number of rows (of other frames) that are the same row of the frame before.
        predicted: samples beside what their neighbours predict, by kind of prediction.
        previous_bits: samples beside the bits of those read before; None where there are too few.
        repeated_lines: number of "rows" and of "columns" that are the one before them in the same frame.
        misplaced_lines: likeliest share of "rows" and of "columns" that hold the samples of other pixels, by
            :data:`PLACES`, shape (6,); none where chance explains them.
        frame_noise: by how much the squares of r of each frame exceed their mean, over their standard
            deviation by chance, shape (n,); None: not known.
        waves: across rows and columns, in the readout residuals over their standard deviation.
        hits, low_hits: samples above, and below, a pixel's support: columns frame, y, x, DN; int64, shape
            (n_hits, 4), at most 20,000.
    """

    frames: IntArray
    n_run: int
    block_frames: int
    block_start: IntArray
    frame_charge: FloatArray
    frame_readout: FloatArray
    frame_gain: FloatArray
    quadrant_readout: FloatArray
    row_charge: Float32Array
    row_readout: Float32Array
    column_charge: Float32Array
    column_readout: Float32Array
    block_charge: Float32Array
    block_readout: Float32Array
    lag_charge: Float32Array
    lag_readout: Float32Array
    lag_readout_charge: Float32Array
    n_pairs: int
    neighbours: Mapping[str, float]
    repeated: IntArray
    repeated_rows: int
    hits: IntArray
    neighbour_maps: Mapping[str, Float32Array] = field(default_factory=dict)
    frame_noise: FloatArray | None = None
    predicted: Mapping[str, PredictedSamples] = field(default_factory=dict)
    previous_bits: PreviousBits | None = None
    repeated_lines: Mapping[str, int] = field(default_factory=dict)
    misplaced_lines: Mapping[str, FloatArray] = field(default_factory=dict)
    waves: tuple[Wave, ...] = ()
    low_hits: IntArray = field(default_factory=lambda: np.empty((0, 4), np.int64))

    @property
    def block_length(self) -> IntArray:
        """Number of frames of each block, shape (n_blocks,)."""
        return np.diff(np.append(np.searchsorted(self.frames, self.block_start), self.frames.size))


@dataclass(frozen=True)
class Evidence:
    """The evidence of one split.

    Attributes:
        maps: plain PCD fit of this split, whatever the model of the run.
        n_frames: samples of a pixel.
        charge_std: standard deviation of k under the fitted PCD, e-, shape (y, x).
        readout_std: standard deviation of r under the fitted PCD, DN, shape (y, x).
        scores: standardised efficient score of each of :data:`SCORES`, about N(0, 1) under the PCD with the
            four parameters fitted, NaN in unusable pixels, shape (y, x) each.
        goodness: goodness of fit of each pixel as a standard normal quantile (large: poor), shape (y, x).
        peaks: the same by groups of codes as wide as the read noise: what is smooth over several codes shows
            far better.
        tail_low, tail_high: samples of each pixel beyond the support of its PCD (expected: below 1e-2 in the
            whole split), uint32, shape (y, x).
        code: counts per DN over the sensor.
        time: what is kept along time and space; None for ready-made histograms.
        z: the vector of statistics, each about N(0, 1) where the PCD holds, by name, in a fixed order
            (names in :mod:`pchem_pipeline.discrepancy.observe.catalogue`). A statistic that these data cannot
            give is absent.
        covariance: of the pixels' (H, g, mu, sigma) in ``maps``, shape (y, x, 4, 4); None: not known.
        ambiguous: share of the usable pixels whose bias may be off by an electron.
        tail_expected: samples of each pixel expected below and above the support, shape (2, y, x); None: not
            known.
        evaluated: evaluations of the likelihood of a pixel by the fit times its codes, of all pixels.
    """

    maps: PixelMaps
    n_frames: int
    charge_std: FloatArray
    readout_std: FloatArray
    scores: Mapping[str, Float32Array]
    goodness: Float32Array
    peaks: Float32Array
    tail_low: NDArray[np.uint32]
    tail_high: NDArray[np.uint32]
    code: CodeResiduals
    time: TimeSeries | None
    z: Mapping[str, float] = field(default_factory=dict)
    covariance: FloatArray | None = None
    ambiguous: float = 0.0
    tail_expected: Float32Array | None = None
    evaluated: float = 0.0

    def strongest(self, *names: str) -> float:
        """Return the largest |z| among the named statistics (0 where these data give none of them)."""
        return max((abs(self.z[name]) for name in names if name in self.z), default=0.0)
