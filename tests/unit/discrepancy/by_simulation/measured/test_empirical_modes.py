"""Gain, light or noise that samples share: measured by the sums of their scores, simulated as it is told."""

import re
from typing import Any

import numpy as np
import pytest
from helpers.small_sensors import a_uniform_sensor
from helpers.small_sensors import simulated as simulated_frames
from pydantic import ValidationError

from pchem_pipeline.discrepancy.by_simulation.measured.modes import (
    Sums,
    codes_within_reach,
    common_scores,
    measured_mode,
)
from pchem_pipeline.discrepancy.by_simulation.measured.samples import PartSamples
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.operators.empirical_noise import EmpiricalNoise, NoiseMode

SHAPE, FRAMES, STEP = (16, 20), 1500, 14.0
SIGNAL = 1.5 * STEP
EVERYWHERE = np.ones(SHAPE, bool)


def frames(
    seed: int, gain: Any = 1.0, light: Any = 1.0, offset: Any = 0.0, loud: Any = 1.0
) -> tuple[np.ndarray, PixelMaps]:
    """Return frames of a sensor of 1.5 e- whose gain, light, offset or noise moves, and its parameters."""
    rng = np.random.default_rng(seed)
    exposure = np.broadcast_to(1.5 * np.asarray(light), (FRAMES, *SHAPE))
    noise = 0.25 * STEP
    own = noise * loud * rng.standard_normal(exposure.shape)
    dn = 100.0 + STEP * gain * rng.poisson(exposure) + offset + own
    maps = (np.full(SHAPE, v) for v in (1.5, 1 / STEP, 100.0, np.sqrt(noise**2 + 1 / 12)))
    return np.floor(dn + 0.5).astype(np.uint16), PixelMaps(*maps, EVERYWHERE)


def scores(frames: np.ndarray, maps: PixelMaps) -> dict[Any, Sums]:
    evidence: Any = None
    return common_scores(PartSamples(frames, np.arange(len(frames)), maps, evidence, EVERYWHERE))


def told(data: dict[Any, Sums], model: dict[Any, Sums] | None = None) -> EmpiricalNoise | None:
    """Return what sums tell beside those of a model, by default of one without common changes."""
    nothing = dict.fromkeys(data, Sums(np.ones((1, 1)), np.ones(1), np.arange(1)))
    found = measured_mode(data, model or nothing, frames(1)[1], EVERYWHERE)
    return None if found is None else found.effect


def measured(stack: tuple[np.ndarray, PixelMaps]) -> EmpiricalNoise | None:
    """Return what is measured of frames beside such a model."""
    return told(scores(*stack))


def sums_of(changes: str, sums: np.ndarray, numbers: np.ndarray | None = None) -> dict[Any, Sums]:
    """Return sums of frames of the information 100 each."""
    numbers = np.arange(len(sums)) if numbers is None else numbers
    return {("frame", changes): Sums(sums, np.full(1, 100.0), numbers)}


def drawn(*shape: int) -> np.ndarray:
    return np.random.default_rng(9).standard_normal(shape)


@pytest.mark.parametrize(
    ("of", "shape"),
    [("frame", (FRAMES, 1, 1)), ("row", (FRAMES, SHAPE[0], 1)), ("column", (FRAMES, 1, SHAPE[1]))],
)
def test_a_gain_that_moves_is_told_by_what_shares_it(of: str, shape: tuple[int, ...]) -> None:
    data = scores(*frames(1, gain=1.0 + 0.02 * drawn(*shape)))
    assert told(data, data) is None  # what a model makes is taken off
    found = told(data)
    (mode,) = found.modes
    assert (mode.of, mode.changes, mode.burst, mode.shape) == (of, "gain", None, ())
    # its own variance is known to sqrt(2 / n); the scores see a little less where the peaks overlap
    error = 0.02 * SIGNAL * np.sqrt(0.5 / np.prod(shape))
    assert abs(found.noise_dn - 0.02 * SIGNAL) < 5 * error + 0.15 * 0.02 * SIGNAL
    words = f"% of the gain, {found.noise_dn:.2g} DN at a signal of 21 DN, common to each {of})"
    assert words in found.describe()


def test_light_in_bursts_in_a_corner_is_told_with_its_place() -> None:
    corner = np.zeros(SHAPE)
    corner[:4, :5] = 1.0
    burst = np.random.default_rng(3).random((FRAMES, 1, 1)) < 0.05
    found = measured(frames(2, light=1.0 + 1.5 * burst * corner))
    (mode,) = found.modes
    assert (mode.of, mode.changes) == ("frame", "light")
    assert mode.burst == pytest.approx(burst.mean(), rel=0.3)
    assert not mode.negative
    blocks = np.array(mode.shape)
    assert blocks.shape == (4, 5)
    assert blocks[0, 0] > 5 * abs(blocks).ravel()[2:].max()
    assert "strongest in the rows from 0 to 25 %" in found.describe()


def test_frames_that_are_noisier_are_told_with_how_many_they_are() -> None:
    some = np.random.default_rng(3).random((FRAMES, 1, 1)) < 0.05
    found = measured(frames(7, loud=1.0 + 0.5 * some))
    (mode,) = found.modes
    assert (mode.of, mode.changes, mode.negative) == ("frame", "noise", False)
    # of one frame the size is known to sqrt(1 / (2 * 320)) of itself: hardly any is taken for another
    assert mode.burst == pytest.approx(some.mean(), rel=0.1)
    # too small, since loud samples scatter more than the scores should: where a fit to all statistics begins
    assert 0.5 < found.noise_dn / (0.5 * np.sqrt(some.mean()) * 0.25 * STEP) < 1.2
    # of bursts their size in the frames that have them
    size = r"\(\+[34]\d % of the read noise, 1\.\d DN of 3.51 DN, common to"
    assert re.search(f"samples share a variation of the read noise {size}", found.describe())


@pytest.mark.parametrize("size", [0.3, 1.0, 2.5])
def test_bursts_are_told_however_strong_they_are(size: float) -> None:
    """Far beyond chance a Gaussian of the same power explains nearly as much as bursts do."""
    rng = np.random.default_rng(int(10 * size))
    some = rng.random((FRAMES, 1)) < 0.03
    found = told(sums_of("noise", rng.standard_normal((FRAMES, 1)) * 10.0 + 100.0 * size * some))
    assert found.modes[0].burst == pytest.approx(some.mean(), rel=0.2)
    gaussian = told(sums_of("noise", 80.0 * np.random.default_rng(8).standard_normal((FRAMES, 1))))
    assert gaussian.modes[0].burst is None


def test_noise_of_changing_size_has_the_law_that_is_simulated() -> None:
    mode = NoiseMode(of="frame", share=1.0, changes="noise", signal_dn=2.0, burst=0.1)
    weights, widths = mode.widths(0.2)
    np.testing.assert_allclose([*weights, *widths], [0.9, 0.1, 1.0, 1.0 + 0.2 / np.sqrt(0.1)])
    weights, widths = mode.model_copy(update={"burst": None}).widths(0.2)
    # of 1 + 0.2 x, x normal: its mean square is 1 + 0.2^2
    assert weights @ widths**2 == pytest.approx(1.04, rel=1e-6)
    quiet, loud = (simulated(mode, size, 0.3, light=1e-9).std(axis=(1, 2)) for size in (0.0, 2.0 * 0.2))
    ratio = np.sort(loud**2 / quiet.mean() ** 2)
    assert abs(np.mean(ratio > 1.25) - 0.1) < 5 * np.sqrt(0.09 / FRAMES)


def test_a_change_that_has_a_memory_is_told_with_it() -> None:
    white = drawn(FRAMES + 1, 1, 1)
    found = measured(frames(4, gain=1.0 + 0.03 * (white[1:] + 0.7 * white[:-1])))
    assert found.modes[0].lags == ((1, 0, 0),)
    # 0.7 / (1 + 0.7^2) = 0.47, within five errors of 1 / sqrt(1500)
    assert found.modes[0].correlation[0] == pytest.approx(0.47, abs=0.13)


def test_frames_that_are_left_out_are_no_neighbours() -> None:
    """Every other pair of frames is left out: those before and behind it do not follow each other."""
    white = drawn(FRAMES + 1)
    power = white[1:] + 0.7 * white[:-1]
    sums = 80.0 * power[:, None] + 10.0 * np.random.default_rng(3).standard_normal((FRAMES, 1))
    seen = np.flatnonzero(np.arange(FRAMES) % 4 < 2)
    for numbers, known in ((seen, True), (np.arange(seen.size), False)):  # and as if none were missing
        [correlation] = told(sums_of("gain", sums[seen], numbers)).modes[0].correlation
        # half of the pairs that are taken for neighbours without the numbers are none
        assert bool(abs(correlation - 0.47) < 4 / np.sqrt(seen.size / 2)) is known


@pytest.mark.parametrize(
    ("of", "per_frame", "per_line", "changes"),
    [("row", 0.163, 0.21, "gain"), ("column", -0.31, 0.12, "light"), ("frame", 0.07, 0.0, "gain")],
)
def test_a_wave_of_gain_or_light_is_told_by_its_frequencies(
    of: Any, per_frame: float, per_line: float, changes: str
) -> None:
    frame, row, column = np.ogrid[:FRAMES, : SHAPE[0], : SHAPE[1]]
    line = {"row": row, "column": column, "frame": 0}[of]
    amplitude = 0.03
    sine = amplitude * np.sin(2.0 * np.pi * (per_frame * frame + per_line * line) + 0.4)
    stack = frames(11, gain=1.0 + sine) if changes == "gain" else frames(11, light=1.0 + sine)
    found = measured(stack)
    (mode,) = found.modes
    assert (mode.of, mode.changes, mode.lags, mode.burst) == (of, changes, (), None)
    wave = np.array([mode.wave[0], mode.wave[2 if of == "column" else 1]])
    known = wave * np.sign(wave[0] * per_frame)
    # of a sine of amplitude a in n values of which each holds the information i (Rife and Boorstyn 1974)
    sums = scores(*stack)[of, changes]
    error = np.sqrt(24.0 / (amplitude**2 * sums.information.sum() * FRAMES)) / (2.0 * np.pi)
    assert abs(known[0] - per_frame) < 4.0 * error / FRAMES
    assert abs(known[1] - per_line) < 4.0 * error / max(sums.information.size, 2)
    # the scores see a little less where the peaks overlap
    assert found.noise_dn / SIGNAL == pytest.approx(amplitude / np.sqrt(2.0), rel=0.15)
    assert "a sine of" in found.describe()


def test_a_wave_that_a_model_makes_is_not_measured_again() -> None:
    """In frames simulated with it its phase is another, and chance is another."""
    frame, row, _ = np.ogrid[:FRAMES, : SHAPE[0], : SHAPE[1]]
    sine = [0.03 * np.sin(2.0 * np.pi * (0.163 * frame + 0.21 * row) + phase) for phase in (0.4, 2.0)]
    data, model = (scores(*frames(20 + seed, gain=1.0 + each)) for seed, each in enumerate(sine))
    assert told(data) is not None
    assert told(data, model) is None


@pytest.mark.parametrize("wave", [(0.163, 0.21, 0.0), (0.5, 0.5, 0.0)])
def test_the_simulated_wave_has_its_frequencies_and_its_size(wave: tuple[float, float, float]) -> None:
    """At half a cycle both ways the phase is 0: another one would be another size."""
    mode = NoiseMode(of="row", share=1.0, changes="gain", signal_dn=4 * STEP, wave=wave)
    means = simulated(mode, 0.05 * 4 * STEP).mean(axis=2) / (4 * STEP) - 1.0
    frame, row = np.ogrid[:FRAMES, : SHAPE[0]]
    part = abs(np.mean(means * np.exp(-2j * np.pi * (wave[0] * frame + wave[1] * row))))
    rms = part if wave[0] == 0.5 else part * np.sqrt(2.0)
    # a mean of a row has the scatter of 20 samples of 4 electrons
    assert abs(rms - 0.05) < 5 * np.sqrt(1.05 / (4 * SHAPE[0] * SHAPE[1] * FRAMES))


def test_an_offset_that_takes_turns_is_told_as_that() -> None:
    mode = NoiseMode(of="sample", share=1.0, wave=(0.5, 0.5, -0.5))
    assert mode.describe(0.3) == (
        "0.3 DN, alternating from frame to frame, from row to row, from column to column"
    )
    assert NoiseMode(of="column", share=1.0, wave=(0.1, 0.0, 0.25)).describe(0.3) == (
        "0.3 DN, common to each column, a sine of 0.1 cycles per frame and 0.25 per column"
    )


def test_neither_nothing_nor_an_offset_is_taken_for_gain_or_light() -> None:
    assert [measured(frames(seed)) for seed in range(10, 14)] == [None] * 4
    assert measured(frames(5, offset=0.5 * drawn(FRAMES, 1, 1))) is None


def test_an_offset_in_bursts_is_told_with_how_often_and_how_large() -> None:
    some = np.random.default_rng(4).random((FRAMES, 1, 1)) < 0.05
    found = measured(frames(12, offset=1.5 * some))
    (mode,) = found.modes
    assert (mode.of, mode.changes, mode.negative) == ("frame", "offset", False)
    assert mode.burst == pytest.approx(some.mean(), rel=0.05)  # a frame of 320 samples tells it
    # the scores see a little less where the peaks overlap
    assert found.noise_dn == pytest.approx(1.5 * np.sqrt(some.mean()), rel=0.15)
    assert re.search(r"only in \S+ % of the frames", found.describe())


def simulated(mode: NoiseMode, noise_dn: float, read_noise: float = 1e-6, light: float = 4.0) -> np.ndarray:
    """Return frames of a sensor, with next to no read noise (e-), in which something is shared."""
    sensor = a_uniform_sensor(SHAPE, light, 1 / STEP, 100.0, read_noise)
    effect = EmpiricalNoise(noise_dn=noise_dn, modes=(mode,))
    return simulated_frames(sensor, effect, n_frames=FRAMES, seed=5)[0] - 100.0


@pytest.mark.parametrize("on", ["gain", "light"])
def test_the_simulated_change_has_its_size(on: Any) -> None:
    mode = NoiseMode(of="frame", share=1.0, changes=on, signal_dn=4 * STEP)
    means = simulated(mode, 0.1 * 4 * STEP).mean(axis=(1, 2)) / (4 * STEP)
    own = 1 / (4 * means.size * EVERYWHERE.size)
    chance = np.var(simulated(mode, 0.0).mean(axis=(1, 2)) / (4 * STEP))
    assert abs(means.mean() - 1.0) < 5 * np.sqrt(own + 0.01 / FRAMES)
    assert means.var() - chance == pytest.approx(0.01, rel=5 * np.sqrt(2 / FRAMES))


def test_simulated_bursts_are_as_rare_and_where_they_are_told() -> None:
    corner = ((1.0, 0.0), (0.0, 0.0))
    mode = NoiseMode(of="frame", share=1.0, changes="light", signal_dn=4 * STEP, burst=0.04, shape=corner)
    found = simulated(mode, 2.0 * np.sqrt(0.04) / 2.0 * 4 * STEP)
    there, rest = found[:, :8, :10].mean(axis=(1, 2)), found[:, 8:, 10:].mean(axis=(1, 2))
    high = there > 6 * STEP
    assert abs(high.mean() - 0.04) < 5 * np.sqrt(0.04 / FRAMES)
    # twice the light more: a root mean square over the sensor of half of that
    assert there[high].mean() == pytest.approx(12 * STEP, rel=0.03)
    assert rest.max() < 6 * STEP


def test_a_hit_by_a_particle_needs_no_tables_of_its_codes_and_outweighs_no_other_sample() -> None:
    """As many codes as the law reaches; what lies beyond counts as the last of them."""
    stack, maps = frames(1, gain=1.0 + 0.02 * drawn(FRAMES, 1, 1))
    hit = stack.copy()
    hit[700, 3, 4] = 60000
    pixels = np.arange(stack[0].size)
    first, last = (each(axis=0).ravel().astype(np.int64) for each in (hit.min, hit.max))
    length = codes_within_reach(maps, pixels, first, last)
    assert int(stack.max() - stack.min()) <= length < 1000
    found, usual = measured((hit, maps)), measured((stack, maps))
    assert found.modes[0].changes == usual.modes[0].changes
    assert found.noise_dn == pytest.approx(usual.noise_dn, rel=0.1)


@pytest.mark.parametrize("of", ["frame", "row", "column"])
def test_a_shape_that_was_found_in_a_window_is_there_on_the_sensor_and_nowhere_else(of: Any) -> None:
    """And as it was in the window, or in another one that shows a part of it."""
    sensor, window = (40, 60), ((10, 26), (20, 40))
    form: Any = {"shape": ((0.5, 1.0), (1.5, 0.2))} if of == "frame" else {"profile": (1.0, -0.5, 2.0)}
    found = EmpiricalNoise(noise_dn=1.0, modes=(NoiseMode(of=of, share=1.0, **form),))
    of_sensor = found.to_sensor(*window, sensor)
    size = (16, 20)
    assert of_sensor.to_window(*window, sensor) == found

    def relative(effect: EmpiricalNoise, shape: tuple[int, int]) -> np.ndarray:
        rows, columns = np.arange(shape[0]), np.arange(shape[1])
        return np.broadcast_to(effect.modes[0].relative(rows, columns, shape), shape)

    whole, inside = relative(of_sensor, sensor), relative(found, size)
    np.testing.assert_allclose(whole[10:26, 20:40], inside)
    assert np.mean(inside**2) == pytest.approx(1.0, abs=0.2)  # of a few pixels, not of a line
    y, x = np.indices(sensor)
    rows, columns = (y >= 10) & (y < 26), (x >= 20) & (x < 40)
    assert not whole[~{"frame": rows & columns, "row": columns, "column": rows}[of]].any()
    other = relative(of_sensor.to_window((0, 20), (30, 60), sensor), (20, 30))
    np.testing.assert_allclose(other, whole[:20, 30:])
    if of == "frame":
        assert "strongest in rows 10 to 25 and columns 20 to 39" in of_sensor.describe()


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"of": "frame", "wave": (0.1, 0.2, 0.0)}, "wave"),
        ({"wave": (0.6, 0.0, 0.0)}, "wave"),
        ({"wave": (0.1, 0.2, 0.1)}, "wave"),
        ({"wave": (0.1, 0.2, 0.0), "burst": 0.1}, "wave"),
        ({"wave": (0.1, 0.2, 0.0), "lags": ((1, 0, 0),), "correlation": (0.1,)}, "wave"),
        ({"burst": 0.1, "lags": ((1, 0, 0),), "correlation": (0.1,)}, "leave lags out"),
        ({"shape": ((1.0,),)}, "equally many"),
        ({"of": "frame", "shape": ((1.0,),), "extent": ((4, 4), (0, 2))}, "extent"),
        ({"of": "sample", "lags": ((0, 1, 0),)}, "one correlation"),
        ({"lags": ((0, 0, 1),), "correlation": (0.1,)}, "0 within it"),
    ],
)
def test_a_mode_that_contradicts_itself_is_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        NoiseMode(**{"of": "row", "share": 1.0, **({"changes": "gain"} if "wave" in wrong else {}), **wrong})
