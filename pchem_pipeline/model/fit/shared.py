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

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
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
        """Tell which rows are of samples with electrons, shape (n_rows,)."""
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
        """Return information and score in own and shared parameters of each pixel.

        Args:
            information: of the rows, own parameters first, shape (n J, 4 + d, 4 + d).
            score: likewise, shape (n J, 4 + d).

        Returns:
            Shapes (n, P + d, P + d) and (n, P + d).
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
    """Histograms and the law that they are to follow.

    Attributes:
        counts: histograms, shape (n, B); n counts the samples of all pixels.
        origin: DN of bin 0, shape (n,).
        kept: codes that count, shape (n, B).
        law: from shared and own parameters to the law of the rows.
        bounds: lowest and highest value of each shared parameter, shape (d, 2).
        scale: natural scale of each shared parameter, shape (d,).
        samples: which rows are of one pixel.
    """

    counts: NDArray[np.integer]
    origin: IntArray
    kept: BoolArray
    law: Law
    bounds: FloatArray
    scale: FloatArray
    samples: Samples = field(default_factory=Samples)

    @property
    def n_shared(self) -> int:
        """Number of shared parameters."""
        return int(self.scale.size)

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

    def log_likelihood(self, theta: FloatArray, shared: FloatArray) -> FloatArray:
        """Return the log-likelihood of each pixel, nats; -inf where the law refuses."""
        try:
            rows = (self.counts * self.log_masses(theta, shared)).sum(axis=1)
        except ValueError:  # fields that do not go together
            return np.full(theta.shape[0], -np.inf)
        found = rows.reshape(-1, self.samples.n).sum(axis=1)
        return np.where(np.isfinite(found), found, -np.inf)


@dataclass(frozen=True)
class SharedFit:
    """Estimates.

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
    def row_theta(self) -> FloatArray:
        """(log H, log 1/g, mu, log sigma_R^2) of the rows, shape (n J, 4)."""
        return self.samples.rows(self.theta)

    @property
    def parameters(self) -> FloatArray:
        """(H, g, mu, sigma) of the rows, shape (n J, 4); e-, e-/DN, DN, DN."""
        return to_parameters(self.row_theta)

    @property
    def stderr(self) -> FloatArray:
        """Standard errors of the parameters of the rows, shape (n J, 4)."""
        slopes = self.samples.slopes
        found = np.einsum("jap,npq,jaq->nja", slopes, self.own_covariance, slopes, optimize=True)
        h, g, _, sigma = self.parameters.T
        per = np.stack([h, g, np.ones_like(h), 0.5 * np.exp(self.row_theta[:, 3]) / sigma], axis=1)
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
    """Climb the likelihood from a start.

    Without shared parameters the pixels are independent, and each has a damping of its own.

    Args:
        problem: histograms and law.
        parameters: start of (H, g, mu, sigma) of the rows, shape (n J, 4), finite; g, mu and sigma are taken
            from the first sample of a pixel.
        shared: start of the shared parameters, shape (d,).
        max_steps: scoring steps at most.
        tolerance: converged where a step promises a smaller rise of all pixels together, nats.
    """
    theta = problem.samples.theta(parameters)
    limits = _limits(theta, problem.samples.n_exposures)
    shared = np.clip(np.asarray(shared, np.float64), problem.bounds[:, 0], problem.bounds[:, 1])
    loglik = problem.log_likelihood(theta, shared)
    together = problem.n_shared > 0
    damping = np.full(theta.shape[0], _FIRST_DAMPING)
    promised, slopes = np.full(theta.shape[0], np.inf), None
    for _ in range(max_steps):
        slopes = slopes or Tangent.at(problem, theta, shared).slopes(problem.counts)
        step, shared_step, promised = slopes.step(damping)
        active = np.full(promised.size, promised.sum() >= tolerance)
        if not together:
            active &= promised >= tolerance / promised.size
        active &= damping < _LARGEST_DAMPING
        if not active.any():
            break
        trial = np.where(active[:, None], np.clip(theta + step, *limits), theta)
        reach = np.abs(shared) + problem.scale
        shared_trial = shared + np.clip(shared_step, -reach, reach)
        shared_trial = np.clip(shared_trial, problem.bounds[:, 0], problem.bounds[:, 1])
        found = problem.log_likelihood(trial, shared_trial)
        better = np.full(theta.shape[0], found.sum() > loglik.sum()) if together else found > loglik
        better &= active
        damping = np.where(better, damping / 10.0, np.where(active, damping * 6.0, damping))
        if better.any():
            theta, loglik = np.where(better[:, None], trial, theta), np.where(better, found, loglik)
            shared = shared_trial if together else shared
            slopes = None
    slopes = slopes or Tangent.at(problem, theta, shared).slopes(problem.counts)
    own, common = slopes.covariance()
    arrived = bool(promised.sum() < tolerance)
    return SharedFit(theta, shared, own, common, loglik, arrived, problem.samples)


@dataclass(frozen=True)
class Tangent:
    """The law at a point, to first order.

    Attributes:
        problem: histograms and law.
        log_masses: given that the code is kept, shape (n, B); 0 where it is not.
        derivatives: of the log masses of the rows, their own four parameters first, shape (n, 4 + d, B).
        shared: shared parameters, shape (d,).
    """

    problem: SharedProblem
    log_masses: FloatArray
    derivatives: FloatArray
    shared: FloatArray

    @classmethod
    def at(cls, problem: SharedProblem, theta: FloatArray, shared: FloatArray) -> Tangent:
        """Evaluate at a point."""
        base = problem.log_masses(theta, shared)
        return cls(problem, base, _differences(problem, theta, shared, base), shared)

    @property
    def masses(self) -> FloatArray:
        """Mass of each code given that it is kept, shape (n, B)."""
        return np.where(self.problem.kept, np.exp(self.log_masses), 0.0)

    def slopes(self, counts: NDArray[np.integer]) -> Slopes:
        """Return score and information of histograms, shape (n, B)."""
        seen = np.where(self.problem.kept, counts, 0)
        score, information = score_and_information(self.derivatives, self.masses, seen)
        information, score = self.problem.samples.by_pixel(information, score)
        own = self.problem.samples.n_exposures + 3
        shared_score = score[:, own:].sum(axis=0)
        low, high = self.problem.bounds[:, 0] >= self.shared, self.problem.bounds[:, 1] <= self.shared
        return Slopes(
            information[:, :own, :own],
            information[:, :own, own:],
            information[:, own:, own:].sum(axis=0),
            score[:, :own],
            shared_score,
            ~((low & (shared_score < 0)) | (high & (shared_score > 0))),
        )


@dataclass(frozen=True)
class Slopes:
    """Score and information at a point.

    Attributes:
        own, border, common: blocks of the information: (n, P, P), (n, P, d), (d, d).
        score, shared_score: gradients, shapes (n, P) and (d,).
        free: shared parameters that may move, shape (d,).
    """

    own: FloatArray
    border: FloatArray
    common: FloatArray
    score: FloatArray
    shared_score: FloatArray
    free: BoolArray

    def step(self, damping: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the steps of own and shared parameters, and the rise promised in each pixel, nats."""
        inverse = np.asarray(np.linalg.inv(_damped(self.own, damping)), np.float64)
        own = np.einsum("nab,nb->na", inverse, self.score)
        shared = np.zeros(self.free.size)
        if self.free.any():
            through, schur = self._reduced(inverse, float(damping.max()))
            right = self.shared_score[self.free] - np.einsum("nad,na->d", through, self.score)
            shared[self.free] = np.linalg.lstsq(schur, right, rcond=1e-12)[0]
            own -= np.einsum("nad,d->na", through, shared[self.free])
        promised = 0.5 * (own * self.score).sum(axis=1)
        promised += 0.5 * float(shared @ np.where(self.free, self.shared_score, 0.0)) / promised.size
        return own, shared, promised

    def covariance(self) -> tuple[FloatArray, FloatArray]:
        """Return covariances of own, (n, P, P), and of shared parameters, (d, d), NaN for those at bounds.

        That of the own parameters takes the shared ones as known.
        """
        still = np.zeros(self.own.shape[0])
        inverse = np.asarray(np.linalg.inv(_damped(self.own, still)), np.float64)
        found = np.full((self.free.size, self.free.size), np.nan)
        if self.free.any():
            found[np.ix_(self.free, self.free)] = np.linalg.pinv(
                np.asarray(self._reduced(inverse, 0.0)[1]), rcond=1e-15
            )
        return inverse, found

    def _reduced(self, inverse: FloatArray, damping: float) -> tuple[FloatArray, FloatArray]:
        """Eliminate the own parameters: return their answer to the shared ones, and the information left."""
        border = self.border[:, :, self.free]
        through = np.einsum("nab,nbd->nad", inverse, border)
        common = self.common[np.ix_(self.free, self.free)]
        schur = common * (1.0 + damping * np.eye(common.shape[0])) - np.einsum("nad,nae->de", border, through)
        return through, schur


def _damped(information: FloatArray, damping: FloatArray) -> FloatArray:
    diagonal = np.einsum("naa->na", information)
    more = damping[:, None] * diagonal + 1e-12 * (1.0 + diagonal)
    return np.asarray(information + more[:, :, None] * np.eye(information.shape[1]))


def _limits(theta: FloatArray, n_exposures: int) -> tuple[FloatArray, FloatArray]:
    """Return how far the own parameters may go from a start: not to another electron number, (n, P) each.

    Beyond, the law would need ever more electron numbers, and each step ever more time.
    """
    m = n_exposures
    step = np.exp(theta[:, m])
    reach = np.full((step.size, m + 2), _REACH_EXPOSURE)
    reach[:, m], reach[:, m + 1] = _REACH_STEP, 1.2 * step
    low = np.concatenate([theta[:, : m + 2] - reach, np.full((step.size, 1), LOWEST_LOG_VARIANCE)], axis=1)
    widest = np.maximum(2.0 * theta[:, m : m + 1] - _LOG_16, theta[:, m + 2 :] + 1.0)
    high = np.concatenate([theta[:, : m + 2] + reach, widest], axis=1)
    low[:, :m] -= _REACH_EXPOSURE
    return low, np.maximum(high, theta)


def _differences(
    problem: SharedProblem, theta: FloatArray, shared: FloatArray, base: FloatArray
) -> FloatArray:
    """Return the derivatives of the log masses of the rows, own parameters first, shape (n, 4 + d, B)."""
    n, width = base.shape
    slopes = np.zeros((n, 4 + problem.n_shared, width))
    own = to_parameters(problem.samples.rows(theta))
    mass, found = sample_slopes(problem.law(shared, own), list(own.T), problem.origin, width)
    found[:, 1] /= own[:, 1:2]  # of the logarithm of 1/g
    kept = problem.kept[:, None, :]
    inside = np.where(problem.kept, mass, 0.0).sum(axis=1)
    change = np.where(kept, found, 0.0).sum(axis=2) / np.maximum(inside, LEAST_SEEN)[:, None]
    relative = found / np.maximum(mass, LEAST_SEEN)[:, None, :] - change[:, :, None]
    slopes[:, :4] = np.where(kept & (mass > LEAST_SEEN)[:, None, :], relative, 0.0)
    for index in range(problem.n_shared):
        moved = shared.copy()
        step = _STEP * problem.scale[index]
        if moved[index] + step > problem.bounds[index, 1]:
            step = -step
        moved[index] += step
        slopes[:, 4 + index] = (problem.log_masses(theta, moved) - base) / step
    return slopes
