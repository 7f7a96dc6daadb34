"""Mixtures of exposures by their moments."""

import numpy as np
import pytest

from pchem_pipeline.effects.estimators.charge_sums import exposure_nodes


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
