"""The check of an estimator by simulation: its numbers are those of scipy, and it finds a wrong estimator."""

import numpy as np
import pytest
from scipy.stats import ttest_1samp

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.discrepancy.estimator_check import RecoveredStrength, recovered_strength
from pchem_pipeline.effects.operators.curve import Clipping
from pchem_pipeline.effects.operators.offsets import ColumnNoise

STACKS = {"stacks": 5, "n_frames": 400, "shape": (16, 16)}


class TwiceTooLarge(ColumnNoise):
    """Column noise with an estimator that does not know what it does."""

    @classmethod
    def estimate(cls, evidence):
        """Return twice the strength."""
        return [guess.scaled(2.0) for guess in ColumnNoise.estimate(evidence)]


def test_mean_and_probability_are_those_of_a_t_test():
    found = RecoveredStrength(0.5, np.array([0.52, 0.49, 0.55, 0.53]))
    expected = ttest_1samp(found.found, 0.5)
    assert found.probability == pytest.approx(expected.pvalue)
    assert (found.mean - 0.5) / found.standard_error == pytest.approx(expected.statistic)
    missed = RecoveredStrength(0.5, np.array([0.52, np.nan]))
    assert missed.n_guesses == 1
    assert np.isnan([missed.mean, missed.probability]).all()


def test_a_right_estimator_passes_and_a_wrong_one_does_not():
    right = recovered_strength(ColumnNoise(column_noise_dn=1.0), **STACKS)
    assert right.true == 1.0
    assert right.probability > 1e-4
    assert right.standard_error < 0.1
    wrong = recovered_strength(TwiceTooLarge(column_noise_dn=1.0), **STACKS)
    np.testing.assert_allclose(wrong.found, 2 * right.found)
    assert wrong.probability < 1e-4


def test_frames_of_another_simulator_are_taken():
    seeds = []

    def dull(seed):
        seeds.append(seed)
        rng = np.random.default_rng(seed)
        electrons = rng.poisson(2.0, (400, 8, 8)) + 0.25 * rng.standard_normal((400, 8, 8))
        return np.rint(100 + 10 * electrons).astype(np.uint16)

    assert recovered_strength(ColumnNoise(column_noise_dn=1.0), camera=dull, stacks=2, seed=4).n_guesses == 0
    assert seeds == [4, 5]


def test_an_effect_without_a_strength_is_refused():
    with pytest.raises(ConfigError, match="'clipping' has no strength"):
        recovered_strength(Clipping(high=900.0))


class RowBefore(ColumnNoise):
    """Adds a share of the row before, without saying so."""

    def apply(self, values, context):
        """Return each row with what the one before it in the array has."""
        return values + 0.5 * np.roll(values, 1, axis=1)


class FrameBefore(ColumnNoise):
    """Adds a share of the frame before, without saying so."""

    def apply(self, values, context):
        """Return each frame with what the one before it in the array has."""
        return values + 0.5 * np.roll(values, 1, axis=0)


@pytest.mark.parametrize(("effect", "declared"), [(RowBefore, "reach_rows"), (FrameBefore, "reach_frames")])
def test_an_effect_that_reads_more_than_it_declares_is_refused(effect, declared):
    with pytest.raises(ConfigError, match=f"set `{declared}` to how many"):
        recovered_strength(effect(column_noise_dn=1.0), **STACKS)
