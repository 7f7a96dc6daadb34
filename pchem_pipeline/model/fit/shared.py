"""Maximum likelihood of the pixels' four parameters together with parameters that all pixels share.

Scoring steps (Fisher 1935) with a damping (Levenberg 1944) on the exact masses of the codes
(:func:`~pchem_pipeline.model.law.mass.sample_mass`); derivatives in what the pixels share are differences
of masses, so any law will do. The information matrix has an arrow shape, a 4 x 4 block per pixel and one
border for what they share, so a step costs no more than the pixels' own.

Codes may be left out, pixel by pixel: the likelihood is then conditional on the other codes, so that what is
not understood in one place (a cut, a contamination) does not bend the parameters found in another.

A pixel may have several samples (exposures): they share g, mu and sigma, and each has an exposure of its own,
or all lie in proportion to their integration times (:class:`Samples`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray, IntegerArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.law.mass import LEAST_SEEN, sample_mass, sample_slopes, score_and_information
from pchem_pipeline.model.law.sample_law import SampleLaw

#: From the shared parameters (d,) and the pixels' (H, g, mu, sigma), shape (n, 4), to their law.
Law = Callable[[FloatArray, FloatArray], SampleLaw]

_STEP = 1e-5  # of the differences, in units of the parameters' natural scale
_REACH_EXPOSURE, _REACH_STEP = 2.0, 0.3  # logarithms
_LOG_16 = float(np.log(16.0))  # a read noise of a quarter of a step
LOWEST_LOG_VARIANCE = float(np.log(1e-4))
_FIRST_DAMPING, _LARGEST_DAMPING = 1e-3, 1e8
_NO_ELECTRONS = 1e-9  # e-: the exposure of a sample without any


@dataclass(frozen=True)
class Samples:
    """The samples of a pixel: each is a row of the histograms, the rows of a pixel follow one another.

    With J samples, P = J + 3 own parameters: (log H_1, ..., log H_J, log 1/g, mu, log sigma_R^2). With times,
    ``H_j = D t_j`` and P = 4: (log D, log 1/g, mu, log sigma_R^2), D in e-/px/s.

    Attributes:
        dark: samples without electrons, H = 0.
        times: integration times, s; None: every sample has an exposure of its own.
    """

    dark: tuple[bool, ...] = (False,)
    times: tuple[float, ...] | None = None

    @property
    def n(self) -> int:
        """Number of samples of a pixel, J."""
        return len(self.dark)

    def illuminated(self, n_rows: int) -> BoolArray:
        """Return which rows are of samples with electrons, shape (n_rows,)."""
        return np.asarray(np.tile(~np.array(self.dark), n_rows // self.n))

    @property
    def n_exposures(self) -> int:
        """Own parameters that are exposures."""
        return self.n if self.times is None else 1

    @property
    def n_free(self) -> int:
        """Own parameters that are fitted."""
        return int(self.slopes.any(axis=(0, 1)).sum())

    @property
    def slopes(self) -> FloatArray:
        """Derivatives of (log H, log 1/g, mu, log sigma_R^2) of each row in the own parameters, (J, 4, P)."""
        m = self.n_exposures
        found = np.zeros((self.n, 4, m + 3))
        for j in range(self.n):
            found[j, 0, 0 if self.times is not None else j] = 0.0 if self._empty(j) else 1.0
            found[j, 1:, m:] = np.eye(3)
        return found

    def _empty(self, j: int) -> bool:
        return self.dark[j] or (self.times is not None and self.times[j] == 0.0)

    def rows(self, theta: FloatArray) -> FloatArray:
        """Return (log H, log 1/g, mu, log sigma_R^2) of the rows, (n J, 4), of own parameters (n, P)."""
        found = np.einsum("jap,np->nja", self.slopes, theta)
        for j, time in enumerate(self.times or self.n * (1.0,)):
            found[:, j, 0] += np.log(_NO_ELECTRONS if self._empty(j) else time)
        return np.asarray(found.reshape(-1, 4))

    def theta(self, parameters: FloatArray) -> FloatArray:
        """Return own parameters (n, P) of (H, g, mu, sigma), (n J, 4); g, mu, sigma of the first sample."""
        by_sample = to_theta(parameters).reshape(-1, self.n, 4)
        exposures = by_sample[:, :, 0]
        if self.times is not None:
            lit = [j for j in range(self.n) if not self._empty(j)]
            total = np.exp(exposures[:, lit]).sum(axis=1) / sum(self.times[j] for j in lit)
            exposures = np.log(total)[:, None]
        return np.concatenate([exposures, by_sample[:, 0, 1:]], axis=1)

    def by_pixel(self, information: FloatArray, score: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return information and score in own and shared parameters: (n, P + d, P + d) and (n, P + d).

        Those given are of the rows, own parameters first, shapes (n J, 4 + d, 4 + d) and (n J, 4 + d).
        """
        more = score.shape[1] - 4
        slopes = np.zeros((self.n, 4 + more, self.n_exposures + 3 + more))
        slopes[:, :4, : self.n_exposures + 3] = self.slopes
        slopes[:, 4:, self.n_exposures + 3 :] = np.eye(more)
        by_sample = information.reshape(-1, self.n, *information.shape[1:])
        whole = np.einsum("jap,njab,jbq->npq", slopes, by_sample, slopes, optimize=True)
        # an exposure that is held gets no score, and so no step, whatever its information
        held = np.flatnonzero(~slopes.any(axis=(0, 1)))
        whole[:, held, held] = 1.0
        return whole, np.einsum("jap,nja->np", slopes, score.reshape(-1, self.n, 4 + more))


@dataclass(frozen=True)
class SharedProblem:
    """Histograms and the law that they are to follow."""

    counts: IntegerArray  # histograms, shape (n, B); n counts the samples of all pixels
    origin: IntArray  # DN of bin 0, shape (n,)
    kept: BoolArray  # codes that count, shape (n, B)
    law: Law  # from shared and own parameters to the law of the rows
    bounds: FloatArray  # lowest and highest value of each shared parameter, shape (d, 2)
    scale: FloatArray  # natural scale of each shared parameter, shape (d,)
    samples: Samples = field(default_factory=Samples)  # which rows are of one pixel

    def masses(self, theta: FloatArray, shared: FloatArray) -> FloatArray:
        """Return the mass of every code, those left out included, shape (n, B)."""
        own = to_parameters(self.samples.rows(theta))
        codes = self.origin[:, None] + np.arange(self.counts.shape[1])
        return sample_mass(self.law(shared, own), list(own.T), codes, smallest=1e-50)

    def log_masses(self, theta: FloatArray, shared: FloatArray) -> FloatArray:
        """Return the logarithm of the mass given that the code is kept, shape (n, B); 0 where it is not."""
        mass = np.where(self.kept, self.masses(theta, shared), 0.0)
        inside = np.maximum(mass.sum(axis=1, keepdims=True), LEAST_SEEN)
        return np.where(self.kept, np.log(np.maximum(mass, LEAST_SEEN) / inside), 0.0)

    def slopes(self, theta: FloatArray, shared: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the log masses, (n, B), and their derivatives, own four parameters first, (n, 4 + d, B).

        Raises:
            ValueError: fields of the law do not go together.
        """
        base, own = self.log_masses(theta, shared), to_parameters(self.samples.rows(theta))
        n, width = base.shape
        slopes = np.zeros((n, 4 + shared.size, width))
        mass, found = sample_slopes(self.law(shared, own), list(own.T), self.origin, width)
        found[:, 1] /= own[:, 1:2]  # of the logarithm of 1/g
        kept = self.kept[:, None, :]
        inside = np.where(self.kept, mass, 0.0).sum(axis=1)
        change = np.where(kept, found, 0.0).sum(axis=2) / np.maximum(inside, LEAST_SEEN)[:, None]
        relative = found / np.maximum(mass, LEAST_SEEN)[:, None, :] - change[:, :, None]
        slopes[:, :4] = np.where(kept & (mass > LEAST_SEEN)[:, None, :], relative, 0.0)
        for index, (scale, (_, highest)) in enumerate(zip(self.scale, self.bounds, strict=True)):
            moved, step = shared.copy(), _STEP * scale
            step = -step if moved[index] + step > highest else step
            moved[index] += step
            slopes[:, 4 + index] = (self.log_masses(theta, moved) - base) / step
        return base, slopes

    def expansion(self, log_masses: FloatArray, derivatives: FloatArray) -> Expansion:
        """Return the log-likelihood of each pixel to second order, where the law has these slopes."""
        seen, mass = np.where(self.kept, self.counts, 0), np.where(self.kept, np.exp(log_masses), 0.0)
        score, information = score_and_information(derivatives, mass, seen)
        information, score = self.samples.by_pixel(information, score)
        value = (seen * log_masses).sum(axis=1).reshape(-1, self.samples.n).sum(axis=1)
        return Expansion(value, score, information)


@dataclass(frozen=True)
class SharedFit:
    """Estimates of own and shared parameters.

    Attributes:
        theta: own parameters of the pixels (see :class:`Samples`), shape (n, P).
        shared: shared parameters, shape (d,).
        own_covariance: of the own parameters, the shared ones taken as known, shape (n, P, P).
        covariance: of the shared parameters, shape (d, d), from the information; NaN for one at its bound.
        log_likelihood: nats, shape (n,).
        converged: whether the rise that a further step promises is below the tolerance.
        samples: which rows are of one pixel.
    """

    theta: FloatArray
    shared: FloatArray
    own_covariance: FloatArray
    covariance: FloatArray
    log_likelihood: FloatArray
    converged: bool
    samples: Samples = field(default_factory=Samples)

    @property
    def parameters(self) -> FloatArray:
        """(H, g, mu, sigma) of the rows, shape (n J, 4); e-, e-/DN, DN, DN."""
        return to_parameters(self.samples.rows(self.theta))

    @property
    def stderr(self) -> FloatArray:
        """Standard errors of the parameters of the rows, shape (n J, 4)."""
        slopes = self.samples.slopes
        found = np.einsum("jap,npq,jaq->nja", slopes, self.own_covariance, slopes, optimize=True)
        h, g, _, sigma = self.parameters.T
        per = np.stack([h, g, np.ones_like(h), 0.5 * (sigma - QUANTISATION_VARIANCE / sigma)], axis=1)
        return np.asarray(np.sqrt(np.maximum(found.reshape(-1, 4), 0.0)) * per)


def to_parameters(theta: FloatArray) -> FloatArray:
    """Return (H, g, mu, sigma), shape (n, 4), of (log H, log 1/g, mu, log sigma_R^2)."""
    variance = np.exp(theta[:, 3]) + QUANTISATION_VARIANCE
    return np.stack([np.exp(theta[:, 0]), np.exp(-theta[:, 1]), theta[:, 2], np.sqrt(variance)], axis=1)


def to_theta(parameters: FloatArray) -> FloatArray:
    """Return (log H, log 1/g, mu, log sigma_R^2), shape (n, 4), of (H, g, mu, sigma)."""
    h, g, mu, sigma = parameters.T
    analog = np.maximum(sigma**2 - QUANTISATION_VARIANCE, 0.05 * sigma**2)
    return np.stack([np.log(np.maximum(h, 1e-6)), -np.log(g), mu, np.log(analog)], axis=1)


def fit_shared(
    problem: SharedProblem,
    parameters: FloatArray,
    shared: FloatArray,
    *,
    max_steps: int = 60,
    tolerance: float = 1e-3,
) -> SharedFit:
    """Climb the likelihood from a start until a step promises a rise, nats, below the tolerance.

    The start is (H, g, mu, sigma) of the rows, shape (n J, 4), finite, with g, mu and sigma of the first
    sample of a pixel, and the shared parameters, shape (d,).
    """
    theta = problem.samples.theta(parameters)
    shared = np.clip(np.asarray(shared, np.float64), problem.bounds[:, 0], problem.bounds[:, 1])
    limits = _limits(theta, problem.samples.n_exposures)

    def expand(theta: FloatArray, shared: FloatArray, rows: IntArray) -> Expansion:
        return problem.expansion(*problem.slopes(theta, shared)).of(rows)

    start = expand(theta, shared, np.arange(len(theta)))
    ascent = Ascent(theta, shared, start, problem.bounds, problem.scale)
    arrived = ascent.climb(expand, limits, limits[1] - limits[0], max_steps, tolerance)
    own, common = ascent.covariance()
    value = ascent.expansion.value
    return SharedFit(ascent.theta, ascent.shared, own, common, value, arrived, problem.samples)


@dataclass
class Expansion:
    """A function of own parameters (n, P) and shared ones (d,) about a point, to second order."""

    value: FloatArray  # of each pixel, shape (n,)
    score: FloatArray  # its gradient, own parameters first, shape (n, P + d)
    information: FloatArray  # the curvature with the opposite sign, as expected, shape (n, P + d, P + d)

    def of(self, pixels: Any) -> Expansion:
        """Return that of some pixels, by any index."""
        return Expansion(self.value[pixels], self.score[pixels], self.information[pixels])

    def shaped(self, *shape: int) -> Expansion:
        """Return it with the pixels in another order of axes, from shape (n, ...) or (j, n, ...)."""
        p = self.score.shape[-1]
        score, information = self.score.reshape(*shape, p), self.information.reshape(*shape, p, p)
        return Expansion(self.value.reshape(shape), score, information)

    def put(self, pixels: Any, other: Expansion) -> None:
        """Replace that of some pixels, by any index."""
        for old, new in zip(vars(self).values(), vars(other).values(), strict=True):
            old[pixels] = new


@dataclass
class Ascent:
    """Damped scoring steps (Fisher 1935; Levenberg 1944; Marquardt 1963) that never lead down.

    Without shared parameters the pixels are independent, and each has a damping of its own.

    Attributes:
        theta: own parameters, shape (n, P).
        shared: shared parameters, shape (d,).
        expansion: of the function that is to be maximised, there.
        bounds: lowest and highest value of each shared parameter, shape (d, 2).
        scale: natural scale of each shared parameter, shape (d,).
    """

    theta: FloatArray
    shared: FloatArray
    expansion: Expansion
    bounds: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    scale: FloatArray = field(default_factory=lambda: np.zeros(0))

    def climb(
        self,
        expand: Callable[[FloatArray, FloatArray, IntArray], Expansion],
        limits: tuple[FloatArray, FloatArray],
        longest: FloatArray,
        max_steps: int,
        tolerance: float,
    ) -> bool:
        """Go up, and return whether the rise of all pixels that a further step promises is small enough.

        A point (theta, shared) whose expansion raises ValueError is refused. The limits are the lowest and
        highest own parameters, (n, P); a step that is longer than the longest, (n, P), is shortened.
        """
        n, together = len(self.theta), self.shared.size > 0
        damping, promised = np.full(n, _FIRST_DAMPING), np.full(n, np.inf)
        for _ in range(max_steps):
            step, shared_step, promised = self.step(damping)
            active = (promised.sum() >= tolerance) & (damping < _LARGEST_DAMPING)
            if not together:
                active &= promised >= tolerance / n
            rows = np.flatnonzero(active)
            if rows.size == 0:
                break
            step /= np.maximum(1.0, (np.abs(step) / longest).max(axis=1, keepdims=True))
            theta = np.where(active[:, None], np.clip(self.theta + step, *limits), self.theta)
            reach = np.abs(self.shared) + self.scale
            shared = np.clip(self.shared + np.clip(shared_step, -reach, reach), *self.bounds.T)
            try:
                new = expand(theta, shared, rows)
            except ValueError:
                better = np.zeros(rows.size, np.bool_)
            else:
                rise = new.value - self.expansion.value[rows]
                better = np.full(rows.size, rise.sum() > 0.0) if together else rise > 0.0
            damping[rows] = np.where(better, damping[rows] / 10.0, 10.0 * damping[rows] + 1.0)
            if better.any():
                took = rows[better]
                self.theta[took], self.shared = theta[took], shared
                self.expansion.put(took, new.of(better))
        return bool(promised.sum() < tolerance)

    def step(self, damping: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the steps of own and shared parameters, and the rise promised in each pixel."""
        score, free = self.expansion.score[:, : self.theta.shape[1]], self._free
        inverse, through, schur = self._reduced(damping)
        own = np.einsum("nab,nb->na", inverse, score)
        shared = np.zeros(self.shared.size)
        if free.any():
            right = self._shared_score[free] - np.einsum("nad,na->d", through, score)
            shared[free] = np.linalg.lstsq(schur, right, rcond=1e-12)[0]
            own -= np.einsum("nad,d->na", through, shared[free])
        promised = 0.5 * (own * score).sum(axis=1)
        return own, shared, promised + 0.5 * float(shared[free] @ self._shared_score[free]) / promised.size

    def covariance(self) -> tuple[FloatArray, FloatArray]:
        """Return covariances of own, (n, P, P), and of shared parameters, (d, d), NaN for those at bounds.

        That of the own parameters takes the shared ones as known.
        """
        inverse, _, schur = self._reduced(np.zeros(len(self.theta)))
        found = np.full((self.shared.size, self.shared.size), np.nan)
        found[np.ix_(self._free, self._free)] = np.linalg.pinv(schur, rcond=1e-15)
        return inverse, found

    @property
    def _shared_score(self) -> FloatArray:
        return np.asarray(self.expansion.score[:, self.theta.shape[1] :].sum(axis=0))

    @property
    def _free(self) -> BoolArray:
        """Which shared parameters may move: not those at a bound whose score leads outside, shape (d,)."""
        low, high = (self.bounds >= self.shared[:, None])[:, 0], (self.bounds <= self.shared[:, None])[:, 1]
        return ~((low & (self._shared_score < 0)) | (high & (self._shared_score > 0)))

    def _reduced(self, damping: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Eliminate the own parameters from the information, whose shape is an arrow.

        Returns the inverse of the own block, what the own parameters answer to the free shared ones, and the
        information that is left of these: shapes (n, P, P), (n, P, d') and (d', d').
        """
        p, information = self.theta.shape[1], self.expansion.information
        own = information[:, :p, :p]
        diagonal = np.einsum("naa->na", own)
        more = damping[:, None] * diagonal + 1e-12 * (1.0 + diagonal)
        inverse = np.asarray(np.linalg.inv(own + more[:, :, None] * np.eye(p)), np.float64)
        border = information[:, :p, p:][:, :, self._free]
        through = np.einsum("nab,nbd->nad", inverse, border)
        common = information[:, p:, p:].sum(axis=0)[np.ix_(self._free, self._free)]
        common = common * (1.0 + damping.max(initial=0.0) * np.eye(len(common)))
        return inverse, through, common - np.einsum("nad,nae->de", border, through)


def _limits(theta: FloatArray, n_exposures: int) -> tuple[FloatArray, FloatArray]:
    """Return how far the own parameters may go from a start: not to another electron number, (n, P) each."""
    # beyond, the law would need ever more electron numbers, and each step ever more time
    m = n_exposures
    step = np.exp(theta[:, m])
    reach = np.full((step.size, m + 2), _REACH_EXPOSURE)
    reach[:, m], reach[:, m + 1] = _REACH_STEP, 1.2 * step
    low = np.concatenate([theta[:, : m + 2] - reach, np.full((step.size, 1), LOWEST_LOG_VARIANCE)], axis=1)
    widest = np.maximum(2.0 * theta[:, m : m + 1] - _LOG_16, theta[:, m + 2 :] + 1.0)
    high = np.concatenate([theta[:, : m + 2] + reach, widest], axis=1)
    low[:, :m] -= _REACH_EXPOSURE
    return low, np.maximum(high, theta)
