"""Wrong bits: the forward model, the law of a pixel, and what the estimator makes of the counts per code."""

import numpy as np
import pytest
from helpers.small_sensors import context_of, drawn_truth, seen, taken

from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.operators.replace import BitErrors
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.sample_law import SampleLaw

SHAPE = (50, 50)
FRAMES = np.random.default_rng(1).integers(90, 140, (40, *SHAPE)).astype(np.uint16)


def by_hand(code, bit, fault):
    """Return a code with a wrong bit, by its binary digits."""
    digits = list(f"{code:016b}")
    place = 15 - bit
    digits[place] = {"zero": "0", "one": "1", "flip": "10"[int(digits[place])]}[fault]
    return int("".join(digits), 2)


@pytest.mark.parametrize("fault", ["zero", "one", "flip"])
@pytest.mark.parametrize("bit", [0, 3, 5])
def test_a_stuck_bit_is_wrong_in_every_sample(bit, fault):
    effect = BitErrors(share=1.0, bit=bit, fault=fault)
    found = effect.apply(FRAMES, context_of(SHAPE, 40))
    table = np.array([by_hand(code, bit, fault) for code in range(256)])
    np.testing.assert_array_equal(found, table[FRAMES])
    assert found.dtype == FRAMES.dtype


def test_a_share_of_the_samples_is_wrong():
    found = BitErrors(share=0.02, bit=3, fault="flip").apply(FRAMES, context_of(SHAPE, 40))
    n, wrong = FRAMES.size, int((found != FRAMES).sum())
    assert abs(wrong - 0.02 * n) < 5 * np.sqrt(0.02 * 0.98 * n)
    np.testing.assert_array_equal(BitErrors(share=0, bit=3).apply(FRAMES, context_of(SHAPE, 40)), FRAMES)


def test_a_bit_that_the_converter_lacks_is_never_wrong():
    found = BitErrors(share=1.0, bit=14, fault="one").apply(FRAMES, context_of(SHAPE, 40))
    np.testing.assert_array_equal(found, FRAMES)


@pytest.mark.parametrize("fault", ["zero", "one", "flip"])
def test_the_law_has_as_many_moved_samples_and_their_mean(fault):
    effect = BitErrors(share=0.01, bit=3, fault=fault)
    maps = PixelMaps(
        np.array([0.8, 2.5]), np.array([0.1, 0.07]), np.array([100.3, 97.0]), np.array([3.0, 3.4]),
        np.ones(2, bool),
    )  # fmt: skip
    codes = np.arange(40, 400)
    plain = sample_mass(SampleLaw(), maps, codes)
    law = sample_mass(effect.sample_law(SampleLaw(), maps), maps, codes)
    exact = 0.99 * plain
    for place, code in enumerate(codes):
        exact[:, by_hand(code, 3, fault) - 40] += 0.01 * plain[:, place]
    np.testing.assert_allclose(law.sum(axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(law @ codes, exact @ codes, atol=2e-4)


def test_the_law_takes_some_of_the_errors_out_of_the_read_noise():
    rng = np.random.default_rng(7)
    n = 24
    maps = PixelMaps(
        rng.uniform(0.5, 3, n), 1 / rng.uniform(8, 16, n), rng.uniform(96, 112, n), rng.uniform(2.4, 4.2, n),
        np.ones(n, bool),
    )  # fmt: skip
    effect = BitErrors(share=0.004, bit=3)
    codes = np.arange(30, 500)
    plain = sample_mass(SampleLaw(), maps, codes)
    mass = 0.996 * plain
    for place, code in enumerate(codes[:300]):
        mass[:, by_hand(int(code), 3, "zero") - 30] += 0.004 * plain[:, place]
    counts, origin = np.rint(1e6 * mass).astype(np.uint32), np.full(n, 30)
    errors = []
    for law in (None, effect.sample_law(SampleLaw(), maps)):
        fit = fit_histograms(counts, origin, law=law, settings=FitSettings(tail_guard=0))
        errors.append(np.sqrt(np.nanmean(np.log(fit.read_noise_dn / maps.read_noise_dn) ** 2)))
    # from which codes the samples come, the law does not know, so it is not exact
    assert errors[1] < 0.7 * errors[0]
    assert errors[0] > 3e-3


CASES = [
    (BitErrors(share=0.004, bit=3), (40, 40), 2),
    (BitErrors(share=0.004, bit=3, fault="flip"), (32, 50), 3),
    (BitErrors(share=0.02, bit=1), (40, 40), 4),
    (BitErrors(share=0.002, bit=7), (40, 40), 5),
]


@pytest.mark.parametrize(("effect", "shape", "seed"), CASES)
def test_bit_fault_and_share_are_found(effect, shape, seed):
    truth = drawn_truth(shape, seed=seed)
    guesses = BitErrors.estimate(seen(taken(truth, effect, n_frames=2000, seed=seed)))
    assert {guess.bit for guess in guesses} == {effect.bit}
    found = next(guess for guess in guesses if guess.fault == effect.fault)
    # half of the pixels have no fit where a high bit is lost
    assert 0.4 < found.share / effect.share < 2.5


@pytest.mark.parametrize(("bit", "fault"), [(0, "zero"), (1, "one"), (3, "zero")])
def test_a_bit_that_never_changes_is_stuck(bit, fault):
    effect = BitErrors(share=1.0, bit=bit, fault=fault)
    truth = drawn_truth((16, 16))
    assert BitErrors.estimate(seen(taken(truth, effect, n_frames=800))) == (effect,)
