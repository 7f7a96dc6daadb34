"""How effects enter the model: at their best refit, the simplest set that leaves nothing, proven at last."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from helpers.refitted_world import NAMES, M, Mean, World, at_best_fit, refined
from scipy import stats

from pchem_pipeline.discrepancy.build_verdict import Findings
from pchem_pipeline.discrepancy.by_simulation.acceptance import Acceptance
from pchem_pipeline.discrepancy.by_simulation.additions import Extension, unexplained_of_its_kind
from pchem_pipeline.discrepancy.by_simulation.candidates.candidates import ReplicateSimulator
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import (
    PRICE_OF_MORE,
    Hypothesis,
    fit_set,
)
from pchem_pipeline.discrepancy.by_simulation.candidates.screening import Screened
from pchem_pipeline.discrepancy.by_simulation.explainer import FrameExplainer
from pchem_pipeline.discrepancy.by_simulation.sets.pixel_likelihood import HistogramLikelihood
from pchem_pipeline.discrepancy.by_simulation.sets.refits import Refitted, Steps
from pchem_pipeline.discrepancy.by_simulation.sets.rivals import Comparison, _apart
from pchem_pipeline.discrepancy.by_simulation.sets.search import Search, Trial, _grown, compare
from pchem_pipeline.discrepancy.effort import Effort, EffortSpentError
from pchem_pipeline.discrepancy.gap import StatisticsGap
from pchem_pipeline.discrepancy.null import Covariance, Measured, NullModel
from pchem_pipeline.discrepancy.observe.places import Part, SensorWindow
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.skeleton import Prepared
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.effects.framework.registry import effect_class
from pchem_pipeline.effects.operators.curve import AdcInl
from pchem_pipeline.effects.operators.empirical_noise import EmpiricalNoise, NoiseMode

STRENGTHS = {
    "row_noise": "row_noise_dn",
    "frame_noise": "frame_noise_dn",
    "exposure_drift": "drift",
    "interpixel_capacitance": "coupling",
}
#: what a unit of each effect (of strength ** power) does to the statistics once the pixels are refitted
TRUTH = {
    "row_noise": (np.eye(M)[0] * 40.0, 0.6),
    "frame_noise": (np.eye(M)[1] * 40.0, 1.0),
    "exposure_drift": (np.eye(M)[2] * 40.0, 1.0),
    "interpixel_capacitance": (np.eye(M)[3] * 40.0, 1.0),
}


def effect(tag: str, strength: float, **more: float) -> Effect:
    return effect_class(tag).model_validate({"tag": tag, STRENGTHS[tag]: strength, **more})


def factor(one: Effect) -> float:
    return float(getattr(one, one.strength) / 0.1) ** one.power


def statistics(effects: Sequence[Effect]) -> np.ndarray:
    """Return the mean of the statistics: a power of the factor, so that a fingerprint extrapolates badly."""
    shifts = [TRUTH[e.tag][0] * factor(e) ** TRUTH[e.tag][1] for e in effects]
    return np.sum(shifts, axis=0) if shifts else np.zeros(M)


def hypothesis(tag: str, strength: float = 0.1, **more: float) -> Hypothesis:
    one = effect(tag, strength, **more)
    # what it does to pixels that are not refitted is half as much again
    return Hypothesis(one, 1.5 * statistics([one]))


def world_of(
    *, mean: Mean = statistics, seed: int = 1, beside: np.ndarray | float = 0.0, **strengths: float
) -> World:
    return World([effect(*each) for each in strengths.items()], mean, seed, beside)


@pytest.mark.parametrize("strength", [0.03, 0.1, 0.4, 1.2])
def test_a_strength_is_refined_by_refits_until_it_stops_moving(strength: float) -> None:
    world = world_of(row_noise=strength)
    found = refined(world.refitter(), [hypothesis("row_noise")])
    assert found.settled
    wanted, [got] = factor(effect("row_noise", strength)), [factor(e) for e in found.effects]
    error = 1.5 * found.stderr[0] / TRUTH["row_noise"][1]  # six replicates scatter too
    assert abs(np.log(got / wanted)) < 3.5 * error + 0.05
    assert world.drawn <= 6 * 7


def test_a_dip_on_the_way_to_the_best_strength_is_crossed() -> None:
    """As of row noise of 0.4 e-: what it moves goes slowly with its strength, many others to and fro.

    So steps are short, the next one explains less, and the data ask for the same on both sides of that.
    """
    best, dip = factor(effect("row_noise", 0.1)), 0.8

    def bent(effects: Sequence[Effect]) -> np.ndarray:
        way = np.log(factor(effects[0]) / best) if effects else -50.0
        slow, to_and_fro = 40.0 + 18.0 * np.tanh(way / 1.2), np.exp(-0.5 * ((way - dip) / 0.08) ** 2)
        return (np.eye(M)[0] * slow + (np.arange(M) >= M // 2) * 1.6 * to_and_fro) * (way > -50.0)

    world = world_of(row_noise=0.1, mean=bent)
    start = Hypothesis(effect("row_noise", 0.1 * np.exp(0.5)), bent([effect("row_noise", 0.1)]))
    found = refined(world.refitter(), [start])
    assert np.log(factor(found.effects[0]) / best) < dip - 0.15
    assert world.drawn <= 6 * 7


def test_slopes_that_are_too_steep_cost_few_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of noise that grows with the signal, 0.7 e-: each step does a sixth of what it promises.

    Too little in any statistic for the slopes to be corrected.
    """
    best = factor(effect("row_noise", 0.1))

    def weak(effects: Sequence[Effect]) -> np.ndarray:
        way = np.log(factor(effects[0]) / best) if effects else -50.0
        return (np.arange(M) >= M // 2) * (40.0 + 3.0 * way) * (way > -50.0)

    def draw(effects: tuple[Effect, ...], count: int) -> np.ndarray:
        world.drawn += count
        return weak(effects) + world.rng.standard_normal((count, M))

    world = world_of(row_noise=0.1, mean=weak)
    monkeypatch.setattr(world, "draw", draw)
    start = Hypothesis(effect("row_noise", 0.1 * np.exp(-0.7)), (np.arange(M) >= M // 2) * 18.0)
    found = refined(world.refitter(), [start])
    # of twelve statistics, two splits and six replicates
    assert abs(np.log(factor(found.effects[0]) / best)) < 3.5 * np.sqrt((0.5 + 1.0 / 6.0) / 12.0) / 3.0
    assert world.drawn <= 6 * 6


@pytest.mark.parametrize("tags", [("row_noise",), ("row_noise", "frame_noise")])
@pytest.mark.parametrize("power", [1.0, 1.0 / 3.0])
def test_the_error_of_a_strong_effect_is_that_of_its_slope(
    monkeypatch: pytest.MonkeyPatch, power: float, tags: Sequence[str]
) -> None:
    """The normal quantile of a sum of squares goes as a cubic root where one mode is nearly all of it."""
    monkeypatch.setitem(TRUTH, "row_noise", (np.eye(M)[0] * 40.0, power))
    off = []
    for seed in range(12):
        guesses = [effect(tag, 0.103) for tag in tags]
        refitter = world_of(**dict.fromkeys(tags, 0.1), seed=seed).refitter()
        found = refined(refitter, [Hypothesis(guess, statistics([guess])) for guess in guesses])
        found = refitter.sharpened(found, 24)
        # chance, and 3 % that are allowed to the details of an effect
        wanted = np.hypot(np.sqrt(1.0 / 2.0 + 1.0 / 24.0) / (power * 40.0), 0.03)
        assert found.stderr[0] == pytest.approx(wanted, rel=0.4)  # the scatter of 24
        off.append((factor(found.effects[0]) * np.exp(found.change[0]) - 1.0) / wanted)
    assert np.sqrt(np.mean(np.square(off))) < 1.0 + 4.0 / np.sqrt(24.0)


def test_a_part_that_stands_out_makes_no_effect_stronger_that_acts_everywhere(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It was chosen because it stands out, so its statistics are too large."""
    monkeypatch.setitem(TRUTH, "row_noise", (np.eye(M)[0] * 40.0 + np.eye(M)[1] * 30.0, 1.0))
    factors = {}
    for place in (None, Region(rows=((3, 8),))):
        for chance in (0.0, 8.0):
            world = world_of(row_noise=0.2, beside=chance * np.eye(M)[1])
            names = (NAMES[0], f"{NAMES[0]}@rows=3:8", *NAMES[2:])
            world.null = replace(world.null, names=names)
            guess = hypothesis("row_noise", 0.2)
            found = refined(world.refitter(), [replace(guess, effect=guess.effect.at_place(place))])
            factors[place is None, chance] = factor(found.effects[0]) * float(np.exp(found.change[0]))
    assert factors[True, 8.0] == pytest.approx(factors[True, 0.0], rel=1e-6)
    assert factors[False, 8.0] > 1.01 * factors[False, 0.0]


def test_an_expensive_refit_is_not_repeated_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pchem_pipeline.discrepancy.by_simulation.sets.refits.is_expensive", lambda _: True)
    world = world_of(row_noise=2.0)
    found = refined(world.refitter(), [hypothesis("row_noise", 0.02)])
    assert world.drawn <= 3 * 6
    assert not found.settled


def limit(paid: int) -> Callable[[str], None]:
    """Return what allows so many refits."""
    left = iter(range(paid))

    def allow(words: str) -> None:
        if next(left, None) is None:
            raise EffortSpentError(words)

    return allow


@pytest.mark.parametrize("paid", [1, 2, 3])
def test_a_refit_that_meets_the_limit_keeps_the_steps_before_it(paid: int) -> None:
    world = world_of(row_noise=1.2)
    found = refined(replace(world.refitter(), allow=limit(paid)), [hypothesis("row_noise")])
    assert world.drawn == 6 * paid
    whole = refined(world.refitter(), [hypothesis("row_noise")])
    assert (found.effects == (effect("row_noise", 0.1),)) == (paid == 1)
    assert found.score < whole.score


def test_a_set_begins_at_the_strengths_of_one_that_differs_in_one_effect() -> None:
    world = world_of(row_noise=0.5, frame_noise=0.3)
    known = refined(world.refitter(), [hypothesis("row_noise"), hypothesis("frame_noise")])
    drift = hypothesis("exposure_drift")

    def begun(members: Sequence[Hypothesis], *tried: Refitted) -> tuple[Hypothesis, ...]:
        trials = [at_best_fit(one) for one in tried]
        return Search(world.refitter(), HistogramLikelihood(), trials)._started(members)

    first, second = begun([hypothesis("row_noise"), drift], known)
    assert (first.effect, second) == (hypothesis("row_noise").effect, drift)  # one in common is not enough
    members = [hypothesis("row_noise"), drift, hypothesis("frame_noise")]
    found = begun(members, known)
    assert {found[0].effect, found[2].effect} == set(known.effects)
    assert found[1] is drift
    alone = refined(world.refitter(), [hypothesis("row_noise")])
    assert begun(members[:2], known, alone)[0].effect == alone.effects[0]
    # in a part, the effect is another hypothesis, however well it does alone
    here = at_best_fit(refined(world.refitter(), [placed(hypothesis("row_noise"), "columns=0:8")]))
    assert begun(members[:2], here.way.best)[0] is members[0]
    whole = Trial(tuple(members[:2]), 0.0)
    assert not whole.begins_with(Trial(here.members, 0.0))
    assert whole.begins_with(Trial((members[0],), 0.0))


def test_a_set_that_cannot_come_to_another_is_not_simulated_further() -> None:
    world = world_of(row_noise=0.4, frame_noise=0.4)
    told: list[str] = []
    search = Search(world.refitter(), HistogramLikelihood(), report=told.append)
    both = search.at_best_fit([hypothesis("row_noise", 0.4), hypothesis("frame_noise", 0.4)])
    assert told[-1] == "row_noise + frame_noise"
    before = world.drawn
    begun = search.at_best_fit([hypothesis("row_noise")], both.penalised_log_likelihood)
    assert world.drawn == before + 6
    whole = search.at_best_fit([hypothesis("row_noise")])
    assert world.drawn > before + 6
    assert begun.score < whole.score < both.score


def test_a_set_whose_steps_were_broken_off_goes_on_from_the_strength_beside_others() -> None:
    """At a quarter of its strength the effect moves next to nothing: its slopes there promise no more."""

    def steep(effects: Sequence[Effect]) -> np.ndarray:
        return np.eye(M)[0] * 40.0 * (sum(factor(e) for e in effects) / factor(strong)) ** 4

    weak, strong = effect("row_noise", 0.1), effect("row_noise", 0.4)
    world = world_of(row_noise=0.4, mean=steep)
    search = Search(world.refitter(), HistogramLikelihood())
    left = search.at_best_fit([Hypothesis(weak, steep([weak]))], 0.0)
    found = search.at_best_fit([Hypothesis(strong, steep([strong]))], 0.0)
    assert found.score > left.score + 1000.0
    assert found.effects == (strong,)
    assert len(search.trials) == 1


def test_a_promising_set_does_not_wait_for_the_best_strengths_of_its_effects() -> None:
    world = world_of(row_noise=0.4, frame_noise=0.4)
    hypotheses = [hypothesis(tag) for tag in STRENGTHS]
    three = limit(3)  # each of the two, and both
    search = Search(replace(world.refitter(), allow=three), HistogramLikelihood())
    compare(search, hypotheses, world.likely(*hypotheses))
    assert search.limit is not None
    assert search.best.tags == {"row_noise", "frame_noise"}


def test_a_single_effect_that_leaves_nothing_stands_alone() -> None:
    world = world_of(row_noise=0.5)
    # frame noise helps the fingerprint of row noise out where that is extrapolated
    mimic = Hypothesis(effect("frame_noise", 0.1), 20.0 * (np.eye(M)[0] + np.eye(M)[1]))
    found = world.compare(hypothesis("row_noise"), mimic)
    assert found.chosen.tags == {"row_noise"}
    assert found.rivals_of(found.chosen.hypotheses[0])[0].effect.tag == "row_noise"


def likelihood_of(behind: Callable[[str, str], tuple[float, float] | None]) -> HistogramLikelihood:
    """Return a likelihood that says so of the first effects of two sets."""

    class Told(HistogramLikelihood):
        def behind(self, one: Sequence[Effect], other: Sequence[Effect]) -> tuple[float, float] | None:
            return behind(one[0].tag, other[0].tag)

    return Told()


def test_histograms_decide_between_effects_that_the_statistics_tell_badly_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world, guess = world_of(row_noise=0.5), hypothesis("row_noise", 0.5)
    twin = Hypothesis(effect("frame_noise", 0.5), guess.fingerprint)
    row, asked = TRUTH["row_noise"], []

    def decided(one: str, other: str) -> tuple[float, float]:
        asked.append((one, other))
        return (12.0, 4.0) if one == "frame_noise" else (-12.0, 4.0)

    monkeypatch.setitem(TRUTH, "frame_noise", (row[0] + 0.5 * np.eye(M)[1], row[1]))
    plain, found, open_ = (
        world.compare(guess, twin, likelihood=likelihood_of(behind) if behind else None)
        for behind in (None, decided, lambda *_: (-3.0, 4.0))
    )
    assert plain.chosen.tags == open_.chosen.tags == {"row_noise"}
    assert found.chosen.tags == {"frame_noise"}
    assert asked == [("frame_noise", "row_noise"), ("row_noise", "frame_noise")]
    first, second = found.rivals_of(found.chosen.hypotheses[0])
    assert (first.effect.tag, second.effect.tag) == ("frame_noise", "row_noise")
    assert (second.score, second.stderr) == (-12.0, 4.0)
    assert second.probability == pytest.approx(stats.norm.cdf(-3.0), rel=0.01)
    assert open_.rivals_of(open_.chosen.hypotheses[0])[1].probability > 0.1


def test_statistics_that_are_all_off_a_little_are_no_good_fit() -> None:
    """Each by less than chance may leave among so many, but all of them by more than it does together."""
    world, guess = world_of(row_noise=0.5), [hypothesis("row_noise", 0.5)]
    fitted = refined(world.refitter(), guess)
    assert world.refitter().passes_goodness_of_fit(fitted)
    scatter = world.refitter().scatter(fitted.covariance, len(fitted.vectors))
    to_and_fro = np.where(np.arange(M) % 2, 1.0, -1.0)
    off = replace(world.refitter(), target=fitted.mean + 2.55 * scatter * to_and_fro)
    left = refined(off, guess)
    assert np.abs(left.rest).max() < 2.0
    assert not off.passes_goodness_of_fit(left)


def test_predictions_that_lie_near_each_other_are_not_told_apart_by_chance(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two errors apart, they are told apart by two nats; by chance the likelihood makes nearly five of it."""
    row, world = TRUTH["row_noise"], world_of(row_noise=0.5, seed=20)
    twin = Hypothesis(effect("frame_noise", 0.5), hypothesis("row_noise", 0.5).fingerprint)
    monkeypatch.setitem(TRUTH, "frame_noise", (row[0] + 0.35 * np.eye(M)[1], row[1]))
    found = world.compare(hypothesis("row_noise", 0.5), twin)
    _, second = found.rivals_of(found.chosen.hypotheses[0])
    assert second.stderr == pytest.approx(2.4, abs=0.1)
    assert second.score == pytest.approx(-(second.stderr**2) / 2.0)
    assert second.probability == pytest.approx(1.0 / (1.0 + np.exp(-second.score)))
    # what simulations of one law draw otherwise tells nothing
    drawn = np.random.default_rng(21).normal(size=(12, 6, M)) * found.chosen.covariance.variances**0.5
    told = [
        _apart(replace(found.chosen, vectors=one), replace(found.chosen, vectors=drawn[0]))
        for one in drawn[1:]
    ]
    assert np.mean([nats for _, nats in told]) < 1.0 < np.mean([apart**2 / 2.0 for apart, _ in told])


def test_what_a_strong_effect_hides_is_asked_for_beside_it() -> None:
    """Nothing in the frames leads to the noise of frames: it is guessed of what the rows' leaves."""
    world = world_of(row_noise=0.3, frame_noise=0.04)
    alone = world.compare(hypothesis("row_noise"))
    assert alone.chosen.tags == {"row_noise"}
    grown = world.compare(hypothesis("row_noise"), beside=[hypothesis("frame_noise", 0.04)])
    assert grown.chosen.tags == {"row_noise", "frame_noise"}


def test_a_part_of_a_better_set_is_not_grown_again() -> None:
    refitter = world_of(row_noise=0.3, frame_noise=0.3, exposure_drift=0.3).refitter()
    row, frame, drift = (hypothesis(tag) for tag in ("row_noise", "frame_noise", "exposure_drift"))
    # of all that there is to explain each explains nearly as much
    far = replace(refitter, null=replace(refitter.null, mean=refitter.null.mean - 1e4 * np.eye(M)[0]))
    alone, both, other = (refined(refitter, each) for each in ([row], [row, frame], [row, drift]))
    for tried, seeds in (((alone, both), [both.tags]), ((other, both), [other.tags, both.tags])):
        asked: list[frozenset[str]] = []
        search = Search(far, HistogramLikelihood(), [at_best_fit(one) for one in tried])
        _grown(search, lambda one, asked=asked: asked.append(one.tags) or [])  # type: ignore[misc]
        assert sorted(asked, key=sorted) == sorted(seeds, key=sorted)


def test_an_effect_that_its_set_lets_vanish_does_not_take_the_others_with_it() -> None:
    """Of three effects that the fingerprints ask for one is not there, and something is left."""
    world = world_of(row_noise=0.3, frame_noise=0.3, interpixel_capacitance=0.1)
    row, frame, drift = (hypothesis(tag, 0.3) for tag in ("row_noise", "frame_noise", "exposure_drift"))
    shift, noise = world.z.both - world.null.mean, world.refitter().noise(world.null.covariance, 40)
    fit = fit_set([row, frame, drift], shift, noise)
    found = world.compare(row, frame, drift, sets=[fit])
    assert found.chosen.tags == {"row_noise", "frame_noise"}


@pytest.mark.parametrize("left", [0.0, 9.0])
def test_what_is_measured_competes_with_several_effects_at_its_price(left: float) -> None:
    """One thing is simpler than three effects, if it leaves nothing either; with two it is not compared."""
    tags = ("row_noise", "frame_noise", "exposure_drift")
    guesses = [hypothesis(tag, 0.3) for tag in tags]
    best = world_of(**dict.fromkeys(tags, 0.3)).compare(*guesses).chosen
    assert len(best.tags) == 3
    noise = EmpiricalNoise(noise_dn=1.0, modes=(NoiseMode(of="row", share=1.0),))
    whole = replace(best, hypotheses=(Hypothesis(noise, best.parts.sum(axis=0)),))
    assert whole.price == PRICE_OF_MORE
    whole = replace(whole, score=best.score - 10.0, rest=best.rest + left)
    world = world_of(**dict.fromkeys(tags, 0.3))
    # another form whose count of nats was larger, and which fits worse
    worse = replace(whole, score=best.score - 100.0, rest=best.rest + 9.0)
    ways = [Steps.begin(one) for one in (worse, whole)]
    found = world.compare(*guesses, measured=lambda kept: [] if kept else ways)
    assert (found.chosen is whole) == (left == 0.0)

    def never(_: Any) -> list[Steps]:
        raise AssertionError("two effects leave nothing")

    for some in (tags[:1], tags[:2]):
        found = world_of(**dict.fromkeys(some, 0.3)).compare(*guesses[: len(some)], measured=never)
        assert found.chosen.tags == set(some)


def test_a_measured_form_that_leaves_nothing_keeps_no_named_effect_from_its_refit() -> None:
    """Noise in a few rows was not refitted, since a description of two parts had left nothing before."""
    refitter = world_of(row_noise=0.3, frame_noise=0.05).refitter()
    named = refined(refitter, [hypothesis("row_noise", 0.3), hypothesis("frame_noise", 0.05)])
    noise = EmpiricalNoise(noise_dn=1.0, modes=(NoiseMode(of="row", share=1.0),))
    described = replace(named, hypotheses=(Hypothesis(noise, named.parts.sum(axis=0)),))
    # INL through measured knots had taken the place of noise that grows with the charge
    inl = AdcInl(inl_lsb=0.1, form="curve", curve=(0.0, 1.0, 0.0, -1.0))
    curve = replace(named, hypotheses=(Hypothesis(inl, named.parts.sum(axis=0)),))
    assert described.price == curve.price == named.price == PRICE_OF_MORE
    # as near as row noise by its fingerprint, which leaves what frame noise does
    other = replace(hypothesis("row_noise", 0.3), effect=effect("exposure_drift", 0.3))
    for first, refits in ((described, 1), (curve, 1), (named, 0)):
        search = Search(refitter, HistogramLikelihood(), [at_best_fit(first)])
        assert search.complete
        search.compare([[other]])
        assert sum(one.tags == {"exposure_drift"} for one in search.tried) == refits


def placed(one: Hypothesis, place: str) -> Hypothesis:
    return replace(one, effect=one.effect.at_place(Region.model_validate(place)))


@pytest.mark.parametrize("second", ["columns=0:8", "columns=16:24"])
def test_effects_that_meet_in_one_part_are_one_cause_without_a_name(second: str) -> None:
    world = world_of(row_noise=0.1, frame_noise=0.06)
    row, frame = hypothesis("row_noise"), hypothesis("frame_noise")
    found = world.compare(placed(row, "columns=0:8"), placed(frame, second))
    assert len(found.chosen.tags) == (1 if second == "columns=0:8" else 2)


@pytest.mark.parametrize(
    ("left", "words"),
    [
        ({"frame.covariance": 6.0}, "it leaves a deviation"),
        ({"frame.covariance": 3.0}, ""),
        ({"shape.He4.mean": 6.0}, ""),
    ],
)
def test_what_is_left_in_the_family_of_a_signature_speaks_against_a_name(
    left: dict[str, float], words: str
) -> None:
    names = ("frame.readout.variance", "frame.covariance", "shape.He4.mean", "code.smooth@columns=0:8")
    null = NullModel.from_replicates(names, np.random.default_rng(3).standard_normal((40, 4)))
    everywhere = effect("frame_noise", 0.1)
    placed = everywhere.at_place(Region.model_validate("columns=0:8"))
    rest = np.array([left.get(name, 0.0) for name in names])
    part = np.array([100.0, 0.0, 1.0, 0.0])
    for one in (everywhere, placed):
        assert unexplained_of_its_kind(one, part, rest, null).startswith(words)
        assert bool(unexplained_of_its_kind(one, part, rest, null)) == bool(words)
    # what stands in its place, whatever it is
    there = np.array([0.0, 0.0, 0.0, 6.0])
    assert not unexplained_of_its_kind(everywhere, part, there, null)
    assert unexplained_of_its_kind(placed, part, there, null).startswith("it leaves a deviation")


def guesses_of(shape: tuple[int, int]) -> Callable[..., list[Effect]]:
    """Return what asks effects for guesses in a sensor of that shape."""
    taken: Any = SimpleNamespace(window=SensorWindow.whole(shape))
    return ReplicateSimulator(None, (), taken, (), list, 1).guesses  # type: ignore[arg-type]


def test_what_the_model_leaves_is_asked_for_guesses_before_what_the_frames_show() -> None:
    beside, frames = (SimpleNamespace(strongest=lambda *_, z=z: z) for z in (5.0, 0.0))

    class Seen:
        signature = ("shape.He3.mean",)

        @staticmethod
        def estimate(evidence: Any) -> list[Effect]:
            return [effect("row_noise", 0.1 if evidence is beside else 0.2)]

    class Unseen(Seen):
        @staticmethod
        def estimate(_: Any) -> list[Effect]:
            return []

        @staticmethod
        def typical() -> list[Effect]:
            return [effect("frame_noise", 0.3)]

    classes, guesses = {"seen": Seen, "unseen": Unseen}, guesses_of((4, 4))
    assert guesses(classes, [frames], (), beside) == [effect("row_noise", 0.1), effect("frame_noise", 0.3)]
    assert guesses(classes, [frames]) == [effect("row_noise", 0.2)]


def test_of_guesses_in_parts_those_that_stand_out_most_are_kept() -> None:
    """Much is wrong everywhere: all parts ask for nearly all effects, and each is a simulation."""
    loud, quiet = (SimpleNamespace(strongest=lambda *_, z=z: z) for z in (9.0, 4.0))
    parts: Any = [(Part(Region(rows=((i, i + 1),))), loud if i < 15 else quiet) for i in range(30)]

    class Seen:
        signature = ("shape.He3.mean",)

        @staticmethod
        def estimate(_: Any) -> list[Effect]:
            return [effect("row_noise", 0.1), effect("row_noise", 0.2)]

    found = guesses_of((30, 4))({"seen": Seen}, [quiet], parts)
    assert found[:2] == [effect("row_noise", 0.1), effect("row_noise", 0.2)]
    placed = found[2:]
    assert len(placed) == 36
    # the likeliest in every part, then the next ones where most is wrong
    first, second = ({e.region for e in placed if e.row_noise_dn == strength} for strength in (0.1, 0.2))  # type: ignore[attr-defined]
    assert first == {part.region for part, _ in parts}
    assert second <= {part.region for part, own in parts if own is loud}


def test_a_set_is_fitted_again_with_the_kind_of_an_effect_that_does_better() -> None:
    world = world_of(row_noise=0.3, frame_noise=0.3, exposure_drift=0.3)
    row, frame = hypothesis("row_noise"), hypothesis("frame_noise")
    search = Search(world.refitter(), HistogramLikelihood())
    for members in ((row,), (frame,), (row, frame), (row, frame)):
        search.add(members)
    assert len(search.trials) == 3
    search.add((row, placed(frame, "rows=1:2")))
    assert len(search.trials) == 4


def test_a_simulated_stack_is_known_by_all_that_makes_it_under_a_name_that_a_file_can_have() -> None:
    keys = [
        ReplicateSimulator(None, model, None, (), list, seed)._replicate(one, 0).key  # type: ignore[arg-type]
        for model in ((), (effect("row_noise", 0.1),), (effect("row_noise", 0.2),))
        for one in (None, effect("frame_noise", 0.3))
        for seed in (1, 2)
    ]
    assert len(set(keys)) == len(keys)
    assert not any("/" in key for key in keys)


@pytest.mark.parametrize(("strong", "rest"), [(20.0, 0.0), (100.0, 0.0), (20.0, 9.0)])
def test_effects_that_move_the_same_statistics_are_seen_where_they_leave_nothing(
    monkeypatch: pytest.MonkeyPatch, strong: float, rest: float
) -> None:
    # a clamp takes back what a common noise does to the means of frames: nothing of that is its own
    own, shared = np.eye(M)[0], np.eye(M)[1:5].sum(axis=0)
    monkeypatch.setitem(TRUTH, "row_noise", (strong * (2.0 * own + shared), 1.0))
    monkeypatch.setitem(TRUTH, "frame_noise", (-20.0 * shared, 1.0))
    world = world_of(row_noise=0.1, frame_noise=0.1, beside=rest * np.eye(M)[5])
    found = world.compare(hypothesis("row_noise"), beside=[hypothesis("frame_noise")])
    assert found.chosen.tags == ({"row_noise"} if rest else {"row_noise", "frame_noise"})


UNMOVED = SimpleNamespace(fit=SimpleNamespace(moved={}))


def add(world: World, monkeypatch: pytest.MonkeyPatch, *hypotheses: Hypothesis, final: Any = None) -> Any:
    """Return a search that added what it found, and the null that it came to."""
    z = world.z if final is None else Measured(world.z.train, world.z.test, final)
    work: Any = SimpleNamespace(mapped=lambda _: UNMOVED, forget=lambda _: None, effort=Effort(None))
    unused: Any = None
    settings = DiscrepancySettings()
    judge = Acceptance(world.null, z, StatisticsGap(world.null, 100_000), settings)
    prepared = Prepared(settings, "frames", unused, unused, world.null, z, work.effort, {})
    search = FrameExplainer(prepared, unused, work, unused, judge, ())
    monkeypatch.setattr(search, "_refitter", lambda: world.refitter())
    monkeypatch.setattr(search, "_left_by", lambda *_: [])
    monkeypatch.setattr(search, "_likelihood", lambda *_: None)
    monkeypatch.setattr(search, "_measured", lambda _: lambda kept: ())
    return search, search.add(Screened(hypotheses, world.likely(*hypotheses), 0.0), world.null)


def test_slopes_beyond_all_that_an_effect_does_do_not_lift_the_floor() -> None:
    # near the limit of a strength a small step may spoil all fits: nothing is at the floor by that
    world = world_of(row_noise=0.5)
    work: Any = SimpleNamespace(mapped=lambda _: UNMOVED)
    one = world.refitter().simulated((hypothesis("row_noise", 0.5),), None, 12)
    gaps = StatisticsGap(world.null, 100_000)

    def floor(slopes: np.ndarray) -> float:
        steep = replace(one, slopes=slopes)
        accept = Acceptance(world.null, world.z, gaps, DiscrepancySettings())
        null = Extension.of(work, (), accept, Comparison(steep, (steep,)), steep, [{}], (), certain=True).last
        return gaps.gap(world.z.final, null.mean, null.replicates, null.strengths).floor

    assert floor(1e5 * one.slopes) == pytest.approx(floor(one.slopes), rel=0.5)


def test_what_is_found_enters_the_model_at_its_best_strength(monkeypatch: pytest.MonkeyPatch) -> None:
    search, extended = add(world_of(row_noise=0.5), monkeypatch, hypothesis("row_noise"))
    assert [e.tag for e in search.model] == ["row_noise"]
    assert search.model[0].row_noise_dn == pytest.approx(0.5, rel=0.05)
    assert np.abs(extended.mean[0] - statistics(search.model)[0]) < 3.0


@pytest.mark.parametrize("rest", [0.0, 30.0])
def test_what_explains_all_but_is_not_certain_is_told_without_a_name(
    monkeypatch: pytest.MonkeyPatch, rest: float
) -> None:
    """Weak over-dispersion, 4 standard errors strong, was 'unexplained: no known effect explains it'."""
    world = world_of(row_noise=0.5, beside=rest * np.eye(M)[5])
    monkeypatch.setattr(Acceptance, "established", lambda *_: ())
    search, told = add(world, monkeypatch, hypothesis("row_noise"))
    assert (told is None) == (rest > 0.0)
    if told is not None:
        before = search.gap(world.null)
        added = search.close(before, told, False)
        assert [(a.effect.tag, a.verdict) for a in added.additions] == [("row_noise", "ambiguous")]
        found = Findings("frames", world.z, world.null, told, before, [], False, added)
        assert found.state == "ambiguous"
        assert found.model((), search.model) == ()


def established(
    null: NullModel,
    parts: np.ndarray,
    stderr: float,
    seen: np.ndarray,
    *,
    effects: Sequence[Effect] = (),
    final: np.ndarray | None = None,
    scatter: float = 1.0,
    **more: Any,
) -> set[str]:
    """Return the tags of the effects of a set that are certain, which do ``parts`` and are known so well."""
    effects = effects or [effect(tag, 0.1) for tag in ("row_noise", "frame_noise")[: len(parts)]]
    n, m, unused = len(parts), len(null.names), cast("Any", None)
    hypotheses = tuple(Hypothesis(e, part) for e, part in zip(effects, parts, strict=True))
    added = {
        "parts": parts,
        "slopes": parts,
        "mean": seen,
        "change": np.zeros(n),
        "stderr": np.full(n, stderr),
    }
    added |= {"vectors": np.zeros((400, m)), "rest": np.zeros(m), **more}
    covariance = Covariance(np.full(m, scatter**2), np.zeros((0, m)))
    one: Any = SimpleNamespace(hypotheses=hypotheses, covariance=covariance, **added)
    z = Measured(seen, seen, seen if final is None else final)
    accept = Acceptance(null, z, unused, DiscrepancySettings(model_error=0.0))
    return {h.tag for h in accept.established(one)}


@pytest.mark.parametrize(
    ("error", "in_final", "with_name", "without"),
    [
        (0.15, 6.0, True, True),
        (0.26, 6.0, False, True),  # 3.8 standard errors
        (0.40, 6.0, False, False),
        (0.15, 2.0, True, False),
        (0.15, 0.5, False, False),
    ],
)
def test_what_gets_no_name_needs_fewer_errors_and_more_of_them_in_the_final_frames(
    error: float, in_final: float, with_name: bool, without: bool
) -> None:
    null, part = world_of().null, np.eye(M)[0] * 6.0
    seen = null.mean + np.eye(M)[0] * in_final
    # missing codes where the pixels have no samples: no statistic moves, and no strength is off
    assert not established(null, 0.0 * part[None], 0.0, seen, mean=null.mean)
    noise = EmpiricalNoise(noise_dn=1.0, modes=(NoiseMode(of="row", share=1.0),))
    for one, there in ((effect("row_noise", 0.1), with_name), (noise, without)):
        found = established(null, part[None], error, seen, effects=[one], mean=null.mean + part)
        assert bool(found) is there


@pytest.mark.parametrize(
    ("size", "other", "there"), [(6.0, 0.0, False), (300.0, 0.0, True), (300.0, 290.0, False)]
)
def test_an_effect_beyond_doubt_is_there_though_few_frames_know_its_strength_badly(
    size: float, other: float, there: bool
) -> None:
    """Light that flickers in 97 of 1,000 frames moved statistics by 480 sd; its strength had 4.3 errors."""
    null = world_of().null
    parts = np.array([np.eye(M)[0] * size, np.eye(M)[0] * other])[: 2 if other else 1]
    found = established(null, parts, 0.26, null.mean + np.eye(M)[0] * size)
    assert ("row_noise" in found) is there


@pytest.mark.parametrize(
    ("name", "seen", "final", "made", "there"),
    [
        ("tail.low.count", 6.0, 4.0, 4.0, True),
        ("shape.He4.mean", 6.0, 4.0, 4.0, False),  # no count: what matters is how well its strength is known
        ("tail.low.count", 3.0, 4.0, 2.0, False),  # 4.1 standard deviations of the mean of two splits
        ("tail.low.count", 6.0, 0.5, 4.0, False),  # chance in the final frames
        ("tail.low.count", 6.0, 4.0, 0.5, False),  # the effect makes far less than is seen
    ],
)
def test_a_few_events_are_an_effect_though_they_hardly_tell_its_strength(
    name: str, seen: float, final: float, made: float, there: bool
) -> None:
    """A dozen events where chance makes one: their number is known to a third, but there they are."""
    rng, first, size = np.random.default_rng(3), np.eye(9)[0], 1.3
    null = NullModel.from_replicates((name, *NAMES[:8]), rng.standard_normal((40, 9)))
    scatter = size * rng.standard_normal((16, 9))
    mean, shown = null.mean + made * first, null.mean + seen * first
    found = established(
        null, made * first[None], 0.36, shown, final=null.mean + final * first, scatter=size, mean=mean,
        vectors=mean + scatter - scatter.mean(axis=0), rest=(shown - mean) / (size * np.sqrt(1 / 2 + 1 / 16)),
    )  # fmt: skip
    assert bool(found) is there


def test_strong_effects_need_not_add_up_to_be_there() -> None:
    """Column noise beside a ghost that alone would move the statistics by more than both together do."""
    null, own, shared = world_of().null, np.eye(M)[0] * 100.0, np.eye(M)[1] * 100.0
    parts = np.array([own + 0.5 * shared, 3.6 * shared + 1.4 * own])
    found = established(null, parts, 0.02, null.mean + own + 2.6 * shared)
    assert found == {"row_noise", "frame_noise"}


def test_what_widens_the_gap_of_the_final_frames_is_not_certain(monkeypatch: pytest.MonkeyPatch) -> None:
    """They have some of it, by what it does to one statistic, and the opposite of what it does to another."""
    monkeypatch.setitem(TRUTH, "row_noise", ((np.eye(M)[0] + np.eye(M)[5]) * 40.0, 1.0))
    world = world_of(row_noise=0.1)
    for of_one, of_other, certain in ((1.0, -0.5, False), (1.0, 0.3, True), (0.0, 0.0, False)):
        final = 40.0 * (of_one * np.eye(M)[0] + of_other * np.eye(M)[5])
        search, extended = add(world, monkeypatch, hypothesis("row_noise"), final=final)
        assert (search.extension is not None and search.extension.certain) is certain
    added = search.close(search.gap(world.null), extended, False).additions
    assert not any(each.named for each in added)  # what the final frames do not show at all


@pytest.mark.parametrize(
    ("anisotropy", "against"), [(-1.0, "its anisotropy is at the limit of -1"), (-0.9, "")]
)
def test_an_effect_that_can_go_no_further_gets_no_name(
    monkeypatch: pytest.MonkeyPatch, anisotropy: float, against: str
) -> None:
    world = world_of(interpixel_capacitance=0.1)
    guess = hypothesis("interpixel_capacitance", anisotropy=anisotropy)
    search, extended = add(world, monkeypatch, guess)
    before = search.gap(world.null)
    [added] = search.close(before, extended, False).additions
    assert added.against == against
    assert added.named == (not against)


def test_a_rival_in_a_pair_is_measured_where_the_effect_in_whose_place_it_stands_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = world_of(interpixel_capacitance=0.2, frame_noise=0.1)
    tags = ("interpixel_capacitance", "frame_noise", "exposure_drift")
    search, extended = add(world, monkeypatch, *(hypothesis(tag) for tag in tags))
    before = search.gap(world.null)
    additions = search.close(before, extended, False).additions
    assert {each.effect.tag for each in additions} == {"interpixel_capacitance", "frame_noise"}
    for each in additions:
        closed = each.before.value - each.after.value
        assert closed > 0.0
        # nothing is rejected that is named, nor twice
        assert [rival.effect for rival in each.rivals] == ["exposure_drift"]
        [rival] = [rival for rival in each.rivals if rival.effect == "exposure_drift"]
        # nothing of it is in the data: it closes nothing; the other strength is settled to 5 %
        assert -0.1 * closed < rival.gap_after - each.before.value < 0.5 * closed


def test_strengths_that_no_pixel_can_be_fitted_with_end_no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """A trial step, the best correction and a part of a set may all be such."""
    monkeypatch.setitem(TRUTH, "row_noise", (np.eye(M)[0] * 40.0, 1.0))
    world = world_of(row_noise=0.1)
    guess = Hypothesis(effect("row_noise", 0.098), statistics([effect("row_noise", 0.098)]))
    refitter = world.refitter()
    near = refined(refitter, [guess])
    world.unfit = lambda effects: effects != near.effects
    assert refitter._slopes(near) is None
    assert refitter.sharpened(near, 24).effects == near.effects
    world.unfit = lambda effects: False
    assert refitter.sharpened(near, 24).effects != near.effects


def test_an_effect_is_held_to_what_it_moves_only_where_the_data_disagree_with_the_model(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    world = world_of(interpixel_capacitance=0.2)
    search, extended = add(world, monkeypatch, hypothesis("interpixel_capacitance"))
    before = search.gap(world.null)
    search.extension = replace(search.extension, last=extended.shifted(np.eye(M)[3] * 20.0))
    for still in (False, True):
        [added] = search.close(before, extended, still).additions
        assert added.named == (not still)
        assert bool(added.against) == still
