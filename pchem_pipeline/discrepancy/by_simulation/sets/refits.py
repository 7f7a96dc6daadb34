"""Sets of effects at their best fit under the law: refit, simulate, compare, correct, until they stop moving.

The fingerprint of a strong effect extrapolates badly, since the read noise of the plain fit holds a part of
it. Here the pixels are fitted with the effects in their law, replicates are drawn from that fit, and the
strengths are corrected by what the replicates leave of the data (indirect inference, Gourieroux, Monfort and
Renault 1993, by secants): an effect is judged by what is left after its best fit.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import (
    PRICE_OF_MORE,
    Hypothesis,
    Noise,
    correction,
    lesser,
    log_density,
)
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import NotFittedError
from pchem_pipeline.discrepancy.null import Covariance, NullModel
from pchem_pipeline.effects.framework.compose import along_chain
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.model.arithmetic.significance import BEYOND_DOUBT, FALSE_ALARM, NO_DIFFERENCE, OUTLYING
from pchem_pipeline.model.arithmetic.statistics import chi_square, look_elsewhere

_SPLITS = 2  # train and test frames, whose mean is explained
#: Replicates at each strength on the way.
FEW = 6
ENOUGH = 12  # replicates that tell a scatter
_MOST_STEPS = 5  # corrections of strengths
_STEPS_OF_EXPENSIVE = 2
#: Standard errors of its strength that an effect must have: the best of some hundred guesses reaches more
#: than a single one would by chance.
ESTABLISHED = 4.5
_CLOSE = 0.05  # relative change of a factor that is not worth another simulation
#: Of the logarithm of a factor: shorter steps say nothing about the slope.
SMALLEST_SECANT = 0.05
_TRIAL = 0.3  # step of the logarithm of a factor by which a slope is measured
_STRONG = 10.0  # standard deviations by which an effect moves a statistic where its slope is
_LARGEST_SHARE = 0.9  # of a factor that a correction takes away
_FINE_ERROR = 0.03  # relative error of what a set does to the statistics at its best fit
#: Most that the logarithm of the factor of a strength changes in one step.
LARGEST_STEP = float(np.log(4.0))
_FURTHER = 2  # steps beyond one that explains less, where the data go on asking for the same
# of a step, what the data ask for after it: too much for a good slope, and the most that is believed
_SLOW, _SLOWEST = 0.5, 0.75
_SHORTEST = 0.25  # of the step that the data ask for
State = TypeVar("State")


@dataclass(frozen=True, eq=False)
class Refitted:
    """A set of effects at strengths for which the refitted model was simulated.

    Attributes:
        hypotheses: the effects, with the shift of the statistics that each has a part in.
        stderr: relative standard errors of the factors (of ``strength ** power``), shape (e,).
        vectors: statistics of replicates drawn from it, shape (b, m).
        covariance: of the statistics of one split under it.
        slopes: derivatives of the statistics by the logarithm of each factor, shape (e, m).
        change: logarithms of the factors by which the data ask for more of each, shape (e,).
        rest: deviations of the data from the mean in standard errors, model errors included, shape (m,).
        score: log density of the rest, nats.
        promise: the same after that change, if the statistics are linear.
        chance: the same of a rest that chance leaves.
        tuned: whether other parameters of the effects than strengths were tuned.
    """

    hypotheses: tuple[Hypothesis, ...]
    stderr: FloatArray
    vectors: FloatArray
    covariance: Covariance
    slopes: FloatArray
    change: FloatArray
    rest: FloatArray
    score: float
    promise: float
    chance: float
    tuned: bool = False

    @property
    def tags(self) -> frozenset[str]:
        """Of the effects."""
        return frozenset(h.tag for h in self.hypotheses)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The effects."""
        return tuple(h.effect for h in self.hypotheses)

    @property
    def words(self) -> str:
        """Tags of the effects."""
        return tags_of(self.hypotheses)

    @property
    def price(self) -> float:
        """Nats beyond those of one effect with a name; each part that is measured costs as two of these."""
        return price(self.effects)

    @property
    def penalised_log_likelihood(self) -> float:
        """Score less the price of the effects, nats."""
        return self.score - self.price

    @property
    def mean(self) -> FloatArray:
        """Mean of the statistics, shape (m,)."""
        return np.asarray(self.vectors.mean(axis=0))

    @property
    def parts(self) -> FloatArray:
        """Shift of the statistics by effect, shape (e, m)."""
        return np.array([h.fingerprint for h in self.hypotheses])

    @property
    def settled(self) -> bool:
        """Whether the strengths are what the data ask for, to a few per cent or a standard error."""
        return bool(np.all(np.abs(self.change) < np.maximum(_CLOSE, self.stderr)))


@dataclass
class DampedSteps(Generic[State]):
    """The state of the highest log score so far, and the length of the next step, which a failure halves."""

    best: State
    score: float
    length: float = 1.0

    def judge(self, now: State | None, score: float = -np.inf) -> bool:
        """Keep the better one, and tell whether it is the new one; None: the step led nowhere."""
        if now is None or not score > self.score:
            self.length *= 0.5
            return False
        self.best, self.score, self.length = now, score, 1.0
        return True


def broyden(slopes: FloatArray, step: FloatArray, unforeseen: FloatArray) -> FloatArray:
    """Return slopes (e, m) corrected by the change (m,) beyond them after a step (e,) (Broyden 1965)."""
    return np.asarray(slopes + np.outer(step, unforeseen / float(step @ step)))


@dataclass
class Steps(DampedSteps[Refitted]):
    """The search for the strengths of a set that explain the data best; the score may dip on the way."""

    now: Refitted = field(kw_only=True)  # the set at its last strengths
    step: FloatArray = field(kw_only=True)  # that led there, logarithms of factors, shape (e,)
    gained: float = np.inf  # nats, by the last improvement
    further: int = 0  # steps since the last improvement
    taken_so_far: int = 0  # steps in all

    @classmethod
    def begin(cls, one: Refitted) -> Steps:
        """Begin at the guessed strengths."""
        return cls(one, one.score, now=one, step=one.change)

    def ahead(self) -> tuple[Refitted, FloatArray]:
        """Return from where the next step is to be, and the step."""
        if self.further:
            change = self.now.change
            step = change * (np.linalg.norm(self.step) / max(float(np.linalg.norm(change)), 1e-12))
            return self.now, np.clip(step, -LARGEST_STEP, LARGEST_STEP)
        # cut here, so that a length that is halved is half of the step that was taken
        self.length = min(self.length, LARGEST_STEP / max(float(np.abs(self.best.change).max()), 1e-12))
        return self.best, self.best.change * self.length

    def taken(self, step: FloatArray, now: Refitted | None) -> bool:
        """Take note of where a step led (None: nowhere), and tell whether there is another one to try."""
        self.step, before, self.taken_so_far = step, self.score, self.taken_so_far + 1
        if now is not None and not now.score > before and self._goes_on(now):
            self.now, self.further = now, self.further + 1
            return True
        another, self.further = self.length > _SHORTEST, 0
        if not self.judge(now, -np.inf if now is None else now.score) or now is None:
            return another
        self.gained, self.now, self.length = self.score - before, now, _lengthened(now.change, step)
        return True

    def _goes_on(self, now: Refitted) -> bool:
        """Return whether the data ask for more of the same on both sides of a dip."""
        return self.further < _FURTHER and self.length >= 1.0 and float(now.change @ self.step) > 0.0


def _lengthened(change: FloatArray, step: FloatArray) -> float:
    """Return the factor of the next step: where changes shrink slowly, that of their geometric series."""
    ratio = float(change @ step) / max(float(step @ step), 1e-12)
    return 1.0 if ratio < _SLOW else 1.0 / (1.0 - min(ratio, _SLOWEST))


@dataclass
class Refitter:
    """Fits sets of effects to the statistics of the data.

    Attributes:
        draw: refits the pixels with effects beside those of the model, and returns the statistics of so many
            replicates, (b, m), which share their random numbers whatever the effects.
        null: of the model without them.
        target: mean of the statistics of train and test frames, shape (m,).
        present: other effects of the model.
        allow: is given the effects simulated next, and raises an error where the work is at its limit.
        defects: effects that failed, and why; out.
    """

    draw: Callable[[tuple[Effect, ...], int], FloatArray]
    null: NullModel
    target: FloatArray
    present: tuple[Effect, ...] = ()
    allow: Callable[[str], None] = lambda _: None
    defects: dict[str, str] = field(default_factory=dict)

    def begin(self, hypotheses: Sequence[Hypothesis]) -> Steps:
        """Simulate a set at its guessed strengths.

        Raises:
            NotFittedError: hardly a pixel can be fitted with the set.
            EffortSpentError: the work is at its limit.
        """
        self.allow(tags_of(hypotheses))
        return Steps.begin(self.simulated(tuple(hypotheses), None, FEW))

    def step(self, way: Steps) -> bool:
        """Simulate a set a step nearer to its best strengths; return whether another step may pay.

        Raises:
            EffortSpentError: the work is at its limit.
        """
        best = way.best
        most = _STEPS_OF_EXPENSIVE if is_expensive(best.effects) else _MOST_STEPS
        # after a step that brings so little the next ones bring less
        if best.settled or way.gained < NO_DIFFERENCE or way.taken_so_far >= most:
            return False
        start, step = way.ahead()
        moved = _moved(start.hypotheses, step)
        if moved is None:
            return False
        self.allow(best.words)
        try:
            now = self.simulated(moved, start, len(best.vectors))
        except NotFittedError:
            now = None  # a step too far
        return way.taken(step, now)

    def model(self, effects: tuple[Effect, ...]) -> tuple[Effect, ...]:
        """Return the model with effects."""
        return along_chain(self.present, effects)

    @property
    def nothing(self) -> float:
        """Log density of the data under the model without effects, nats."""
        noise = self.noise(self.null.covariance, self.null.n_replicates)
        return log_density(self.target - self.null.mean, noise.covariance)

    def sharpened(self, one: Refitted, replicates: int) -> Refitted:
        """Return a set with more replicates, at the strengths that its slopes ask for."""
        if one.vectors.shape[0] >= replicates:
            return one
        slopes, hypotheses = self._slopes(one), one.hypotheses
        if slopes is not None:
            noise = self.noise(one.covariance, len(one.vectors))
            kept = self.kept(hypotheses)
            residual = (self.target - one.mean)[kept]
            allowed = noise.among(kept).of(lesser(slopes, one.parts)[:, kept], residual)
            change, _ = correction(slopes[:, kept], residual, allowed)
            hypotheses = _moved(hypotheses, np.log1p(np.maximum(change, -_LARGEST_SHARE))) or hypotheses
        try:
            return self.simulated(hypotheses, one, replicates, slopes)
        except NotFittedError:  # a step too far
            return self.simulated(one.hypotheses, one, replicates)

    def _slopes(self, one: Refitted) -> FloatArray | None:
        """Return slopes, those of strong effects measured by a step of each alone; None: none is strong."""
        strong = np.max(np.abs(one.parts) / self.null.std, axis=1) > _STRONG
        if not strong.any() or is_expensive(one.effects):
            return None
        ahead = np.diag(np.where(strong, np.copysign(_TRIAL, one.change), 0.0))
        found = [self._slope(one, place, ahead[place]) for place in range(strong.size)]
        if all(slope is None for slope in found):
            return None
        return np.array([old if new is None else new for old, new in zip(one.slopes, found, strict=True)])

    def _slope(self, one: Refitted, place: int, ahead: FloatArray) -> FloatArray | None:
        """Return the slope of one effect of a set, from a step ahead of it alone; None: there is none."""
        moved = _moved(one.hypotheses, ahead)
        if moved is None:
            return None
        effects = tuple(h.effect for h in moved)
        step = float(_step(one.effects, effects)[place])
        if abs(step) < SMALLEST_SECANT:
            return None
        # a shift in proportion to the factor has this slope between the two
        middle = np.exp(step / 2.0)
        slope = self.measured_slope(one, effects, step, middle * one.slopes[place])
        return None if slope is None else np.asarray(slope / middle)

    def measured_slope(
        self, one: Refitted, effects: tuple[Effect, ...], step: float, foreseen: FloatArray | float = 0.0
    ) -> FloatArray | None:
        """Return the slope (m,) of the statistics by the logarithm of a parameter of a set, by simulation.

        Args:
            one: the set.
            effects: the same with one parameter changed.
            step: change of its logarithm.
            foreseen: the slope where the measured one does not differ beyond chance, shape (m,).
        """
        self.allow(one.words)
        try:
            vectors = self.draw(effects, len(one.vectors))
        except NotFittedError:
            return None
        apart = (vectors - one.vectors) / step
        error = apart.std(axis=0, ddof=1) / np.sqrt(len(apart))
        return np.asarray(foreseen + beyond_chance(apart.mean(axis=0) - foreseen, error))

    def passes_goodness_of_fit(self, one: Refitted) -> bool:
        """Return whether a set leaves no statistic beyond chance, nor all of them together (chi-square)."""
        p, number = float(self.null.p_of(one.rest, _SPLITS).min()), one.rest.size
        together = float(chi_square(2.0 * (one.chance - one.score) + number, number))
        return look_elsewhere(p, self.null.effective_tests) > FALSE_ALARM and together < BEYOND_DOUBT

    def ranked(self, sets: Iterable[Refitted]) -> list[Refitted]:
        """Return sets, the best first: the likeliest; if it leaves nothing, the smallest that does so."""
        found = sorted(sets, key=operator.attrgetter("penalised_log_likelihood"), reverse=True)
        if found and self.passes_goodness_of_fit(found[0]):
            found.sort(key=lambda one: one.price if self.passes_goodness_of_fit(one) else np.inf)
        return found

    def kept(self, hypotheses: Sequence[Hypothesis]) -> BoolArray:
        """Return which statistics tell strengths: of effects everywhere, not those of conspicuous parts."""
        placed = any(not h.effect.everywhere for h in hypotheses)
        return np.array([placed or "@" not in name for name in self.null.names])

    def noise(self, covariance: Covariance, replicates: int) -> Noise:
        """Return the noise of the data less the mean of so many replicates."""
        scale = 1.0 / _SPLITS + 1.0 / replicates
        return Noise(covariance.times(scale), _FINE_ERROR, self.null.events / _SPLITS)

    def scatter(self, covariance: Covariance, replicates: int) -> FloatArray:
        """Return standard deviations of the same, by chance alone, shape (m,)."""
        return np.asarray(np.sqrt(self.noise(covariance, replicates).covariance.variances))

    def simulated(
        self,
        hypotheses: tuple[Hypothesis, ...],
        before: Refitted | None,
        replicates: int,
        slopes: FloatArray | None = None,
    ) -> Refitted:
        """Simulate effects at their strengths; ``before`` is the same set at other strengths, if known."""
        vectors = self.draw(tuple(h.effect for h in hypotheses), replicates)
        mean = vectors.mean(axis=0)
        covariance = self._covariance(vectors)
        parts = self._shifts(hypotheses, vectors, covariance)
        if slopes is None:
            slopes = self._secants(hypotheses, parts, before, vectors, covariance)
        noise = self.noise(covariance, replicates)
        residual = self.target - mean
        scaling = np.array([bool(h.effect.strength) for h in hypotheses])
        kept = self.kept(hypotheses)
        scatter = (vectors - mean)[:, kept] * np.sqrt(1.0 / _SPLITS + 1.0 / replicates)
        change, stderr = correction(
            slopes[:, kept],
            residual[kept],
            noise.among(kept).of(lesser(slopes, parts)[:, kept], residual[kept]),
            scatter if replicates >= ENOUGH else None,
        )
        change = np.where(scaling, np.log1p(np.maximum(change, -_LARGEST_SHARE)), 0.0)
        found = tuple(replace(h, fingerprint=part) for h, part in zip(hypotheses, parts, strict=True))
        allowed = noise.of(parts, residual)
        promised = residual - np.expm1(change) @ slopes
        return Refitted(
            found,
            stderr,
            vectors,
            covariance,
            slopes,
            change,
            rest=residual / np.sqrt(allowed.variances),
            score=log_density(residual, allowed),
            promise=log_density(promised, allowed),
            chance=log_density(np.zeros_like(residual), allowed) - residual.size / 2.0,
        )

    def _shifts(
        self, hypotheses: tuple[Hypothesis, ...], vectors: FloatArray, covariance: Covariance
    ) -> FloatArray:
        """Return the shifts by each effect, shape (e, m): as foreseen where their sum is so within chance."""
        parts = np.array([h.fingerprint for h in hypotheses])
        error = np.sqrt(covariance.variances * (1.0 / len(vectors) + 1.0 / self.null.n_replicates))
        apart = vectors.mean(axis=0) - self.null.mean - parts.sum(axis=0)
        # shared among the effects by the squares of their shifts
        weight = parts**2
        total = weight.sum(axis=0)
        share = np.where(total > 1e-12, weight / np.maximum(total, 1e-12), 1.0 / len(parts))
        return np.asarray(parts + share * beyond_chance(apart, error))

    def _secants(
        self,
        hypotheses: tuple[Hypothesis, ...],
        parts: FloatArray,
        before: Refitted | None,
        vectors: FloatArray,
        covariance: Covariance,
    ) -> FloatArray:
        """Return the slopes of the statistics by the logarithms of the factors, shape (e, m), by secants.

        What is within chance of what was foreseen is taken as foreseen: a slope that holds the scatter of the
        replicates would be correlated with what they leave, and every strength would come out too low.
        """
        if before is None:
            return parts
        step = _step(before.effects, tuple(h.effect for h in hypotheses))
        length, old = float(step @ step), before.slopes
        if length < SMALLEST_SECANT**2:
            return old
        apart = vectors.mean(axis=0) - before.mean - step @ old
        error = _error_of_difference(vectors, before.vectors, np.sqrt(covariance.variances))
        slope = broyden(old, step, beyond_chance(apart, error))
        # a secant holds between the two; a shift in proportion to the factor has its end's slope
        return np.asarray(slope * np.exp(step / 2.0)[:, None])

    def _covariance(self, vectors: FloatArray) -> Covariance:
        """Return the covariance of the statistics: that of the null, more where effects make them scatter."""
        null = self.null
        ratio = np.maximum(vectors.std(axis=0, ddof=1) / null.std, 1.0)
        ratio[~null.moved_by(vectors)] = 1.0
        return null.covariance.scaled(ratio)


def tags_of(hypotheses: Iterable[Hypothesis]) -> str:
    """Return the tags of a set in one line."""
    return " + ".join(h.tag for h in hypotheses)


def price(effects: Iterable[Effect]) -> float:
    """Return the price of effects beyond that of one with a name, nats; a measured part costs as two."""
    return PRICE_OF_MORE * (sum(max(1, 2 * effect.measured_parts) for effect in effects) - 1)


def is_expensive(effects: Iterable[Effect]) -> bool:
    """Return whether a refit with effects takes long: it looks for levels or a path in every pixel."""
    return any(type(effect).random_realisation for effect in effects)


def _moved(hypotheses: Sequence[Hypothesis], step: FloatArray) -> tuple[Hypothesis, ...] | None:
    """Return the hypotheses at other strengths; None where their limits do not let them move."""
    new = tuple(h.times(float(np.exp(s))) for h, s in zip(hypotheses, step, strict=True))
    return None if all(a.effect == b.effect for a, b in zip(new, hypotheses, strict=True)) else new


def _error_of_difference(vectors: FloatArray, before: FloatArray, std: FloatArray) -> FloatArray:
    """Return standard errors of the difference of the means of replicates at two strengths, shape (m,).

    They share their random numbers; few of them tell the error of one statistic badly: never below the usual.
    """
    if len(vectors) != len(before):
        return np.asarray(std * np.sqrt(1.0 / len(vectors) + 1.0 / len(before)))
    scatter = (vectors - before).std(axis=0, ddof=1)
    usual = std * np.sqrt(np.mean((scatter / std) ** 2))
    return np.asarray(np.maximum(scatter, usual) / np.sqrt(len(vectors)))


def _step(before: Sequence[Effect], after: Sequence[Effect]) -> FloatArray:
    """Return the logarithms of the factors between two strengths of the same effects."""
    found = []
    for old, new in zip(before, after, strict=True):
        a, b = (float(getattr(e, e.strength, 1.0)) if e.strength else 1.0 for e in (old, new))
        found.append(old.power * np.log(b / a) if a * b > 0.0 else 0.0)
    return np.array(found)


def beyond_chance(difference: FloatArray, error: FloatArray) -> FloatArray:
    """Return differences of means where they are beyond chance, 0 elsewhere."""
    return np.asarray(np.where(np.abs(difference) > OUTLYING * error, difference, 0.0))
