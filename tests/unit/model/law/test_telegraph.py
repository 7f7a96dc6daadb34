"""Pixels whose exposure blinks: the likelihood against plain matrices, and what is found in drawn samples."""

import numpy as np
import pytest

from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.operators.light import DarkCurrentRts
from pchem_pipeline.model.law import telegraph_numba
from pchem_pipeline.model.law.telegraph import find_telegraph, transitions

PIXEL = np.array([1.4, 1 / 12, 100.0, 3.6])
STEP, SHARE, TAU = 0.9, 0.4, 60.0


def course(rng, frames, share, tau):
    up = np.empty(frames.size, bool)
    state = rng.random() < share
    for i, gap in enumerate(np.diff(frames, prepend=frames[0])):
        if rng.random() > np.exp(-gap / tau):
            state = rng.random() < share
        up[i] = state
    return up


def drawn(rng, exposure):
    _, gain, bias, sigma = PIXEL
    dn = bias + rng.poisson(exposure) / gain + np.sqrt(sigma**2 - 1 / 12) * rng.standard_normal(exposure.size)
    return np.rint(dn).astype(np.uint16)


def looked_at(samples, frames):
    """Return what is found, and the exposure of a plain fit, the mean one, with which it begins."""
    mean = (samples.mean() - PIXEL[2]) * PIXEL[1]
    return find_telegraph(samples, frames, np.array([mean, *PIXEL[1:]])), mean


@pytest.mark.parametrize("n_processes", [1, 2])
def test_likelihood_and_states_are_those_of_the_matrices(n_processes):
    rng = np.random.default_rng(4)
    share, tau = np.array([0.3, 0.6])[:n_processes], np.array([2.5, 7.0])[:n_processes]
    states = 2**n_processes
    emission = rng.uniform(0.1, 1.0, (5, states))
    samples = rng.integers(0, 5, 400)
    gaps = np.where(rng.random(400) < 0.2, rng.integers(2, 9, 400), 1)
    bits = (np.arange(states)[:, None] >> np.arange(n_processes)) & 1
    start = np.where(bits, share, 1 - share).prod(axis=1)

    def moves(gap):
        whole = np.ones((1, 1))
        for s, t in zip(share, tau, strict=True):
            kept = np.exp(-gap / t)
            one = kept * np.eye(2) + (1 - kept) * np.array([[1 - s, s], [1 - s, s]])
            # the first process is the lowest bit
            whole = np.kron(one, whole)
        return whole

    # forward and backward with every step normalised
    forward = [start * emission[samples[0]]]
    for i in range(1, 400):
        forward.append((forward[-1] / forward[-1].sum()) @ moves(gaps[i]) * emission[samples[i]])
    total = sum(np.log(f.sum()) for f in forward)
    after, smooth = np.ones(states), np.empty((400, states))
    for i in range(399, -1, -1):
        smooth[i] = forward[i] * after / (forward[i] * after).sum()
        after = moves(gaps[i]) @ (emission[samples[i]] * after)
        after /= after.max()
    kinds, which = np.unique(gaps, return_inverse=True)
    for got in (np.empty((0, states)), np.empty((400, states))):
        value = telegraph_numba.filtered(emission, samples, *transitions(share, tau, kinds), which, got)
        assert value == pytest.approx(total, rel=1e-12)
    np.testing.assert_allclose(got, smooth, rtol=1e-10)


@pytest.mark.parametrize("gap", [0, 200])
def test_blinking_pixels_are_found_with_their_lower_exposure(gap):
    frames = (np.arange(30)[:, None] * (100 + gap) + np.arange(100)).ravel()
    pulls, shares = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        up = course(rng, frames, SHARE, TAU)
        samples = drawn(rng, PIXEL[0] + STEP * up)
        (added, weight), mean = looked_at(samples, frames)
        assert weight.sum() == pytest.approx(1.0)
        steady = mean - added @ weight
        # of a pixel whose states are known: the mean of its frames with the lower exposure
        noise = np.sqrt((PIXEL[0] + (PIXEL[1] * PIXEL[3]) ** 2) / (~up).sum())
        pulls.append((steady - PIXEL[0]) / noise)
        shares.append(weight[1:].sum() - up.mean())
    # states that are not known cost some precision: not more than twice the error, mean of twelve pixels
    assert abs(np.mean(pulls)) < 2 * 4 / np.sqrt(12)
    assert abs(np.mean(shares)) < 0.08


def test_two_defects_of_one_pixel_are_told_apart():
    rng = np.random.default_rng(2)
    frames = np.arange(4000)
    low, high = course(rng, frames, 0.5, 80.0), course(rng, frames, 0.3, 40.0)
    samples = drawn(rng, PIXEL[0] + 0.8 * low + 1.7 * high)
    (added, weight), mean = looked_at(samples, frames)
    assert added.size == 4
    np.testing.assert_allclose(np.sort(added[1:3]), [0.8, 1.7], atol=0.25)
    np.testing.assert_allclose(added[[0, 3]], [0.0, added[1:3].sum()])
    assert mean - added @ weight == pytest.approx(PIXEL[0], abs=0.15)


def test_hardly_a_steady_pixel_is_said_to_blink():
    steady = [drawn(np.random.default_rng([7, seed]), np.full(2000, PIXEL[0])) for seed in range(200)]
    found = [looked_at(each, np.arange(2000))[0] for each in steady]
    # one in 300 is expected: more than four of 200 would come once in 1500 times
    assert sum(each is not None for each in found) <= 4


def test_effect_gives_levels_to_the_pixels_that_blink_and_none_to_the_others():
    rng = np.random.default_rng(9)
    exposure = np.full((2000, 4, 5), PIXEL[0])
    exposure[:, 2, 3] += 1.5 * course(rng, np.arange(2000), 0.5, 50.0)
    frames = drawn(rng, exposure.ravel()).reshape(exposure.shape)
    usable = np.ones((4, 5), bool)
    usable[0, 0] = False
    mean = (frames.mean(axis=0) - PIXEL[2]) * PIXEL[1]
    maps = PixelMaps(mean, *(np.full((4, 5), v) for v in PIXEL[1:]), usable)
    effect = DarkCurrentRts(fraction=0.05)
    added = effect.added_exposure(frames, np.arange(2000), maps)
    where = (added.exposure_e > 0).any(axis=0)
    assert np.argwhere(where).tolist() == [[2, 3]]
    np.testing.assert_allclose(added.weight.sum(axis=0), 1.0)
    assert (added.weight[0, ~where] == 1.0).all()
    assert added.exposure_e[1, 2, 3] == pytest.approx(1.5, abs=0.3)
    assert effect.scaled(0.0).added_exposure(frames, np.arange(2000), maps) is None
