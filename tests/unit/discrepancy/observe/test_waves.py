"""Waves across rows and columns, found in the spectrum of residuals and told as pickup or measured."""

from typing import Any

import numpy as np
import pytest

from pchem_pipeline.discrepancy.by_simulation.measured.noise import measured_wave
from pchem_pipeline.discrepancy.observe.observe import observe
from pchem_pipeline.discrepancy.observe.sums import laws_of_frames
from pchem_pipeline.discrepancy.observe.waves import Waves, waves_across
from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
from pchem_pipeline.effects.operators.offsets import PeriodicPickup

Floats = np.ndarray[Any, np.dtype[np.float64]]
Frames = np.ndarray[Any, np.dtype[np.uint16]]
STEP, NOISE, EXPOSURE = 8.0, 2.0, 1.0  # DN, DN, e-
SHAPE, FRAMES = (24, 20), 600
CYCLES = 0.31, -0.17, 0.23  # per frame, row, column
EVERYWHERE = np.ones(SHAPE, np.bool_)
KNOWN = EXPOSURE, 1.0 / STEP, 100.0, np.sqrt(NOISE**2 + 1.0 / 12.0)
MAPS = PixelMaps.known([np.full(SHAPE, each) for each in KNOWN], EVERYWHERE)


def frames(seed: int, offset: Floats | float = 0.0) -> Frames:
    """Return frames of equal pixels with an offset, DN."""
    rng = np.random.default_rng(seed)
    electrons = rng.poisson(EXPOSURE, (FRAMES, *SHAPE))
    dn = 100.0 + STEP * electrons + rng.normal(0.0, NOISE, electrons.shape) + offset
    return np.rint(dn).astype(np.uint16)


def sine(amplitude: float, turns: Floats | None = None, cycles: tuple[float, ...] = CYCLES) -> Floats:
    """Return a wave, DN, with phases of its own, in cycles, if there are any."""
    t, y, x = np.ogrid[:FRAMES, : SHAPE[0], : SHAPE[1]]
    phase = cycles[0] * t if turns is None else turns[:, None, None]
    return amplitude * np.sin(2.0 * np.pi * (phase + cycles[1] * y + cycles[2] * x) + 0.4)


def found(values: Frames, numbers: Any = range(FRAMES)) -> Waves:
    return waves_across(values, np.array(numbers), laws_of_frames(values, MAPS), MAPS)


def evidence(values: Frames) -> Evidence:
    return observe(values, np.arange(FRAMES), n_run=FRAMES, block_frames=100, start=MAPS, fitted=False)


def test_frames_in_random_order_have_hardly_a_wave() -> None:
    assert sum(len(found(frames(seed)).found) for seed in range(20)) <= 4  # 2 kinds, 2 % each


def test_a_steady_wave_has_its_frequencies_size_and_phase() -> None:
    amplitude = 0.2
    (wave,) = found(frames(1, sine(amplitude))).found
    # a residual holds that part of an offset which charge does not take for electrons
    response = 1.0 / evidence(frames(1)).readout_std.mean()
    # Cramer and Rao: sqrt(6) / (pi snr n sqrt(N)) in each frequency
    ratio = amplitude * response / np.sqrt(2.0) * np.sqrt(FRAMES * SHAPE[0] * SHAPE[1])
    told = wave.per_frame, wave.per_row, wave.per_column
    for seen, true, length in zip(told, CYCLES, (FRAMES, *SHAPE), strict=True):
        assert abs(seen - true) < 5.0 * np.sqrt(6.0) / (np.pi * ratio * length)
    assert found(np.random.default_rng(2).permutation(frames(1, sine(amplitude)))).steady is None


def test_a_wave_is_found_between_frames_that_are_missing() -> None:
    kept = np.flatnonzero(np.arange(FRAMES) % 200 >= 50)
    (wave,) = found(frames(3, sine(0.3))[kept], kept).found
    assert wave.per_frame == pytest.approx(CYCLES[0], abs=1e-4)
    assert np.cos(wave.phase - 0.4) > 0.97  # at frame 0, which is not among them


def test_a_wave_of_any_phase_in_each_frame_is_pickup_of_random_phase() -> None:
    turns = np.random.default_rng(4).random(FRAMES)
    guesses = PeriodicPickup.estimate(evidence(frames(4, sine(0.5, turns))))
    (pickup,) = (guess for guess in guesses if guess.cycles_per_column)
    assert pickup.random_phase
    assert pickup.cycles_per_row == pytest.approx(CYCLES[1], abs=2e-3)
    assert pickup.cycles_per_column == pytest.approx(CYCLES[2], abs=2e-3)
    assert pickup.amplitude_dn == pytest.approx(0.5, rel=0.1)


def test_pickup_sample_by_sample_is_estimated_as_it_is() -> None:
    (pickup,) = PeriodicPickup.estimate(evidence(frames(5, sine(0.3))))
    assert not pickup.random_phase
    # of 288,000 samples, whose noise is 8 times as large: 1.7 % per standard error
    assert pickup.amplitude_dn == pytest.approx(0.3, rel=0.09)
    assert np.cos(pickup.phase - 0.4) > 0.99
    moved = pickup.to_sensor((5, 29), (3, 23), (40, 40))
    seen_again = moved.to_window((5, 29), (3, 23), (40, 40))
    assert np.exp(1j * seen_again.phase) == pytest.approx(np.exp(1j * pickup.phase))
    turned = pickup.phase - 2.0 * np.pi * (pickup.cycles_per_row * 5 + pickup.cycles_per_column * 3)
    assert np.exp(1j * moved.phase) == pytest.approx(np.exp(1j * turned))


def test_noise_that_neighbours_share_is_no_wave() -> None:
    white = np.random.default_rng(6).normal(0.0, 1.0, (FRAMES, SHAPE[0], SHAPE[1] + 1))
    waves = found(frames(6, white[..., 1:] + white[..., :-1]))
    assert waves.found == ()
    # residuals correlated by 0.06: the mean power of 600 frames is 3 standard errors higher somewhere
    assert waves.z["space.sample.readout.spectrum"] > 3.0
    assert abs(waves.z["space.sample.readout.line"]) < 5.0


def test_what_takes_turns_is_measured_and_no_pickup() -> None:
    values = frames(7, sine(0.3 / np.sin(0.4), cycles=(0.5, 0.5, 0.5)))
    seen = evidence(values)
    assert [p for p in PeriodicPickup.estimate(seen) if p.cycles_per_column and p.cycles_per_row] == []
    measured = measured_wave(found(values), found(frames(8)), seen, EVERYWHERE)
    assert measured.effect.noise_dn == pytest.approx(0.3, rel=0.09)
    assert measured_wave(found(values), found(values), seen, EVERYWHERE) is None


def test_too_few_frames_or_lines_have_no_statistic() -> None:
    assert found(frames(9)[:40], range(40)) == Waves((), {})
