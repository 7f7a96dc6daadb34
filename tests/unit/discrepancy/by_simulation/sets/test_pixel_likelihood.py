"""The likelihood of the pixels tells the numbers of an effect, and tells effects apart."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.by_likelihood.members import Member
from pchem_pipeline.discrepancy.by_likelihood.sets import FittedSet, SetComparison
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import Hypothesis
from pchem_pipeline.discrepancy.by_simulation.sets.pixel_likelihood import (
    HistogramLikelihood,
    Histograms,
    PixelLikelihood,
    identifiable_from_histograms,
)
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.discrepancy.observe.observe import fitted_maps
from pchem_pipeline.discrepancy.observe.places import Part
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.framework.region import Region, When
from pchem_pipeline.effects.framework.registry import effect_class

SIDE, FRAMES, EXPOSURE, STEP = 12, 3000, 1.5, 8.0  # pixels, frames, e-, DN per e-
HEAVY, SKEW = effect_class("heavy_tailed_noise"), effect_class("noise_skew")
GROWING = effect_class("signal_dependent_noise")


def frames_of(noise: NDArray[np.float64], seed: int, exposure: float = EXPOSURE) -> NDArray[np.uint16]:
    """Return frames of pixels with some read noise, e-: an own simulator, independent of the product's."""
    rng = np.random.default_rng(seed)
    charge = rng.poisson(exposure, noise.shape)
    return np.rint(100.0 + STEP * (charge + noise)).astype(np.uint16)


def fitted_numbers(fit: FittedSet) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the coordinates of the only effect of a fit, and their standard errors."""
    return fit.fit.shared, np.sqrt(np.diag(fit.fit.covariance))


def maps_of(read_noise_e: float) -> PixelMaps:
    values = (EXPOSURE, 1.0 / STEP, 100.0, STEP * read_noise_e)
    return PixelMaps.known([np.full((SIDE, SIDE), v) for v in values], np.ones((SIDE, SIDE), np.bool_))


def likelihood_of(frames: NDArray[np.uint16], read_noise_e: float = 0.3, *more: Any) -> PixelLikelihood:
    return PixelLikelihood(frames, maps_of(read_noise_e), (), Effort(None), *more)


def histograms_of(frames: NDArray[np.uint16], present: tuple[Effect, ...] = ()) -> Histograms:
    return Histograms(frames, maps_of(0.28), present, Effort(None), samples_of)


def mixture(rng: np.random.Generator, share: float, factor: float) -> NDArray[np.float64]:
    shape = FRAMES, SIDE, SIDE
    return rng.normal(0.0, 0.25, shape) * np.where(rng.random(shape) < share, factor, 1.0)


def exgaussian(rng: np.random.Generator, share: float) -> NDArray[np.float64]:
    shape = FRAMES, SIDE, SIDE
    smooth = np.sqrt(1.0 - share**2) * rng.standard_normal(shape)
    return 0.3 * (smooth + share * (rng.standard_exponential(shape) - 1.0))


def samples_of(part: Part) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    some = np.ones(FRAMES, np.bool_) if part.when is None else part.when.frames(np.arange(FRAMES))
    inside = np.ones((SIDE, SIDE), np.bool_) if part.region is None else part.region.mask((SIDE, SIDE))
    return some, inside


@pytest.mark.parametrize(("share", "factor"), [(0.1, 2.2), (0.4, 1.5)])
def test_share_and_width_of_a_tail_are_found_from_afar(share: float, factor: float) -> None:
    frames = frames_of(mixture(np.random.default_rng(3), share, factor), 4)
    guesses = [HEAVY(share=0.02, factor=3.0), HEAVY(share=0.5, factor=1.3), SKEW(share=0.2)]
    effort = Effort(None)
    found, skew = Histograms(frames, maps_of(0.28), (), effort, samples_of).with_numbers(guesses)
    assert skew.tag == "noise_skew"
    assert effort.spent > 0.0
    likelihood = PixelLikelihood(frames, maps_of(0.28), (), effort, 144)
    fit = likelihood._fit([found], ())
    _, error = fitted_numbers(fit)
    assert abs(found.share - share) < 4.0 * error[0]  # type: ignore[attr-defined]
    assert abs(found.factor - factor) < 4.0 * error[1]  # type: ignore[attr-defined]
    assert error[1] < 0.1 * factor  # the limit is worth something


def test_numbers_of_a_tail_in_a_part_are_told_by_the_samples_there() -> None:
    there, when = Region(rows=((4, 8),)), When(range=((0, 2000),))
    frames = frames_of(mixture(np.random.default_rng(3), 0.0, 1.0), 4)
    tails = frames_of(mixture(np.random.default_rng(5), 0.3, 2.0), 6)
    frames[:2000, 4:8] = tails[:2000, 4:8]
    guesses = [HEAVY(share=0.02, factor=3.0, region=there, when=when), HEAVY(share=0.02, factor=3.0)]
    placed, everywhere = histograms_of(frames).with_numbers(guesses)
    assert (placed.region, placed.when) == (there, when)
    assert placed.share == pytest.approx(0.3, abs=0.08)  # type: ignore[attr-defined]
    assert placed.factor == pytest.approx(2.0, abs=0.15)  # type: ignore[attr-defined]
    # of the whole the part is two ninths
    assert everywhere.region is None
    assert everywhere.share < 0.15  # type: ignore[attr-defined]


def test_guesses_of_few_pixels_and_other_effects_stay_as_they_are() -> None:
    frames = frames_of(mixture(np.random.default_rng(5), 0.1, 2.2), 6)
    placed = HEAVY(share=0.02, factor=3.0, region=Region(rows=((0, 1),), columns=((0, 8),)))
    others: list[Effect] = [placed, effect_class("row_noise")(row_noise_dn=1.0)]
    assert histograms_of(frames).with_numbers(others) == others
    present = (effect_class("row_noise")(row_noise_dn=1.0, region=Region(rows=((0, 4),))),)
    everywhere = [HEAVY(share=0.02, factor=3.0)]
    assert histograms_of(frames, present).with_numbers(everywhere) == everywhere
    assert not any(identifiable_from_histograms(each) for each in others)
    assert identifiable_from_histograms(HEAVY(share=0.1))


def test_a_strong_effect_for_which_no_estimator_speaks_is_found_where_a_plain_fit_is_led_astray() -> None:
    """Of noise of 0.7 e- a root electron a plain fit finds hardly a true peak."""
    rng, there = np.random.default_rng(13), Region(rows=((2, 7),))
    shape = FRAMES, SIDE, SIDE
    charge = rng.poisson(EXPOSURE, shape)
    strong = np.zeros(shape, np.bool_)
    strong[:, 2:7] = True
    width = np.sqrt(0.25**2 + np.where(strong, 0.7**2 * charge, 0.0))
    frames = np.rint(100.0 + STEP * (charge + width * rng.standard_normal(shape))).astype(np.uint16)
    clean = np.where(strong, np.roll(frames, 7, axis=1), frames)  # rows of the rest
    kinds = {"signal_dependent_noise": GROWING, "noise_skew": SKEW}
    found, nothing = (
        Histograms(each, fitted_maps(each, np.zeros((SIDE, SIDE), np.bool_))[0], (), Effort(None), samples_of)
        .suggested(kinds, [Part(there)], ())
        for each in (frames, clean)
    )  # fmt: skip
    assert found[0].tag == "signal_dependent_noise"
    assert found[0].region == there
    assert found[0].noise_e == pytest.approx(0.7, rel=0.1)  # type: ignore[attr-defined]
    assert nothing == []


def test_a_strength_is_told_though_the_plain_fit_has_the_bias_off_by_an_electron() -> None:
    frames = frames_of(exgaussian(np.random.default_rng(8), 0.95), 9)
    off = PixelMaps.known(
        [m + shift for m, shift in zip(maps_of(0.3).maps, (1.0, 0.0, -STEP, 0.0), strict=True)],
        np.ones((SIDE, SIDE), np.bool_),
    )
    [(_, found)] = PixelLikelihood(frames, off, (), Effort(None)).fitted([SKEW(share=0.6)])
    assert found.share == pytest.approx(0.95, abs=0.02)  # type: ignore[attr-defined]


def test_rare_and_wide_tails_are_told_though_they_led_plain_fits_astray() -> None:
    """A fit that must count a sample far below all others lowers the bias for it, at times by electrons."""
    frames = frames_of(mixture(np.random.default_rng(21), 0.003, 8.0)[:1500], 22, exposure=3.5)
    maps, _ = fitted_maps(frames, np.zeros((SIDE, SIDE), np.bool_))
    mistaken = np.abs(maps.quanta_exposure - 3.5)[maps.usable] > 0.5
    assert np.mean(mistaken) > 0.02
    likelihood = PixelLikelihood(frames, maps, (), Effort(None))
    fit = likelihood._fit([HEAVY(share=0.003, factor=4.0)], ())
    (share, factor), error = fitted_numbers(fit)
    assert abs(share - 0.003) < 4.0 * error[0] < 0.007
    assert abs(factor - 8.0) < 4.0 * error[1] < 4.0
    left = np.abs(fit.fit.parameters[:, 0] - 3.5) > 0.5
    assert np.mean(left) < 0.2 * np.mean(mistaken)


def test_bits_that_flip_are_told_from_wide_tails() -> None:
    """They put as many samples as low as wide tails do, but all at one distance."""
    bit = effect_class("bit_errors")(share=0.001, bit=5, fault="flip")
    tails = HEAVY(share=0.003, factor=8.0)
    wide = frames_of(mixture(np.random.default_rng(23), 0.003, 8.0), 24)
    flipped = frames_of(np.random.default_rng(25).normal(0.0, 0.25, (FRAMES, SIDE, SIDE)), 26)
    flipped ^= (np.random.default_rng(27).random(flipped.shape) < 0.002).astype(np.uint16) << 5
    for frames, right, wrong in ((wide, tails, bit), (flipped, bit, tails)):
        likelihood = likelihood_of(frames, 0.25)
        [[rise, _]] = likelihood.fitted([right])
        assert rise > max((other for other, _ in likelihood.fitted([wrong])), default=0.0) + 20.0


def test_a_skew_is_told_from_tails_and_tails_from_a_skew() -> None:
    rng = np.random.default_rng(8)
    skew, heavy = SKEW(share=0.4), HEAVY(share=0.2, factor=1.6)
    for noise, right, wrong in ((exgaussian(rng, 0.4), skew, heavy), (mixture(rng, 0.2, 1.8), heavy, skew)):
        likelihood = likelihood_of(frames_of(noise, 9))
        answer, back = likelihood.behind([wrong], [right]), likelihood.behind([right], [wrong])
        assert answer[0] < -4.0 * answer[1] < 0.0
        assert back == pytest.approx((-answer[0], answer[1]))
    # of noise without either nothing is said: chance makes a nat of each number, and of that half
    plain = frames_of(np.random.default_rng(10).normal(0.0, 0.3, (FRAMES, SIDE, SIDE)), 11)
    answer = likelihood_of(plain).behind([SKEW(share=0.1)], [HEAVY(share=0.05, factor=1.5)])
    assert abs(answer[0]) < 4.0


def test_a_set_begins_where_its_numbers_are_likeliest_together() -> None:
    frames = frames_of(exgaussian(np.random.default_rng(14), 0.4), 15)
    row = Hypothesis(effect_class("row_noise")(row_noise_dn=0.5), np.ones(3))
    skew = Hypothesis(SKEW(share=0.25), np.array([1.0, 0.0, -2.0]))
    likelihood = likelihood_of(frames)
    same, moved = likelihood.begun([row, skew])
    assert same is row
    fit = likelihood._fit([skew.effect], [row.effect])
    coordinate, error = fitted_numbers(fit)
    assert abs(coordinate[0] - 0.4**3) < 4.0 * error[0] < 0.05
    share = moved.effect.share  # type: ignore[attr-defined]
    assert share == pytest.approx(np.cbrt(coordinate[0]), rel=0.02)
    np.testing.assert_allclose(moved.fingerprint, skew.fingerprint * (share / 0.25) ** 3)
    [alone] = likelihood.begun([row])
    assert alone is row
    far = Hypothesis(SKEW(share=0.005), np.ones(3))
    [still] = likelihood.begun([far])
    assert still is far  # so far away it is another hypothesis


def test_what_no_law_of_a_sample_holds_is_not_told() -> None:
    frames = frames_of(mixture(np.random.default_rng(12), 0.1, 2.2), 13)
    likelihood = likelihood_of(frames, 0.28, 64)
    row = effect_class("row_noise")(row_noise_dn=1.0)
    column = effect_class("column_noise")(column_noise_dn=1.0)
    heavy, skew = HEAVY(share=0.1, factor=2.0), SKEW(share=0.2)
    asked: list[Sequence[Effect]] = []

    def of(effects: Sequence[Effect], pixels: int) -> PixelLikelihood:
        asked.append(effects)
        return likelihood

    asked_of = HistogramLikelihood(of)
    assert asked_of.behind([heavy], [row]) is None
    assert asked_of.behind([row], [column]) is None
    assert asked_of.begun([Hypothesis(row, np.ones(2))])[0].effect is row
    assert asked == []  # nothing is counted in vain
    assert asked_of.behind([heavy, row], [skew, row]) is not None


def test_a_fit_that_went_astray_says_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """It was 23,000 nats below the plain one, and another effect took the place of the true one."""
    frames = frames_of(exgaussian(np.random.default_rng(17), 0.4), 18)
    likelihood = likelihood_of(frames, 0.3, 64)
    heavy, skew = HEAVY(share=0.1, factor=2.0), SKEW(share=0.3)
    answer = likelihood.behind([heavy], [skew])
    assert answer is not None
    plain = SetComparison.fit

    def astray(self: SetComparison, members: Sequence[Member], *rest: Any) -> FittedSet:
        found = plain(self, members, *rest)
        if "noise_skew" not in found.tags:
            return found
        return replace(found, fit=replace(found.fit, log_likelihood=found.fit.log_likelihood - 100.0))

    monkeypatch.setattr(SetComparison, "fit", astray)
    # what was asked before is not fitted again, at whatever strength
    assert likelihood.behind([HEAVY(share=0.2, factor=2.0)], [SKEW(share=0.2)]) == answer
    likelihood = likelihood_of(frames, 0.3, 64)
    assert likelihood.behind([heavy], [skew]) is None
    hypothesis = Hypothesis(skew, np.ones(2))
    assert likelihood.begun([hypothesis]) == (hypothesis,)


@pytest.mark.parametrize(
    ("raised", "noted"),
    [(KeyError("gone"), True), (ZeroDivisionError("zero"), True), (ValueError("apart"), False)],
)
def test_what_a_fit_raises_is_noted_unless_its_numbers_are_no_law(
    monkeypatch: pytest.MonkeyPatch, raised: Exception, noted: bool
) -> None:
    defects: dict[str, str] = {}
    frames = frames_of(exgaussian(np.random.default_rng(17), 0.4), 18)
    likelihood = likelihood_of(frames, 0.3, 64, defects)

    def broken(*_: Any) -> FittedSet:
        raise raised

    monkeypatch.setattr(SetComparison, "fit", broken)
    assert likelihood.fitted([SKEW(share=0.3)]) == []
    assert (str(raised) in defects.get("noise_skew", "")) is noted
