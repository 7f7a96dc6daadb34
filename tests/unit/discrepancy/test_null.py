"""Tails of the null: skewed sums of squares, counts of hardly any event, and sensors drawn to simulate."""

import numpy as np
import pytest
from scipy import special, stats

from pchem_pipeline.discrepancy.by_simulation.sensor.population import Population, Posterior
from pchem_pipeline.discrepancy.null import Covariance, NullModel, moments, without_strays
from pchem_pipeline.discrepancy.observe import laws

REPLICATES, SETS, DATA = 40, 300, 50
SUMS = tuple(f"shape.{score}.chi" for score in ("C2", "C3", "He3", "He4", "He2C1", "He1C2", "He2C2", "He3C1"))
COUNTS = ("time.lag1.charge.cnt", "time.lag1.readout.cnt", "shape.C3.cnt", "shape.He3.cnt")


def dense(covariance: Covariance) -> np.ndarray:
    """The covariance as a matrix, (m, m)."""
    return np.diag(covariance.own) + covariance.common.T @ covariance.common


def sums(rng, n):
    """Sums of squares that few pixels carry: gamma laws of skewness 1, standardised."""
    return (rng.gamma(4.0, 1.0, (n, len(SUMS))) - 4.0) / 2.0


def counts(rng, n):
    """Counts of which 0.15 are expected, as the statistics of outlying pixels have them."""
    seen = rng.poisson(0.15, (n, len(COUNTS)))
    table = np.array([laws.poisson(k, 0.15) for k in range(20)])
    return table[seen]


def test_events_of_exact_counts_are_those_of_their_parts_too() -> None:
    names = ("frame.repeated", "frame.repeated@rows=0:4", "shape.C2.mean")
    null = NullModel.from_replicates(names, np.random.default_rng(1).normal(size=(12, 3)))
    assert null.events.tolist() == [10.0, 10.0, 0.0]


@pytest.mark.parametrize(
    ("draw", "names", "level", "far"),
    [(sums, SUMS, 1e-3, 12.0), (counts, COUNTS, 1e-4, laws.poisson(8, 0.15))],
)
def test_small_p_values_of_skewed_sums_and_rare_counts_are_as_rare_as_they_say(draw, names, level, far):
    """Of the mean of two parts of clean data, beside those by a symmetric tail."""
    rng, found, before = np.random.default_rng(5), [], []
    for _ in range(SETS):
        null = NullModel.from_replicates(names, draw(rng, REPLICATES))
        both = draw(rng, 2 * DATA).reshape(2, DATA, -1).mean(axis=0)
        found.append(null.p_values(both, 2))
        before.append(2.0 * special.stdtr(null.freedom, -np.abs(null.pulls(both, 2))))
    found, before = np.array(found), np.array(before)
    error = np.sqrt(level / found.size)
    assert np.mean(found < level) < level + 5.0 * error
    # symmetric tails are wrong by far, so the check can fail
    assert np.mean(before < level) > 2.0 * level + 5.0 * error
    assert null.p_values(np.full(len(names), far), 2).max() < 1e-6  # a strong deviation is none by chance


def test_what_scatters_more_than_it_should_is_not_taken_for_quieter():
    rng = np.random.default_rng(7)
    stds = [NullModel.from_replicates(SUMS, 3.0 * sums(rng, REPLICATES)).std.mean() for _ in range(200)]
    # 3 within the bias and the error of a standard deviation from 40 (2.7 with what was expected before)
    assert np.mean(stds) == pytest.approx(3.0, abs=0.12)


def test_drawn_pixels_keep_the_mean_of_their_samples_however_little_is_known_of_its_parts():
    n = 2000
    # H = 5 at 7 DN per electron: log H and log 1/g are known to 0.5 and 0.25, the mean to 0.1 DN
    theta = np.tile([np.log(5.0), np.log(7.0), 80.0, np.log(6.0)], (1, n, 1))
    slope = np.array([35.0, 35.0, 1.0, 0.0])
    basis = np.array([[0.5, -0.25, 0, 0], [0, 0, 0.1, 0], [0, 0, 0, 0.3], [0.1, 0, 0, 0]])
    basis[:, 2] -= basis[:, :2] @ slope[:2]
    covariance = np.tile(basis.T @ basis, (1, n, 1, 1))
    posterior = Posterior(Population(theta[0, 0], np.eye(4)), theta, covariance, np.ones((1, n)))
    exposure, gain, bias, _ = posterior.draw(np.random.default_rng(8)).T
    assert exposure.std() > 2.0
    assert (exposure / gain + bias).std() == pytest.approx(0.1, rel=5.0 / np.sqrt(2.0 * n))
    assert (exposure / gain + bias).mean() == pytest.approx(115.0, abs=5 * 0.1 / np.sqrt(n))


def test_a_single_pixel_does_not_make_the_scatter_of_replicates() -> None:
    usual = np.random.default_rng(6).normal(100.0, 5.0, (16, 3))
    np.testing.assert_array_equal(without_strays(usual), usual)
    strayed = usual.copy()
    strayed[7, 1] = 17_000.0  # as seen in a sum of squares of scores
    found = without_strays(strayed)
    assert abs(found[:, 1].mean() - 100.0) < 20.0
    found[7, 1] = usual[7, 1]
    np.testing.assert_array_equal(found, usual)


def _drawn(modes: int, n: int = 40) -> tuple[np.random.Generator, Covariance]:
    rng = np.random.default_rng(modes)
    return rng, Covariance(rng.uniform(0.2, 4.0, n), rng.normal(size=(modes, n)))


@pytest.mark.parametrize("modes", [0, 3, 12, 60])
def test_what_is_made_of_a_covariance_is_made_of_its_matrix(modes: int) -> None:
    rng, covariance = _drawn(modes)
    whole, rows = dense(covariance), rng.normal(size=(5, 40))
    white = covariance.white(rows)
    expected = rows @ np.linalg.inv(whole) @ rows.T
    np.testing.assert_allclose(white @ white.T, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(covariance.white(rows[0]), white[0], rtol=1e-9, atol=1e-12)
    law = stats.multivariate_normal(np.zeros(40), whole)
    half = -0.5 * white[0] @ white[0] - covariance.log_root_determinant - 20.0 * np.log(2.0 * np.pi)
    assert half == pytest.approx(law.logpdf(rows[0]), rel=1e-10)
    ratio, more = rng.uniform(0.5, 3.0, 40), rng.normal(size=(2, 40))
    np.testing.assert_allclose(covariance.variances, np.diag(whole), rtol=1e-12)
    np.testing.assert_allclose(dense(covariance.times(0.3)), 0.3 * whole, rtol=1e-12)
    np.testing.assert_allclose(dense(covariance.scaled(ratio)), whole * np.outer(ratio, ratio), rtol=1e-12)
    np.testing.assert_allclose(dense(covariance.plus(ratio)), whole + np.diag(ratio), rtol=1e-12)
    np.testing.assert_allclose(dense(covariance.with_modes(more)), whole + more.T @ more, rtol=1e-12)
    some = [3, 5, 30]
    np.testing.assert_allclose(dense(covariance.among(some)), whole[np.ix_(some, some)], rtol=1e-12)


def test_a_mode_far_above_all_others_spoils_none_of_them() -> None:
    rng, covariance = _drawn(3)
    large = covariance.with_modes(1e5 * rng.normal(size=(1, 40)))
    rows = rng.normal(size=(4, 40))
    # an inverse by the small matrix of the modes alone, in extended precision
    own, common = large.own.astype(np.longdouble), large.common.astype(np.longdouble)
    inner = np.eye(4, dtype=np.longdouble) + (common / own) @ common.T
    there = (rows / own) @ common.T
    solved = np.linalg.solve(inner.astype(float), there.T.astype(float))
    expected = (rows / own) @ rows.T - there @ solved
    white = large.white(rows)
    np.testing.assert_allclose(white @ white.T, expected.astype(float), rtol=1e-4)


def test_of_replicates_it_is_their_correlation_drawn_to_the_diagonal() -> None:
    rng = np.random.default_rng(5)
    vectors = rng.normal(size=(24, 30)) @ rng.normal(size=(30, 30))
    vectors[:, 7] = 2.0  # a statistic that is always the same
    _, std, covariance = moments(vectors)
    varied = np.delete(np.arange(30), 7)
    expected = np.eye(30)
    expected[np.ix_(varied, varied)] = 0.4 * np.corrcoef(vectors[:, varied], rowvar=False)
    np.fill_diagonal(expected, 1.0)
    np.testing.assert_allclose(dense(covariance), expected * np.outer(std, std), rtol=1e-10, atol=1e-12)
