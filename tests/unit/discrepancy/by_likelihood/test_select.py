"""Stepwise selection of effects by the likelihood of histograms."""

import numpy as np
import pytest

from pchem_pipeline.discrepancy.by_likelihood.members import Member, law_of
from pchem_pipeline.discrepancy.by_likelihood.sets import SetComparison, select
from pchem_pipeline.effects.framework.registry import effect_class
from pchem_pipeline.model.fit.shared import Samples
from pchem_pipeline.model.law.mass import sample_mass

BRANCHING = effect_class("branching_counts")
WIDENING = effect_class("signal_dependent_noise")
PARAMETERS = np.array([[h, 1 / 14, 100.0, 3.0] for h in (0.8, 1.6, 2.4, 3.2)])


def candidates():
    """Effects at typical strengths."""
    tags = "branching_counts", "overdispersed_counts", "signal_dependent_noise", "nonlinearity"
    return [Member.of(effect) for tag in tags for effect in effect_class(tag).typical()]


@pytest.fixture(scope="module")
def sets():
    """Histograms of four pixels with branching, and with noise that grows with the signal."""
    rng = np.random.default_rng(4)
    effects, none = (BRANCHING(branching=0.08), WIDENING(noise_e=0.12)), np.zeros(0)
    law = law_of(effects, (), none, PARAMETERS, Samples())
    mass = sample_mass(law, list(PARAMETERS.T), np.tile(np.arange(70, 250), (4, 1)))
    train, test = (rng.multinomial(20000, mass / mass.sum(axis=1, keepdims=True)) for _ in range(2))
    every = np.ones(train.shape, np.bool_)
    return SetComparison(train, test, np.full(4, 70), every, (), PARAMETERS)


def tags(found):
    return {member.tag for member in found.members}


def test_what_is_in_the_data_is_selected(sets):
    found = select(sets, candidates())
    assert tags(found) == {"branching_counts", "signal_dependent_noise"}
    for member, true in zip(sorted(found.members, key=lambda m: m.tag), (0.08, 0.12), strict=True):
        value = getattr(member.effect, member.effect.strength)
        assert abs(value - true) < 4 * found.stderr(member)[member.effect.strength]
    assert sets.gap(found).at_floor


def test_a_needless_effect_is_left_out_and_a_wrong_one_exchanged(sets):
    wrong = sets.fit([m for m in candidates() if m.tag in ("overdispersed_counts", "nonlinearity")][:2])
    assert tags(wrong) == {"overdispersed_counts", "nonlinearity"}
    assert tags(select(sets, candidates(), wrong)) == {"branching_counts", "signal_dependent_noise"}
