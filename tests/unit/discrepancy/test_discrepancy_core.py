"""The pure parts of the workflow on made-up statistics: splits, null model, fingerprints, naming, gap."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.plain_law import joint_mass
from scipy import stats

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.discrepancy.build_verdict import Added, Addition, Findings, _sentence, _still
from pchem_pipeline.discrepancy.by_simulation.additions import without_company
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import (
    Hypothesis,
    Noise,
    fit_set,
    held_out_gain,
    likeliest_sets,
    log_density,
    meets_itself,
    seconds,
)
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import expected_codes
from pchem_pipeline.discrepancy.gap import Gap, StatisticsGap
from pchem_pipeline.discrepancy.null import Covariance, Measured, NullModel, as_matrix
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.splits import block_length, split_frames
from pchem_pipeline.discrepancy.verdict import Candidate, Place
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.effects.framework.registry import effect_class

NAMES = tuple(STATISTICS)[:40]
UNIT = Covariance(np.ones(40), np.zeros((0, 40)))


def _null(rng: np.random.Generator, b: int = 60, m: int = 40) -> NullModel:
    return NullModel.from_replicates(NAMES[:m], rng.normal(0.3, 1.0, (b, m)))


def _hypothesis(tag: str, fingerprint: np.ndarray) -> Hypothesis:
    kind = effect_class(tag)
    return Hypothesis(kind.model_validate({"tag": tag, kind.strength: 0.1}), fingerprint)


def _gap_of(value: float, floor: float = 3e-5) -> Gap:
    return Gap(value, floor, (value, value), {})


def _addition(effect: Effect, before: Gap, after: Gap, **more: Any) -> Addition:
    """Return an effect that fits, added alone."""
    plain = Addition(effect, True, "", (), {}, before, after, (), ())
    return replace(plain, **more)


def test_beside_an_effect_that_moves_more_and_does_not_fit_there_is_no_name() -> None:
    def one(tag: str, against: str) -> Addition:
        return _addition(_hypothesis(tag, np.zeros(1)).effect, _gap_of(1.0), _gap_of(1.0), against=against)

    mimic, good = one("frame_noise", "it leaves too much of the discrepancy"), one("row_noise", "")
    assert [each.fits for each in without_company([mimic, good])] == [False, False]
    assert without_company([good, mimic]) == [good, mimic]
    assert without_company([good, good]) == [good, good]
    measured = replace(good, described=True)
    assert without_company([mimic, measured])[1].verdict == "described"
    assert [each.verdict for each in without_company([measured, good])] == ["described", "unexplained"]
    assert without_company([good, measured]) == [good, measured]


def test_splits_share_no_frame_and_keep_blocks_whole_also_at_a_gap_in_the_numbering() -> None:
    splits = split_frames(np.arange(1000), 20)
    parts = [splits.train, splits.test, splits.final]
    together = np.concatenate(parts)
    assert len({part.size for part in parts}) == 1
    assert np.unique(together).size == together.size == 960  # 48 blocks; the rest is left out
    for part in parts:
        blocks = part.reshape(-1, 20)
        assert np.all(np.diff(blocks, axis=1) == 1)
        assert np.all(blocks[:, 0] % 20 == 0)
    # a slow drift must look alike in all three: their middles are a block apart at most
    assert np.ptp([part.mean() for part in parts]) <= 20
    numbers = np.concatenate([np.arange(0, 330), np.arange(500, 830)])
    splits = split_frames(numbers, 20)
    for part in (splits.train, splits.test, splits.final):
        assert np.all(np.diff(numbers[part].reshape(-1, 20), axis=1) == 1)


def test_length_of_blocks_and_too_few_frames_are_refused_with_how_many() -> None:
    assert [block_length(frames, None) for frames in (4000, 17750, 700)] == [66, 100, 20]
    for frames, wanted, least in ((299, None, 300), (800, 100, 900)):
        with pytest.raises(InputError, match=f"need {least}"):
            block_length(frames, wanted)


def test_global_p_is_uniform_under_the_null() -> None:
    rng = np.random.default_rng(11)
    drawn = [(_null(rng), rng.normal(0.3, 1.0, 40)) for _ in range(400)]
    p = np.array([null.global_p(z) for null, z in drawn])
    # binomial: 5 standard errors
    for level in (0.05, 0.2, 0.5):
        assert abs(np.mean(p < level) - level) < 5 * np.sqrt(level * (1 - level) / p.size)
    # which is not what the smallest of 40 would give
    assert np.mean([null.p_values(z).min() < 0.05 for null, z in drawn]) > 0.5


def test_effective_tests_of_copies_are_those_of_one() -> None:
    rng = np.random.default_rng(13)
    one = rng.normal(size=(200, 1))
    copies = NullModel.from_replicates(NAMES[:20], np.repeat(one, 20, axis=1))
    assert copies.effective_tests == pytest.approx(1.0, abs=0.3)


def test_an_effect_that_only_widens_a_statistic_makes_no_false_deviation() -> None:
    rng = np.random.default_rng(17)
    tests, low, unaware = 200, 0, 0
    for _ in range(tests):
        before = _null(rng)
        wide = np.where(np.arange(40) == 7, 4.0, 1.0)
        after = NullModel.from_replicates(NAMES[:40], rng.normal(0.3, wide, (16, 40)), before)
        z = rng.normal(0.3, wide)
        low += bool(after.p_values(z)[7] < 0.01)
        unaware += bool(before.p_values(z)[7] < 0.01)
        # what it leaves alone scatters as before, known from all replicates
        assert np.median(after.std[8:]) == pytest.approx(1.0, abs=0.1)
    assert low <= stats.binom.ppf(0.999, tests, 0.03)
    assert unaware > 0.3 * tests


def test_factors_and_their_errors_are_those_of_least_squares() -> None:
    rng = np.random.default_rng(14)
    first, second = rng.normal(size=(2, 40))
    both = [_hypothesis("row_noise", first), _hypothesis("frame_noise", second)]
    shifts = 8.0 * first + 5.0 * second + rng.normal(size=(400, 40))
    fits = [fit_set(both, shift, Noise(UNIT, 0.0)) for shift in shifts]
    pulls = np.array([(fit.factors - [8.0, 5.0]) / fit.stderr for fit in fits])
    assert np.all(np.abs(pulls.mean(axis=0)) < 5 / np.sqrt(400))
    assert np.all(np.abs(pulls.std(axis=0) - 1) < 5 / np.sqrt(800))


def test_an_effect_in_two_regions_is_named_in_both_beside_one_of_the_whole_sensor() -> None:
    rng = np.random.default_rng(28)
    left, right = rng.normal(size=40), rng.normal(size=40)
    regions = [Region.model_validate(f"columns={span}") for span in ("0:12", "12:24")]
    placed = [
        Hypothesis(_hypothesis("row_noise", each).effect.at_place(region), each)
        for region, each in zip(regions, (left, right), strict=True)
    ]
    hypotheses = [_hypothesis("row_noise", left + right + rng.normal(size=40)), *placed]
    hypotheses += seconds(hypotheses)
    assert [h.tag for h in hypotheses] == ["row_noise", "row_noise", "row_noise", "row_noise 2"]
    shift = 3.0 * left + 2.0 * right + rng.normal(size=40) / np.sqrt(2.0)
    sets = likeliest_sets(hypotheses, shift, Noise(UNIT.times(0.5), 0.05))
    assert [h.effect.region for h in sets[0].hypotheses] == regions
    assert all(not meets_itself(one.hypotheses) for one in sets)
    assert all("row_noise" in {h.tag for h in one.hypotheses} for one in sets)  # none is a second one alone
    assert len({h.effect.key for h in sets[0].hypotheses}) == 2


def test_beside_what_another_effect_does_the_likeliest_strength_is_the_right_one() -> None:
    """What is allowed to the details of an effect does not grow with a strength that the data do not show.

    Else one that is 20 times too strong would hide in them what the other one does, and be the likeliest.
    """
    own, other = 50.0 * np.eye(40)[1], 200.0 * np.eye(40)[2]
    noise, factors = Noise(UNIT, 0.2), (0.0, 0.5, 1.0, 3.0, 20.0, 100.0)
    left = [own + other - factor * own for factor in factors]
    allowed = [noise.of(factor * own[None], rest) for factor, rest in zip(factors, left, strict=True)]
    scores = [log_density(rest, each) for rest, each in zip(left, allowed, strict=True)]
    assert factors[int(np.argmax(scores))] == 1.0
    assert allowed[2].variances[1] == pytest.approx(1.0 + (0.2 * 50.0) ** 2, rel=0.02)


def test_nothing_predicts_held_out_samples_where_nothing_is() -> None:
    rng = np.random.default_rng(18)

    def gain(size: float) -> float:
        print_ = rng.normal(size=40)
        halves = size * print_ + rng.normal(size=(2, 40))
        return held_out_gain([_hypothesis("row_noise", print_)], tuple(halves), Noise(UNIT, 0.1))

    assert sum(gain(0.0) > 0.0 for _ in range(50)) <= 1
    assert min(gain(2.0) for _ in range(50)) > 10.0


def test_gap_is_the_divergence_and_does_not_grow_with_the_samples() -> None:
    rng = np.random.default_rng(20)
    values = []
    for n in (10_000, 40_000):
        null = _null(rng, b=200)
        z = 0.3 + 0.05 * np.sqrt(n) * (np.arange(40) < 3) + rng.normal(size=(60, 40))
        gaps = [StatisticsGap(null, n).gap(each, null.mean, null.replicates).value for each in z]
        values.append(np.mean(gaps))
    # three statistics moved by 0.05 sigma per root sample: 3 * 0.05^2 / 2
    assert values[0] == pytest.approx(3 * 0.05**2 / 2, rel=0.15)
    assert values[1] == pytest.approx(values[0], rel=0.15)


@pytest.mark.parametrize("part", [[7], [6, 7]])  # of both parts of a stack, too
@pytest.mark.parametrize("size", [1.0, 0.01])
def test_one_pixel_of_one_replicate_decides_nothing(part: list[int], size: float) -> None:
    rng = np.random.default_rng(26)
    strays = {"shape.He3C1.chi": 4595.0, "shape.He2C2.chi": 4451.0, "shape.He3.chi": 2715.0}
    names = tuple(dict.fromkeys((*strays, *list(STATISTICS)[:500])))
    vectors = rng.normal(0.0, 1.0, (40, len(names)))
    strayed = vectors.copy()
    for name, value in strays.items():
        strayed[part, names.index(name)] = size * value
    n, space = 1_900_000, names.index("space.x.rr")
    z = rng.normal(0.0, 1.0, len(names))
    z[space] += 36.0  # 650 nats of row noise
    gaps = []
    for each in (vectors, strayed):
        null = NullModel.from_replicates(names, each)
        gaps.append(StatisticsGap(null, n).gap(z, null.mean, null.replicates))
        assert null.p_values(z)[space] < 1e-15
    clean, other = gaps
    assert clean.standing_out == other.standing_out == ("space",)
    assert other.floor == pytest.approx(clean.floor, rel=0.5)
    assert other.value == pytest.approx(clean.value, rel=0.1)
    assert other.interval[0] > 0.5 * other.value


def test_a_family_that_shows_an_effect_is_not_hidden_by_the_chance_of_the_others() -> None:
    rng = np.random.default_rng(27)
    names = tuple(STATISTICS)
    null = NullModel.from_replicates(names, rng.normal(0.0, 1.0, (40, len(names))))
    metric, z = StatisticsGap(null, 1_000_000), null.mean.copy()
    z[names.index("code.alternating")] += 9.0
    gap = metric.gap(z, null.mean, null.replicates)
    assert gap.value < gap.floor
    assert gap.standing_out == ("code",)
    assert not gap.at_floor


def test_events_that_a_model_predicts_scatter_as_poisson_counts() -> None:
    # three repeated frames are proof, but three that are expected may be none or six: the floor holds that
    rng = np.random.default_rng(25)
    names = ("frame.repeated", *list(STATISTICS)[:39])
    vectors = rng.normal(size=(40, 40))
    vectors[:, 0] = 0.0
    null = NullModel.from_replicates(names, vectors)
    metric, three = StatisticsGap(null, 1000), 30.0 * np.eye(40)[0]

    def gap(events: float, mean: np.ndarray, replicates: np.ndarray) -> Gap:
        return metric.gap(null.mean + 10.0 * events * np.eye(40)[0], mean, replicates)

    below = []
    for _ in range(100):
        counts = 10.0 * rng.poisson(3.0, 25)[:, None] * np.eye(40)[0]
        replicates = counts + np.r_[vectors[:12], vectors[:13]]
        below.append(metric.gap(replicates[0], null.mean + three, replicates[1:]).at_floor)
    assert abs(np.mean(below) - 0.95) < 5 * np.sqrt(0.95 * 0.05 / 100)
    assert gap(3.0, null.mean, null.replicates).value > 0.3  # without an effect that predicts some: proof
    assert gap(0.0, null.mean + three, vectors + three).value < 0.01


def test_a_right_model_fitted_to_other_frames_is_below_the_floor_in_19_of_20() -> None:
    # a common mode in few frames scatters a statistic widely; few replicates know it, and the strength was
    # fitted to as many other frames
    rng = np.random.default_rng(24)
    null, scale = _null(rng, b=200), np.ones(40)
    metric, scale[0] = StatisticsGap(null, 1000), 10.0
    counted = []
    for _ in range(150):
        replicates = 0.3 + scale * rng.standard_normal((24, 40))
        error = np.zeros((1, 40))
        error[0, 0] = 10.0
        z = 0.3 + scale * rng.standard_normal(40) + error[0] * rng.standard_normal()
        mean = np.full(40, 0.3)
        gaps = [metric.gap(z, mean, replicates, s) for s in (error, None)]
        counted.append([gap.at_floor for gap in gaps])
    right, fixed = np.mean(counted, axis=0)
    assert abs(right - 0.95) < 4 * np.sqrt(0.95 * 0.05 / 150)
    assert fixed < 0.9


def test_expected_codes_are_those_of_the_mixture_of_every_usable_pixel() -> None:
    h, g, mu, sigma = np.array([[1.0, 2.5], [0.1, 0.08], [100.0, 104.5], [3.1, 4.2]]).reshape(4, 1, 2)
    maps = PixelMaps(h, g, mu, sigma, np.array([[True, True]]))
    codes = np.arange(70, 260)
    by_hand = np.zeros(codes.size)
    for theta in zip(*(each[0] for each in (h, g, mu, sigma)), strict=True):
        by_hand += 300 * joint_mass(codes, *theta, 40).sum(axis=0)
    found = expected_codes(maps, [], codes, np.arange(300))
    np.testing.assert_allclose(found, by_hand, rtol=1e-8, atol=1e-9)
    one = expected_codes(PixelMaps(h, g, mu, sigma, np.array([[True, False]])), [], codes, np.arange(300))
    assert one.sum() == pytest.approx(300, rel=1e-6)


def test_a_statistic_that_a_replicate_lacks_says_nothing() -> None:
    """A part of few pixels may have no pair that can be used, in one stack and not in another."""
    vectors = [{"a": 1.0, "b": 4.0}, {"a": 3.0}, {"a": 2.0, "b": 8.0}]
    np.testing.assert_allclose(as_matrix(("a", "b"), vectors), [[1, 4], [3, 6], [2, 8]])
    usual = np.array([0.0, 0.0, 5.0])
    np.testing.assert_allclose(as_matrix(("a", "b", "c"), vectors, usual)[:, 2], 5.0)
    with pytest.raises(KeyError, match="c"):
        as_matrix(("a", "c"), vectors)


def test_what_nearly_disagrees_is_said_beside_consistent() -> None:
    null, calm, high = _null(np.random.default_rng(31)), np.full(40, 0.3), np.full(40, 0.3)
    high[5] += 4.2
    near, far = _gap_of(1e-4, 2e-4), _gap_of(3e-4, 2e-4)
    nothing = Added((), near)
    words = {
        (quiet, gap.at_floor): _sentence(
            Findings("frames", Measured(z, z, z), null, null, gap, [], False, nothing), {}
        )
        for quiet, z in ((True, calm), (False, high))
        for gap in (near, far)
    }
    assert words[True, True] == "No statistic tested disagrees with the model."
    assert "; borderline: " in words[False, True]
    assert "take more frames to decide" in words[True, False]
    assert "all statistics together exceed" in words[True, False]
    assert "all statistics together exceed" not in words[False, True]
    high[5] = 60.0  # a gap at its floor does not excuse it
    sure = Findings("frames", Measured(high, high, high), null, null, near, [], False, nothing)
    assert sure.state == "unexplained"
    z = Measured(calm, calm, calm)
    joint = _sentence(Findings("histograms", z, null, null, near, [], False, nothing), {})
    assert "frames, rows, columns and neighbours were not tested" in joint


@pytest.mark.parametrize(
    ("effect", "rival", "score", "says"),
    [
        ("noise_skew", "heavy_tailed_noise", -3.0, "heavy-tailed noise two"),
        ("heavy_tailed_noise", "noise_skew", -3.0, "heavy-tailed noise two"),  # known to the rival alone
        ("noise_skew", "row_noise", -4.0, "9 times as many samples"),
        ("noise_skew", "row_noise", -0.1, "a second exposure"),
        ("noise_skew", "row_noise", 0.0, "a second exposure"),
    ],
)
def test_rivals_that_frames_cannot_tell_apart_come_with_the_measurement_that_can(
    effect: str, rival: str, score: float, says: str
) -> None:
    first, other = (effect_class(tag).typical()[0] for tag in (effect, rival))
    candidates = (Candidate.of(first, 0.0, 0.0, 0.6), Candidate.of(other, score, 4.0, 0.4))
    addition = _addition(first, _gap_of(9e-5), _gap_of(9e-5), alone=False, candidates=candidates)
    assert list(addition.step(None).separate) == [rival]
    assert says in addition.step(None).separate[rival]


def test_what_the_likeliest_effects_have_in_common_is_certain() -> None:
    row, pickup = (effect_class(tag).typical()[0] for tag in ("row_noise", "periodic_pickup"))
    candidates = (Candidate.of(row, 0.0, 0.0, 0.6), Candidate.of(pickup, -1.0, 4.0, 0.4))
    gap = _gap_of(9e-5)
    addition = _addition(row, gap, gap, alone=False, candidates=candidates)
    assert addition.step(None).factors == {
        "changes": ("offset",),
        "shared_by": ("pixels of a row", "a wave over the sensor"),
        "varies": ("new in each frame", "periodic"),
    }
    null = _null(np.random.default_rng(4))
    z = Measured(*(np.zeros(null.mean.size),) * 3)
    found = Findings("frames", z, null, null, gap, [], False, Added((addition,), gap))
    assert found.state == "ambiguous"
    certain = "certain: what changes (offset); open: what shares it (pixels of a row or"
    assert f"do not decide which; {certain}" in _sentence(found, {})
    named = replace(addition, alone=True, candidates=candidates[:1])
    assert named.step(None).factors["shared_by"] == ("pixels of a row",)
    assert replace(addition, against="it does not fit").step(None).factors == {}


def test_a_statistic_says_what_its_sign_says() -> None:
    assert "skewed to low DN" in Place.of("shape.He3.mean", z=-17.0).sentence
    assert "skewed to high DN" in Place.of("shape.He3.mean", z=17.0).sentence
    assert "less than by chance" in Place.of("space.follows.line", z=-5.0).sentence
    for statistic in ("tail.high.pixels", "shape.He4.cnt", "frame.charge.line"):  # "more ... less" is neither
        assert "less than" not in STATISTICS[statistic].says(-5.0)
    part = STATISTICS["space.x.rr@columns=24:28"]
    assert "anticorrelated, along x, in columns 24 to 27" in part.says(-5.0)


@pytest.mark.parametrize(
    ("before", "after", "state"), [(1e-5, 2e-5, "ambiguous"), (1e-5, 0.5e-5, "named"), (9e-5, 2e-5, "named")]
)
def test_what_the_final_frames_do_not_confirm_has_no_name(before: float, after: float, state: str) -> None:
    effect = effect_class("flicker_noise")(share=0.1)
    first, last = _gap_of(before), _gap_of(after)
    both = effect, effect_class("row_noise")(row_noise_dn=1.0)
    addition = _addition(effect, first, last, candidates=tuple(Candidate.of(e, 0.0, 0.0, 0.5) for e in both))
    found = Findings("frames", None, None, None, first, [], False, Added((addition,), last))  # type: ignore[arg-type]
    assert found.state == addition.verdict == state
    assert bool(found.named) == bool(found.model((), (effect,))) == (state == "named")
    words = _sentence(found, {})
    assert ("not confirmed" in words) == (state == "ambiguous"), words
    step = addition.step(None)
    assert (step.effect, len(step.candidates)) == (("flicker_noise", 2) if state == "named" else (None, 1))
    two = Added((addition, replace(addition, alone=False)), last)
    words = _sentence(replace(found, added=two), {})
    assert "do not decide" in words
    assert ("not confirmed" in words) == (state == "ambiguous"), words


def test_what_one_statistic_shows_still_is_a_part_that_has_no_name() -> None:
    """Quadrants that wandered apart were 7.5 sd beside the wrong one of two effects, the gap at its floor."""
    null = _null(np.random.default_rng(5))
    z = null.mean.copy()
    z[7] += 7.5 * null.std[7]
    effect = effect_class("row_noise")(row_noise_dn=1.0)
    first, last = _gap_of(9e-5), _gap_of(1e-5)
    addition = _addition(effect, first, last)
    found = Findings("frames", Measured(z, z, z), null, null, first, [], True, Added((addition,), last))
    assert (found.state, found.named) == ("named_in_part", (effect,))
    assert STATISTICS[NAMES[7]].sentence in _sentence(found, {})
    calm = replace(found, still=False)
    assert calm.state == "named"
    # the gap shows what no statistic by itself does
    rest = Gap(3.6e-5, 3e-5, (1.64e-5, 5.56e-5), {})
    part = replace(calm, added=Added((addition,), rest))
    words = "40 % of the discrepancy remains, in no single statistic (36 ± 10 micronats per sample, sampling"
    assert (part.state, words in _sentence(part, {})) == ("named_in_part", True)
    assert STATISTICS[NAMES[7]].sentence not in _sentence(calm, {})


@pytest.mark.parametrize("left", [0.05, 0.3])
def test_the_verdict_says_where_the_fit_itself_breaks_down(left: float) -> None:
    """A gain of the rows that scatters by a half in every frame leaves 0.8 nats per sample."""
    null = _null(np.random.default_rng(5))
    z = null.mean + 40.0 * null.std
    gap = Gap(left + 0.02, 3e-5, (left, left + 0.04), {})
    found = Findings("frames", Measured(z, z, z), null, null, gap, [], True, Added((), gap))
    assert found.state == "unexplained"
    assert ("is too large for the fit" in _sentence(found, {})) == (left > 0.1)


def test_what_is_left_is_the_farthest_and_what_chance_does_not_make() -> None:
    pulls, chances = np.array([2.8, -6.5, 6.0]), np.array([0.01, 1e-9, 1e-8])
    names = ("code.smooth", "code.largest", "code.rough")
    last = SimpleNamespace(names=names, effective_tests=100.0, p_of=lambda pulls, splits: chances)
    left = _still(SimpleNamespace(still=True, last=last), pulls)  # type: ignore[arg-type]
    assert [place.statistic for place in left] == ["code.largest", "code.rough"]
    last.p_of = lambda pulls, splits: np.ones(3)
    left = _still(SimpleNamespace(still=True, last=last), pulls)  # type: ignore[arg-type]
    assert [place.statistic for place in left] == ["code.largest"]
