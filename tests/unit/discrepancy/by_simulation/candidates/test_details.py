"""Numbers of effects beside their strengths are tuned to the statistics of the data."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from helpers.refitted_world import M, World
from helpers.refitted_world import refined as refined_set

from pchem_pipeline.discrepancy.by_simulation.candidates.details import may_be_tuned, standard_errors, tuned
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import Hypothesis
from pchem_pipeline.discrepancy.by_simulation.sets.pixel_likelihood import HistogramLikelihood
from pchem_pipeline.discrepancy.by_simulation.sets.refits import Refitted
from pchem_pipeline.discrepancy.by_simulation.sets.search import Search, compare
from pchem_pipeline.discrepancy.effort import Effort, EffortSpentError
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.registry import effect_classes
from pchem_pipeline.effects.operators.light import DarkCurrentRts
from pchem_pipeline.effects.operators.offsets import RowNoise

UNIT = np.eye(M)
BLINKING = DarkCurrentRts(fraction=0.1, step_e=1.0, dwell_low_frames=200.0, dwell_high_frames=200.0)
TRUE = DarkCurrentRts(fraction=0.12, step_e=1.4, dwell_low_frames=120.0, dwell_high_frames=200.0)


def statistics(effects: Sequence[Effect]) -> np.ndarray:
    """Return the mean: the form of what blinking does goes with its numbers, its size with the fraction."""
    mean = np.zeros(M)
    for one in effects:
        if isinstance(one, DarkCurrentRts):
            form = 40.0 * UNIT[0] + 30.0 * one.step_e**1.5 * UNIT[1]
            form += 20.0 * (one.dwell_low_frames / 200.0) ** -0.8 * UNIT[2]
            form += (4.0 + 40.0 * np.log(200.0 / one.dwell_low_frames)) * UNIT[4]
            mean += one.fraction / 0.1 * (form + 15.0 * (one.dwell_high_frames / 200.0) ** 0.5 * UNIT[3])
        if isinstance(one, RowNoise):
            # what wrong numbers of the blinking leave, and little of its own
            mean += one.row_noise_dn**2 * (60.0 * UNIT[4] + 20.0 * UNIT[1])
    return mean


def world_of(*truth: Effect, beside: np.ndarray | float = 0.0) -> World:
    return World(truth, statistics, beside=beside)


def refined(world: World, effect: Effect) -> Refitted:
    return refined_set(world.refitter(), [Hypothesis(effect, statistics([effect]))])


def test_numbers_are_brought_to_what_the_data_ask_for() -> None:
    world = world_of(TRUE)
    begun = refined(world, BLINKING)
    assert may_be_tuned(world.refitter(), begun)
    found = tuned(world.refitter(), begun)
    [effect] = found.effects
    assert found.tuned
    assert begun.chance - begun.score > 40.0
    assert found.chance - found.score < 15.0
    assert effect.fraction == pytest.approx(TRUE.fraction, rel=0.15)
    assert effect.step_e == pytest.approx(TRUE.step_e, rel=0.15)
    assert effect.dwell_low_frames == pytest.approx(TRUE.dwell_low_frames, rel=0.3)


def test_standard_errors_are_those_of_a_fit_of_all_numbers_together() -> None:
    """The scatter of least squares with other derivatives; a number that nothing tells has none."""
    world = world_of(TRUE)
    one = refined(world, TRUE)
    [found] = standard_errors(world.refitter(), one, np.zeros(1), {})
    [taken] = one.effects
    names = ["fraction", "step_e", "dwell_low_frames", "dwell_high_frames"]
    ahead, back = ([taken.times(n, factor) for n in names] for factor in (1.01, 0.99))
    slopes = np.stack([statistics([a]) - statistics([b]) for a, b in zip(ahead, back, strict=True)]) / 0.02
    # by chance, in data and replicates, and where the model is wrong by 3 %
    noise = np.sqrt(1 / 2 + 1 / len(one.vectors) + (0.03 * statistics([taken])) ** 2)
    draws = noise[:, None] * np.random.default_rng(3).standard_normal((M, 4000))
    scatter = np.linalg.lstsq(slopes.T / noise[:, None], draws / noise[:, None], rcond=None)[0].std(axis=1)
    for name, relative in zip(names, scatter, strict=True):
        assert found[name] == pytest.approx(relative * getattr(taken, name), rel=0.25)
    alone = taken.fraction / np.linalg.norm(slopes[0] / noise)
    assert found["fraction"] > 1.5 * alone
    [blind] = standard_errors(replace(world.refitter(), draw=lambda *_: one.vectors), one, np.ones(1), {})
    assert blind == {"fraction": pytest.approx(taken.fraction)}
    # a fit to histograms in which the strength varies with another number knows better, no other
    tied, held = ({taken.tag: {"fraction": 9.0} | more} for more in ({"level_dn": 1.0}, {}))
    of_law = [standard_errors(world.refitter(), one, np.zeros(1), law)[0] for law in (tied, held)]
    assert of_law == [found | tied[taken.tag], found]


def test_errors_away_from_the_maximum_hold_the_change_that_the_data_still_ask_for() -> None:
    world = world_of(TRUE)
    one = refined(world, BLINKING)
    [found], [right] = (
        standard_errors(world.refitter(), each, np.zeros(1), {}) for each in (one, refined(world, TRUE))
    )
    [taken] = one.effects
    off = {n: abs(getattr(taken, n) - getattr(TRUE, n)) for n in ("step_e", "dwell_low_frames")}
    assert all(off[name] > 3.0 * right[name] for name in off)
    # a number that is so far off may have no error at all
    assert all(off[name] < 2.0 * found.get(name, np.inf) for name in off)


def test_the_chosen_set_is_at_its_maximum_though_it_leaves_nothing_at_the_guess() -> None:
    truth = BLINKING.model_copy(update={"dwell_low_frames": 187.0})
    world = world_of(truth)
    begun = refined(world, BLINKING)
    assert world.refitter().passes_goodness_of_fit(begun)
    assert not may_be_tuned(world.refitter(), begun)
    found = world.compare(Hypothesis(BLINKING, statistics([BLINKING])))
    assert found is not None
    [effect] = found.chosen.effects
    assert found.chosen.tuned
    assert abs(effect.dwell_low_frames - 187.0) < 6.0
    assert [each.tags for each in found.tried] == [found.chosen.tags]


def test_what_is_left_where_the_effect_moves_nothing_is_no_reason_to_tune() -> None:
    world = world_of(TRUE, beside=60.0 * UNIT[9])
    assert not may_be_tuned(world.refitter(), refined(world, BLINKING))
    # nor is it where nothing is left
    world = world_of(TRUE)
    assert not may_be_tuned(world.refitter(), refined(world, TRUE))


def test_nothing_is_simulated_at_the_limit() -> None:
    world = world_of(TRUE)
    begun, effort = refined(world, BLINKING), Effort(1.0)
    drawn = world.drawn
    effort.begin()
    effort.spent = effort.most
    with pytest.raises(EffortSpentError):
        tuned(replace(world.refitter(), allow=effort.check), begun)
    assert world.drawn == drawn


@pytest.mark.parametrize("truth", [TRUE, BLINKING.model_copy(update={"dwell_low_frames": 165.0})])
def test_an_effect_that_wrong_numbers_of_another_brought_in_is_not_kept(truth: DarkCurrentRts) -> None:
    """Row noise explains what blinking leaves at the guessed numbers, at once or when tuned, too."""
    world = world_of(truth)
    hypotheses = [Hypothesis(e, statistics([e])) for e in (BLINKING, RowNoise(row_noise_dn=0.6))]
    sets = world.likely(*hypotheses)
    assert {h.tag for h in sets[0].hypotheses} == {"dark_current_rts", "row_noise"}
    found = world.compare(*hypotheses, sets=sets)
    assert found.chosen.tags == {"dark_current_rts"}


@pytest.mark.parametrize("tag", sorted(effect_classes()))
def test_numbers_that_are_tuned_are_positive_and_none_is_the_strength(tag: str) -> None:
    for effect in effect_classes()[tag].typical():
        for name in effect.details():
            assert getattr(effect, name) > 0.0
            assert name != effect.strength
            assert getattr(effect.times(name, 0.9), name) == pytest.approx(0.9 * getattr(effect, name))


class Limited(DarkCurrentRts):
    """Of another package: some of its numbers are not free."""

    def times(self, name: str, factor: float) -> "Limited":
        if name == self.strength:
            return super().times(name, factor)
        raise ValueError("not so long")


class Wrong(DarkCurrentRts):
    """Names what is no number of it."""

    def details(self) -> tuple[str, ...]:
        return ("n_levels", "step")


class Broken(DarkCurrentRts):
    """Cannot say what its numbers are."""

    def details(self) -> tuple[str, ...]:
        raise RuntimeError("broken")


@pytest.mark.parametrize("strange", [Limited, Wrong, Broken])
def test_what_an_effect_of_another_package_raises_ends_no_search(strange: type[DarkCurrentRts]) -> None:
    world = world_of(TRUE)
    guessed = strange.model_validate(BLINKING.model_dump())
    hypotheses = [Hypothesis(e, statistics([e])) for e in (guessed, RowNoise(row_noise_dn=0.6))]
    refitter = world.refitter()
    search = Search(refitter, HistogramLikelihood())
    compare(search, hypotheses, world.likely(*hypotheses))
    assert "dark_current_rts" in search.best.tags
    own = refined(world, guessed)
    assert standard_errors(refitter, own, own.stderr, {})[0].keys() == {"fraction"}
    assert refitter.defects
    assert all("dark_current_rts" in failed for failed in refitter.defects)
