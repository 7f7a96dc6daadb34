"""Noise in read order: the forward model, and what the estimator makes of it and of relatives."""

import numpy as np
import pytest
from helpers.small_sensors import context_of, drawn_truth, offsets, seen, taken
from hidden.chain import hide

from pchem_pipeline.effects.operators.offsets import ReadOrderNoise, RowNoise

SHAPE = (16, 12)


@pytest.mark.parametrize("taps", [1, 4])
def test_its_spectrum_falls_along_the_samples_of_a_tap(taps):
    noise = offsets(ReadOrderNoise(noise_dn=2.0, taps=taps), context_of(SHAPE, 600))
    width = SHAPE[1] // taps
    first = noise[:, :, :width].reshape(600, -1)
    power = (np.abs(np.fft.rfft(first)) ** 2).mean(axis=0)
    frequency = np.arange(power.size)
    # the ends of a record leak into the steep part; nothing is slower than a frame
    middle = slice(3, power.size // 2)
    slope = np.polyfit(np.log(frequency[middle]), np.log(power[middle]), 1)[0]
    assert -1.1 < slope < -0.8
    assert power[0] < power[1]
    assert noise.var() == pytest.approx(4.0, rel=5 * np.sqrt(2 / 600))
    if taps > 1:
        other = noise[:, :, width : 2 * width].reshape(600, -1)
        assert abs(np.mean(first * other)) < 5 * 4.0 / np.sqrt(600)


# one tap, one tap, four
@pytest.mark.parametrize("seed", [180000, 180001, 180003])
def test_an_independent_camera_s_noise_is_among_the_guesses(seed):
    hiding = hide(("read_order_noise",), 8.0, seed, (32, 32), 1200)
    (hidden,) = hiding.effects
    found = {guess.taps: guess.noise_dn for guess in ReadOrderNoise.estimate(seen(hiding.frames))}
    assert 0.2 < found[hidden.parameters["taps"]] / hidden.strength < 5


def test_it_is_seen_beside_rows_that_move_each_by_itself():
    hidden = RowNoise(row_noise_dn=1.5), ReadOrderNoise(noise_dn=2.0)
    assert ReadOrderNoise.estimate(seen(taken(drawn_truth((24, 24)), *hidden, n_frames=1200, seed=51)))
