"""Maps for simulations: their scatter is that of the true parameters, not that of the fitted ones."""

import numpy as np
import pytest

from pchem_pipeline.discrepancy.by_simulation.maps import equivalent_sensor
from pchem_pipeline.discrepancy.by_simulation.replicate import (
    Acquisition,
    Replicate,
    simulate_frames,
    truth_of,
)
from pchem_pipeline.effects.framework.evidence import PixelMaps

SHAPE = (50, 60)
N = SHAPE[0] * SHAPE[1]


def sensor(rng, spread):
    """Maps whose logarithms (of mu: itself) scatter by ``spread``."""
    off = spread[:, None, None] * rng.standard_normal((4, *SHAPE))
    return off, PixelMaps(
        2 * np.exp(off[0]), 0.09 * np.exp(off[1]), 100 + off[2], 4 * np.exp(off[3]), np.ones(SHAPE, np.bool_)
    )


def logs(maps):
    return np.stack(
        [np.log(maps.quanta_exposure), np.log(maps.conversion_gain), maps.bias, np.log(maps.read_noise_dn)]
    ).reshape(4, -1)


def fitted(rng, truth, size):
    """Maps with correlated errors, their size differing from pixel to pixel, and covariances."""
    root = np.diag([0.02, 0.03, 0.5, 0.06]) @ np.linalg.cholesky(0.5 * np.eye(4) + 0.5)
    scale = size * rng.uniform(0.5, 1.5, N)
    values = logs(truth) + scale * (root @ rng.standard_normal((4, N)))
    exposure, gain, bias, noise = values.reshape(4, *SHAPE)
    maps = PixelMaps(np.exp(exposure), np.exp(gain), bias, np.exp(noise), truth.usable)
    jacobian = np.stack(
        [maps.quanta_exposure, maps.conversion_gain, np.ones(SHAPE), maps.read_noise_dn], axis=-1
    )
    covariance = (scale**2).reshape(*SHAPE, 1, 1) * (root @ root.T)
    return maps, covariance * jacobian[..., :, None] * jacobian[..., None, :]


@pytest.mark.parametrize("size", [1.0, 0.3])
def test_scatter_is_that_of_the_truth(size):
    rng = np.random.default_rng(3)
    spread = np.array([0.3, 0.02, 0.5, 0.03])
    _, truth = sensor(rng, spread)
    maps, covariance = fitted(rng, truth, size)
    drawn = equivalent_sensor(maps, covariance)
    before, after = np.cov(logs(maps)), np.cov(logs(drawn))
    # the variance of C = T + E scatters by sqrt(2/n) of itself, and E is taken off
    limit = 5 * np.sqrt(2 / N) * np.diag(before)
    assert (np.abs(np.diag(after) - spread**2) < limit).all()
    if size == 1.0:
        assert (np.abs(np.diag(before) - spread**2) > limit)[1:].all()
        # correlations come from the errors alone, and are gone with them
        off = ~np.eye(4, dtype=np.bool_)
        scale = np.sqrt(np.outer(np.diag(before), np.diag(before)))
        assert np.abs(after / scale)[off].max() < 5 / np.sqrt(N)
        assert np.abs(before / scale)[1:, 1:][off[1:, 1:]].min() > 5 / np.sqrt(N)
    # in truth and maps it is the same pixel that is high
    assert np.corrcoef(logs(drawn)[0], logs(truth)[0])[0, 1] > 0.99


def test_sharp_maps_outliers_and_unknown_errors_stay():
    rng = np.random.default_rng(4)
    _, truth = sensor(rng, np.array([0.3, 0.02, 0.5, 0.03]))
    maps, covariance = fitted(rng, truth, 0.01)
    drawn = equivalent_sensor(maps, covariance)
    assert np.abs(logs(drawn) - logs(maps)).max() < 1e-3
    maps, covariance = fitted(rng, truth, 1.0)
    maps.quanta_exposure[0, 0] = 80.0
    covariance[1, 1] = np.nan
    drawn = equivalent_sensor(maps, covariance)
    for place in ((0, 0), (1, 1)):
        assert drawn.bias[place] == pytest.approx(maps.bias[place], rel=1e-12)
        assert drawn.quanta_exposure[place] == pytest.approx(maps.quanta_exposure[place], rel=1e-12)
    few = PixelMaps(
        *(
            getattr(maps, n)[:5, :5]
            for n in ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn", "usable")
        )
    )
    assert equivalent_sensor(few, covariance[:5, :5]) is few


def test_a_replicate_mistakes_as_many_biases_as_the_frames_do():
    """Begun at the truth, hardly a fit is an electron off; begun from nothing, as many as of frames."""
    rng = np.random.default_rng(5)
    shape = (32, 32)
    ones = np.ones(shape)
    maps = PixelMaps(2.7 * ones, ones / 11, 100 + rng.standard_normal(shape), 0.41 * 11 * ones, ones > 0)
    numbers = np.arange(600)
    known = Acquisition(numbers, 1200, 50, 12)
    anew = Acquisition(numbers, 1200, 50, 12, fitted_with=np.arange(600, 1200))
    truth = truth_of(maps).bias

    def mistaken(taken, seed):
        found = Replicate("x", maps, (), seed, taken).evidence().maps
        return np.mean(np.abs(found.bias - truth)[found.usable] > 0.5 * 11)

    assert mistaken(known, 1) < 0.005
    first, second = mistaken(anew, 1), mistaken(anew, 2)
    assert first > 0.03
    # two binomial shares
    assert abs(first - second) < 5 * np.sqrt(2 * first * (1 - first) / maps.usable.sum())
    # the frames of a split do not depend on what else is simulated
    both = simulate_frames(maps, (), 1, Acquisition(np.arange(1200), 1200, 50, 12))
    assert (simulate_frames(maps, (), 1, known) == both[:600]).all()
