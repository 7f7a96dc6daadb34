"""Noise that samples share: simulated by its spectrum, measured by its covariances, never on clean data."""

from typing import Any

import numpy as np
import pytest
from helpers.small_sensors import a_uniform_sensor
from helpers.small_sensors import simulated as simulated_frames

from pchem_pipeline.discrepancy.by_simulation.explainer import find_discrepancies
from pchem_pipeline.discrepancy.by_simulation.measured.noise import (
    Covariance,
    Covariances,
    measured_noise,
    residual_covariances,
)
from pchem_pipeline.discrepancy.by_simulation.measured.samples import PartSamples
from pchem_pipeline.discrepancy.observe.observe import observe
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.effects.operators.empirical_noise import EmpiricalNoise, NoiseMode

ROWS, COLUMNS, FRAMES, STEP = 14, 16, 900, 12.0
SHAPE = (ROWS, COLUMNS)
EVERYWHERE = np.ones(SHAPE, bool)
AMPLITUDE, NEXT = 0.9, 0.7  # DN, and the weight of the neighbour
POWER = AMPLITUDE**2 * (1 + NEXT**2)
COVARIANCE = AMPLITUDE**2 * NEXT
NOTHING = Covariances({}, {})


def of_next_rows(rng: np.random.Generator) -> np.ndarray:
    """Noise of single samples, correlated with the next row's."""
    white = rng.standard_normal((FRAMES, ROWS + 1, COLUMNS))
    return AMPLITUDE * (white[:, 1:] + NEXT * white[:, :-1])


def of_whole_rows(rng: np.random.Generator) -> np.ndarray:
    """Noise of whole rows, correlated with the next row's."""
    white = rng.standard_normal((FRAMES, ROWS + 1, 1))
    return AMPLITUDE * (white[:, 1:] + NEXT * white[:, :-1])


def of_earlier_frames(rng: np.random.Generator) -> np.ndarray:
    """Noise of single samples, anticorrelated with the frame before."""
    white = rng.standard_normal((FRAMES + 1, *SHAPE))
    return AMPLITUDE * (white[1:] - NEXT * white[:-1])


def nothing(rng: np.random.Generator) -> float:
    return 0.0


def stack(seed: int, noise: Any, read_noise: float = 0.25, exposure: float = 1.2) -> np.ndarray:
    """Return frames of a sensor with more noise than its pixels' own."""
    rng = np.random.default_rng(seed)
    mean, bias = exposure * rng.uniform(0.6, 1.4, SHAPE), rng.uniform(95.0, 105.0, SHAPE)
    own = read_noise * rng.uniform(0.85, 1.15, SHAPE) * STEP
    size = (FRAMES, *SHAPE)
    dn = bias + STEP * rng.poisson(mean, size) + own * rng.standard_normal(size) + noise(rng)
    return np.floor(dn + 0.5).clip(0).astype(np.uint16)


def measured(frames: np.ndarray, inside: np.ndarray = EVERYWHERE) -> EmpiricalNoise | None:
    """Return what is measured beside a model that makes no covariances."""
    numbers = np.arange(FRAMES)
    evidence = observe(frames, numbers, n_run=FRAMES, block_frames=30)
    found = residual_covariances(PartSamples(frames, numbers, evidence.maps, evidence, inside))
    noise = measured_noise(found, NOTHING, evidence, inside)
    return None if noise is None else noise.effect


@pytest.mark.parametrize(
    ("noise", "of", "lag", "covariance"),
    [
        (of_next_rows, "sample", (0, 1, 0), COVARIANCE),
        (of_whole_rows, "row", (0, 1, 0), COVARIANCE),
        (of_earlier_frames, "sample", (1, 0, 0), -COVARIANCE),
    ],
)
def test_what_samples_share_is_measured_by_distance(noise, of, lag, covariance):
    found = measured(stack(4, noise))
    (mode,) = found.modes
    assert (mode.of, mode.lags) == (of, (lag,))
    # pairs at that distance, each with a product of standard deviation 1, of residuals that follow half of it
    pairs = FRAMES * ROWS * (COLUMNS if of == "sample" else COLUMNS**2)
    error = 2.0 * (0.25 * STEP) ** 2 / np.sqrt(pairs) + 0.06 * abs(covariance)
    assert abs(found.noise_dn**2 * mode.correlation[0] - covariance) < 5 * error
    if of == "row":
        assert found.noise_dn**2 == pytest.approx(POWER, rel=0.15)
    else:
        # the least with which a covariance at one distance is possible is twice as much
        assert abs(mode.correlation[0]) == pytest.approx(0.5 / 1.15, abs=1e-4)
    assert "share" in found.describe()


def test_nothing_is_measured_where_there_is_nothing():
    for seed, (read_noise, exposure) in enumerate([(0.15, 0.3), (0.25, 4.0), (0.4, 1.0), (0.6, 2.0)]):
        assert measured(stack(seed, nothing, read_noise, exposure)) is None


@pytest.mark.parametrize("axis", [1, 2])
def test_the_shape_of_what_lines_share_is_measured(axis):
    slope = np.linspace(-1.5, 1.5, SHAPE[axis - 1])

    along, size = {1: (np.s_[:, None], (FRAMES, 1, COLUMNS)), 2: (np.s_[:], (FRAMES, ROWS, 1))}[axis]
    found = measured(stack(7, lambda rng: rng.standard_normal(size) * slope[along]))
    (mode,) = found.modes  # near samples share it, and nothing else
    assert mode.of == ("row" if axis == 2 else "column")
    shape = mode.along(np.linspace(0.0, 1.0, slope.size))
    assert abs(np.corrcoef(shape, slope)[0, 1]) > 0.95
    power = np.mean(slope**2)
    assert found.share_of(mode) ** 2 == pytest.approx(power, rel=0.25)
    noise = simulated(EmpiricalNoise(noise_dn=1.0, modes=(mode,)))
    wanted = np.broadcast_to(abs(shape)[along], SHAPE)
    # a standard deviation of 600 values has an error of 2.9 %
    np.testing.assert_allclose(noise.std(axis=0), wanted, rtol=0.15, atol=0.02)


def test_only_a_part_is_looked_at():
    left = np.broadcast_to(np.arange(COLUMNS) < COLUMNS // 2, SHAPE)
    frames = stack(5, lambda rng: of_whole_rows(rng) * left)
    found = measured(frames, left)
    assert found.noise_dn**2 == pytest.approx(POWER, rel=0.25)
    assert measured(frames, ~left) is None


def test_what_a_model_makes_is_taken_off():
    frames, numbers = stack(6, of_whole_rows), np.arange(FRAMES)
    evidence = observe(frames, numbers, n_run=FRAMES, block_frames=30)
    data = residual_covariances(PartSamples(frames, numbers, evidence.maps, evidence, EVERYWHERE))
    pairs = {key: Covariance(2.0 * one.error, one.error) for key, one in data.pairs.items()}
    models = data, Covariances(pairs, {}), NOTHING
    own, by_chance, nothing = (measured_noise(data, model, evidence, EVERYWHERE) for model in models)
    assert own is None
    assert by_chance == nothing


def simulated(effect: EmpiricalNoise, n_frames: int = 600) -> np.ndarray:
    """Return the noise, DN, of a sensor of no other noise and no light, in steps of a hundredth."""
    sensor = a_uniform_sensor(SHAPE, 1e-9, 1.0, 30000.0, 1e-6)
    frames, _ = simulated_frames(sensor, effect.scaled(100.0), n_frames=n_frames, seed=5, bit_depth=16)
    return (frames - 30000.0) / 100.0


@pytest.mark.parametrize(
    "mode",
    [
        NoiseMode(of="sample", share=1.0, lags=((0, 1, 0),), correlation=(0.42,)),
        NoiseMode(of="sample", share=1.0, lags=((1, 0, 0), (0, 1, -1)), correlation=(-0.25, 0.2)),
        NoiseMode(of="row", share=1.0, lags=((0, 1, 0), (1, 0, 0)), correlation=(0.25, -0.22)),
        NoiseMode(of="column", share=1.0, lags=((0, 0, 2),), correlation=(0.4,)),
        NoiseMode(of="frame", share=1.0, lags=((1, 0, 0),), correlation=(0.4,)),
    ],
    ids=lambda mode: f"{mode.of} {mode.lags}",
)
def test_the_simulated_noise_has_its_power_and_correlations(mode):
    noise = simulated(EmpiricalNoise(noise_dn=2.0, modes=(mode,)))
    parts = {"sample": np.s_[:], "row": np.s_[:, :, :1], "column": np.s_[:, :1], "frame": np.s_[:, :1, :1]}
    values = noise[parts[mode.of]]
    np.testing.assert_array_equal(noise, np.broadcast_to(values, noise.shape))
    # neighbours count for less than one each
    error = 2.0 / np.sqrt(values.size)
    assert abs(np.mean(values**2) / 4.0 - 1.0) < 5 * error
    for lag, wanted in zip(mode.lags, mode.correlation, strict=True):
        one = values[tuple(slice(max(-n, 0), s - max(n, 0)) for n, s in zip(lag, values.shape, strict=True))]
        two = values[tuple(slice(max(n, 0), s + min(n, 0)) for n, s in zip(lag, values.shape, strict=True))]
        assert np.mean(one * two) / 4.0 == pytest.approx(wanted, abs=5 * error + 0.03)
        assert abs(wanted) > 10 * (error if mode.of != "frame" else error / 4)


def test_it_is_found_beside_a_named_effect_and_closes_the_gap():
    # the only test of the whole way: split, null, row noise, what is measured beside it, final frames
    def hidden(rng):
        return of_next_rows(rng) + 0.7 * rng.standard_normal((FRAMES, ROWS, 1))

    settings = DiscrepancySettings(candidates=("row_noise",), replicates=20, extended_replicates=12)
    found = find_discrepancies(stack(42, hidden), settings=settings)
    verdict = found.verdict
    assert (verdict.verdict, verdict.effects) == ("described", ("row_noise",))
    effects = {effect.tag: effect for effect in found.model}
    assert effects.keys() == {"row_noise", "empirical_noise"}
    measured_mode = effects["empirical_noise"].modes[0]
    assert (measured_mode.of, measured_mode.lags) == ("sample", ((0, 1, 0),))
    assert verdict.gap.closed_fraction > 0.8
    assert "share" in verdict.sentence
