"""The empirical component: moves of the samples are measured, simulated and fitted, and never compete."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.small_sensors import a_uniform_sensor
from helpers.small_sensors import simulated as simulated_frames
from pydantic import ValidationError

from pchem_pipeline.discrepancy.build_verdict import Added, Addition, Findings, _sentence
from pchem_pipeline.discrepancy.by_simulation.measured.mixture_shifts import (
    _Mixture,
    measured_mixture_shifts,
    without_squares,
)
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.verdict import closed_share
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.operators.offsets import RowNoise
from pchem_pipeline.effects.operators.replace import Empirical, MixtureShift, neighbour_words

SHAPE, FRAMES, STEP = (10, 12), 1500, 12.0
SENSOR = a_uniform_sensor(SHAPE, 1.0, 1 / STEP, 100.0, 0.25)


def sensor(seed: int) -> tuple[np.ndarray, np.random.Generator, PixelMaps]:
    """Return the samples of a plain sensor before rounding, DN, random numbers, and its true parameters."""
    rng = np.random.default_rng(seed)
    exposure, bias = rng.uniform(0.6, 2.0, SHAPE), rng.uniform(90.0, 110.0, SHAPE)
    noise = rng.uniform(0.22, 0.28, SHAPE) * STEP
    size = (FRAMES, *SHAPE)
    dn = bias + STEP * rng.poisson(exposure, size) + noise * rng.standard_normal(size)
    values = exposure, np.full(SHAPE, 1 / STEP), bias, np.sqrt(noise**2 + 1 / 12)
    return dn, rng, PixelMaps(*values, np.ones(SHAPE, bool))


def codes(dn: np.ndarray, _: Any = None) -> np.ndarray:
    return np.floor(dn + 0.5).astype(np.int64)


def shifted(share: float, shift: int):
    return lambda dn, rng: codes(dn) + shift * (rng.random(dn.shape) < share)


def averaged(dn: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    code = codes(dn)
    for t in range(1, FRAMES):
        alike = abs(code[t] - code[t - 1]) <= STEP / 2
        some = alike & (rng.random(SHAPE) < 0.1)
        code[t] = np.where(some, (code[t] + code[t - 1]) // 2, code[t])
    return code


def drawn(strength: float):
    def move(dn: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        code = codes(dn)
        for t in range(1, FRAMES):
            code[t] = codes(dn[t] + strength * np.sign(code[t - 1] - dn[t]))
        return code

    return move


def in_squares(code: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return codes from the second row and the first column on as (frame, y, 2, x, 2), and their means."""
    squares = code[:, 1:-1].reshape(len(code), SHAPE[0] // 2 - 1, 2, SHAPE[1] // 2, 2)
    return squares, squares.sum(axis=(2, 4), keepdims=True) // 4


def merged(dn: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    code = codes(dn)
    squares, mean = in_squares(code)
    some = rng.random(mean.shape) < 0.05
    code[:, 1:-1] = np.where(some, mean, squares).reshape(FRAMES, SHAPE[0] - 2, SHAPE[1])
    return code


def measured(move: Any, seed: int) -> Empirical | None:
    """Return what is measured in frames of which some samples are moved."""
    dn, rng, maps = sensor(seed)
    found = measured_mixture_shifts(move(dn, rng).astype(np.uint16), np.arange(FRAMES), maps, ())
    assert found is None or found.gain > 10.0
    return None if found is None else found.effect


@pytest.mark.parametrize(("share", "shift"), [(0.004, -8), (0.02, 4)])
def test_shifts_are_measured(share: float, shift: int) -> None:
    found = measured(shifted(share, shift), 3)
    samples = FRAMES * SHAPE[0] * SHAPE[1]
    mean = float(found.shares() @ np.array([move.shift_dn for move in found.moves]))
    # neighbouring shifts of the grid stand for one another: their mean is what is known well
    assert mean == pytest.approx(share * shift, rel=0.1)
    assert found.share == pytest.approx(share, rel=0.35)
    assert found.share * samples > 100


@pytest.mark.parametrize(
    ("move", "share", "wanted"),
    [
        (averaged, 0.1, MixtureShift(towards=(-1, 0, 0), part=0.5, within_dn=6)),
        (drawn(2.0), 1.0, MixtureShift(towards=(-1, 0, 0), shift_dn=2)),
        (drawn(0.7), 0.7, MixtureShift(towards=(-1, 0, 0), shift_dn=1)),
    ],
)
def test_what_depends_on_a_neighbour_is_measured(move: Any, share: float, wanted: MixtureShift) -> None:
    found = measured(move, 5)
    main = max(found.moves, key=lambda one: one.weight)
    assert main.model_copy(update={"weight": 1.0}) == wanted
    assert found.together == "sample"
    # a few samples are taken for other moves
    assert found.share == pytest.approx(share, rel=0.25)
    assert neighbour_words(wanted.towards) in found.describe()


def test_squares_that_come_as_their_mean_are_measured_where_they_begin() -> None:
    found = measured(merged, 6)
    assert found.squares == (1, 0)
    assert found.share == pytest.approx(0.05, rel=0.1)
    assert "from odd rows and even columns on" in found.describe()
    # in a window that begins at an odd row they begin at even ones
    assert found.to_window((3, 9), (2, 12), SHAPE).squares == (0, 0)
    assert found.to_sensor((3, 9), (2, 12), SHAPE).squares == (0, 0)


def test_simulated_squares_are_the_mean_of_their_samples() -> None:
    found, own = simulated(Empirical(share=0.3, moves=(MixtureShift(),), squares=(1, 0)), 400)
    equal = (in_squares(found)[0] == in_squares(own)[1]).all(axis=(2, 4))
    assert abs(equal.mean() - 0.3) < 5 * np.sqrt(0.21 / equal.size) + 0.01
    np.testing.assert_array_equal(found[:, 0], own[:, 0])


def test_pixels_are_fitted_without_samples_that_were_averaged() -> None:
    dn, rng, maps = sensor(11)
    found, own = merged(dn, rng).astype(np.uint16), codes(dn)
    effect = Empirical(share=0.05, moves=(MixtureShift(),), squares=(1, 0))
    left = without_squares(found, maps.usable, (effect,))
    error = np.sqrt(2.0) * own.std(axis=0) / np.sqrt(FRAMES)
    inside = np.s_[:, 1:-1]

    def largest(frames: np.ndarray) -> float:
        return float(np.abs((frames.mean(axis=0) - own.mean(axis=0)) / error)[inside].max())

    assert largest(left) < min(4.0, largest(found))
    # nothing else is touched, and nothing by other effects
    assert (left == found).all(axis=2).mean() > 0.7
    assert without_squares(found, maps.usable, Empirical.typical()) is found


def test_nothing_is_measured_where_there_is_nothing() -> None:
    found = [measured(codes, seed) for seed in range(4)]
    assert [one for one in found if one is not None and one.share > 1e-3] == []


def test_moves_of_which_none_is_needed_are_not_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_Mixture, "needed", lambda self: ([], np.zeros(len(self.mass)), 0.0))
    assert measured(averaged, 5) is None


def simulated(effect: Empirical, n_frames: int) -> tuple[np.ndarray, np.ndarray]:
    both = (simulated_frames(SENSOR, *each, n_frames=n_frames, seed=4)[0] for each in ((effect,), ()))
    return tuple(frames.astype(int) for frames in both)


def test_samples_are_moved_by_their_shares() -> None:
    moves = MixtureShift(shift_dn=-9, weight=3.0), MixtureShift(shift_dn=5, weight=1.0)
    effect = Empirical(share=0.2, moves=moves)
    np.testing.assert_allclose(effect.shares(), [0.15, 0.05])
    found, own = simulated(effect, 1000)
    for shift, share in ((-9, 0.15), (5, 0.05), (0, 0.8)):
        error = np.sqrt(share * (1 - share) / own.size)
        assert abs((found - own == shift).mean() - share) < 5 * error


def test_samples_are_moved_towards_what_was_delivered_before() -> None:
    found, own = simulated(Empirical(share=0.2, moves=(MixtureShift(towards=(-1, 0, 0), part=0.5),)), 400)
    towards = own[1:] + (found[:-1] - own[1:]) // 2
    moved = (found[1:] != own[1:]) & (towards != own[1:])
    # four moves after another are followed, a fifth one is not
    wrong = (found[1:] != towards)[moved].mean()
    assert wrong < 2 * 0.2**4
    assert abs(moved.sum() / (towards != own[1:]).sum() - 0.2) < 0.01


@pytest.mark.parametrize(("together", "axes"), [("row", 2), ("frame", (1, 2)), ("column", 1)])
def test_what_is_moved_together_comes_from_one_side(together: Any, axes: Any) -> None:
    move = MixtureShift(towards=(0, 0, 1))
    found, own = simulated(Empirical(share=0.3, moves=(move,), together=together), 400)
    moved, kept = found[:, :, :-1] == own[:, :, 1:], found[:, :, :-1] == own[:, :, :-1]
    assert np.all(moved | kept)
    whole = moved.all(axis=axes)
    assert np.all(whole | kept.all(axis=axes))
    assert abs(whole.mean() - 0.3) < 5 * np.sqrt(0.21 / whole.size) + 0.01


def test_half_a_table_is_refused() -> None:
    with pytest.raises(ValidationError, match="not shifted"):
        Empirical(share=0.3, moves=(MixtureShift(shift_dn=3),), squares=(1, 0))
    with pytest.raises(ValidationError, match="earlier"):
        MixtureShift(towards=(1, 0, 0))
    with pytest.raises(ValidationError, match="weight above 0"):
        Empirical(share=0.1, moves=(MixtureShift(shift_dn=1, weight=0.0),))


def test_a_described_sensor_is_said_so_and_keeps_the_component_in_its_model() -> None:
    effect = Empirical(share=0.004, moves=(MixtureShift(shift_dn=-8),))
    before, after = Gap(2e-3, 5e-5, (0.0, 0.0), {}), Gap(3e-5, 5e-5, (0.0, 0.0), {})
    addition = Addition(effect, True, "", (), {}, before, after, (), (), described=True)
    nothing: Any = None
    found = Findings("frames", *3 * [nothing], before, [], False, Added((addition,), after))
    assert found.state == "described"
    assert found.named == ()
    assert found.model((), (effect,)) == (effect,)
    step = addition.step(None)
    assert (step.verdict, step.effect) == ("described", None)
    assert "empirically, 0.40 % of the samples are shifted by -8 DN; this" in _sentence(found, {})
    assert "still disagree" in _sentence(replace(found, still=True), {})


def test_a_description_that_leaves_a_part_of_the_gap_is_proposed_and_not_in_the_model() -> None:
    effect, named = Empirical(share=0.004, moves=(MixtureShift(shift_dn=-8),)), RowNoise(row_noise_dn=0.3)
    first, second, third = (Gap(value, 5e-5, (0.0, 0.0), {}) for value in (4e-3, 2e-3, 4e-4))
    steps = (
        Addition(named, True, "", (), {}, first, second, (), ()),
        Addition(effect, True, "", (), {}, second, third, (), (), described=True),
    )
    nothing: Any = None
    found = Findings("frames", *3 * [nothing], first, [], False, Added(steps, third))
    assert found.state == "described"
    assert found.model((), (named, effect)) == (named,)
    assert found.proposed == (effect,)
    said = _sentence(found, {})
    assert "explains 90 % of the discrepancy in unseen frames" in said
    assert "proposed, not added to the model" in said
    # a gap that chance alone makes, or that only grew, has no shares
    for before, after in ((0.0, 1e-4), (-2e-5, 1e-4), (1e-4, 3e-4)):
        gaps = [Gap(value, 5e-5, (0.0, 0.0), {}) for value in (before, after)]
        said = _sentence(replace(found, before=gaps[0], added=Added(steps, gaps[1])), {})
        assert "does not reduce the discrepancy" in said
        assert closed_share(before, after) == 0.0
    assert closed_share(1e-4, -3e-5) == 1.0
