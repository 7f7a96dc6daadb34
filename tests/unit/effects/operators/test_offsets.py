"""Offsets that many samples share: forward models against theory, and estimators."""

import itertools

import numpy as np
import pytest
from helpers.small_sensors import context_of, drawn_truth, offsets, seen, taken
from hidden.chain import hide

from pchem_pipeline.effects.operators.offsets import (
    BiasJumps,
    ColumnNoise,
    FrameNoise,
    PeriodicPickup,
    ReadOrderNoise,
    ReadoutAlternation,
    RowNoise,
)

JUMPS = (((0, 1.0), (5, -2.0), (9, 0.0)), ((3, 1.0),), (), ((2, 0.5), (11, 4.0)))


@pytest.mark.parametrize(
    ("effect", "axes"),
    [
        (FrameNoise(frame_noise_dn=0.7), (0,)),
        (RowNoise(row_noise_dn=0.7), (0, 1)),
        (ColumnNoise(column_noise_dn=0.7), (0, 2)),
    ],
    ids=lambda v: getattr(v, "tag", ""),
)
def test_random_offsets_have_their_variance_and_their_place(effect, axes):
    added = offsets(effect, context_of((40, 50), 500))
    others = tuple(axis for axis in range(3) if axis not in axes)
    # along the other axes there is one and the same number
    np.testing.assert_allclose(np.ptp(added, axis=others), 0.0, atol=1e-12)
    numbers = added.mean(axis=others).ravel()
    assert abs(numbers.mean()) < 5 * 0.7 / np.sqrt(numbers.size)
    assert abs((numbers**2).mean() / 0.49 - 1) < 5 * np.sqrt(2 / numbers.size)


def test_jumps_have_their_rate_and_their_levels():
    n_frames, rate = 20_000, 0.01
    added = offsets(BiasJumps(amplitude_dn=0.5, rate=rate, levels=3), context_of((2, 2), n_frames))
    for y, x in itertools.product((0, 1), (0, 1)):
        series = np.round(added[:, y, x], 9)
        assert set(series) <= {-0.5, 0.0, 0.5}
        number = int((np.diff(series) != 0).sum())
        assert abs(number - rate * n_frames) < 5 * np.sqrt(rate * n_frames)
    together = np.corrcoef(added.reshape(n_frames, 4).T)
    assert np.abs(together - np.eye(4)).max() < 5 * np.sqrt(1 / (rate * n_frames))


def test_a_path_of_jumps_holds_each_level_from_its_frame_on_and_halves_jump_together():
    added = offsets(BiasJumps(amplitude_dn=2.0, path=JUMPS), context_of((5, 5)))
    top_left = added[:, 0, 0]
    np.testing.assert_allclose(top_left[:5] - top_left[5], 6.0)
    np.testing.assert_allclose(top_left[9:] - top_left[8], 4.0)
    np.testing.assert_allclose(added.mean(axis=0), 0.0, atol=1e-12)
    # an odd middle row and column belong to the bottom and the right; their path has one level only
    np.testing.assert_array_equal(added[:, 0, 2:], 0.0)
    np.testing.assert_array_equal(added[:, 2:, 0], 0.0)
    np.testing.assert_array_equal(added[:, 2, 2], added[:, 4, 4])
    assert np.ptp(added[:, 2, 2]) == pytest.approx(7.0)
    tops = offsets(BiasJumps(amplitude_dn=2.0, rate=0.3, parts="top_bottom"), context_of((4, 6), 50))
    sides = offsets(BiasJumps(amplitude_dn=2.0, parts="left_right", path=JUMPS[:2]), context_of((4, 6)))
    assert np.ptp(tops, axis=2).max() == np.ptp(sides, axis=1).max() == 0
    assert (tops[:, 0] != tops[:, 3]).any()
    np.testing.assert_array_equal(tops[:, 0], tops[:, 1])
    np.testing.assert_allclose(sides[9, 0] - sides[8, 0], [4.0] * 3 + [0.0] * 3)


def test_pickup_is_the_sine_that_it_says():
    cycles = {"cycles_per_row": 0.11, "cycles_per_frame": -0.27, "cycles_per_column": 0.07}
    effect = PeriodicPickup(amplitude_dn=0.4, phase=0.6, **cycles)
    context = context_of((6, 7), 30, frames=np.arange(10, 30))
    t, y, x = np.ogrid[10:30, :6, :7]
    expected = 0.4 * np.sin(2 * np.pi * (0.11 * y - 0.27 * t + 0.07 * x) + 0.6)
    np.testing.assert_allclose(offsets(effect, context), expected, atol=1e-12)


def test_a_random_phase_is_new_in_every_frame():
    effect = PeriodicPickup(amplitude_dn=0.4, cycles_per_row=0.25, random_phase=True)
    added = offsets(effect, context_of((4, 1), 2000))[:, :, 0]
    np.testing.assert_allclose((added**2).sum(axis=1), 2 * 0.16, atol=1e-9)
    assert abs(added.mean()) < 5 * 0.4 / np.sqrt(2 * added.size)
    lag = (added[1:, 0] * added[:-1, 0]).mean() / 0.08
    assert abs(lag) < 5 / np.sqrt(2000)


def test_alternation_is_positive_in_even_frames():
    added = offsets(ReadoutAlternation(alternation_dn=0.3), context_of(frames=[-1, 0, 1, 7, 8]))
    np.testing.assert_allclose(added[:, 0, 0], [-0.3, 0.3, -0.3, -0.3, 0.3])


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


def test_some_rows_of_a_frame_have_its_slow_noise():
    effect, frames = ReadOrderNoise(noise_dn=2.0), 4000
    whole = offsets(effect, context_of((64, 6), frames))[:, 24:32]
    part = offsets(effect.to_window((24, 32), (0, 6), (64, 6)), context_of((8, 6), frames))
    error = 5 * np.sqrt(4 / frames)
    assert part.mean(axis=(1, 2)).var() == pytest.approx(whole.mean(axis=(1, 2)).var(), rel=error)
    assert part.var() == pytest.approx(whole.var(), rel=error)
    assert effect.to_window((24, 32), (0, 6), (64, 6)).to_sensor((24, 32), (0, 6), (64, 6)) == effect


@pytest.mark.parametrize("every", [1, 2])
def test_a_checkerboard_that_takes_turns_is_no_pickup(every):
    """Nor are every second of its columns, whose rows take turns; a wave of any other length is."""
    frames = taken(drawn_truth((24, 48)), n_frames=1200, seed=52)[:, :, ::every].astype(np.int64)
    t, y, x = np.indices(frames.shape)
    checkered = frames + 3 * (-1) ** (t + y + every * x)
    guesses = PeriodicPickup.estimate(seen(checkered.astype(np.uint16)))
    assert not any(abs(guess.cycles_per_row) > 0.49 for guess in guesses)
    wave = np.rint(3.0 * np.sin(2.0 * np.pi * (0.31 * y + 0.17 * t))).astype(np.int64)
    assert PeriodicPickup.estimate(seen((frames + wave).astype(np.uint16)))[
        0
    ].cycles_per_row == pytest.approx(0.31, abs=0.01)


@pytest.mark.parametrize("rows", [24, 12])
def test_noise_in_read_order_goes_on_from_frame_to_frame(rows):
    """Means of successive frames, of all rows or half of them, are as alike as those of one long record."""
    n, frames = 24 * 6, 8000
    frequency = np.fft.rfftfreq(n * frames)
    phase = np.random.default_rng(2).standard_normal((2, frequency.size))
    spectrum = np.where(frequency * n >= 1, np.maximum(frequency, 1e-9) ** -0.5, 0.0)
    record = np.fft.irfft(spectrum * (phase[0] + 1j * phase[1]), n * frames).reshape(frames, 24, 6)[:, :rows]
    effect = ReadOrderNoise(noise_dn=2.0).to_window((0, rows), (0, 6), (24, 6))
    alike = [
        np.corrcoef(means[1:], means[:-1])[0, 1]
        for means in (
            record.mean(axis=(1, 2)),
            offsets(effect, context_of((rows, 6), frames)).mean(axis=(1, 2)),
        )
    ]
    assert abs(alike[0]) > 10 / np.sqrt(frames)
    # a record of eight frames follows none, and ends as it begins
    assert alike[1] == pytest.approx(alike[0], rel=0.25, abs=5 / np.sqrt(frames))


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
