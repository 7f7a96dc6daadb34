"""What the estimators of common modes, ADC and data path make of simulated frames."""

import functools

import numpy as np
import pytest
from helpers.small_sensors import context_of, drawn_truth, seen, some_blocks, taken

from pchem_pipeline.effects.estimators.series import find_steps
from pchem_pipeline.effects.framework.effect import FEWEST_SHOWN, Effect
from pchem_pipeline.effects.operators.curve import AdcDnl, AdcInl, Clipping
from pchem_pipeline.effects.operators.drifts import BiasDrift
from pchem_pipeline.effects.operators.offsets import (
    BiasJumps,
    ColumnNoise,
    FrameNoise,
    PeriodicPickup,
    ReadoutAlternation,
    RowNoise,
)
from pchem_pipeline.effects.operators.replace import RepeatedFrames
from pchem_pipeline.simulate.streams import KeyedStreams

SHAPE, N_FRAMES = (24, 24), 2400
TRUTH = drawn_truth(SHAPE)


@functools.cache
def evidence_of(*effects, third=True, seed=1):
    frames = taken(TRUTH, *effects, n_frames=N_FRAMES, seed=seed)
    return seen(frames, some_blocks(N_FRAMES) if third else None)


def estimated(effect, **kwargs):
    return list(type(effect).estimate(evidence_of(effect, **kwargs)))


@pytest.mark.parametrize(
    ("effect", "within"),
    [
        # standard errors: of the mean of 576 pixels of 2.2 DN in 800 frames, 0.0033 DN, and what follows
        (BiasDrift(drift_dn=0.3), 0.07),
        (BiasDrift(drift_dn=-0.3), 0.07),
        # what is typical, as strong as its statistic
        (FrameNoise(frame_noise_dn=0.3), 0.2),
        (RowNoise(row_noise_dn=0.8), 0.5),
        (ColumnNoise(column_noise_dn=0.8), 0.5),
        (ReadoutAlternation(alternation_dn=-0.08), 0.06),
        (PeriodicPickup(amplitude_dn=0.3, cycles_per_row=0.17, cycles_per_frame=0.231), 0.05),
        (PeriodicPickup(amplitude_dn=0.3, cycles_per_frame=0.231), 0.05),
        (PeriodicPickup(amplitude_dn=0.5, cycles_per_row=0.17, random_phase=True), 0.1),
        (PeriodicPickup(amplitude_dn=0.3, cycles_per_column=0.4, cycles_per_frame=-0.1), 0.05),
        (AdcDnl(dnl_lsb=0.05, pattern="bit", bit=0), 0.02),
        (AdcDnl(dnl_lsb=-0.05, pattern="bit", bit=2), 0.03),
        (AdcInl(inl_lsb=0.4, period_dn=60.0, phase=1.0), 0.15),
    ],
    ids=lambda v: v.tag if isinstance(v, Effect) else "",
)
def test_the_strength_is_found(effect, within):
    first = estimated(effect)[0]
    assert abs(getattr(first, effect.strength) - getattr(effect, effect.strength)) < within
    for name in ("cycles_per_row", "cycles_per_frame", "cycles_per_column"):
        if isinstance(effect, PeriodicPickup):
            resolution = 1e-4 if "frame" in name else 0.01
            assert abs(getattr(first, name) - getattr(effect, name)) < resolution
    for name in ("pattern", "bit", "random_phase", "shape"):
        assert getattr(first, name, None) == getattr(effect, name, None)


def test_the_phase_of_pickup_predicts_the_frames_between():
    effect = PeriodicPickup(amplitude_dn=0.4, cycles_per_row=0.17, cycles_per_frame=0.231, phase=2.0)
    first = estimated(effect)[0]
    t, y = np.ogrid[:N_FRAMES, : SHAPE[0]]
    waves = [
        np.sin(2 * np.pi * (p.cycles_per_row * y + p.cycles_per_frame * t) + p.phase) for p in (first, effect)
    ]
    assert (waves[0] * waves[1]).mean() > 0.45


def test_a_bend_that_is_no_sine_is_found_as_a_curve():
    curve = (0.0, 1.0, 0.2, -0.8, 0.1, 0.1, 0.1, 0.1, -0.9, 0.0)
    effect = AdcInl(inl_lsb=0.5, form="curve", first_dn=95.0, spacing_dn=11.0, curve=curve)
    first = estimated(effect)[0]
    assert first.form == "curve"
    places = np.arange(100.0, 180.0)
    bent = [e.apply(places.reshape(-1, 1, 1), context_of((1, 1), 80)).ravel() for e in (first, effect)]
    # bias and gain take up a straight line
    found, true = (each - np.polyval(np.polyfit(places, each, 1), places) for each in bent)
    assert np.corrcoef(found, true)[0, 1] > 0.9
    # a sine needs no knots
    assert {e.form for e in estimated(AdcInl(inl_lsb=0.4, period_dn=60.0, phase=1.0))} == {"sine"}


def test_a_drift_of_its_own_shape_is_found_as_a_path():
    effect = BiasDrift(drift_dn=0.6, shape="path", path=(-0.5, 0.5, -0.5))
    first = estimated(effect)[0]
    assert first.shape == "path"
    place = np.linspace(0, 1, 50)
    found = first.drift_dn * np.interp(place, np.linspace(0, 1, len(first.path)), first.path)
    true = 0.6 * np.interp(place, [0, 0.5, 1], effect.path)
    assert np.abs(found - found.mean() - true + true.mean()).max() < 0.1
    assert [e.shape for e in estimated(BiasDrift(drift_dn=0.6))] == ["linear"]


def test_a_bias_that_settles_is_found_as_such():
    first = estimated(BiasDrift(drift_dn=0.6, shape="settling", settling_fraction=0.1))[0]
    assert first.shape == "settling"
    assert 0.05 <= first.settling_fraction <= 0.2
    assert first.drift_dn == pytest.approx(0.6, abs=0.1)


def test_jumps_are_found_with_their_frames_and_levels():
    path = (((0, 0.0), (1000, 1.0)), ((0, 0.0),), ((0, 0.0), (400, -1.0), (2000, 0.0)), ((0, 0.0),))
    effect = BiasJumps(amplitude_dn=0.8, path=path)
    first = estimated(effect, third=False)[0]
    for found, true in zip(first.path, path, strict=True):
        (frames, levels), (at, to) = np.transpose(found), np.transpose(true)
        assert frames == pytest.approx(at, abs=40)
        assert first.amplitude_dn * np.diff(levels) == pytest.approx(0.8 * np.diff(to), abs=0.15)


@pytest.mark.parametrize("parts", ["quadrants", "top_bottom", "left_right"])
def test_what_jumps_together_has_one_path(parts):
    """Quadrants of a half that jumped together came out as jumping 43 frames apart, and were unexplained."""
    number = 4 if parts == "quadrants" else 2
    path = [((0, 0.0), (400 + 150 * i, 1.0), (1200 + 120 * i, -0.5)) for i in range(number)]
    effect = BiasJumps(amplitude_dn=0.5, parts=parts, path=path)
    first = estimated(effect, third=False)[0]
    assert first.parts == parts
    assert [len(part) for part in first.path] == [3] * number
    assert np.abs(np.subtract(first.path, path)[:, :, 0]).max() < 60


def test_a_common_drift_is_no_jump_and_jumps_too_many_to_tell_apart_still_count():
    for other in (BiasDrift(drift_dn=1.0), FrameNoise(frame_noise_dn=0.5)):
        assert not BiasJumps.estimate(evidence_of(other))
    many = BiasJumps(amplitude_dn=0.5, rate=0.05)
    assert any(0.15 < e.amplitude_dn < 1.5 and e.rate == 1e-2 for e in estimated(many) if not e.path)


def test_drift_and_alternation_are_no_pickup():
    # nothing but what chance makes of rows and columns in one stack of 50
    for other in (BiasDrift(drift_dn=1.0), ReadoutAlternation(alternation_dn=-0.3)):
        found = PeriodicPickup.estimate(evidence_of(other))
        assert all(p.amplitude_dn < 0.06 and p.cycles_per_row for p in found)
    pickup = PeriodicPickup(amplitude_dn=0.3, cycles_per_frame=0.231)
    assert not ReadoutAlternation.estimate(evidence_of(pickup))


def test_edges_are_found_one_by_one():
    effect = AdcDnl(dnl_lsb=0.1, pattern="edges", first_code=120, edges=(1.0,))
    few = next(e for e in estimated(effect, third=False) if e.pattern == "edges")
    shifts = dict(enumerate(np.array(few.edges) * few.dnl_lsb, few.first_code))
    assert abs(shifts[120] - 0.1) < 0.03
    assert sum(abs(s) for code, s in shifts.items() if code != 120) < 0.06
    random = AdcDnl(dnl_lsb=0.08)
    found = estimated(random, third=False)[-1]
    # how far the listed shifts explain those that were simulated
    streams = KeyedStreams(1, "effect/adc_dnl/0", np.zeros(1, np.int64), np.zeros(1, np.int64), np.arange(1))
    drawn = streams.generator(draw=0).standard_normal(1024)
    true = drawn[found.first_code : found.first_code + len(found.edges)]
    assert np.corrcoef(np.diff(true), np.diff(found.edges))[0, 1] > 0.8


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_missing_codes_are_edges_that_nearly_coincide(share):
    frames = taken(TRUTH, n_frames=N_FRAMES, seed=4)
    # every 13th code reads one less, always or in some of its samples
    moved = (frames % 13 == 5) & (np.random.default_rng(4).random(frames.shape) < share)
    (found,) = AdcDnl.estimate(seen((frames - moved).astype(np.uint16)))
    shifts = dict(enumerate(np.array(found.edges) * found.dnl_lsb, found.first_code))
    # codes with samples enough on both sides; the fits of the pixels take up some of the rest
    inner = [shifts.get(code, 0.0) for code in range(109, 175, 13)]
    assert np.abs(np.array(inner) / share - 1.0).max() < 0.35
    others = [abs(shift) for code, shift in shifts.items() if code % 13 != 5 and 100 < code < 175]
    assert np.mean(others) < 0.1 * share


def test_limits_are_found_exactly():
    for limits in ({"high": 140}, {"low": 96}, {"low": 96, "high": 140}):
        first, *others = estimated(Clipping(**limits))
        assert first == Clipping(**limits)
        assert len(limits) == 2 or not others


def test_repeats_are_counted():
    listed = RepeatedFrames(frames=(20, 21, 333, 450, 750))
    for effect in (listed, listed.model_copy(update={"rows": (0, 6)})):
        (found,) = estimated(effect, third=False)
        assert found.rows == effect.rows
        assert found.probability == pytest.approx(5 / (N_FRAMES - 1))


def test_a_change_across_a_gap_is_put_into_the_gap():
    rng = np.random.default_rng(4)
    series = 0.5 * rng.standard_normal((200, 4))
    series[100:, 0] += 1.0
    gaps = np.ones(200)
    gaps[100] = 200.0
    assert find_steps(series, gaps)[0].starts.tolist() == [0, 100]


def test_rare_repeats_are_simulated_in_their_mean_number():
    numbers = np.concatenate([np.arange(0, 500), np.arange(900, 1401)])
    shown, share = RepeatedFrames(probability=1e-3, rows=(0, 4)).representative(numbers)
    assert shown.rows == (0, 4)
    assert len(shown.frames) == FEWEST_SHOWN
    assert set(shown.frames) <= set(numbers) - {0, 900}  # the frames before these are not there
    assert share == pytest.approx(1e-3 * 999 / FEWEST_SHOWN)
    many, share = RepeatedFrames(probability=0.02).representative(numbers)
    assert (len(many.frames), share) == (20, pytest.approx(0.02 * 999 / 20))
    listed = RepeatedFrames(frames=(3, 9))
    assert listed.representative(numbers) == (listed, 1.0)
