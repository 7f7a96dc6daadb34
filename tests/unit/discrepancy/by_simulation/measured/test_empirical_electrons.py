"""What electrons do to each other is measured in frames made by plain numpy, and simulated as it is told."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from helpers.small_sensors import a_uniform_sensor
from helpers.small_sensors import simulated as simulated_frames
from pydantic import ValidationError
from scipy import stats

from pchem_pipeline.discrepancy.by_simulation.measured.electrons import electron_chances, measured_electrons
from pchem_pipeline.discrepancy.by_simulation.measured.samples import PartSamples
from pchem_pipeline.discrepancy.observe.observe import observe
from pchem_pipeline.effects.operators.fate import ElectronMode, EmpiricalElectrons
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.sample_law import SampleLaw

SHAPE, FRAMES, STEP, NOISE = (16, 16), 2000, 14.0, 0.25
QUIET = a_uniform_sensor(SHAPE, 2.0, 1 / STEP, 100.0, 1e-6)
EXPOSURE = np.exp(np.random.default_rng(20).normal(0.6, 0.25, SHAPE))
Fate = Callable[[np.ndarray, np.random.Generator], np.ndarray]


def nothing(k: np.ndarray, _: np.random.Generator) -> np.ndarray:
    return k


def followed_by(number: float) -> Fate:
    """Return what makes each electron bring so many others to the next frame, on average."""

    def fate(k: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        for t in range(1, len(k)):
            k[t] += rng.poisson(number * k[t - 1])
        return k

    return fate


def lost(k: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return electrons each of which is lost with a chance of 0.03 for every other one."""
    return k - rng.binomial(k, 0.03 * np.maximum(k - 1, 0))


def moved(k: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return electrons each of which goes one column to the right with a chance of 0.04 for every other."""
    gone = rng.binomial(k, 0.04 * np.maximum(k - 1, 0))
    found = k - gone
    found[:, :, 1:] += gone[:, :, :-1]
    return found


def emptied(k: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return electrons of which a sample loses all with a chance of 0.06."""
    return np.where(rng.random(k.shape) < 0.06, 0, k)


def chances(frames: np.ndarray) -> Any:
    numbers = np.arange(FRAMES)
    evidence = observe(frames, numbers, n_run=FRAMES, block_frames=100)
    return electron_chances(PartSamples(frames, numbers, evidence.maps, evidence, np.ones(SHAPE, bool)))


def drawn(fate: Fate, seed: int) -> np.ndarray:
    """Return frames in which something happens to electrons."""
    rng = np.random.default_rng(seed)
    electrons = fate(rng.poisson(EXPOSURE, (FRAMES, *SHAPE)), rng)
    noise = NOISE * np.random.default_rng(seed + 1000).standard_normal(electrons.shape)
    return np.floor(100.0 + STEP * (electrons + noise) + 0.5).astype(np.uint16)


@pytest.fixture(scope="module")
def plain() -> Any:
    return chances(drawn(nothing, 1))


@pytest.mark.parametrize(
    ("fate", "told", "place", "chance"),
    [
        (followed_by(0.05), "followed", (1, 0, 0), 0.05),
        # those that come bring others in turn: more than Poisson in a frame, and nothing of its own
        (followed_by(0.2), "followed", (1, 0, 0), 0.2),
        (lost, "lost", (0, 0, 0), 0.03),
        (moved, "moved", (0, 0, 1), 0.04),
        (emptied, "emptied", (0, 0, 0), 0.06),
    ],
)
def test_what_happens_to_electrons_is_told_with_its_chance(
    plain: Any, fate: Fate, told: str, place: tuple[int, int, int], chance: float
) -> None:
    found = measured_electrons(chances(drawn(fate, 2)), plain)
    (mode,) = found.effect.modes
    assert (mode.fate, mode.place) == (told, place)
    # to first order in the chance; refits make it exact
    assert found.effect.chance == pytest.approx(chance, rel=0.35)


def test_electrons_that_come_by_themselves_need_nothing(plain: Any) -> None:
    for seed in (3, 4):
        assert measured_electrons(chances(drawn(nothing, seed)), plain) is None


def simulated(*modes: ElectronMode, chance: float) -> np.ndarray:
    """Return electron numbers of a sensor of next to no read noise under the effect."""
    effect = EmpiricalElectrons(chance=chance, modes=modes)
    return (simulated_frames(QUIET, effect, n_frames=FRAMES, seed=5)[0] - 100.0) / STEP


def test_simulated_electrons_are_followed_by_as_many_as_told() -> None:
    k = simulated(ElectronMode(fate="followed", place=(1, 0, 0)), chance=0.1)
    error = np.sqrt(2.0 / k.size)
    # each brings 0.1 others, and these again
    assert abs(k.mean() - 2.0 / 0.9) < 5 * error
    together = np.mean((k[1:] - k.mean()) * (k[:-1] - k.mean()))
    # of a mean of 2.22, a tenth of the variance
    assert together == pytest.approx(0.1 * k.var(), abs=5 * 2.3 / np.sqrt(k.size))


def test_simulated_electrons_that_go_are_as_many_as_told_and_come_where_it_is_told() -> None:
    lost = simulated(ElectronMode(fate="lost"), chance=0.05)
    moved = simulated(ElectronMode(fate="moved", place=(0, 0, 1)), chance=0.05)
    error = np.sqrt(2.0 / lost.size)
    # pairs are H^2 many
    assert abs(lost.mean() - (2.0 - 0.05 * 4.0)) < 5 * error
    assert abs(moved[:, :, 1:].mean() - 2.0) < 5 * error
    assert abs(moved[:, :, 0].mean() - 1.8) < 5 * error * np.sqrt(SHAPE[1])


def law_of(*modes: ElectronMode, chance: float) -> np.ndarray:
    """Return the probabilities of the numbers of electrons under the law, at H = 2."""
    columns = [np.array([v]) for v in (2.0, 1 / STEP, 100.0, np.sqrt(0.02**2 + 1 / 12))]
    law = EmpiricalElectrons(chance=chance, modes=modes).sample_law(SampleLaw(), None)
    return sample_mass(law, columns, 93 + np.arange(16 * int(STEP))).reshape(16, -1).sum(axis=1)


def test_the_law_of_emptied_samples_is_a_mixture() -> None:
    mixed = 0.9 * stats.poisson.pmf(np.arange(16), 2.0) + 0.1 * (np.arange(16) == 0)
    np.testing.assert_allclose(law_of(ElectronMode(fate="emptied"), chance=0.1), mixed, atol=1e-6)


@pytest.mark.parametrize("place", [(1, 0, 0), (0, 0, 1), (0, 0, 0)])
def test_the_law_has_the_mean_of_electrons_with_those_that_follow(place: tuple[int, int, int]) -> None:
    mode = ElectronMode(fate="followed", place=place)
    k = simulated(mode, chance=0.1)[4:, :, 1:]  # none come from beyond the edge
    mean = law_of(mode, chance=0.1) @ np.arange(16)
    error = np.sqrt(1.5 * k.var() / k.size)
    assert abs(k.mean() - mean) < 5 * error
    assert abs(mean - 2.0) > 20 * error


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ValidationError, match="this frame or a later one"):
        ElectronMode(fate="followed", place=(-1, 0, 0))
    with pytest.raises(ValidationError, match="another sample"):
        ElectronMode(fate="moved")
    with pytest.raises(ValidationError, match="leave it out"):
        ElectronMode(fate="emptied", place=(0, 0, 1))


def test_its_words_say_what_happens_to_electrons() -> None:
    modes = (ElectronMode(fate="followed", place=(1, 0, 0)), ElectronMode(fate="lost", weight=0.5))
    assert EmpiricalElectrons(chance=0.04, modes=modes).describe() == (
        "electron numbers are not independent (+0.04 electrons in the sample one frame later per electron; "
        "a sample of k electrons loses 0.02 k (k - 1) of them)"
    )
