"""The covariance of few replicates against its matrix, by scipy and numpy."""

import numpy as np
import pytest
from scipy import stats

from pchem_pipeline.discrepancy.covariance import Covariance
from pchem_pipeline.discrepancy.null import moments

MODES = [0, 3, 12, 60]


def _drawn(modes: int, n: int = 40) -> tuple[np.random.Generator, Covariance]:
    rng = np.random.default_rng(modes)
    return rng, Covariance(rng.uniform(0.2, 4.0, n), rng.normal(size=(modes, n)))


@pytest.mark.parametrize("modes", MODES)
def test_white_vectors_and_determinant_are_those_of_the_matrix(modes: int) -> None:
    rng, covariance = _drawn(modes)
    rows = rng.normal(size=(5, 40))
    white = covariance.white(rows)
    expected = rows @ np.linalg.inv(covariance.dense()) @ rows.T
    np.testing.assert_allclose(white @ white.T, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(covariance.white(rows[0]), white[0], rtol=1e-9, atol=1e-12)
    law = stats.multivariate_normal(np.zeros(40), covariance.dense())
    half = -0.5 * white[0] @ white[0] - covariance.log_root_determinant - 20.0 * np.log(2.0 * np.pi)
    assert half == pytest.approx(law.logpdf(rows[0]), rel=1e-10)


@pytest.mark.parametrize("modes", MODES)
def test_what_is_made_of_a_covariance_is_made_of_its_matrix(modes: int) -> None:
    rng, covariance = _drawn(modes)
    dense, ratio, more = covariance.dense(), rng.uniform(0.5, 3.0, 40), rng.normal(size=(2, 40))
    np.testing.assert_allclose(covariance.variances, np.diag(dense), rtol=1e-12)
    np.testing.assert_allclose(covariance.times(0.3).dense(), 0.3 * dense, rtol=1e-12)
    np.testing.assert_allclose(covariance.scaled(ratio).dense(), dense * np.outer(ratio, ratio), rtol=1e-12)
    np.testing.assert_allclose(covariance.plus(ratio).dense(), dense + np.diag(ratio), rtol=1e-12)
    np.testing.assert_allclose(covariance.with_modes(more).dense(), dense + more.T @ more, rtol=1e-12)
    some = [3, 5, 30]
    np.testing.assert_allclose(covariance.among(some).dense(), dense[np.ix_(some, some)], rtol=1e-12)


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
    np.testing.assert_allclose(covariance.dense(), expected * np.outer(std, std), rtol=1e-10, atol=1e-12)
