"""Telegraph jumps are subtracted as Bayes' theorem says, and the noise that remains is as stated."""

import numpy as np
import pytest
from scipy import stats

from pchem_pipeline.model.electrons.electrons import KnownPixels
from pchem_pipeline.model.law.sample_law import SampleLaw
from pchem_pipeline.use.telegraph import TelegraphJumps

N, BIAS, WEIGHT = 20_000, 100.0, 0.2
DOUBLE = ((-1.0, 0.5), (1.0, 0.5))


def stack(gain, noise, step, exposure, pattern=DOUBLE, seed=5):
    """Return electrons and frames (n, 1, 3) of like pixels, each with a trap, and the pixels as known."""
    rng = np.random.default_rng(seed)
    levels = np.array([0.0, *(step * height for height, _ in pattern)])
    share = [1.0 - WEIGHT, *(WEIGHT * w for _, w in pattern)]
    electrons = rng.poisson(exposure, (N, 1, 3))
    jump = rng.choice(levels, electrons.shape, p=share)
    value = BIAS + (electrons + jump + noise * rng.standard_normal(electrons.shape)) / gain
    law = SampleLaw().with_free_satellites([step], pattern=pattern)
    sigma = np.sqrt((noise / gain) ** 2 + 1.0 / 12.0)
    parameters = [np.full(3, each) for each in (exposure, gain, BIAS, sigma)]
    known = KnownPixels(parameters, law, (np.full(3, step), np.full(3, WEIGHT)))
    return electrons, np.rint(value).astype(np.uint16), known


def without_jumps(frames, known, gain, prior):
    found = TelegraphJumps.of(frames.min(axis=0), frames.max(axis=0), prior, known)
    values = ((frames - BIAS) * gain).astype(np.float32)
    found.subtract(values, frames, 0)
    return values, found


@pytest.mark.parametrize("exposure", [0.1, 2.0, 20.0])
@pytest.mark.parametrize(("gain", "noise", "step"), [(0.1, 0.2, 0.5), (0.1, 0.3, 4.0), (0.4, 0.3, 1.5)])
def test_the_noise_that_remains_is_as_stated(gain, noise, step, exposure):
    electrons, frames, known = stack(gain, noise, step, exposure)
    values, found = without_jumps(frames, known, gain, np.full((1, 3), exposure))
    square = (values - electrons).astype(np.float64).ravel() ** 2
    error = square.std() / np.sqrt(square.size) / (2.0 * np.sqrt(square.mean()))
    # the derivative of the mean is taken from code to code: 0.25 e- apart it is 3 % off at most
    assert abs(np.sqrt(square.mean()) - found.noise.mean()) < 5.0 * error + (0.01 if gain < 0.4 else 0.03)
    before = np.sqrt(np.mean(((frames - BIAS) * gain - electrons) ** 2))
    assert np.sqrt(square.mean()) < before
    if exposure < 1.0:
        assert before - found.noise.mean() > 0.4 * (before - noise)
    assert abs((values - electrons).mean()) < 5.0 * np.sqrt(square.mean() / square.size)


@pytest.mark.parametrize("pattern", [DOUBLE, ((1.0, 1.0),)])
def test_the_jump_is_its_mean_given_the_code_by_a_sum_over_electrons_and_levels(pattern):
    gain, noise, step, exposure = 0.1, 0.25, 1.4, 0.8
    _, frames, known = stack(gain, noise, step, exposure, pattern)
    _, found = without_jumps(frames, known, gain, np.full((1, 3), exposure))
    code = found.tables.first[0] + np.arange(found.tables.start[1])
    k = np.arange(30)
    levels = [(0.0, 1.0 - WEIGHT), *((height * step, WEIGHT * w) for height, w in pattern)]
    mass = []
    for level, share in levels:
        middle = BIAS + (k + level) / gain
        cell = stats.norm.cdf(code[:, None] + 0.5, middle, noise / gain)
        cell -= stats.norm.cdf(code[:, None] - 0.5, middle, noise / gain)
        mass.append(share * cell @ stats.poisson.pmf(k, exposure))
    expected = np.array([level for level, _ in levels]) @ mass / np.sum(mass, axis=0)
    likely = np.sum(mass, axis=0) > 1e-9
    np.testing.assert_allclose(found.jump[: code.size][likely], expected[likely], atol=1e-5)


def test_the_noise_that_remains_does_not_depend_on_the_codes_that_few_frames_show():
    _, frames, known = stack(0.1, 0.2, 2.5, 0.1)
    few, many = (without_jumps(each, known, 0.1, np.full((1, 3), 0.1))[1] for each in (frames[:60], frames))
    np.testing.assert_allclose(few.noise, many.noise, rtol=0.003)


def test_without_a_prior_whole_electrons_are_kept_and_pixels_without_a_trap_are_left_alone():
    _, frames, known = stack(0.1, 0.15, 2.0, 0.1)
    amplitude = np.array([2.0, 0.0, 2.0])
    known = KnownPixels(known.parameters, known.law, (amplitude, np.array([WEIGHT, WEIGHT, 0.0])))
    values, found = without_jumps(frames, known, 0.1, None)
    assert found.pixels.tolist() == [0]
    np.testing.assert_array_equal(values[..., 1:], ((frames - BIAS) * 0.1).astype(np.float32)[..., 1:])
    star = frames.copy()
    star[:5, 0, 0] = np.rint(BIAS + 60.0)  # six electrons, where jumps of two come
    kept, _ = without_jumps(star, known, 0.1, None)
    assert np.all(np.abs(kept[:5, 0, 0] - 6.0) < 0.5)
