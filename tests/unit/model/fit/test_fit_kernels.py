"""The loops of the fit against the paper's equations on raw samples, and compiled against plain."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from helpers.drawn_pixels import draw, samples
from helpers.em_trace import em_trace, evaluated, one_sample
from helpers.reference_pchem import Theta, em, log_likelihood
from scipy.special import logsumexp
from scipy.stats import norm, poisson

from pchem_pipeline.model.fit import climb_numba
from pchem_pipeline.model.fit.engine import likelihood
from pchem_pipeline.model.law import pixel_numba
from pchem_pipeline.model.law.pixel_numba import (
    AT,
    DERIVATIVES,
    INFORMATION,
    LOGLIK_ALONE,
    SCORE,
    Pixel,
    Scratch,
)

# (H, 1/g, s_e) from needles to unresolved peaks, a hot pixel, and steps of which few bins go at a time
CASES = [
    (2.0, 11.0, 0.3),
    (0.1, 10.0, 0.2),
    (8.0, 13.0, 0.42),
    (5.0, 10.0, 0.6),
    (4.0, 10.0, 1.3),
    (60.0, 9.0, 0.3),
    (3.0, 12.0, 0.1),
    (3.0, 11.0, 0.53),
    (3.0, 4.0, 0.53),
    (3.0, 4.0, 0.2),
    (3.0, 1.7, 0.45),
    (3.0, 1.7, 0.3),
]
N = 3000


class Sample(NamedTuple):
    """One histogram as the loops take it, and room to work in."""

    pixel: Pixel
    scratch: Scratch

    @property
    def at(self):
        return self.scratch.evaluations[AT, 0]

    @property
    def information(self):
        lower = np.tril(self.at[INFORMATION : INFORMATION + 4, :4])
        return np.asarray(lower + np.tril(lower, -1).T)


def prepare(case, seed=4):
    """Histogram, centre in DN, raw sample and a theta that is off the truth."""
    counts, origin, truth = draw(np.random.default_rng(seed), *case, n_frames=N)
    pixel, scratch, centre = one_sample(counts[0])
    scratch.rows[:] = np.nan  # what was in memory before must not matter
    theta = Theta(*(truth[0] * [1.04, 0.985, 1.0, 1.05] - [0, 0, 0.3, 0]))
    return Sample(pixel, scratch), float(origin[0] + centre), samples(counts[0], int(origin[0])), theta


def internal(theta, centre):
    sigma = 2 * np.log(theta.sigma)
    return np.array([np.log(theta.exposure), 1 / theta.gain, theta.bias - centre, sigma, 0.0])


def run(sample, theta):
    return evaluated(sample.pixel, theta, DERIVATIVES, likelihood(False), sample.scratch)


@pytest.mark.parametrize("case", CASES)
def test_score_is_the_gradient_and_information_minus_its_jacobian(case):
    histogram, centre, x, theta = prepare(case)
    point = internal(theta, centre)
    assert run(histogram, point) == pytest.approx(log_likelihood(x, theta), rel=1e-11)
    score, information = histogram.at[SCORE, :4].copy(), histogram.information
    alone = evaluated(histogram.pixel, point, LOGLIK_ALONE, likelihood(False), histogram.scratch)
    assert alone == pytest.approx(log_likelihood(x, theta), rel=1e-6)  # without components further down
    size = np.sqrt(np.abs(np.diag(information)))
    step = 1e-3 / size

    def loglik(p):
        return log_likelihood(x, Theta(float(np.exp(p[0])), 1 / p[1], p[2] + centre, float(np.exp(p[3] / 2))))

    def score_at(p):
        run(histogram, p)
        return histogram.at[SCORE, :4].copy()

    for i, h in enumerate(np.eye(4, 5) * step[:, None]):
        near, far = (loglik(point + n * h) - loglik(point - n * h) for n in (1, 2))
        slope = (8 * near - far) / 12 / step[i]
        assert score[i] / size[i] == pytest.approx(slope / size[i], rel=1e-6, abs=2e-5)
        change = (score_at(point - h) - score_at(point + h)) / (2 * step[i])
        np.testing.assert_allclose(information[i] / size / size[i], change / size / size[i], atol=2e-6)


@pytest.mark.parametrize("case", CASES)
def test_em_iterates_follow_the_paper(case):
    counts, origin, truth = draw(np.random.default_rng(5), *case, n_frames=N)
    start = Theta(*(truth[0] * [1.1, 1.03, 1.002, 0.9]))
    trace = em_trace(counts[0], int(origin[0]), start, 25)
    path = em(samples(counts[0], int(origin[0])), start, 25)
    np.testing.assert_allclose(trace.parameters, np.array(path), rtol=1e-9)
    assert not np.allclose(trace.parameters[1], trace.parameters[0], rtol=1e-4)


BELL = np.array([0, 3, 40, 180, 300, 180, 40, 3, 0])
FAR = np.bincount(np.repeat([0, 200, 211, 222, 399], [1, 300, 400, 200, 1]))


@pytest.mark.parametrize(
    ("counts", "theta"),
    [
        # large electron numbers: with a table of factorials, and beyond it
        *((BELL, Theta(h, 1 / 0.6, 4.0 - 0.6 * h, 0.7)) for h in (40.0, 5000.0)),
        # values far from all components; e-: 0.055 and 0.27
        *((FAR, Theta(1.0, 1 / 11.0, 200.3, sigma)) for sigma in (0.6, 3.0)),
    ],
)
def test_many_electrons_and_far_values_have_the_density_of_all_components(counts, theta):
    pixel, scratch, centre = one_sample(counts)
    loglik = evaluated(pixel, internal(theta, centre), DERIVATIVES, likelihood(False), scratch)
    k = np.arange(max(0, int(theta.exposure) - 60), int(theta.exposure) + 60)
    x = np.repeat(np.arange(counts.size), counts)[:, None]
    terms = poisson.logpmf(k, theta.exposure) + norm.logpdf(x, theta.bias + k / theta.gain, theta.sigma)
    assert loglik == pytest.approx(logsumexp(terms, axis=1).sum(), rel=1e-10)


def test_a_comb_finer_than_any_has_no_likelihood():
    pixel, scratch, _ = one_sample(BELL)
    finest = internal(Theta(2.0, 1 / 0.01, 0.0, 0.3), 0.0)
    assert evaluated(pixel, finest, DERIVATIVES, likelihood(False), scratch) == -np.inf


def test_a_tied_step_leaves_the_noise_in_electrons():
    sample, centre, _, theta = prepare(CASES[2])
    point = internal(theta, centre)
    at, h = sample.scratch.evaluations[AT], 1e-4

    def score(p):
        run(sample, p)
        climb_numba.tie_noise(p, at, 0.0)
        return sample.at[SCORE].copy()

    def moved(step):
        p = point.copy()
        p[1] += step
        p[3] = point[3] + 2 * np.log(p[1] / point[1])
        return p

    score(point)
    information = sample.at[INFORMATION + 1, 1]
    slope = (run(sample, moved(h)) - run(sample, moved(-h))) / (2 * h)
    assert score(point)[1] == pytest.approx(slope, rel=1e-6)
    assert information == pytest.approx(-(score(moved(h))[1] - score(moved(-h))[1]) / (2 * h), rel=1e-6)


def test_no_kernel_lets_the_compiler_choose_the_bits():
    # numba optimises a kernel again in every kernel that calls it, and which copy runs depends on what the
    # process compiled or loaded before: with sums in any order, so would the last bits
    kernels = sorted(Path(pixel_numba.__file__).parents[1].rglob("*_numba.py"))
    assert len(kernels) > 20
    assert [path.name for path in kernels if "fastmath" in path.read_text()] == []
