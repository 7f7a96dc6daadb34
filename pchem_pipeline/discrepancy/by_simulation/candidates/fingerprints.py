"""Which effects explain the shift of the statistics, and how much of each: optimal fingerprinting of sets.

The shift of the statistics against the null is regressed on the fingerprints of candidate effects, as climate
science attributes warming (Hasselmann 1997; Allen and Tett 1999): ``y = sum_e c_e F_e + noise`` with ``c_e
>= 0``. The noise has the covariance of the null replicates, and a relative error of each fingerprint on top:
details of real effects differ. Sets of up to three candidates are compared by their likelihood, less a price
for every effect: the best are worth a refit of the pixels.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.discrepancy.null import Covariance
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.model.arithmetic.significance import OUTLYING, POSSIBLE, PRICE

_REWEIGHTINGS = 3
_LEAK = 0.1
LARGEST_DECREASE, _LARGEST_INCREASE = 0.75, 3.0
PRICE_OF_MORE = 2.0 * PRICE  # nats for every further one
_LARGEST_SET = 3
_SHORTLIST = (4, 3, 2)  # hypotheses that are taken alone, beside the best one, and beside the best two
#: Nats behind from which on a fingerprint is no rival of a right set, and share of what there is to explain,
#: in addition, for a set that leaves something.
FAR, FAR_SHARE_OF_PART = 40.0, 0.5
#: Factor of a fingerprint beyond which it says nothing, and is another hypothesis.
LARGEST_FACTOR = 30.0
_BLUR = 2.0  # model errors of the others that are added to chance there


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """An effect with parameters, and what it would do to the statistics."""

    effect: Effect  # with guessed or refined parameters
    fingerprint: FloatArray  # shift of the statistics at this strength, shape (m,)
    number: int = 1  # 1 for the first effect of its tag, 2 for the second one, at another place, and so on

    @property
    def tag(self) -> str:
        """Tag of the effect, with its number if it is not the first of its tag."""
        return self.effect.tag if self.number == 1 else f"{self.effect.tag} {self.number}"

    @functools.cached_property
    def kind(self) -> str:
        """The effect without its strength, and its number."""
        return f"{self.effect.model_dump_json(exclude={self.effect.strength})} {self.number}"

    def rescaled(self, factor: float) -> Effect:
        """Return the effect with the strength at which its fingerprint is ``factor`` times as large."""
        if not self.effect.strength:
            return self.effect
        return self.effect.scaled(float(factor) ** (1.0 / self.effect.power))

    def times(self, factor: float) -> Hypothesis:
        """Return the effect so many times as strong, its fingerprint in proportion."""
        return replace(self, effect=self.rescaled(factor), fingerprint=self.fingerprint * factor)


@dataclass(frozen=True)
class Noise:
    """Covariance of the difference of measured and predicted statistics.

    Attributes:
        covariance: of the statistics under the null, its estimation included.
        model_error: relative error of a fingerprint, no unit.
        events: of exact counts, which are Poisson, by how much an event raises the statistic, over the number
            of splits in the mean; 0 for all others, shape (m,).
    """

    covariance: Covariance
    model_error: float
    events: FloatArray | float = 0.0

    def among(self, kept: BoolArray) -> Noise:
        """Return the noise of some of the statistics, (m,)."""
        events = np.broadcast_to(self.events, kept.shape)[kept]
        return replace(self, covariance=self.covariance.among(kept), events=events)

    def of(self, parts: FloatArray, left: FloatArray) -> Covariance:
        """Return the covariance of what the shifts of effects, (e, m), leave, (m,).

        The details of an effect may be off by a fraction of its shift, or of what the data show of it beside
        the other effects where that is less: else the strongest effect would be the likeliest.
        """
        shown = lesser(parts, parts + left)
        counts = self.events * np.abs(shown.sum(axis=0))
        allowed = tolerance(shown, self.model_error, self.events)
        return self.covariance.plus(allowed**2 + counts)


@dataclass(frozen=True)
class SetFit:
    """A set of hypotheses fitted to the shift of one split, with arrays of shape (e,)."""

    hypotheses: tuple[Hypothesis, ...]
    factors: FloatArray  # c_e of each, at least 0
    stderr: FloatArray  # their standard errors
    certain: BoolArray  # whether an exact count asks for it, however few events it has

    @property
    def parts(self) -> FloatArray:
        """Predicted shift by effect, shape (e, m)."""
        return np.array([c * h.fingerprint for c, h in zip(self.factors, self.hypotheses, strict=True)])

    def settled(self, close: float) -> bool:
        """Return whether all strengths are what the data ask for, to ``close`` or half a standard error."""
        return bool(np.all(np.abs(self.factors - 1.0) < np.maximum(close, self.stderr / 2.0)))

    def at_best(self) -> tuple[Hypothesis, ...]:
        """Return the set at the fitted strengths."""
        return tuple(h.times(float(c)) for h, c in zip(self.hypotheses, self.factors, strict=True))

    def log_score(self, shift: FloatArray, noise: Noise) -> float:
        """Return the Gaussian log density of a shift of statistics, up to a constant, nats."""
        parts = self.parts
        left = shift - parts.sum(axis=0)
        return log_density(left, noise.of(parts, left))


def correction(
    slopes: FloatArray, residual: FloatArray, covariance: Covariance, scatter: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return relative changes of the strengths that a residual asks for, and standard errors, (e,) each.

    Args:
        slopes: derivatives of the statistics by the relative strengths, shape (e, m).
        residual: what the model with all effects leaves, shape (m,).
        covariance: of the residual, model errors included.
        scatter: residuals of replicates, shape (b, m), whose changes may scatter more; None: too few.
    """
    design = covariance.white(slopes).T
    weights = np.linalg.pinv(design)

    def asked(rows: FloatArray) -> FloatArray:
        return np.asarray(weights @ covariance.white(rows).T)

    stderr = np.sqrt(np.diag(np.linalg.pinv(design.T @ design)))
    if scatter is not None:
        stderr = np.maximum(stderr, asked(scatter).std(axis=1, ddof=1))
    return np.clip(asked(residual), -LARGEST_DECREASE, _LARGEST_INCREASE), stderr


def tolerance(parts: FloatArray, model_error: float, events: FloatArray | float) -> FloatArray:
    """Return the deviations that are not held against effects, shape (m,).

    A fraction ``model_error`` of their shifts ``parts`` (e, m), and a tenth of that of the largest shift of
    each: the details of a very strong effect show where the effect itself does not. An exact count (see
    :class:`Noise`) has no details.
    """
    own = np.sum(parts**2, axis=0)
    leaked = np.sum((_LEAK * np.max(np.where(np.equal(events, 0.0), np.abs(parts), 0.0), axis=1)) ** 2)
    return np.asarray(model_error * np.sqrt(own + leaked))


def lesser(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the value that is nearer to 0, element by element."""
    return np.asarray(np.where(np.abs(one) < np.abs(other), one, other))


def log_density(residual: FloatArray, covariance: Covariance) -> float:
    """Return the Gaussian log density of a residual, up to a constant, nats."""
    white = covariance.white(residual)
    return float(-0.5 * white @ white - covariance.log_root_determinant)


def fit_set(hypotheses: Sequence[Hypothesis], shift: FloatArray, noise: Noise) -> SetFit:
    """Fit non-negative factors of fingerprints to a shift (m,) by generalised least squares, reweighted."""
    columns = np.array([h.fingerprint for h in hypotheses])
    factors = np.ones(len(hypotheses))
    stderr = np.full(len(hypotheses), np.inf)
    for _ in range(_REWEIGHTINGS):
        parts = columns * factors[:, None]
        covariance = noise.of(parts, shift - parts.sum(axis=0))
        design = covariance.white(columns).T
        factors, _ = optimize.nnls(design, covariance.white(shift))
        variance = np.diag(np.linalg.pinv(design.T @ design))
        # where effects do the same, rounding may leave less than nothing of what separates them
        stderr = np.sqrt(np.where(variance > 0.0, variance, np.inf))
    return SetFit(tuple(hypotheses), factors, stderr, counted(columns * factors[:, None], shift, noise))


def counted(parts: FloatArray, shift: FloatArray, noise: Noise) -> BoolArray:
    """Return which effects, (e,), of shifts (e, m) an exact count in the shift seen, (m,), asks for."""
    return np.asarray(((parts * noise.events > 0.0) & (shift > 0.0)).any(axis=1))


def held_out_gain(
    members: Sequence[Hypothesis], shifts: tuple[FloatArray, FloatArray], noise: Noise
) -> float:
    """Return the gain of a set fitted to each split in predicting the other one, less its price, nats."""
    predicted = (fit_set(members, shift, noise) for shift in shifts)
    scores = (fit.log_score(shift, noise) for fit, shift in zip(predicted, reversed(shifts), strict=True))
    without = sum(log_density(shift, noise.covariance) for shift in shifts)
    return sum(scores) - without - PRICE - PRICE_OF_MORE * (len(members) - 1)


def share_place(effects: Iterable[Effect]) -> bool:
    """Return whether several effects act in one part of the sensor or run: they mimic one cause there."""
    placed = itertools.combinations([e for e in effects if not e.everywhere], 2)
    return any(
        (a.region is not None and a.region == b.region) or (a.when is not None and a.when == b.when)
        for a, b in placed
    )


def seconds(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return those of an effect in another region than its first one, as second ones."""
    first: dict[str, Hypothesis] = {}
    placed = [h for h in hypotheses if h.effect.region is not None]
    apart = [h for h in placed if first.setdefault(h.tag, h).effect.region != h.effect.region]
    return [replace(h, number=h.number + 1) for h in apart]


def meets_itself(members: Iterable[Hypothesis]) -> bool:
    """Return whether an effect is more than once in a set without regions that tell its places apart."""
    pairs = itertools.combinations([h.effect for h in members], 2)
    return any(a.tag == b.tag and (None in (a.region, b.region) or a.region == b.region) for a, b in pairs)


def firsts(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return hypotheses without those that are second ones of others among them."""
    tags = {(h.effect.tag, h.number) for h in hypotheses}
    return [h for h in hypotheses if (h.effect.tag, h.number - 1) not in tags]


def likeliest_sets(hypotheses: Sequence[Hypothesis], shift: FloatArray, noise: Noise) -> list[SetFit]:
    """Fit sets of up to three effects to a shift (m,), and return those likelier than no effect, sorted.

    By their likelihood less the price of their effects. Each is beyond its error, and seen among the others.
    """
    shortlist, alone = _shortlist(hypotheses, shift, noise), set(firsts(hypotheses))
    found: list[tuple[float, SetFit]] = []
    for size in range(1, _LARGEST_SET + 1):
        for members in itertools.combinations(shortlist, size):
            once = len({h.tag for h in members}) == size and not meets_itself(members)
            if once and alone.issuperset(firsts(members)) and not share_place(h.effect for h in members):
                fit = fit_set(members, shift, noise)
                if _all_needed(fit, shift, noise):
                    found.append((fit.log_score(shift, noise) - PRICE_OF_MORE * (size - 1), fit))
    least = log_density(shift, noise.covariance) + PRICE
    likely = sorted((one for one in found if one[0] > least), key=lambda one: -one[0])
    return [fit for _, fit in likely]


def _shortlist(hypotheses: Sequence[Hypothesis], shift: FloatArray, noise: Noise) -> list[Hypothesis]:
    """Return the hypotheses that do best alone, and those that do best beside the best ones."""
    alone, chosen, best = firsts(hypotheses), list[Hypothesis](), list[Hypothesis]()

    def score(one: Hypothesis) -> float:
        return fit_set([*best, one], shift, noise).log_score(shift, noise)

    for most in _SHORTLIST:
        used = {h.tag for h in best}
        left = [h for h in alone if h.tag not in used and h not in chosen]
        chosen += sorted(left, key=score, reverse=True)[:most]
        beside = [h for h in chosen if h.tag not in used]
        best += [max(beside, key=score)] if beside else []
    # an effect that does well in one region may do so in others at once
    kept = {h.effect.tag for h in chosen if h.effect.region is not None}
    return chosen + [h for h in hypotheses if h.effect.tag in kept and h not in alone]


def _all_needed(fit: SetFit, shift: FloatArray, noise: Noise) -> bool:
    """Test whether every effect of a set is beyond its error, and seen among the others."""
    parts = fit.parts
    if not np.all((fit.factors > POSSIBLE * fit.stderr) | fit.certain):
        return False
    return len(parts) == 1 or all(
        seen_among(part, np.delete(parts, member, axis=0), shift, noise) for member, part in enumerate(parts)
    )


def seen_among(part: FloatArray, others: FloatArray, shift: FloatArray, noise: Noise) -> bool:
    """Return whether a statistic deviates from what other effects make of it, in the direction of an effect.

    Args:
        part: shift of the statistics by the effect, shape (m,).
        others: by the other effects, shape (e, m).
        shift: seen of all, shape (m,).
        noise: of the shift.
    """
    blur = _BLUR * tolerance(others, noise.model_error, noise.events)
    scale = np.sqrt(noise.covariance.variances + blur**2)
    left, own = (shift - others.sum(axis=0)) / scale, part / scale
    return bool(np.any((np.abs(left) > OUTLYING) & (np.abs(own) > POSSIBLE) & (left * own > 0.0)))
