"""Trapping: its law, its moments in time and its estimator, against theory and a camera of the test's own."""

import numpy as np
import pytest
from helpers.small_sensors import electrons
from scipy import stats

from pchem_pipeline.discrepancy.estimator_check import recovered_strength
from pchem_pipeline.effects.operators.fate import Trapping
from pchem_pipeline.model.law.sample_law import SampleLaw

H, FRAMES, SHAPE = 2.0, 2000, (30, 30)
TRAP = Trapping(capture=0.5, release=0.3)


def theory(exposure, capture, release):
    """Return the chance m that a sample with electrons loses one, and P(K >= 2)."""
    some = -np.expm1(-exposure)
    return capture * release / (release + capture * some), some - exposure * np.exp(-exposure)


def of_numpy(seed, capture=0.3, release=0.3, shape=(20, 20), n_frames=1500):
    """Return frames of pixels with a trap each, frame by frame: 10 DN and 0.3 e- of noise an electron."""
    rng = np.random.default_rng(seed)
    full = rng.random(shape) < 0.5
    frames = np.empty((n_frames, *shape), np.uint16)
    for t in range(-60, n_frames):
        k = rng.poisson(H, shape)
        freed = full & (rng.random(shape) < release)
        caught = ~full & (k > 0) & (rng.random(shape) < capture)
        full = (full & ~freed) | caught
        if t >= 0:
            seen = k + freed - caught + 0.3 * rng.standard_normal(shape)
            frames[t] = np.rint(100 + 10 * seen)
    return frames


def test_variance_and_covariances_in_time_are_those_of_theory():
    k = electrons(H, SHAPE, FRAMES, TRAP)
    n, pixels = FRAMES, SHAPE[0] * SHAPE[1]
    m, several = theory(H, TRAP.capture, TRAP.release)
    left = 1.0 - TRAP.release - TRAP.capture * -np.expm1(-H)
    assert abs(k.mean() - H) < 5 * np.sqrt(H / k.size)  # no charge is lost
    off = k - k.mean(axis=0)
    error = np.sqrt(3.0) * H / np.sqrt(n * pixels)  # of a variance; of a product it is less
    variance = (off**2).sum() / (n - 1) / pixels
    assert abs(variance - H - 2 * m * several) < 5 * error
    assert 2 * m * several > 20 * error
    for lag in (1, 2, 3):
        found = (off[lag:] * off[:-lag]).sum() / (n - lag) / pixels + variance / n
        expected = -TRAP.release * TRAP.capture * several * left ** (lag - 1)
        assert abs(found - expected) < 5 * error
        assert lag > 1 or abs(expected) > 20 * error


def test_a_sample_has_the_law_of_the_fit():
    """Each pixel's frames are correlated; one frame of a thousand pixels is not."""
    k = electrons(H, (60, 60), 400, TRAP)[::40]  # the states of a trap forget in 40 frames
    m, _ = theory(H, TRAP.capture, TRAP.release)
    number = np.arange(12)
    plain = stats.poisson.pmf(np.arange(-1, 14), H)
    some, p, above, below = -np.expm1(-H), plain[1:13], plain[2:14], plain[0:12]
    mass = p + m * some * (below - p) + m * (above - p * (number >= 1))
    law = TRAP.sample_law(SampleLaw(), _maps(H))
    assert law.law == "trapped"
    assert np.ravel(law.dispersion)[0] == pytest.approx(m, rel=1e-12)
    seen = np.bincount(k.ravel(), minlength=12)[:12]

    def misfit(expected):
        good = expected > 20
        chi2 = float(((seen - expected)[good] ** 2 / expected[good]).sum())
        return (chi2 - good.sum()) / np.sqrt(2.0 * good.sum())

    assert abs(misfit(k.size * mass)) < 5
    assert misfit(k.size * p) > 20


def _maps(exposure):
    from pchem_pipeline.effects.framework.evidence import PixelMaps

    one = np.ones((1, 1))
    return PixelMaps(exposure * one, 0.1 * one, 100.0 * one, 3.0 * one, one.astype(bool))


@pytest.mark.parametrize("camera", [None, of_numpy], ids=["package", "numpy"])
def test_it_is_guessed_in_every_stack(camera):
    found = recovered_strength(Trapping(capture=0.3, release=0.3), camera=camera)
    assert found.n_guesses == 6
    assert 1 / 3 < found.mean / 0.3 < 3


def test_nothing_is_found_where_nothing_is():
    assert recovered_strength(Trapping(capture=0.0)).n_guesses == 0
