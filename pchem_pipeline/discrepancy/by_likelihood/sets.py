"""Sets of effects compared by likelihood on histograms: fitted on one part, scored on another.

The samples of every pixel are split at random into three parts. A set of effects is fitted on the first
together with the pixels' own four parameters and scored by its log-likelihood on the second; the standard
error of a difference of scores is that of a mean of independent samples (Vuong 1989).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.base.errors import error_words
from pchem_pipeline.discrepancy.build_verdict import MOST_RIVALS
from pchem_pipeline.discrepancy.by_likelihood.members import Member, law_of
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.model.arithmetic.significance import CLEAR, PRICE
from pchem_pipeline.model.fit.shared import Samples, SharedFit, SharedProblem, Tangent, fit_shared
from pchem_pipeline.model.law.sample_law import SampleLaw

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_LARGEST_SET = 4
_FITTED = 3  # candidates fitted in full, of those that a first-order step promises most of
_TOLERANCE = 0.02  # nats; of a misfit more, since it is known no better
_TOLERANCE_PER_SAMPLE = 1e-6
_MOST_STEPS = 20
_SECANT = 0.1  # of the start: where the slope at no effect is taken
# of the gap, left by so many effects: none of them is what is missing
_HOPELESS = {1: 0.8, 2: 0.5, 3: 0.5, 4: 0.5}
_HARDLY = 0.03  # of what the set closes: a member that closes less is not one of a set that misfits anyway
SWAPPED = 0.2  # of what the set closes: members that close more are not exchanged


def split_samples(counts: NDArray[np.integer], parts: int, rng: np.random.Generator) -> tuple[IntArray, ...]:
    """Split the samples of histograms (n, B) into equal parts at random, without replacement."""
    left = counts.astype(np.int64)
    found = []
    for remaining in range(parts, 1, -1):
        drawn = np.stack(
            [
                rng.multivariate_hypergeometric(row, int(row.sum()) // remaining, method="marginals")
                for row in left
            ]
        )
        found.append(drawn.astype(np.int64))
        left = left - found[-1]
    return (*found, left)


def saturated(counts: IntArray, kept: NDArray[np.bool_]) -> FloatArray:
    """Return the log-likelihood of histograms under their own frequencies in the kept codes, nats, (n,)."""
    seen = np.where(kept, counts, 0).astype(np.float64)
    total = np.maximum(seen.sum(axis=1, keepdims=True), 1.0)
    return np.asarray((seen * np.log(np.maximum(seen, 1.0) / total)).sum(axis=1))


def chance_of_cells(expected: FloatArray) -> float:
    """Return the mean of ``sum n log(n / e)`` for Poisson counts n of expectation e, nats.

    It is 1/2 per cell where many counts are expected, and less where few are.
    """
    grid, values = _chance_table()
    some = expected[expected > 0.0]
    found = np.interp(np.log(np.maximum(some, 1e-300)), grid, values)
    few = some < np.exp(grid[0])
    found[few] = -some[few] * np.log(some[few])
    return float(found.sum())


@functools.cache
def _chance_table() -> tuple[FloatArray, FloatArray]:
    """Return log e and the mean of ``n log(n / e)``, from 1e-6 to 1e3 (1/2 beyond)."""
    expected = np.geomspace(1e-6, 1e3, 600)
    n = np.arange(1, 1500)
    log_mass = n * np.log(expected[:, None]) - expected[:, None] - special.gammaln(n + 1.0)
    values = (np.exp(log_mass) * n * (np.log(n) - np.log(expected[:, None]))).sum(axis=1)
    return np.log(expected), np.asarray(values, np.float64)


@dataclass(frozen=True)
class FittedSet:
    """A set of candidates, fitted.

    Attributes:
        members: at the fitted coordinates.
        fit: of own and shared parameters.
        log_masses: of the codes under it, shape (n, B).
        score: log-likelihood of the other part, nats.
    """

    members: tuple[Member, ...]
    fit: SharedFit
    log_masses: FloatArray
    score: float

    @property
    def tags(self) -> frozenset[str]:
        """Their tags."""
        return frozenset(m.tag for m in self.members)

    def without(self, tag: str) -> tuple[Member, ...]:
        """Return the members but one."""
        return tuple(m for m in self.members if m.tag != tag)

    def member(self, tag: str) -> Member | None:
        """Return a member; None: it has none of that tag."""
        return next((m for m in self.members if m.tag == tag), None)

    def new(self, other: FittedSet) -> Member | None:
        """Return the member that another set does not have; None: it has all."""
        return next((m for m in self.members if m.tag not in other.tags), None)

    def coordinates(self, tag: str) -> tuple[FloatArray, FloatArray]:
        """Return coordinates of a member and their standard errors."""
        at = 0
        for member in self.members:
            n = len(member.coordinates)
            if member.tag == tag:
                variance = np.diag(self.fit.covariance)[at : at + n]
                return self.fit.shared[at : at + n], np.sqrt(np.maximum(variance, 0.0))
            at += n
        raise KeyError(tag)


@dataclass
class SetComparison:
    """Fits sets of effects to one part of the samples and scores them on another.

    Attributes:
        train, test: histograms, shape (n, B); a row for each sample of each pixel.
        origin: DN of bin 0, shape (n,).
        kept: codes that count, shape (n, B).
        present: effects that the model has.
        start: (H, g, mu, sigma), shape (n, 4).
        samples: which rows are of one pixel.
        failed: candidates that could not be fitted, and why.
        effort: counts the masses, and ends the search at its limit.
    """

    train: IntArray
    test: IntArray
    origin: IntArray
    kept: NDArray[np.bool_]
    present: tuple[Effect, ...]
    start: FloatArray
    samples: Samples = field(default_factory=Samples)
    failed: dict[str, str] = field(default_factory=dict)
    effort: Effort = field(default_factory=lambda: Effort(None))
    _known: dict[frozenset[str], FittedSet] = field(default_factory=dict)

    def on(self, kept: NDArray[np.bool_], start: FloatArray) -> SetComparison:
        """Return the same on other codes, begun elsewhere.

        Args:
            kept: codes that count, shape (n, B).
            start: (H, g, mu, sigma), shape (n, 4).
        """
        return replace(self, kept=kept, start=start, failed=dict(self.failed), _known={})

    def of(self, rows: slice, start: FloatArray) -> SetComparison:
        """Return the same of some of the rows, begun elsewhere: ``start`` has shape (n, 4)."""
        taken = {name: getattr(self, name)[rows] for name in ("train", "test", "origin", "kept")}
        return replace(self, **taken, start=start[rows], failed=dict(self.failed), _known={})

    @property
    def n_test(self) -> float:
        """Samples that count in the scored part."""
        return float(np.where(self.kept, self.test, 0).sum())

    def problem(self, members: Sequence[Member], counts: IntArray | None = None) -> SharedProblem:
        """Return what a set is fitted to: the train part, or other histograms."""
        tags = [m.tag for m in members]

        def law(shared: FloatArray, own: FloatArray) -> SampleLaw:
            found = law_of(self.present, members, shared, own, self.samples)
            self.effort.evaluate(self.train.size, found.components, tags)
            return found

        coordinates = [c for m in members for c in m.coordinates]
        return SharedProblem(
            self.train if counts is None else counts,
            self.origin,
            self.kept,
            law,
            np.array([c.bounds for c in coordinates], np.float64).reshape(-1, 2),
            np.concatenate([np.zeros(0), *(m.scale for m in members)]),
            self.samples,
        )

    def fit(
        self, members: Sequence[Member], start: FloatArray | None = None, counts: IntArray | None = None
    ) -> FittedSet:
        """Fit a set from the starts of its members.

        Raises:
            Exception: whatever an effect raises.
        """
        problem = self.problem(members, counts)
        shared = np.concatenate([np.zeros(0), *(m.start for m in members)])
        tolerance = max(_TOLERANCE, _TOLERANCE_PER_SAMPLE * self.n_test)
        fit = fit_shared(
            problem,
            self.start if start is None else start,
            shared,
            tolerance=tolerance,
            max_steps=_MOST_STEPS,
        )
        at, moved = 0, []
        for member in members:
            n = len(member.coordinates)
            moved.append(member.moved(fit.shared[at : at + n]))
            at += n
        log_masses = problem.log_masses(fit.theta, fit.shared)
        return FittedSet(tuple(moved), fit, log_masses, float((self.test * log_masses).sum()))

    def attempt(self, members: Sequence[Member], start: FloatArray | None = None) -> FittedSet | None:
        """Fit a set, unless that was done; None where the last of its members cannot be fitted.

        Raises:
            EffortSpentError: the work is at its limit.
        """
        kinds = frozenset(m.kind for m in members)
        if kinds in self._known:
            return self._known[kinds]
        self.effort.check(f"{' with '.join(m.tag for m in members) or 'the model'} was fitted")
        # an effect of a plug-in may raise anything: the others are compared all the same
        try:
            return self._known.setdefault(kinds, self.fit(members, start))
        except ValueError:
            return None  # its fields do not go together where the fit led
        except Exception as error:
            self.failed[members[-1].tag] = error_words(error)
            return None

    def attempt_without(self, found: FittedSet, member: Member) -> FittedSet | None:
        """Fit a set without one of its members, from where it is; None where that cannot be done."""
        return self.attempt(found.without(member.tag), found.fit.parameters)

    def beats(self, one: FittedSet, other: FittedSet, least: float = PRICE) -> bool:
        """Tell whether a set predicts better than another one, beyond chance and by so many nats at least."""
        rise, error = self.difference(one, other)
        return rise > max(CLEAR * error, least)

    def rise(self, one: FittedSet, other: FittedSet) -> float:
        """Return the score of one above that of the other, nats."""
        return self.difference(one, other)[0]

    def difference(self, one: FittedSet, other: FittedSet) -> tuple[float, float]:
        """Return the score of one above that of the other, nats, and its standard error."""
        apart = one.log_masses - other.log_masses
        seen = np.where(self.kept, self.test, 0)
        total = np.maximum(seen.sum(axis=1), 1)
        sums = (seen * apart).sum(axis=1)
        variance = (seen * apart**2).sum(axis=1) - sums**2 / total
        return float(sums.sum()), float(np.sqrt(max(variance.sum(), 0.0)))

    def gap(self, found: FittedSet) -> float:
        """Return the distance of the scored part from the set beyond chance, nats per sample that counts."""
        total = np.where(self.kept, self.test, 0).sum(axis=1, keepdims=True)
        chance = chance_of_cells(np.where(self.kept, np.exp(found.log_masses), 0.0) * total)
        # a fitted parameter costs half a nat on samples that were not fitted; the fixed total saves as much
        own = found.fit.theta.shape[0] * self.samples.n_free
        chance += 0.5 * float(own - total.size + found.fit.shared.size)
        return float(saturated(self.test, self.kept).sum() - found.score - chance) / max(self.n_test, 1.0)

    def promising(self, base: FittedSet, candidates: Sequence[Member]) -> list[Member]:
        """Return candidates, each moved by a first-order step, by the rise that this step promises."""
        problem = self.problem(base.members)
        theta = self.samples.theta(base.fit.parameters)
        tangent, still = Tangent.at(problem, theta, base.fit.shared), np.zeros(theta.shape[0])
        # of the candidate's strength and the pixels' own parameters; what is in the set stays
        alone = replace(problem, bounds=np.array([[-np.inf, np.inf]]))
        ranked = []
        for member in candidates:
            if any(member.excludes(m) for m in base.members) or member.tag in self.failed:
                continue
            try:
                slope, step = self._slope(base, theta, member, tangent.log_masses)
            # an effect of a plug-in may raise anything: the others are compared all the same
            except Exception as error:
                self.failed[member.tag] = error_words(error)
                continue
            derivatives = np.concatenate([tangent.derivatives[:, :4], slope[:, None, :]], axis=1)
            slopes = Tangent(alone, tangent.log_masses, derivatives, np.zeros(1)).slopes(self.train)
            variance = float(slopes.covariance()[1][0, 0])
            length = float(slopes.step(still)[1][0]) if variance > 0.0 else 0.0
            rise = 0.5 * length**2 / variance if variance > 0.0 else 0.0
            if not member.coordinates:
                ranked.append((np.inf, member))
            elif length * step > 0 or member.coordinates[0].bounds[0] < 0:
                ranked.append((rise, _placed(member, length)))
        ranked.sort(key=lambda pair: -pair[0])
        return [member for _, member in ranked]

    def _slope(
        self, base: FittedSet, theta: FloatArray, member: Member, log_masses: FloatArray
    ) -> tuple[FloatArray, float]:
        """Return the derivative of the log masses in a candidate's strength near none of it."""
        shared, step = np.zeros(0), 1.0
        if member.coordinates:
            shared = member.start.copy()
            shared[0] *= _SECANT
            step = float(shared[0])
        problem = self.problem((*base.members, member))
        moved = problem.log_masses(theta, np.concatenate([base.fit.shared, shared]))
        return (moved - log_masses) / step, step


def _placed(member: Member, length: float) -> Member:
    """Return the member with the strength that a step leads to, where its limits allow."""
    start = member.start
    first = member.coordinates[0]
    low, high = (0.5 * b for b in first.bounds)
    start[0] = float(np.clip(length, max(low, -50.0 * abs(start[0])), min(high, 50.0 * abs(start[0]))))
    try:
        return member.moved(start)
    except ValueError:
        return member


@dataclass(frozen=True)
class Choice:
    """What the comparison of the sets came to.

    Attributes:
        plain: the fit without candidates.
        best: the chosen set, perhaps empty.
        fitted: all sets fitted with one candidate, the best first.
    """

    plain: FittedSet
    best: FittedSet
    fitted: list[FittedSet]


def compare_sets(
    sets: SetComparison, candidates: Sequence[Member], *, largest: int = _LARGEST_SET, coarse: bool = False
) -> Choice:
    """Select effects forward while the score improves by more than chance, with swaps, then eliminate them.

    Effects that leave most of the gap are not what is missing: nothing is put on top of them.

    Args:
        sets: fits and scores them.
        candidates: starts; several may be of one effect.
        largest: size of the set.
        coarse: end where little of the gap is left, since the rest is no matter of known effects.
    """
    plain = best = sets.fit(())
    at_first = sets.gap(plain)
    first: list[FittedSet] = []
    while len(best.members) < largest and not (coarse and sets.gap(best) < _HARDLY * at_first):
        extended = _additions(sets, best, candidates)
        if best is plain:
            first = extended
        if not extended or not sets.beats(extended[0], best):
            break
        best = _swapped(sets, extended[0], plain, candidates)
        if sets.gap(best) > _HOPELESS[len(best.members)] * at_first:
            break
    return Choice(plain, of_best_kind(sets, _backward_eliminate(sets, best, plain), candidates), first)


def _additions(
    sets: SetComparison, base: FittedSet, candidates: Sequence[Member], most: int = _FITTED
) -> list[FittedSet]:
    """Fit the set with each of the most promising candidates, the best start of each, the best first."""
    found: dict[str, FittedSet] = {}
    for member in sets.promising(base, candidates):
        if len(found) == most:
            break
        if member.tag not in found:
            fitted = sets.attempt((*base.members, member), base.fit.parameters)
            if fitted is not None:
                found[member.tag] = fitted
    return sorted(found.values(), key=lambda s: -s.score)


def _swapped(
    sets: SetComparison, best: FittedSet, plain: FittedSet, candidates: Sequence[Member]
) -> FittedSet:
    """Exchange earlier members that have come to matter little for others, where that is better."""
    whole = sets.rise(best, plain)
    for member in best.members[:-1]:
        base = sets.attempt_without(best, member)
        if base is None or sets.rise(best, base) > SWAPPED * whole:
            continue
        for fitted in _additions(sets, base, candidates, 2)[:1]:
            if member.tag not in fitted.tags and sets.beats(fitted, best):
                return fitted
    return best


def of_best_kind(sets: SetComparison, best: FittedSet, candidates: Sequence[Member]) -> FittedSet:
    """Try other kinds of the effects in a set (a law of growth, a bit)."""
    for member in best.members:
        kinds = {c.kind: c for c in candidates if c.tag == member.tag and c.kind != member.kind}
        for other in list(kinds.values())[:_FITTED]:
            fitted = sets.attempt((*best.without(member.tag), other), best.fit.parameters)
            if fitted is not None and fitted.score > best.score:
                best = fitted
    return best


def _backward_eliminate(sets: SetComparison, best: FittedSet, plain: FittedSet) -> FittedSet:
    """Leave out members that the set does as well without."""
    whole = sets.rise(best, plain)
    for member in reversed(best.members):
        if len(best.members) < 2:
            break
        without = sets.attempt_without(best, member)
        if without is None:
            continue
        misfits = sets.gap(best) > _HARDLY * sets.gap(plain)
        small = misfits and sets.rise(best, without) < _HARDLY * whole
        if small or not sets.beats(best, without):
            best = without
    return best


def find_rivals(
    sets: SetComparison, best: FittedSet, member: Member, candidates: Sequence[Member]
) -> tuple[FittedSet | None, list[FittedSet]]:
    """Return the set without a member, and sets with another effect in its place, the best first."""
    base = sets.attempt_without(best, member)
    if base is None:
        return None, []
    wanted = [c for c in candidates if c.tag != member.tag]
    return base, _additions(sets, base, wanted, MOST_RIVALS)
