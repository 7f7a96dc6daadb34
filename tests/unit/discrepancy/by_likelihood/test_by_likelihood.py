"""Effects by the likelihood of histograms: stepwise selection, the gap that is left, and where it is."""

import numpy as np
import pytest

from pchem_pipeline.discrepancy.by_likelihood.comb import find_residuals
from pchem_pipeline.discrepancy.by_likelihood.gap import gap_of, on_all_codes
from pchem_pipeline.discrepancy.by_likelihood.members import Member, law_of
from pchem_pipeline.discrepancy.by_likelihood.sets import SetComparison, select
from pchem_pipeline.effects.framework.registry import effect_class
from pchem_pipeline.model.fit.shared import Samples
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.sample_law import SampleLaw

BRANCHING = effect_class("branching_counts")
WIDENING = effect_class("signal_dependent_noise")
PARAMETERS = np.array([[h, 1 / 14, 100.0, 3.0] for h in (0.8, 1.6, 2.4, 3.2)])


def candidates():
    """Effects at typical strengths."""
    tags = "branching_counts", "overdispersed_counts", "signal_dependent_noise", "nonlinearity"
    return [Member.of(effect) for tag in tags for effect in effect_class(tag).typical()]


def test_what_is_in_the_data_is_selected_and_a_needless_or_wrong_one_is_left_out():
    """Histograms of four pixels with branching, and with noise that grows with the signal."""
    rng = np.random.default_rng(4)
    effects, none = (BRANCHING(branching=0.08), WIDENING(noise_e=0.12)), np.zeros(0)
    law = law_of(effects, (), none, PARAMETERS, Samples())
    mass = sample_mass(law, list(PARAMETERS.T), np.tile(np.arange(70, 250), (4, 1)))
    train, test = (rng.multinomial(20000, mass / mass.sum(axis=1, keepdims=True)) for _ in range(2))
    every = np.ones(train.shape, np.bool_)
    sets = SetComparison(train, test, np.full(4, 70), every, (), PARAMETERS)
    wrong = sets.fit([m for m in candidates() if m.tag in ("overdispersed_counts", "nonlinearity")][:2])
    assert {member.tag for member in wrong.members} == {"overdispersed_counts", "nonlinearity"}
    for found in (select(sets, candidates(), wrong), select(sets, candidates())):
        assert {member.tag for member in found.members} == {"branching_counts", "signal_dependent_noise"}
    for member, true in zip(sorted(found.members, key=lambda m: m.tag), (0.08, 0.12), strict=True):
        value = getattr(member.effect, member.effect.strength)
        assert abs(value - true) < 4 * found.stderr(member)[member.effect.strength]
    assert sets.gap(found).at_floor


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


TWO_PIXELS = np.array([[2.0, 1 / 14, 100.0, 2.0], [1.5, 1 / 14, 108.0, 2.0]])


def histograms():
    """Expected samples of two pixels of different bias, shape (2, B), and DN of bin 0."""
    origin, codes = np.array([80, 88]), np.arange(160)
    rows = [
        sample_mass(SampleLaw(), [np.array([v]) for v in row], first + codes)[0]
        for row, first in zip(TWO_PIXELS, origin, strict=True)
    ]
    return 1e5 * np.array(rows), origin


def test_chance_leaves_nothing_and_what_is_added_is_found_in_its_place():
    rng = np.random.default_rng(3)
    expected, origin = histograms()
    seen = rng.poisson(expected).astype(float)
    assert find_residuals(seen, expected, origin, TWO_PIXELS) == []
    between = (np.arange(160) + origin[:, None] - TWO_PIXELS[:, 2:3]) / 14
    seen += rng.poisson(np.where((between > 1.4) & (between < 1.6), 60.0, 0.0))
    first = find_residuals(seen, expected, origin, TWO_PIXELS)[0]
    assert first.sentence.startswith("more samples than expected between the 1- and the 2-electron peak")
    assert 100 + 14 < first.dn[0] <= first.dn[1] < 108 + 28


def test_a_peak_that_was_set_aside_comes_first():
    expected, origin = histograms()
    electrons = (np.arange(160) + origin[:, None] - TWO_PIXELS[:, 2:3]) / 14
    seen = np.where(electrons < 0.5, 0.1, 1.0) * expected
    [peak] = find_residuals(seen, expected, origin, TWO_PIXELS, [(None, 0.5)])
    assert peak.sentence.startswith("fewer samples than expected at the 0-electron peak")
    assert peak.direction == "-"
