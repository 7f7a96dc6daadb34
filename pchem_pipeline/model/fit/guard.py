"""The tail guard: samples that the model does not expect at all leave the likelihood.

The guarded log-likelihood of a pixel is ``sum_i c_i max(log f(x_i), log(floor / N))``: where fewer than
``floor`` frames per DN are expected, a sample costs the same wherever it lies, so it moves nothing. At a
maximum that is the likelihood of the other samples, found by leaving these out and fitting again until the
set of them stays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.arithmetic.significance import BEYOND_DOUBT
from pchem_pipeline.model.fit import guard_numba
from pchem_pipeline.model.fit.climb_numba import Limits
from pchem_pipeline.model.fit.search_numba import CHI2, FIT_NOT_CONVERGED, GAIN_NOT_IDENTIFIED, OUTLYING
from pchem_pipeline.model.fit.tile_numba import EVALUATIONS, FREEDOM, STATUS, Answers, Histograms
from pchem_pipeline.model.law.pixel_numba import COUNTED, LEFT_OUT

Pixels = NDArray[np.intp]

_MOST_PASSES = 8
# attempts: without what the fit of all samples does not expect, without the ends, without what a gap cuts off
_EXPECTED, _ENDS, _CORE, _N_ATTEMPTS = range(4)


def fit_guarded(
    fit: Callable[[Pixels, bool], None],
    leave_out: Callable[[Pixels, NDArray[np.float64]], NDArray[np.bool_]],
    given: Histograms,
    limits: Limits,
    answers: Answers,
) -> None:
    """Fit all pixels, those that may hold outliers again and again.

    A good fit of all samples says itself which it does not expect. Otherwise both ends of the histograms are
    left out first, as much of them as may be outliers; where that says nothing, the samples that a gap cuts
    off. What these parameters expect then comes back, until the samples left out stay the same. Where that
    fails, or where they are too many to be a few outliers, it is the fit of all samples, which is not fitted
    twice. What is left after a cut only has to say what it expects, and is fitted quickly.

    Args:
        fit: fits some pixels; quickly (True): the first maximum that tells the gain will do.
        leave_out: leaves out what the last fit does not expect: from the number left out before, which it
            updates, to whether they are others.
        given: histograms; codes that are left out before stay so at first; out: those left out at last.
        limits: bounds and limits.
        answers: what the fit fills; out: ``OUTLYING``, the samples left out.
    """
    n = given.counts.shape[0]
    everything = np.arange(n)
    if limits.floor == 0.0:
        fit(everything, False)
        answers.out[:, OUTLYING] = 0.0
        return
    counters = np.zeros(n), np.zeros(n, np.int64), np.zeros(n, np.int64), np.full(n, -1)
    guard = _Guard(fit, leave_out, given, limits, answers, answers, *counters)
    left = given.mask == LEFT_OUT
    resumed = left.any(axis=1)
    guard_numba.cut_tile(given, everything, 0.0, np.empty((0, 0), np.uint8), guard.gone)
    far = guard.gone > 0
    guard.gone[:] = (given.counts * left).sum(axis=1) if resumed.any() else 0.0
    fit(np.flatnonzero(~far | resumed), False)
    good = (_scores(answers) <= BEYOND_DOUBT) | limits.cells
    suspicious = ~far & ~resumed & guard.suspicious(everything)
    guard.keep(np.flatnonzero(suspicious))
    answers.out[~far & ~suspicious & ~resumed, OUTLYING] = 0.0
    guard.attempt[:] = np.where(resumed | far | ~good, _EXPECTED, _EXPECTED - 1)
    again, stuck = guard.check(np.flatnonzero(resumed), far)
    stuck = np.concatenate([stuck, np.flatnonzero(far & ~resumed | suspicious)])
    while again.size or stuck.size:
        active = np.sort(np.concatenate([again, guard.begin(stuck, far)]))
        guard.fit_again(active)
        again, stuck = guard.check(active, far)


@dataclass
class _Guard:
    """What the tail guard knows of n pixels, and works with.

    Attributes:
        fit, leave_out, given, limits, answers: see :func:`fit_guarded`.
        whole: answers for some pixels, all their samples counted.
        gone: samples left out.
        attempt, passes: the attempt, and fits of it.
        place: in ``whole``; -1: not there.
    """

    fit: Callable[[Pixels, bool], None]
    leave_out: Callable[[Pixels, NDArray[np.float64]], NDArray[np.bool_]]
    given: Histograms
    limits: Limits
    answers: Answers
    whole: Answers
    gone: NDArray[np.float64]
    attempt: NDArray[np.int64]
    passes: NDArray[np.int64]
    place: NDArray[np.int64]

    def keep(self, pixels: Pixels) -> None:
        """Keep the answers of pixels of which all samples were fitted."""
        self.whole = Answers._make(each[pixels] for each in self.answers)
        self.place[pixels] = np.arange(pixels.size)

    def fit_again(self, pixels: Pixels) -> None:
        """Fit what the mask leaves of pixels, all of whose samples are not fitted twice."""
        known = (self.place[pixels] >= 0) & (self.gone[pixels] == 0)
        spent = self.answers.words[pixels[known], EVALUATIONS]
        for each, of_all in zip(self.answers, self.whole, strict=True):
            each[pixels[known]] = of_all[self.place[pixels[known]]]
        self.answers.words[pixels[known], EVALUATIONS] = spent
        pixels = pixels[~known]
        quick = self._cut(pixels)
        for some, quickly in ((pixels[quick], True), (pixels[~quick], False)):
            if some.size:
                self.fit(some, quickly)

    def _cut(self, pixels: Pixels) -> NDArray[np.bool_]:
        """Tell which pixels have just had their ends, or what a gap cuts off, left out."""
        cut = (self.attempt[pixels] == _ENDS) | (self.attempt[pixels] == _CORE)
        return np.asarray(cut & (self.passes[pixels] == 0))

    def suspicious(self, pixels: Pixels) -> NDArray[np.bool_]:
        """Tell which fits may have been led by outliers: by single samples or as a whole."""
        out = self.answers.out[pixels]
        fitted = np.isfinite(self.answers.parameters[pixels]).all(axis=1) & np.isfinite(out[:, OUTLYING])
        # of such a goodness of fit outliers may be to blame
        misfit = (_scores(self.answers)[pixels] > BEYOND_DOUBT) & (not self.limits.cells)
        return np.asarray(fitted & ((out[:, OUTLYING] > 0) | misfit))

    def begin(self, pixels: Pixels, far: NDArray[np.bool_]) -> Pixels:
        """Leave out what the next attempt says, or the first that leaves out few enough; return pixels."""
        begun = [pixels[:0]]
        while pixels.size:
            self.attempt[pixels] += 1
            if self.limits.cells:  # the density has tried the others
                self.attempt[pixels[self.attempt[pixels] > _EXPECTED]] = _N_ATTEMPTS
            self.attempt[pixels[(self.attempt[pixels] == _CORE) & ~far[pixels]]] += 1
            self.passes[pixels] = 0
            for attempt, share in ((_ENDS, self.limits.most_outliers), (_CORE, 0.0)):
                some = pixels[self.attempt[pixels] == attempt]
                guard_numba.cut_tile(self.given, some, share, self.given.mask, self.gone)
            some = pixels[self.attempt[pixels] == _EXPECTED]
            self.gone[some] = 0.0
            self.leave_out(some, self.gone)
            last = pixels[self.attempt[pixels] == _N_ATTEMPTS]
            mask = self.given.mask[last]
            self.given.mask[last] = np.where(mask == LEFT_OUT, np.uint8(COUNTED), mask)
            self.gone[last] = 0.0
            few = self._few(pixels)
            begun.append(pixels[few])
            pixels = pixels[~few]
        return np.concatenate(begun)

    def check(self, pixels: Pixels, far: NDArray[np.bool_]) -> tuple[Pixels, Pixels]:
        """Settle the fits that stand; return those that another pass may settle, and those that none will."""
        answers, last = self.answers, self.attempt[pixels] == _N_ATTEMPTS
        lost = pixels[last & far[pixels] & self.suspicious(pixels)]
        # only far samples speak for a gain, and it does not explain them
        answers.words[lost, STATUS] |= GAIN_NOT_IDENTIFIED
        answers.out[pixels[last], OUTLYING] = 0.0
        pixels = pixels[~last]
        failed = (answers.words[pixels, STATUS] & (FIT_NOT_CONVERGED | GAIN_NOT_IDENTIFIED)) != 0
        failed |= ~np.isfinite(answers.out[pixels, OUTLYING])
        stuck, pixels = pixels[failed], pixels[~failed]
        before = self.gone[pixels]
        changed = self.leave_out(pixels, self.gone) | self._cut(pixels)
        answers.out[pixels[~changed], OUTLYING] = before[~changed]
        pixels = pixels[changed]
        self.passes[pixels] += 1
        more = (self.passes[pixels] < _MOST_PASSES) & self._few(pixels)
        return pixels[more], np.concatenate([stuck, pixels[~more]])

    def _few(self, pixels: Pixels) -> NDArray[np.bool_]:
        total = self.given.counts[pixels].sum(axis=1, dtype=np.float64)
        return np.asarray(self.gone[pixels] <= self.limits.most_outliers * total)


def _scores(answers: Answers) -> NDArray[np.float64]:
    """Return the goodness of fit of all pixels as standard normal deviates; 0 without freedom."""
    freedom = np.maximum(answers.words[:, FREEDOM], 1)
    spread = 2.0 / (9.0 * freedom)
    deviate = (np.cbrt(answers.out[:, CHI2] / freedom) - (1.0 - spread)) / np.sqrt(spread)
    return np.where(answers.words[:, FREEDOM] > 0, deviate, 0.0)
