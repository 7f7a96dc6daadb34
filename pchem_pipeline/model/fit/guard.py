"""Samples that leave the likelihood: codes that are set aside, and what the tail guard finds.

The tail guard leaves out samples that the model does not expect at all. Its log-likelihood of a pixel is
``sum_i c_i max(log f(x_i), log(floor / N))``: where fewer than ``floor`` frames per DN are expected, a sample
costs the same wherever it lies, so it moves nothing. At a maximum that is the likelihood of the other
samples, found by leaving these out and fitting again until the set of them stays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IndexArray, IntArray, IntegerArray
from pchem_pipeline.model.arithmetic.significance import BEYOND_DOUBT
from pchem_pipeline.model.arithmetic.statistics import chi_square
from pchem_pipeline.model.fit import guard_numba
from pchem_pipeline.model.fit.climb_numba import Limits
from pchem_pipeline.model.fit.search_numba import FIT_NOT_CONVERGED, GAIN_NOT_IDENTIFIED
from pchem_pipeline.model.fit.tile_numba import Answers, Histograms
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.pcd import pcd
from pchem_pipeline.model.law.pixel_numba import COUNTED, LEFT_OUT, SET_ASIDE
from pchem_pipeline.model.law.sample_law import SampleLaw

#: Limits of codes that are set aside on a pixel's comb, e-; None: no limit.
Interval = tuple[float | None, float | None]

_MOST_PASSES = 8
# attempts: without what the fit of all samples does not expect, without the ends, without what a gap cuts off
_EXPECTED, _ENDS, _CORE, _N_ATTEMPTS = range(4)


def electrons_of(origin: IntegerArray, width: int, gain: FloatArray, bias: FloatArray) -> FloatArray:
    """Return the place ``(x - mu) g`` of every code on its pixel's comb, e-, shape (n, width)."""
    codes = np.asarray(origin, np.int64)[:, None] + np.arange(width)
    return np.asarray((codes - bias[:, None]) * gain[:, None])


def inside(intervals: Sequence[Interval], electrons: FloatArray) -> BoolArray:
    """Return which places on the comb lie in one of the intervals."""
    found = np.zeros(electrons.shape, np.bool_)
    for low, high in intervals:
        above = electrons >= (-np.inf if low is None else low)
        found |= above & (electrons < (np.inf if high is None else high))
    return found


def far_samples(given: Histograms) -> tuple[IntArray, BoolArray]:
    """Return ends of the bins that no gap cuts off, (n, J, 2), and which pixels have samples beyond, (n,)."""
    n = given.counts.shape[0]
    ends, far = np.empty((n, given.dark.size, 2), np.int64), np.empty(n, np.bool_)
    guard_numba.find_cores(given, ends, far)
    return ends, far


def expected_counts(
    given: Histograms,
    pixels: IndexArray,
    laws: Sequence[SampleLaw] | None,
    parameters: FloatArray,
    satellites: FloatArray,
    left_out: FloatArray,
) -> FloatArray:
    """Return the samples expected in each occupied bin of m pixels, shape (m, all bins).

    Under laws of the samples, the cells integrated, or the density of the PCD (None): with (H_1 ... H_J, g,
    mu, sigma), (m, J + 3), amplitude (e-) and weight of free satellites, (m, 2), and the number of samples
    that the likelihood of these parameters left out, (m,).
    """
    counts, kept = given.counts[pixels], given.mask[pixels] != SET_ASIDE
    counts = counts if kept.all() else np.where(kept, counts, 0)
    total, found = counts.sum(axis=1, dtype=np.float64), np.zeros(counts.shape)
    for j in range(given.dark.size):
        part = slice(given.places[j], given.places[j + 1])
        own, first = [parameters[:, j], *parameters[:, -3:].T], given.origin[pixels, j]
        if laws is None:
            row, code = np.nonzero(counts[:, part])
            found[row, part.start + code] = pcd(first[row] + code, *(each[row] for each in own))
        else:
            codes, free = first[:, None] + np.arange(part.stop - part.start), tuple(satellites.T)
            mass = sample_mass(laws[j].of(pixels), own, codes, satellites=free, smallest=1e-50)
            aside = ~kept[:, part].all(axis=1, keepdims=True)  # the likelihood is given the others
            inside = np.where(kept[:, part], mass, 0.0).sum(axis=1, keepdims=True)
            found[:, part] = np.where(aside, mass / inside, mass)
        frames = counts[:, part].sum(axis=1, dtype=np.float64) * (1.0 - left_out / total)
        found[:, part] *= frames[:, None]
    return found


def leave_out(given: Histograms, pixels: IndexArray, outside: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Leave out the samples of m pixels in the bins ``outside``, (m, all bins), and count all others.

    The mask of the histograms is updated; what is set aside stays so.

    Returns:
        How many samples are left out, and whether these are others than before, shape (m,) each.
    """
    counts, mask = given.counts[pixels], given.mask[pixels]
    gone = outside & (counts > 0) & (mask != SET_ASIDE)
    changed = ((gone != (mask == LEFT_OUT)) & (counts > 0)).any(axis=1)
    given.mask[pixels] = np.where(mask == SET_ASIDE, mask, np.where(gone, LEFT_OUT, COUNTED))
    return np.where(gone, counts, 0).sum(axis=1, dtype=np.float64), changed


def fit_guarded(
    fit: Callable[[IndexArray, bool], None],
    expect: Callable[[IndexArray, FloatArray], FloatArray],
    given: Histograms,
    limits: Limits,
    answers: Answers,
) -> None:
    """Fit all pixels, those that may hold outliers again and again.

    A good fit of all samples says itself which it does not expect. Otherwise both ends of the histograms are
    left out first, as much of them as may be outliers; where that fails, the samples that a gap cuts off.
    What these parameters expect then comes back, until the samples left out stay the same. Where that fails,
    or where they are too many to be a few outliers, the fit of all samples is kept.

    Args:
        fit: fits some pixels; quickly (True): the first maximum that tells the gain will do.
        expect: the samples that the last fit expects in each bin, see :func:`expected_counts`, from how many
            it left out.
        given: histograms; codes that are left out before stay so at first; out: those left out at last.
        limits: bounds and limits.
        answers: what the fit fills; out: ``outlying``, the samples left out.
    """
    n = given.counts.shape[0]
    everything = np.arange(n)
    if limits.floor == 0.0:
        fit(everything, False)
        answers.found["outlying"] = 0.0
        return
    counters = np.zeros(n), np.zeros(n, np.int64), np.zeros(n, np.int64), np.full(n, -1)
    ends, far = far_samples(given)
    guard = _Guard(fit, expect, given, limits, ends, answers, answers, *counters)
    left = given.mask == LEFT_OUT
    resumed = left.any(axis=1)
    guard.gone[resumed] = (given.counts[resumed] * left[resumed]).sum(axis=1)
    fit(np.flatnonzero(~far | resumed), False)
    good = (_scores(answers) <= BEYOND_DOUBT) | limits.cells
    suspicious = ~far & ~resumed & guard.suspicious(everything)
    guard.whole = Answers._make(each[suspicious] for each in answers)
    guard.place[suspicious] = np.arange(np.count_nonzero(suspicious))
    answers.found["outlying"][~far & ~suspicious & ~resumed] = 0.0
    guard.attempt[:] = np.where(resumed | far | ~good, _EXPECTED, _EXPECTED - 1)
    again, stuck = guard.check(np.flatnonzero(resumed), far)
    stuck = np.concatenate([stuck, np.flatnonzero(far & ~resumed | suspicious)])
    while again.size or stuck.size:
        active = np.sort(np.concatenate([again, guard.begin(stuck, far)]))
        guard.fit_again(active)
        again, stuck = guard.check(active, far)


@dataclass
class _Guard:
    """What the tail guard knows of n pixels, and works with; see :func:`fit_guarded`."""

    fit: Callable[[IndexArray, bool], None]
    expect: Callable[[IndexArray, FloatArray], FloatArray]
    given: Histograms
    limits: Limits
    ends: IntArray  # of the bins that no gap cuts off, shape (n, J, 2)
    answers: Answers
    whole: Answers  # for some pixels, all their samples counted
    gone: FloatArray  # samples left out
    attempt: IntArray
    passes: IntArray  # fits of the attempt
    place: IntArray  # in ``whole``; -1: not there

    def fit_again(self, pixels: IndexArray) -> None:
        """Fit what the mask leaves of pixels, all of whose samples are not fitted twice."""
        known = (self.place[pixels] >= 0) & (self.gone[pixels] == 0)
        spent = self.answers.found["evaluations"][pixels[known]]
        for each, of_all in zip(self.answers, self.whole, strict=True):
            each[pixels[known]] = of_all[self.place[pixels[known]]]
        self.answers.found["evaluations"][pixels[known]] = spent
        pixels = pixels[~known]
        quick = self._cut(pixels)
        for some, quickly in ((pixels[quick], True), (pixels[~quick], False)):
            if some.size:
                self.fit(some, quickly)

    def _cut(self, pixels: IndexArray) -> BoolArray:
        """Return which pixels have just had their ends, or what a gap cuts off, left out."""
        cut = (self.attempt[pixels] == _ENDS) | (self.attempt[pixels] == _CORE)
        return np.asarray(cut & (self.passes[pixels] == 0))

    def suspicious(self, pixels: IndexArray) -> BoolArray:
        """Return which fits may have been led by outliers: by single samples or as a whole."""
        outlying = self.answers.found["outlying"][pixels]
        fitted = np.isfinite(self.answers.parameters[pixels]).all(axis=1) & np.isfinite(outlying)
        # of such a goodness of fit outliers may be to blame
        misfit = (_scores(self.answers)[pixels] > BEYOND_DOUBT) & (not self.limits.cells)
        return np.asarray(fitted & ((outlying > 0) | misfit))

    def begin(self, pixels: IndexArray, far: BoolArray) -> IndexArray:
        """Leave out what the next attempt says, or the first that leaves out few enough; return pixels."""
        begun = [pixels[:0]]
        while pixels.size:
            self.attempt[pixels] += 1
            if self.limits.cells:  # the density has tried the others
                self.attempt[pixels[self.attempt[pixels] > _EXPECTED]] = _N_ATTEMPTS
            self.attempt[pixels[(self.attempt[pixels] == _CORE) & ~far[pixels]]] += 1
            self.passes[pixels] = 0
            for attempt in range(_EXPECTED, _N_ATTEMPTS + 1):
                some = pixels[self.attempt[pixels] == attempt]
                if attempt == _EXPECTED:
                    self.gone[some] = 0.0  # of the fit of all samples
                    self._leave_out_unexpected(some)
                else:
                    self.gone[some], _ = leave_out(self.given, some, self._outside(some, attempt))
            few = self._few(pixels)
            begun.append(pixels[few])
            pixels = pixels[~few]
        return np.concatenate(begun)

    def _outside(self, pixels: IndexArray, attempt: int) -> BoolArray:
        """Return which bins an attempt leaves out: both ends, what a gap cuts off, or none."""
        counts = self.given.counts[pixels]
        outside = np.zeros(counts.shape, np.bool_)
        for j in range(self.given.dark.size if attempt < _N_ATTEMPTS else 0):
            part = slice(self.given.places[j], self.given.places[j + 1])
            if attempt == _CORE:
                low, end = self.ends[pixels, j, :, None].swapaxes(0, 1)
                place = np.arange(part.stop - part.start)
                outside[:, part] = (place < low) | (place >= end)
            else:
                upto = np.cumsum(counts[:, part], axis=1, dtype=np.float64)
                before, total = upto - counts[:, part], upto[:, -1:]
                cut = 0.5 * self.limits.most_outliers * total
                outside[:, part] = (upto <= cut) | (total - before <= cut)
        return outside

    def _leave_out_unexpected(self, pixels: IndexArray) -> BoolArray:
        """Leave out the samples that the last fit does not expect; tell where these are others."""
        outside = self.expect(pixels, self.gone[pixels]) < self.limits.floor
        self.gone[pixels], changed = leave_out(self.given, pixels, outside)
        return changed

    def check(self, pixels: IndexArray, far: BoolArray) -> tuple[IndexArray, IndexArray]:
        """Settle the fits that stand; return those that another pass may settle, and those that none will."""
        answers, last = self.answers, self.attempt[pixels] == _N_ATTEMPTS
        lost = pixels[last & far[pixels] & self.suspicious(pixels)]
        # only far samples speak for a gain, and it does not explain them
        answers.found["status"][lost] |= GAIN_NOT_IDENTIFIED
        answers.found["outlying"][pixels[last]] = 0.0
        pixels = pixels[~last]
        failed = (answers.found["status"][pixels] & (FIT_NOT_CONVERGED | GAIN_NOT_IDENTIFIED)) != 0
        failed |= ~np.isfinite(answers.found["outlying"][pixels])
        stuck, pixels = pixels[failed], pixels[~failed]
        before = self.gone[pixels]
        changed = self._leave_out_unexpected(pixels) | self._cut(pixels)
        answers.found["outlying"][pixels[~changed]] = before[~changed]
        pixels = pixels[changed]
        self.passes[pixels] += 1
        more = (self.passes[pixels] < _MOST_PASSES) & self._few(pixels)
        return pixels[more], np.concatenate([stuck, pixels[~more]])

    def _few(self, pixels: IndexArray) -> BoolArray:
        total = self.given.counts[pixels].sum(axis=1, dtype=np.float64)
        return np.asarray(self.gone[pixels] <= self.limits.most_outliers * total)


def _scores(answers: Answers) -> FloatArray:
    """Return the goodness of fit of all pixels as standard normal deviates; 0 without freedom."""
    freedom = answers.found["freedom"]
    return np.where(freedom > 0, chi_square(answers.found["chi2"], np.maximum(freedom, 1)), 0.0)
