"""Parameters of effects beside their strengths, tuned to what the data ask for by simulation.

Those in no law of a sample are at first what an estimator made of them. Where a set leaves something that
such an effect moves, a small step of each parameter shows the slope of the statistics (replicates share their
random numbers), and all of them and the strengths are corrected together (Gauss-Newton, damped as by
Levenberg 1944), the slopes by secants from step to step (Broyden 1965).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import Hypothesis, log_density
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import NotFittedError
from pchem_pipeline.discrepancy.by_simulation.sets.pixel_likelihood import (
    identifiable_from_histograms,
    note_defect,
)
from pchem_pipeline.discrepancy.by_simulation.sets.refits import (
    LARGEST_STEP,
    SMALLEST_SECANT,
    DampedSteps,
    Refitted,
    Refitter,
    beyond_chance,
    broyden,
)
from pchem_pipeline.discrepancy.effort import EffortSpentError
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.model.arithmetic.significance import CERTAIN

_TRIAL = 0.25  # step of the logarithm of a number by which its slope is measured
_MOST = 6  # numbers of a set
_STEPS = 4
_USUAL_ERROR = 0.5  # of the logarithm of a number as it is guessed
_LARGEST_STEP = LARGEST_STEP / 2.0  # of a number: it bends what an effect does, and a strength scales it
_FARTHEST = LARGEST_STEP  # from the guess: beyond, it is another hypothesis
_LEARNT = 0.8  # of that error, what may be left of it where the data tell the number
_WORTHWHILE = 5.0  # nats that a step must promise
_MOVED = 1.0  # by which an effect must move it for its numbers to matter there
_ELSEWHERE = 0.5  # of the squares of what is left, the most where its effects move nothing


@dataclass(frozen=True)
class _Detail:
    """A parameter of an effect of a set, by its place there, and the slope (m,) by its logarithm."""

    place: int
    name: str
    slope: FloatArray


def may_be_tuned(refitter: Refitter, one: Refitted) -> bool:
    """Return whether what a set leaves lies where effects move it whose parameters may be tuned."""
    places = sorted({place for place, _ in _numbers(refitter, one.hypotheses)})
    if not places:
        return False
    scatter = refitter.scatter(one.covariance, len(one.vectors))
    left = np.where(np.abs(one.rest) > CERTAIN, one.rest**2, 0.0)
    moved = np.abs(one.parts[places]).max(axis=0) > _MOVED * scatter
    return bool(left.sum() > 0.0 and left[~moved].sum() < _ELSEWHERE * left.sum())


def tuned(refitter: Refitter, one: Refitted) -> Refitted:
    """Return a set at the parameters and strengths that explain the data best, or itself.

    Raises:
        EffortSpentError: the work is at its limit, and nothing was tuned.
    """
    details = _details(refitter, one)
    if not details:
        return one
    way = DampedSteps(one, one.score)
    for _ in range(_STEPS):
        best = way.best
        step, promise = _correction(refitter, best, details)
        moved, taken = _moved(best, one, details, way.length * step)
        if promise - best.score < _WORTHWHILE or np.abs(taken).max() < SMALLEST_SECANT:
            break
        try:
            refitter.allow(one.words)
            now = refitter.simulated(moved, None, len(best.vectors))
        except NotFittedError:  # a step too far
            way.judge(None)
            continue
        except EffortSpentError:
            break
        # a step in vain tells how the statistics go, too
        details = _secant(best, now, details, taken)
        way.judge(replace(now, tuned=True), now.score)
    return way.best


def standard_errors(
    refitter: Refitter, one: Refitted, least: FloatArray, by_law: Mapping[str, Mapping[str, float]]
) -> list[dict[str, float]]:
    """Return the standard errors of the strength and parameters of each effect of a set, by name.

    The root of the inverse of the information of all together, and of the square of the change that the data
    still ask for; none of a parameter that the data hardly constrain. ``least`` are relative errors of the
    factors where the parameters are known, shape (e,). Errors ``by_law``, by tag, are of fits to histograms:
    the strength is known no better than by a fit that has it vary together with other parameters.
    """
    details = _details(refitter, one)
    information, score = _normal_equations(refitter, one, details)
    variance = np.linalg.inv(information)
    left = variance @ score
    left[: len(least)] -= one.change  # to which the strengths are corrected
    relative = np.hypot(np.sqrt(np.diag(variance)), left)
    found: list[dict[str, float]] = []
    for h, error in zip(one.hypotheses, np.maximum(relative[: len(least)], least), strict=True):
        strength = abs(float(getattr(h.effect, h.effect.strength))) if h.effect.strength else np.nan
        law = by_law.get(h.tag, {})
        tied = law.get(h.effect.strength, 0.0) if len(law) > 1 else 0.0
        found.append({**law, h.effect.strength: max(strength * float(error) / h.effect.power, tied)})
    for detail, error in zip(details, relative[len(least) :], strict=True):
        if error < _LEARNT * _USUAL_ERROR:
            value = getattr(one.effects[detail.place], detail.name)
            found[detail.place][detail.name] = float(value * error)
    return found


def _details(refitter: Refitter, one: Refitted) -> list[_Detail]:
    """Return the parameters that may be tuned, with their slopes."""
    found = []
    for place, name in _numbers(refitter, one.hypotheses):
        # an effect of a plug-in may raise anything: what is known of the others counts all the same
        try:
            found.append(_measured(refitter, one, place, name))
        except EffortSpentError:
            raise
        except Exception as error:
            note_defect(refitter.defects, one.hypotheses[place].tag, error)
    return [detail for detail in found if detail is not None]


def _numbers(refitter: Refitter, hypotheses: Sequence[Hypothesis]) -> list[tuple[int, str]]:
    """Return the parameters that may be tuned, with the place of their effect: positive, and in no law."""
    found: list[tuple[int, str]] = []
    for place, h in enumerate(hypotheses):
        # an effect of a plug-in may raise anything: the others are compared all the same
        try:
            free = h.effect.strength and not identifiable_from_histograms(h.effect)
            named = [(name, getattr(h.effect, name)) for name in (h.effect.details() if free else ())]
        except Exception as error:
            note_defect(refitter.defects, h.tag, error)
            continue
        found += [(place, n) for n, value in named if isinstance(value, float) and 0.0 < value < np.inf]
    return found[:_MOST]


def _measured(refitter: Refitter, one: Refitted, place: int, name: str) -> _Detail | None:
    """Return a parameter with its slope, from a step of it alone; None: it cannot move, or moves nothing."""
    for ahead in (_TRIAL, -_TRIAL):
        effects = list(one.effects)
        effects[place] = effects[place].times(name, float(np.exp(ahead)))
        step = _logarithm(one.effects[place], effects[place], name)
        if abs(step) < SMALLEST_SECANT:
            continue
        slope = refitter.measured_slope(one, tuple(effects), step)
        if slope is not None:
            return _Detail(place, name, slope) if slope.any() else None
    return None


def _correction(refitter: Refitter, one: Refitted, details: Sequence[_Detail]) -> tuple[FloatArray, float]:
    """Return changes of the logarithms of factors and parameters, (e + d,), and the score they promise."""
    n = len(one.hypotheses)
    step = np.asarray(np.linalg.solve(*_normal_equations(refitter, one, details)), np.float64)
    scaling = [bool(h.effect.strength) for h in one.hypotheses]
    step[:n] = np.where(scaling, np.clip(step[:n], -LARGEST_STEP, LARGEST_STEP), 0.0)
    step[n:] = np.clip(step[n:], -_LARGEST_STEP, _LARGEST_STEP)
    noise = refitter.noise(one.covariance, len(one.vectors))
    left = refitter.target - one.mean
    return step, log_density(left - step @ _slopes(one, details), noise.of(one.parts, left))


def _normal_equations(
    refitter: Refitter, one: Refitted, details: Sequence[_Detail]
) -> tuple[FloatArray, FloatArray]:
    """Return the information of the logarithms of factors and parameters, (e + d, e + d), and the score."""
    noise, kept = refitter.noise(one.covariance, len(one.vectors)), refitter.kept(one.hypotheses)
    residual = (refitter.target - one.mean)[kept]
    covariance = noise.among(kept).of(one.parts[:, kept], residual)
    design = covariance.white(_slopes(one, details)[:, kept]).T
    left = covariance.white(residual)
    damping = np.where(np.arange(design.shape[1]) < len(one.hypotheses), 1e-6, _USUAL_ERROR**-2.0)
    return design.T @ design + np.diag(damping), design.T @ left


def _slopes(one: Refitted, details: Sequence[_Detail]) -> FloatArray:
    """Return the slopes by the logarithms of factors and parameters, shape (e + d, m)."""
    return np.concatenate([one.slopes, *(detail.slope[None] for detail in details)])


def _moved(
    one: Refitted, guessed: Refitted, details: Sequence[_Detail], step: FloatArray
) -> tuple[tuple[Hypothesis, ...], FloatArray]:
    """Return a set after a step of the logarithms, as far as its limits allow, and the step taken."""
    n = len(one.hypotheses)
    taken = step.copy()
    found = [h.times(float(np.exp(s))) for h, s in zip(one.hypotheses, step[:n], strict=True)]
    for at, detail in enumerate(details, n):
        now, first = found[detail.place], guessed.effects[detail.place]
        so_far = _logarithm(first, now.effect, detail.name)
        ahead = float(np.clip(so_far + step[at], -_FARTHEST, _FARTHEST)) - so_far
        effect = now.effect.times(detail.name, float(np.exp(ahead)))
        taken[at] = _logarithm(now.effect, effect, detail.name)
        found[detail.place] = replace(
            now, effect=effect, fingerprint=now.fingerprint + taken[at] * detail.slope
        )
    return tuple(found), taken


def _secant(before: Refitted, after: Refitted, details: Sequence[_Detail], step: FloatArray) -> list[_Detail]:
    """Return the parameters with slopes corrected by what a step has done."""
    slopes = _slopes(before, details)
    difference = after.vectors - before.vectors
    error = difference.std(axis=0, ddof=1) / np.sqrt(len(difference))
    unforeseen = beyond_chance(difference.mean(axis=0) - step @ slopes, error)
    new = broyden(slopes, step, unforeseen)[len(before.hypotheses) :]
    return [replace(detail, slope=slope) for detail, slope in zip(details, new, strict=True)]


def _logarithm(one: Effect, other: Effect, name: str) -> float:
    """Return the logarithm of the factor between a parameter of two effects."""
    return float(np.log(getattr(other, name) / getattr(one, name)))
