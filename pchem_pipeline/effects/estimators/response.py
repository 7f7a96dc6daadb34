"""The strength of an effect from the scores of the pixels, without simulation.

The mean of an efficient score over the pixels, divided by what the exact law of a few typical pixels says
that the effect does to it (:mod:`pchem_pipeline.effects.estimators.pixel_law`), is a strength.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.effects.estimators.pixel_law import PixelLaw, refitted, typical_pixels
from pchem_pipeline.effects.estimators.regression import CUT, SIGNIFICANT, Multiple, multiple_of
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.types import Evidence, FloatArray, SampleLaw

EffectType = TypeVar("EffectType", bound="Effect")


def strength_of(
    evidence: Evidence,
    effect: EffectType,
    name: str,
    *,
    sigmas: float = SIGNIFICANT,
    signed: bool = False,
    cut: float = CUT,
) -> list[EffectType]:
    """Return the effect at the strength that the mean of a score shows; empty if it shows none.

    Least squares over groups of pixels of similar exposure. A first strength comes from the efficient score,
    a second one from the scores that remain where the PCD is fitted to samples of the effect at the first.

    Args:
        evidence: of one split.
        effect: the effect at some small strength, to compare with.
        name: the score, such as "He2C1".
        sigmas: how many standard errors it must be away from zero.
        signed: whether the strength may have either sign.
        cut: a pixel's score counts up to that many standard deviations away from the others.
    """
    factor, error = first_order(evidence, effect, name, cut)
    if not (abs(factor) if signed else factor) >= sigmas * error:
        return []
    first = _times(effect, factor)
    chosen, groups = typical_pixels(evidence.maps)
    laws = [PixelLaw(evidence.maps, int(pixel), evidence.n_frames) for pixel in chosen]
    seen, number = _mean_scores(evidence, name, groups, cut)
    masses = [law.mass_of(_law(first, law)) for law in laws]
    fits = refitted(laws, masses, evidence.n_frames)
    shift = np.sqrt(evidence.n_frames) * np.array(
        [
            fit.score_shift(name, fit.on_codes(*mass) - fit.mass)
            for fit, mass in zip(fits, masses, strict=True)
        ]
    )
    again, error = multiple_of(shift, seen, number)
    # a fit that goes astray at this strength must not take the estimate along
    return [_times(first, float(np.clip(again, 0.1, 10.0)) if np.isfinite(error) else 1.0)]


def first_order(evidence: Evidence, effect: Effect, name: str, cut: float = CUT) -> Multiple:
    """Return how many times an effect's influence on the mean of a score is seen.

    Args:
        evidence: of one split.
        effect: the effect at some small strength.
        name: the score, such as "He2C1".
        cut: a pixel's score counts up to that many standard deviations away from the others.
    """
    chosen, groups = typical_pixels(evidence.maps)
    laws = [PixelLaw(evidence.maps, int(pixel), evidence.n_frames) for pixel in chosen]
    shift = np.array([law.score_shift(name, law.change(_law(effect, law))) for law in laws])
    seen, number = _mean_scores(evidence, name, groups, cut)
    return multiple_of(np.sqrt(evidence.n_frames) * shift, seen, number)


def _law(effect: Effect, law: PixelLaw) -> SampleLaw:
    return effect.sample_law(SampleLaw(), law.maps)


def _times(effect: EffectType, factor: float) -> EffectType:
    """Return the effect at that many times its first-order influence."""
    return effect.scaled(float(np.sign(factor) * abs(factor) ** (1.0 / effect.power)))


def _mean_scores(
    evidence: Evidence, name: str, groups: Sequence[NDArray[np.intp]], cut: float
) -> tuple[FloatArray, FloatArray]:
    """Return the mean score of each group of pixels, and how many pixels it has."""
    scores = np.asarray(evidence.scores[name], np.float64).reshape(-1)
    mean, number = np.zeros(len(groups)), np.zeros(len(groups))
    for i, group in enumerate(groups):
        values = scores[group]
        values = values[np.isfinite(values)]
        if values.size:
            middle = np.median(values)
            mean[i], number[i] = np.clip(values, middle - cut, middle + cut).mean(), values.size
    return mean, number
