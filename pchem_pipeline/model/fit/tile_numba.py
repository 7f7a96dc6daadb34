"""The loop over the pixels of a tile: load the histograms, search, write parameters and errors."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.errors.algebra_numba import enclose, invert_arrow, to_natural
from pchem_pipeline.model.errors.information_numba import fill_squared_scores
from pchem_pipeline.model.fit.climb_numba import Limits, min_log_variance
from pchem_pipeline.model.fit.search_numba import (
    FIT_NOT_CONVERGED,
    GAIN_AMBIGUOUS,
    NO_DATA,
    SURELY_SEEN,
    TOO_FEW_BINS,
    Task,
    Tools,
    nats_of_peaks,
    ripple_by_chance,
)
from pchem_pipeline.model.fit.starts_numba import start_regression
from pchem_pipeline.model.law import pixel_numba as px
from pchem_pipeline.model.law.cells_numba import Law, resolve
from pchem_pipeline.model.law.pixel_numba import (
    Pixel,
    Scratch,
    copy,
    load,
    make_pixel,
    make_scratch,
    sample_of,
)


class Histograms(NamedTuple):
    """The histograms of n pixels at J exposures."""

    counts: NDArray[np.integer]  # of the samples of each pixel, one after the other, shape (n, all bins)
    places: IntArray  # where each sample begins among the bins, and the end, shape (J + 1,)
    origin: IntArray  # DN of the first bin of each sample, shape (n, J)
    dark: BoolArray  # which samples hold no electrons, shape (J,)
    mask: NDArray[np.uint8]  # codes that do not count, see `COUNTED`, shape (n, all bins)


class Starts(NamedTuple):
    """What is known of n pixels.

    Attributes:
        parameters: (H_1 ... H_J, g, mu, sigma) near the answer, shape (n, J + 3), NaN where not known; or
            (0, J + 3).
        gaps: nats of that answer above its runner-up, shape (n,).
        amplitudes: of free satellites to try, e-.
        looked: pixels in which they are tried, shape (n,) or (1,).
    """

    parameters: FloatArray
    gaps: FloatArray
    amplitudes: FloatArray
    looked: BoolArray


class Answers(NamedTuple):
    """What the loop fills."""

    parameters: FloatArray  # (H_1 ... H_J, g, mu, sigma), shape (n, J + 3); comes as NaN
    covariance: FloatArray  # shape (n, J + 3, J + 3); comes as NaN
    moments: FloatArray  # mean (DN) and variance (DN^2) of each sample, shape (n, J, 2); comes as NaN
    found: NDArray[np.void]  # shape (n,), see :data:`.search_numba.RESULT`; comes as 0


@kernel
def load_pixel(given: Histograms, index: int, room: Pixel) -> Pixel:
    """Load the samples of a pixel; return the pixel, which shares the room's arrays."""
    centre, widest = 0, 0.0
    for j in range(given.dark.size):
        first, end = given.places[j], given.places[j + 1]
        own = load(given.counts[index, first:end], given.mask[index, first:end], room.bins[j], room.facts[j])
        own += given.origin[index, j]
        if j == 0:
            centre = own
        room.facts[j].centre = float(own - centre)
        widest = max(widest, room.facts[j].n_bins)
    return Pixel(room.bins, room.facts, room.laws, room.peaks, room.mixtures, centre, 4.0 * widest + 10.0)


@kernel(borrows=True)
def describe(pixel: Pixel, moments: FloatArray, out: Any) -> tuple[float, float]:
    """Fill moments, frames and extreme codes; return the fewest frames and the most occupied bins."""
    lowest, highest, n, least, occupied = 2**62, -(2**62), 0.0, math.inf, 0.0
    for j in range(pixel.facts.shape[0]):
        facts = pixel.facts[j]
        n += facts.n_frames
        least = min(least, facts.n_frames)
        if not facts.dark:
            occupied = max(occupied, facts.occupied)
        if facts.n_frames > 0.0:
            moments[j, 0] = pixel.centre + facts.centre + facts.mean
            moments[j, 1] = facts.variance
            first = pixel.centre + int(facts.centre + facts.first)
            lowest, highest = min(lowest, first), max(highest, first + facts.n_bins - 1)
    out.lowest_dn, out.highest_dn, out.frames = lowest, highest, int(n)
    return least, occupied


@kernel
def theta_of(parameters: FloatArray, pixel: Pixel, limits: Limits, theta: FloatArray) -> bool:
    """Fill theta, v with the rounding, from (H_1 ... H_J, g, mu, sigma); False unless they are known."""
    n = pixel.facts.shape[0]
    theta[n + px.STEP] = 0.0
    known = 0.0
    for i in range(n + 3):
        known += parameters[i]
    if not math.isfinite(known):
        return False
    for j in range(n):
        dark = pixel.facts[j].dark or not parameters[j] > 0.0
        theta[j] = limits.bound if dark else math.log(parameters[j])
    theta[n + px.STEP] = 1.0 / parameters[n]
    theta[n + px.BIAS] = parameters[n + 1] - pixel.centre
    theta[n + px.LOG_VARIANCE] = 2.0 * math.log(parameters[n + 2])
    theta[n + px.SATELLITE] = 0.0
    return True


@kernel
def _expect_information(
    pixel: Pixel, theta: FloatArray, limits: Limits, evaluate: Any, scratch: Scratch
) -> None:
    """Put the expected information in `AT_BEST`: the squared scores of the counts that are expected.

    The observed one is several times larger where peaks are not resolved, by what looks like peaks by chance.
    """
    at = scratch.evaluations[px.AT_BEST]
    for j in range(pixel.facts.shape[0]):
        copy(pixel.bins[j, px.EXPECTED], pixel.bins[j, px.WEIGHT])
    if limits.cells:
        evaluate(pixel, theta, px.DERIVATIVES, scratch, at)
    else:
        fill_squared_scores(pixel, theta, at)
    for j in range(pixel.facts.shape[0]):
        copy(at[j, px.SCORE] * 0.0, at[j, px.SCORE])
        for row in range(px.N_BLOCK):
            copy(at[j, px.DAMPING + row], at[j, px.INFORMATION + row])


@kernel
def make_room(given: Histograms, law: Law) -> Pixel:
    """Return room for the histograms of a pixel."""
    most = 0
    for j in range(given.dark.size):
        most = max(most, given.places[j + 1] - given.places[j])
    n_peaks = law.peaks.shape[3] * (1 + law.pattern.shape[0])
    n_exposures = max(law.exposures.shape[3], law.added.shape[3])
    room: Pixel = make_pixel(given.dark, most, n_peaks, n_exposures)
    return room


@kernel
def start_tile(given: Histograms, law: Law, basis: FloatArray, parameters: FloatArray) -> None:
    """Fill (H, g, mu, sigma) of single samples from the regression, shape (n, 4); they come as NaN."""
    room = make_room(given, law)
    scratch = make_scratch(1, room.bins.shape[2] - 1, False)
    theta = scratch.small[px.HERE]
    for index in range(given.counts.shape[0]):
        pixel = load_pixel(given, index, room)
        if pixel.facts[0].occupied < 3:
            continue
        if start_regression(sample_of(pixel, 0), basis, scratch.rows, theta)[0]:
            parameters[index, 0] = math.exp(theta[0])
            parameters[index, 1] = 1.0 / theta[1 + px.STEP]
            parameters[index, 2] = theta[1 + px.BIAS] + pixel.centre
            parameters[index, 3] = math.exp(0.5 * theta[1 + px.LOG_VARIANCE])


def _tile_kernel(plain: bool) -> Callable[..., None]:
    """Make the loop; ``plain``: of single samples and errors from the information, half to compile."""

    @kernel
    def _write(
        pixel: Pixel,
        theta: FloatArray,
        limits: Limits,
        scratch: Scratch,
        parameters: FloatArray,
        covariance: FloatArray,
    ) -> bool:
        """Fill parameters and covariance at a maximum; False unless the information is positive definite."""
        n, at, fixed = pixel.facts.shape[0], scratch.evaluations[px.AT_BEST], scratch.flags[px.FIXED]
        held = fixed.copy()
        floor = min_log_variance(theta[n + px.STEP], limits.cells)
        held[n + px.LOG_VARIANCE] = theta[n + px.LOG_VARIANCE] <= floor + 1e-9
        full = np.empty((n + px.N_SHARED, n + px.N_SHARED))
        regular: bool = invert_arrow(at, theta, held, full)
        if not plain and limits.sandwich and regular:
            if not limits.cells:
                fill_squared_scores(pixel, theta, at)
            enclose(at, theta, full)
        absolute = theta.copy()
        absolute[n + px.BIAS] += pixel.centre
        rounding = QUANTISATION_VARIANCE if limits.cells else 0.0
        to_natural(absolute, fixed[:n], held, rounding, full, parameters, covariance)
        if not regular:
            for row in range(n + 3):
                for column in range(n + 3):
                    covariance[row, column] = math.nan
        return regular

    @kernel
    def fit_tile(
        given: Histograms,
        chosen: IntArray,
        law: Law,
        starts: Starts,
        limits: Limits,
        evaluate: Any,
        climb: Any,
        search: Any,
        basis: FloatArray,
        answers: Answers,
    ) -> None:
        """Fit the chosen pixels with likelihood, climb and search; codes left out do not count."""
        n = given.dark.size
        room = make_room(given, law)
        scratch = make_scratch(n, room.bins.shape[2] - 1, limits.cells)
        tools = Tools(limits, evaluate, climb, basis, scratch)
        near, best = np.zeros(n + px.N_SHARED), np.zeros(n + px.N_SHARED)
        fixed = scratch.flags[px.FIXED]
        fixed[n + px.SATELLITE] = True
        for j in range(n):
            fixed[j] = given.dark[j]
        for index in chosen:
            pixel = load_pixel(given, index, room)
            out = answers.found[index]
            least, occupied = describe(pixel, answers.moments[index], out)
            out.log_likelihood = out.gap = out.chi2 = out.outlying = out.amplitude = out.weight = math.nan
            out.freedom = 0
            if least == 0.0 or occupied < 3.0:
                out.status = NO_DATA if least == 0.0 else TOO_FEW_BINS
                continue
            if limits.cells:
                resolve(law, index, 0.0, pixel)
            near[n + px.STEP], gap, scratch.used[0] = 0.0, math.inf, 0
            if starts.parameters.shape[0] > 0:
                theta_of(starts.parameters[index], pixel, limits, near)
                gap = starts.gaps[index]
            tried = starts.looked[index if starts.looked.size > 1 else 0]
            amplitudes = starts.amplitudes if tried else starts.amplitudes[:0]
            task = Task(law, index, amplitudes, near, gap)
            status = search(pixel, tools, task, best, out)
            if best[n + px.STEP] > 0.0:
                parameters, covariance = answers.parameters[index], answers.covariance[index]
                if not plain and n > 1 and nats_of_peaks(pixel, best) < SURELY_SEEN:
                    if ripple_by_chance(pixel, tools, best, out.log_likelihood):
                        status |= GAIN_AMBIGUOUS
                    if not limits.sandwich:
                        _expect_information(pixel, best, limits, evaluate, scratch)
                if not _write(pixel, best, limits, scratch, parameters, covariance):
                    status |= FIT_NOT_CONVERGED
            out.status = status

    compiled: Callable[..., None] = fit_tile
    return compiled


fit_tile, fit_plain_tile = _tile_kernel(False), _tile_kernel(True)
