"""Random numbers of electrons that are lost or grouped anew, and mixtures of exposures by their moments."""

import numpy as np
import pytest
from scipy import stats

from pchem_pipeline.effects.estimators.charge_sums import exposure_nodes
from pchem_pipeline.effects.framework.draws import binomial_upper, further_uniform, regrouped


@pytest.mark.parametrize(("n", "p"), [(1, 0.3), (7, 0.02), (40, 0.6), (20_000, 0.3)])
def test_binomial_numbers_come_from_the_upper_end(n, p):
    u = (np.arange(1000) + 0.5) / 1000
    seen = binomial_upper(u, np.full(1000, n), p)
    assert np.array_equal(seen, stats.binom.isf(u, n, p))
    assert np.all(np.diff(seen) <= 0)


def test_further_numbers_are_uniform_and_unrelated():
    n = 200_000
    u = np.random.default_rng(1).random(n) * 1e-3
    more = [further_uniform(u, draw) for draw in (0, 1, 2)]
    for a in more:
        assert a.min() > 0
        assert a.max() < 1
        assert stats.kstest(a, "uniform").pvalue > 5.7e-7
    for a, b in ((more[0], more[1]), (more[1], more[2]), (more[0], u)):
        assert abs(np.corrcoef(a, b)[0, 1]) < 5 / np.sqrt(n)
    assert np.array_equal(further_uniform(u, np.arange(n) % 3)[1::3], more[1][1::3])


def test_of_very_many_electrons_of_which_nearly_all_are_lost_the_few_are_left():
    """The chance that none is lost is 0 in doubles, which is no reason for a warning."""
    electrons, rng = np.full(2000, 900), np.random.default_rng(4)
    left = regrouped(
        electrons,
        rng.random(2000),
        1.0,
        lambda index: (0.9, 0.0),
        lambda u, index: np.zeros(u.size, np.int64),
    )
    assert abs(left.mean() - 90.0) < 4.0 * np.sqrt(900 * 0.09 / 2000)
    assert left.var() == pytest.approx(81.0, rel=4.0 * np.sqrt(2.0 / 2000))


def test_exposures_of_a_run_are_a_mixture_with_its_moments():
    factors = 1.0 + 0.8 * np.random.default_rng(3).beta(0.5, 2.0, 1000)
    factors /= factors.mean()
    weights, nodes = exposure_nodes(factors)
    for power in range(6):
        assert weights @ nodes**power == pytest.approx(np.mean(factors**power), rel=1e-9)
    assert exposure_nodes(np.ones(5))[1].tolist() == [1.0]
    two = exposure_nodes(np.array([0.9, 1.1]))
    assert np.allclose(two[1], [0.9, 1.1])
    assert np.allclose(two[0], 0.5)
