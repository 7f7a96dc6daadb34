"""The gap of histograms from a fit: what chance makes of it, and codes that are set aside."""

import numpy as np
import pytest

from pchem_pipeline.discrepancy.by_likelihood.gap import gap_of, on_all_codes


def masses(n_codes, spread):
    """Masses of codes that fall off to either side, the rarest below any count."""
    codes = np.arange(n_codes) - n_codes / 2
    found = np.exp(-0.5 * (codes / spread) ** 2)
    return found / found.sum()


def assert_by_chance(gaps):
    """Gaps by chance scatter about 0, as much as their floor says."""
    values = np.array([gap.value for gap in gaps])
    assert abs(values.mean()) < 4 * values.std() / len(gaps) ** 0.5
    assert 1.645 * values.std() == pytest.approx(gaps[0].floor, rel=0.15)


@pytest.mark.parametrize("samples", [30, 3000])
def test_gap_by_chance_is_that_of_simulated_histograms(samples):
    rng = np.random.default_rng(1)
    p = np.tile(masses(60, 6.0), (8, 1))
    drawn = [gap_of(rng.multinomial(samples, p), np.log(p), 0, share=1.0) for _ in range(400)]
    assert_by_chance(drawn)
    assert np.mean([gap.at_floor for gap in drawn]) == pytest.approx(0.95, abs=0.04)


def test_fitted_parameters_add_what_their_errors_do():
    """Frequencies of three codes, fitted to other samples: two parameters for each histogram."""
    rng = np.random.default_rng(2)
    p = np.tile([0.5, 0.3, 0.2], (50, 1))
    found = []
    for _ in range(300):
        fitted = rng.multinomial(4000, p) / 4000
        found.append(gap_of(rng.multinomial(2000, p), np.log(fitted), 100, share=0.5))
    assert_by_chance(found)


def test_codes_that_are_set_aside_keep_what_they_have_without_effects():
    plain, kept = np.log(masses(20, 4.0))[None], np.arange(20)[None] > 8
    fitted = np.where(kept, np.log(masses(20, 3.0)), -np.inf)
    fitted = np.where(kept, fitted - np.log(np.exp(fitted).sum()), 0.0)
    whole = on_all_codes(fitted, kept, plain)
    assert np.exp(whole).sum() == pytest.approx(1.0)
    np.testing.assert_array_equal(whole[~kept], plain[~kept])
