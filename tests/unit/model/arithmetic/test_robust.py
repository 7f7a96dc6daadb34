"""Robust scatter, the look-elsewhere effect, and the normal deviate of a chi-square."""

import numpy as np
import pytest
from scipy import stats

from pchem_pipeline.model.arithmetic.robust import chi_square, look_elsewhere, robust_sd


def test_the_scatter_of_a_normal_law_is_its_standard_deviation_whatever_a_few_values_are() -> None:
    values = np.random.default_rng(1).normal(3.0, 2.0, (20_001, 2))
    values[:100] = 1e9
    assert robust_sd(values, axis=0) == pytest.approx([2.0, 2.0], abs=0.1)
    assert robust_sd([1.0, 2.0, 4.0]) == pytest.approx(1.4826, rel=1e-12)
    assert robust_sd([1.0, 2.0, 4.0], 0.0) == pytest.approx(2.0 * 1.4826, rel=1e-12)


def test_the_smallest_of_many_p_values() -> None:
    assert look_elsewhere(0.01, 10) == pytest.approx(1.0 - 0.99**10, rel=1e-12)
    assert look_elsewhere(1e-15, 100) == pytest.approx(1e-13, rel=1e-9)


@pytest.mark.parametrize("freedom", [20, 60, 400])
def test_a_chi_square_as_a_normal_deviate(freedom: int) -> None:
    deviates = np.array([-2.0, 0.0, 2.0, 4.0])
    values = stats.chi2.ppf(stats.norm.cdf(deviates), freedom)
    # Wilson and Hilferty 1931: good to some hundredths
    assert chi_square(values, freedom) == pytest.approx(deviates, abs=0.06)
    assert chi_square(3.0 * values, 3.0 * freedom, 18.0 * freedom) == pytest.approx(deviates, abs=0.06)
