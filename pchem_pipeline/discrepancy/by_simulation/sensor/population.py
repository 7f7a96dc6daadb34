"""How the true parameters of a sensor's pixels are distributed, and where those of each pixel may lie.

Fitted parameters scatter more than the true ones, by their errors; where peaks are hardly resolved the errors
are large, skewed, and a bias may be off by an electron. A simulation that took the estimates for the truth
would, fitted again, be wrong twice, and every statistic that looks at the shape of the histograms would
deviate without any effect. The likelihood of all pixels together says how much of the scatter is real
(empirical Bayes: Robbins 1956; Efron and Morris 1973).

In ``theta = (log H, log 1/g, mu, log sigma_R^2)`` the pixels of a sensor follow Student's t with centre m and
scatter T. Each pixel's likelihood is a parabola about its posterior maximum, with Fisher's information for
its curvature; with these parabolas (m, T) maximise the marginal likelihood (EM: Dempster, Laird and Rubin
1977, ex. 4.5.2), and the maxima are found anew, a few times over (Laplace's approximation; Lindstrom and
Bates 1990). Maxima an electron apart count with their evidence. Where most pixels are ambiguous Laplace's
approximation is skewed, and the same way in all of them: there m comes from the cumulants of all pixels, with
its error, unless the fits are clearly likelier.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.discrepancy.effort import MOST_LEARNT_FROM
from pchem_pipeline.model.arithmetic.significance import POSSIBLE
from pchem_pipeline.model.arithmetic.statistics import robust_sd
from pchem_pipeline.model.fit.climb_numba import LEAST_STEP, MAX_LOG_EXPOSURE
from pchem_pipeline.model.fit.shared import LOWEST_LOG_VARIANCE, Ascent, Expansion, to_parameters, to_theta
from pchem_pipeline.model.law.mass import sample_mass, sample_parabolas
from pchem_pipeline.model.law.replaced_samples import ReplacedSamples
from pchem_pipeline.model.law.sample_law import SampleLaw

_TAILS = 8.0  # degrees of freedom of Student's t: pixels far from the others are no reason to widen T
_ROUNDS = 8  # of parabolas, each followed by EM
_EM_STEPS = 60
_STILL = 1e-4  # standard deviations, and relative variances: a smaller change ends the steps of EM
_NEWTON_STEPS = 3  # of each pixel between two rounds of EM, and in the end
_LAST_STEPS = 8
_SETTLED = 0.02  # nats: a smaller rise of the marginal likelihood per pixel ends the rounds
_LARGEST_STEP = np.array([0.7, 0.15, 0.5, 0.8])  # of theta at once; of mu in DN per electron
_RISE = 1e-3  # nats per pixel: a smaller one ends the steps
# scatters below which pixels are alike for all purposes: of log H, log 1/g, mu (DN), log sigma_R^2
_LEAST_SCATTER = np.array([2e-3, 2e-4, 5e-3, 2e-3])
_LOWEST_LOG_EXPOSURE = float(np.log(1e-5))
_HARDLY_ANY = 0.003  # share of pixels, mistaken ones say: what they are like does not count
#: The same beyond which they are no start, and what is learnt does not rest on the pixels' maxima.
MANY_MISTAKEN = 0.3
_SHIFTS = (0, 1, -1)  # electrons by which a bias may be mistaken
_ALIKE = np.array([0.3, 0.02, 0.5, 0.15])  # scatter of theta of pixels that are much alike
_WIDEST_DRAW = 1.5  # of log H and log sigma_R^2 from the maximum
_ARRIVED = 0.2  # nats, twice the rise that a further step promises: more, and a point is no maximum
_SKEWED = 1.0  # nats per pixel: by so much Laplace's approximation may be wrong where peaks are not resolved
_AGAIN = 100  # resamplings of the pixels behind the error of the centre
_LARGEST_ERROR = np.array([0.8, 0.25, np.inf, 0.8])  # of theta
_USUAL_NOISE, _NOISE_RANGE = 0.3, 0.2  # e-^2: squared read noise where peaks are hardly resolved, its scatter
_MOST_NOISE = 12.0  # of 1/g over what it were without read noise
_ITERATIONS = 30
_MOST_DRAWN_AGAIN = 500  # pixels behind what is learnt too low
#: Standard deviations of samples: their histograms reach no further.
REACH = 7.0
_LEAST_ELECTRONS = 0.01  # that a pixel is begun with
_OUTLYING = 15.0  # median deviations of a cumulant beyond which a pixel is not asked


@dataclass(frozen=True)
class Population:
    """Student's t of theta over the pixels: m, (4,), T, (4, 4), and the covariance of the estimate of m."""

    centre: FloatArray
    scatter: FloatArray
    uncertainty: FloatArray = field(default_factory=lambda: np.zeros((4, 4)))


@dataclass(frozen=True)
class Posterior:
    """Where the true theta of n pixels may lie: a mixture of Gaussians about j maxima each."""

    population: Population
    theta: FloatArray  # maxima, shape (j, n, 4)
    covariance: FloatArray  # shape (j, n, 4, 4)
    weight: FloatArray  # of the maxima, sums to 1 over j, shape (j, n)

    def likeliest(self) -> FloatArray:
        """Return (H, g, mu, sigma) at the maximum of most weight, shape (n, 4)."""
        best = self.weight.argmax(axis=0)
        return to_parameters(self.theta[best, np.arange(best.size)])

    def moved(self, change: FloatArray) -> Posterior:
        """Return it with another theta in all pixels, by ``change``, shape (4,), or (n, 4) of each."""
        centre = self.population.centre + np.median(np.atleast_2d(change), axis=0)
        return replace(self, population=replace(self.population, centre=centre), theta=self.theta + change)

    def draw(self, rng: np.random.Generator) -> FloatArray:
        """Draw (H, g, mu, sigma) of every pixel, shape (n, 4), the centre of all within its error.

        The mean ``mu + H / g`` of the samples is known far better than its parts, and drawn with its error.
        """
        j, n = self.weight.shape
        chosen = (rng.random(n) > np.cumsum(self.weight, axis=0)[: j - 1]).sum(axis=0)
        every = np.arange(n)
        covariance = self.covariance[chosen, every]
        root = np.linalg.cholesky(covariance)
        theta = self.theta[chosen, every].copy()
        # what is far from Gaussian where hardly anything is known are the logarithms
        widest = np.array([_WIDEST_DRAW, 0.2 * _WIDEST_DRAW, np.inf, _WIDEST_DRAW])
        off = np.einsum("nab,nb->na", root, rng.standard_normal((n, 4)))
        sizes, axes = np.linalg.eigh(self.population.uncertainty)
        moved = axes @ (np.sqrt(np.maximum(sizes, 0.0)) * rng.standard_normal(4))
        # each pixel follows the centre by as much as its own samples leave open
        off += covariance @ np.linalg.solve(self.population.scatter, moved)
        step = np.exp(theta[:, 0] + theta[:, 1])
        mean = theta[:, 2] + step + off[:, 2] + step * (off[:, 0] + off[:, 1])
        theta = _inside(theta + np.clip(off, -widest, widest))
        theta[:, 2] = mean - np.exp(theta[:, 0] + theta[:, 1])
        return to_parameters(theta)


def posterior_of(
    counts: NDArray[np.integer],
    origin: IntArray,
    parameters: FloatArray,
    law: SampleLaw | None = None,
    replaced: ReplacedSamples | None = None,
    *,
    mistaken: float = 1.0,
) -> Posterior:
    """Learn the population of the pixels from their histograms, and where each of them may lie.

    Args:
        counts: histograms, shape (n, B).
        origin: DN of bin 0, shape (n,).
        parameters: fitted (H, g, mu, sigma), shape (n, 4), NaN where there is none.
        law: of the samples; the PCD if None.
        replaced: what becomes of them, at the codes of the histograms; None: nothing.
        mistaken: share of pixels whose bias may be off by an electron: says what starts are worth a try.
    """
    pixels = _Pixels(counts, np.asarray(origin, np.int64), law or SampleLaw(), replaced)
    some = np.arange(len(counts))
    if some.size > MOST_LEARNT_FROM:
        some = np.sort(np.random.default_rng(0).choice(some, MOST_LEARNT_FROM, replace=False))
    shifts = (0,) if mistaken <= _HARDLY_ANY else _SHIFTS
    best, least = None, -np.inf
    for start, population in _seeds(pixels, parameters, mistaken):
        starts = np.stack([_shifted(start, each) for each in shifts])
        if replaced is not None:
            starts = np.concatenate([starts, _usual(pixels, population)[None]])
        about = pixels.about(starts)
        maxima, learnt, evidence = _learn(pixels.of(some), about.of(some), population)
        if evidence > least:
            best, least = (about.with_those(maxima, some), learnt), evidence + _SKEWED
    assert best is not None
    return _climb(pixels, *best, _LAST_STEPS).posterior(best[1])


def shrinkage_bias(posterior: Posterior, totals: NDArray[np.integer], law: SampleLaw | None = None) -> float:
    """Return by how much log sigma_R^2 is learnt too low: where peaks overlap some noise is taken for signal.

    By a parametric bootstrap (Efron 1979) of n pixels with ``totals`` samples, (n,), under a law (None: PCD).
    """
    rng = np.random.default_rng(totals.size)
    some = rng.permutation(totals.size)[:_MOST_DRAWN_AGAIN]
    drawn = posterior.draw(rng)[some]
    own = (law or SampleLaw()).of(some)
    reach = np.sqrt(drawn[:, 0]) / drawn[:, 1] + drawn[:, 3]
    centre = drawn[:, 2] + drawn[:, 0] / drawn[:, 1]
    first = np.floor(centre - REACH * reach).astype(np.int64)
    width = int(2.0 * REACH * np.quantile(reach, 0.99)) + 1
    codes = first[:, None] + np.arange(width)
    mass = np.maximum(sample_mass(own, [np.ascontiguousarray(column) for column in drawn.T], codes), 0.0)
    counts = rng.multinomial(totals[some].astype(np.int64), mass / mass.sum(axis=1, keepdims=True))
    again = posterior_of(counts, first, drawn, own, mistaken=0.0)
    return -float(clipped_mean(to_theta(again.draw(rng)) - to_theta(drawn))[3])


def clipped_mean(values: FloatArray) -> FloatArray:
    """Return means over one or more pixels, (n, m) -> (m,), outliers clipped to three deviations."""
    middle = np.median(values, axis=0)
    widest = 3.0 * robust_sd(values, middle, axis=0)
    return np.asarray(np.clip(values, middle - widest, middle + widest).mean(axis=0))


def posterior_of_estimates(parameters: FloatArray, covariance: FloatArray) -> Posterior:
    """Learn the same from estimates (n, 4) with Gaussian errors of covariance (n, 4, 4), some of them NaN."""
    known = np.asarray(np.isfinite(parameters).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2)))
    theta = to_theta(np.where(known[:, None], parameters, 1.0))
    population = _first_guess(theta[known])
    theta[~known] = population.centre
    slope = np.stack([1 / parameters[:, 0], -1 / parameters[:, 1], np.ones(len(theta)), 2 / parameters[:, 3]])
    error = covariance * slope.T[:, :, None] * slope.T[:, None, :]
    information = np.zeros((1, *covariance.shape))
    information[0, known] = np.linalg.inv(error[known] + 1e-12 * np.eye(4))
    shape = (1, len(theta))
    parabolas = Expansion(np.zeros(shape), np.zeros((*shape, 4)), information)
    maxima = _Maxima(theta[None], parabolas, np.ones(len(theta)), parabolic=True)
    return maxima.posterior(_expectation_maximisation(maxima, population))


@dataclass(frozen=True)
class _Pixels:
    """Histograms (n, B), the DN of their first bin (n,), the law of their samples, what becomes of those."""

    counts: NDArray[np.integer]
    origin: IntArray
    law: SampleLaw
    replaced: ReplacedSamples | None

    def of(self, some: NDArray[np.intp]) -> _Pixels:
        """Return some of them."""
        replaced = None if self.replaced is None else self.replaced.of(some)
        return _Pixels(self.counts[some], self.origin[some], self.law.of(some), replaced)

    def expansion(self, theta: FloatArray) -> Expansion:
        """Return the log-likelihood about theta (n, 4), with Fisher's information."""
        own = to_parameters(theta)
        columns = [np.ascontiguousarray(column) for column in own.T]
        value, score, information = sample_parabolas(
            self.law, columns, self.counts, self.origin, self.replaced
        )
        # the second slope is in 1/g
        score[:, 1] /= own[:, 1]
        information[:, 1] /= own[:, 1, None]
        information[:, :, 1] /= own[:, 1, None]
        return Expansion(value, score, information)

    def about(self, theta: FloatArray) -> _Maxima:
        """Return the parabolas about theta (j, n, 4)."""
        j, n = theta.shape[:2]
        theta = _inside(theta)
        found = self.of(np.tile(np.arange(n), j)).expansion(theta.reshape(-1, 4))
        return _Maxima(theta, found.shaped(j, n), np.ones(n))


@dataclass
class _Maxima:
    """The log-likelihood about theta (j, n, 4), and each pixel's widening of T.

    ``evidence`` is the log marginal likelihood of the last solution, shape (n,). ``parabolic`` likelihoods
    are parabolas everywhere, so that one step arrives.
    """

    theta: FloatArray
    expansion: Expansion
    widening: FloatArray
    evidence: FloatArray = field(default_factory=lambda: np.zeros(0))
    parabolic: bool = False

    def solve(self, population: Population) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return posterior mean (j, n, 4), covariance (j, n, 4, 4) and weight (j, n) under a population."""
        prior = np.linalg.inv(population.scatter)
        pull, off = prior / self.widening[:, None, None], self.theta - population.centre
        precision = self.expansion.information + pull
        covariance = np.asarray(np.linalg.inv(precision), np.float64)
        slope = self.expansion.score - np.einsum("nab,jnb->jna", pull, off)
        step = np.einsum("jnab,jnb->jna", covariance, slope)
        promised, far = (slope * step).sum(axis=2), np.einsum("jna,nab,jnb->jn", off, pull, off)
        arrived, ends = self.parabolic | (promised < _ARRIVED), self.theta + step
        mean = np.where(arrived[:, :, None], ends, self.theta)
        evidence = self.expansion.value + 0.5 * (promised - far - np.linalg.slogdet(precision)[1])
        counts = arrived.copy()
        counts[0] = True
        for j in range(1, len(counts)):
            for i in range(j):  # one of the earlier ones again
                apart = ends[j] - ends[i]
                distance = np.einsum("na,nab,nb->n", apart, precision[i], apart)
                counts[j] &= ~counts[i] | (distance > POSSIBLE**2)
        # the prior's factor, its scatter widened in each pixel
        factor = 0.5 * np.linalg.slogdet(prior)[1] - 2.0 * np.log(self.widening)
        self.evidence = np.logaddexp.reduce(evidence, axis=0) + factor
        # the first maximum always counts, however unlikely the others make it
        evidence = np.where(counts & np.isfinite(evidence), evidence, -1e300)
        weight = np.exp(evidence - evidence.max(axis=0))
        return mean, covariance, weight / weight.sum(axis=0)

    def _among(self, kinds: BoolArray | slice, pixels: NDArray[np.intp] | slice) -> _Maxima:
        expansion = self.expansion.of(kinds).of((slice(None), pixels))
        return _Maxima(self.theta[kinds][:, pixels], expansion, self.widening[pixels])

    def of(self, some: NDArray[np.intp]) -> _Maxima:
        """Return those of some pixels."""
        return self._among(slice(None), some)

    def with_those(self, found: _Maxima, some: NDArray[np.intp]) -> _Maxima:
        """Return it with what was found for some pixels, if that has all kinds of maxima; in place."""
        if len(found.theta) == len(self.theta):
            self.theta[:, some] = found.theta
            self.expansion.put((slice(None), some), found.expansion)
        return self

    def likely(self, population: Population) -> _Maxima:
        """Return the maxima without those kinds that hardly a pixel has."""
        share = self.solve(population)[2].mean(axis=1)
        return self._among((share > _HARDLY_ANY) | (np.arange(share.size) == 0), slice(None))

    def posterior(self, population: Population) -> Posterior:
        """Return the posterior under a population."""
        theta, covariance, weight = self.solve(population)
        return Posterior(population, _inside(theta), covariance, weight)


def _climb(pixels: _Pixels, start: _Maxima, population: Population, steps: int) -> _Maxima:
    """Find the posterior maxima near others (j, n), each pixel by itself."""
    j, n = start.theta.shape[:2]
    flat, theta = pixels.of(np.tile(np.arange(n), j)), start.theta.reshape(-1, 4).copy()
    prior = np.linalg.inv(population.scatter)

    def widened(theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        off = theta - population.centre
        return off, (_TAILS + np.einsum("na,ab,nb->n", off, prior, off)) / (_TAILS + 4.0)

    def times_prior(likelihood: Expansion, theta: FloatArray, power: float = 1.0) -> Expansion:
        """Multiply by Student's t; its information is that of the Gaussian of the same slope."""
        off, wide = widened(theta)
        pull = power * prior / wide[:, None, None]
        return Expansion(
            likelihood.value - power * 0.5 * (_TAILS + 4.0) * np.log(wide),
            likelihood.score - np.einsum("nab,nb->na", pull, off),
            likelihood.information + pull,
        )

    ascent = Ascent(theta, np.zeros(0), times_prior(start.expansion.shaped(j * n), theta))
    longest = np.tile(_LARGEST_STEP, (j * n, 1))
    longest[:, 2] *= np.exp(theta[:, 1])
    ascent.climb(
        lambda theta, _, rows: times_prior(flat.of(rows).expansion(theta[rows]), theta[rows]),
        (_inside(np.full_like(theta, -np.inf)), _inside(np.full_like(theta, np.inf))),
        longest,
        steps,
        _RISE * j * n,
    )
    found, wide = times_prior(ascent.expansion, theta, -1.0).shaped(j, n), widened(theta)[1]
    return _Maxima(theta.reshape(j, n, 4), found, wide.reshape(j, n).min(axis=0))


def _learn(pixels: _Pixels, start: _Maxima, population: Population) -> tuple[_Maxima, Population, float]:
    """Return maxima, the likeliest population, and the mean log evidence of a pixel, nats."""
    before = -np.inf
    for _ in range(_ROUNDS):
        maxima = _climb(pixels, start, population, _NEWTON_STEPS)
        population = _expectation_maximisation(maxima, population)
        start = maxima.likely(population)
        now = float(maxima.evidence.mean())
        if abs(now - before) < _SETTLED:
            break
        before = now
    return start, population, now


def _expectation_maximisation(maxima: _Maxima, population: Population) -> Population:
    """Maximise the marginal likelihood of the parabolas; a centre that has an uncertainty stays."""
    hold = bool(population.uncertainty.any())
    for _ in range(_EM_STEPS):
        mean, covariance, weight = maxima.solve(population)
        off = mean - population.centre
        prior = np.linalg.inv(population.scatter)
        far = np.einsum("jna,ab,jnb->jn", off, prior, off) + np.einsum("ab,jnba->jn", prior, covariance)
        maxima.widening = (_TAILS + (weight * far).sum(axis=0)) / (_TAILS + 4.0)
        share = weight / maxima.widening
        centre = population.centre if hold else np.einsum("jn,jna->a", share, mean) / share.sum()
        off = mean - centre
        scatter = np.einsum("jn,jna,jnb->ab", share, off, off) + np.einsum("jn,jnab->ab", share, covariance)
        new = replace(population, centre=centre, scatter=_at_least(scatter / weight.sum()))
        variance = np.diag(population.scatter)
        moved = np.abs(new.centre - population.centre) / np.sqrt(variance)
        widened = np.abs(np.diag(new.scatter) / variance - 1.0)
        population = new
        if max(moved.max(), widened.max()) < _STILL:
            break
    return population


def _at_least(scatter: FloatArray) -> FloatArray:
    """Return a scatter no smaller than the least one along any direction."""
    white = scatter / np.outer(_LEAST_SCATTER, _LEAST_SCATTER)
    sizes, axes = np.linalg.eigh((white + white.T) / 2.0)
    full = (axes * np.maximum(sizes, 1.0)) @ axes.T
    return np.asarray(full * np.outer(_LEAST_SCATTER, _LEAST_SCATTER))


def _inside(theta: FloatArray) -> FloatArray:
    """Return theta with some exposure and some read noise."""
    found = theta.copy()
    found[..., 0] = np.clip(found[..., 0], _LOWEST_LOG_EXPOSURE, MAX_LOG_EXPOSURE)
    found[..., 3] = np.maximum(found[..., 3], LOWEST_LOG_VARIANCE)
    return found


def _seeds(pixels: _Pixels, parameters: FloatArray, mistaken: float) -> list[tuple[FloatArray, Population]]:
    """Return starts of theta (n, 4) and of the population: from the fits, and from all pixels' cumulants.

    Fits are biased where peaks are hardly resolved, cumulants where pixels differ widely.
    """
    known = np.asarray(np.isfinite(parameters).all(axis=1))
    mean, k = _cumulants(pixels)
    rng = np.random.default_rng(k.shape[1])
    drawn = rng.integers(k.shape[1], size=(_AGAIN, k.shape[1]))
    again = np.stack([k.mean(axis=1), *k[:, drawn].mean(axis=2).T])
    centres = _centres_of(again)
    centre = np.array([centres[0, 0], centres[0, 1], 0.0, centres[0, 2]])
    centre[2] = np.median(mean) - np.exp(centre[0] + centre[1])
    start = np.tile(centre, (mean.size, 1))
    start[:, 2] = mean - np.exp(centre[0] + centre[1])
    found: list[tuple[FloatArray, Population]] = []
    resolved = mistaken <= MANY_MISTAKEN
    if known.any():
        fits = np.where(known[:, None], to_theta(np.where(known[:, None], parameters, 1.0)), start)
        found.append((fits, _first_guess(fits[known])))
        if resolved:
            return found
    off = np.insert(centres[1:] - centres[0], 2, 0.0, axis=1)
    off = np.clip(off, -_LARGEST_ERROR, _LARGEST_ERROR)
    # mu follows H and 1/g: their product is known far better than both
    off[:, 2] = np.exp(centre[0] + centre[1]) * -np.expm1(off[:, 0] + off[:, 1])
    scatter = np.diag(np.maximum(_ALIKE, [0, 0, mean.std(), 0]) ** 2)
    from_all = start, Population(centre, scatter, off.T @ off / len(off))
    return [from_all, *found]


def _centres_of(k: FloatArray) -> FloatArray:
    """Return log H, log 1/g, log sigma_R^2 of pixels that are alike from mean cumulants 2 to 4, DN^j, (b, 3).

    ``k_2 = sigma^2 + H / g^2, k_3 = H / g^3, k_4 = H / g^4``: 1/g is ``k_4 / k_3``, or what k_2 and k_3 give
    at a usual read noise, weighted by the scatter of each over the rows (resamplings of the first).
    """
    k2, k3, k4 = np.maximum(k, [1e-3, 1e-3, 1e-6]).T
    # from no read noise at all to much
    least = np.maximum(k3 / k2, LEAST_STEP)  # samples that are cut off have no skewness of electrons
    by_four = np.log(np.clip(k4 / k3, least, _MOST_NOISE * least))
    step = least.copy()
    for _ in range(_ITERATIONS):
        step = np.minimum(least * (1.0 + _USUAL_NOISE * step**3 / k3), _MOST_NOISE * least)
    by_three = np.log(step)
    electrons = k3[0] / step[0] ** 3
    error_three = np.hypot(by_three.std(), _NOISE_RANGE / (electrons + _USUAL_NOISE))
    share = error_three**2 / (error_three**2 + by_four.std() ** 2 + 1e-12)
    # resamplings scatter by what the read noise may be, too
    unknown = np.linspace(-1.0, 1.0, len(k)) * 1.7 * _NOISE_RANGE / (electrons + _USUAL_NOISE)
    unknown[0] = 0.0
    log_step = np.maximum(share * by_four + (1.0 - share) * (by_three + unknown), np.log(least) + 1e-3)
    step = np.exp(log_step)
    variance = np.maximum(k2 - QUANTISATION_VARIANCE - k3 / step, 0.01 * step**2)
    return np.stack([np.log(k3) - 3.0 * log_step, log_step, np.log(variance)], axis=1)


def _cumulants(pixels: _Pixels) -> tuple[FloatArray, FloatArray]:
    """Return the mean of each pixel (n,), and the cumulants 2 to 4 of those that do not stand out, (3, m)."""
    codes = pixels.origin[:, None] + np.arange(pixels.counts.shape[1])
    seen = pixels.counts.astype(np.float64)
    total = np.maximum(seen.sum(axis=1), 1.0)
    mean = (seen * codes).sum(axis=1) / total
    off = codes - mean[:, None]
    m2, m3, m4 = ((seen * off**j).sum(axis=1) / total for j in (2, 3, 4))
    n = np.maximum(total, 5.0)
    # Fisher's k-statistics, which are unbiased
    k = np.stack(
        [
            m2 * n / (n - 1.0),
            m3 * n**2 / ((n - 1.0) * (n - 2.0)),
            n**2 * ((n + 1.0) * m4 - 3.0 * (n - 1.0) * m2**2) / ((n - 1.0) * (n - 2.0) * (n - 3.0)),
        ]
    )
    apart = np.abs(k - np.median(k, axis=1)[:, None])
    middle = np.maximum(np.median(apart, axis=1), np.finfo(np.float64).tiny)
    farthest = (apart / middle[:, None]).max(axis=0)
    # of pixels of several kinds each may stand out in another cumulant
    return mean, k[:, farthest <= max(_OUTLYING, float(np.median(farthest)))]


def _first_guess(theta: FloatArray) -> Population:
    """Return centre and scatter of the fits by robust figures, along the axes."""
    centre = np.median(theta, axis=0)
    scatter = robust_sd(theta, centre, axis=0)
    return Population(centre, np.diag(np.maximum(scatter, 5.0 * _LEAST_SCATTER) ** 2))


def _usual(pixels: _Pixels, population: Population) -> FloatArray:
    """Return theta (n, 4) of the usual pixel, with the exposure that the mean of each asks for."""
    theta = np.tile(population.centre, (len(pixels.counts), 1))
    electrons = (_cumulants(pixels)[0] - theta[:, 2]) * np.exp(-theta[:, 1])
    theta[:, 0] = np.log(np.maximum(electrons, _LEAST_ELECTRONS))
    return theta


def _shifted(theta: FloatArray, electrons: int) -> FloatArray:
    """Return theta with the bias so many electrons higher, and the mean as it was."""
    found = theta.copy()
    h = np.exp(theta[:, 0])
    moved = np.maximum(h - electrons, 0.2 * h)
    found[:, 0] = np.log(moved)
    found[:, 2] = theta[:, 2] + (h - moved) * np.exp(theta[:, 1])
    return found
