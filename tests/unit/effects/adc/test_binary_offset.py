"""Binary offset: the forward model, the regression on bits, and what the estimator makes of it."""

import numpy as np
import pytest
from helpers.small_sensors import context_of, drawn_truth, seen, taken

from pchem_pipeline.discrepancy.observe.digital.groups import BITS
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.operators.couple import BinaryOffset
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.sample_law import SampleLaw


def test_the_code_before_moves_a_sample_one_after_the_other():
    values = np.random.default_rng(1).uniform(90, 140, (3, 4, 9))
    effect = BinaryOffset(offset_dn=2.0, bits=(1.0, 0.0, -0.5))
    expected = values.copy()
    for t, y, x in np.ndindex(values.shape):
        if x:
            before = format(round(expected[t, y, x - 1]), "016b")
            expected[t, y, x] += 2.0 * (int(before[-1]) - 0.5) - 1.0 * (int(before[-3]) - 0.5)
    np.testing.assert_allclose(effect.apply(values, context_of((4, 9), 3)), expected, atol=1e-12)
    same = BinaryOffset(offset_dn=0.0).apply(values, context_of((4, 9), 3))
    np.testing.assert_array_equal(same, values)


def test_the_law_has_the_variance_of_all_bits():
    maps = PixelMaps(np.array([1.5]), np.array([0.1]), np.array([100.0]), np.array([3.0]), np.ones(1, bool))
    codes = np.arange(40, 300)
    bits = (0.5, 0.2, 0.0, 1.0, -0.3)
    law = BinaryOffset(offset_dn=1.6, bits=bits).sample_law(SampleLaw(), maps)
    variances = []
    for one in (SampleLaw(), law):
        mass = sample_mass(one, maps, codes)[0]
        variances.append(mass @ (codes - mass @ codes) ** 2)
    assert variances[1] - variances[0] == pytest.approx(1.6**2 / 4 * np.sum(np.square(bits)), rel=1e-6)


TRUE = BinaryOffset(offset_dn=-1.0, bits=(-0.3, -0.5, 0.0, 1.0))


@pytest.mark.parametrize(
    ("effect", "shape", "seed"),
    [
        (BinaryOffset(offset_dn=0.5), (24, 24), 1),
        (BinaryOffset(offset_dn=-0.5, bits=(0.0, 0.0, 1.0)), (20, 36), 2),
        (TRUE, (36, 20), 3),
    ],
)
def test_the_bits_and_their_offsets_are_found(effect, shape, seed):
    evidence = seen(taken(drawn_truth(shape, seed=seed), effect, n_frames=1600, seed=seed))
    [found] = BinaryOffset.estimate(evidence)
    bits = evidence.time.previous_bits
    # a bit of the sample before is known beyond its value up to these errors
    errors = np.sqrt(bits.variance / np.diag(bits.square))
    wanted, offsets = np.zeros(BITS), np.zeros(BITS)
    wanted[: len(effect.bits)] = effect.offset_dn * np.array(effect.bits)
    offsets[: len(found.bits)] = found.offset_dn * np.array(found.bits)
    small = wanted == 0
    assert not offsets[small].any()
    assert (np.abs(offsets - wanted)[~small] < 4 * errors[~small]).all()
    assert (errors[~small] < 0.35 * np.abs(wanted[~small])).all()
    assert evidence.z["space.x.bits"] > 5.0
