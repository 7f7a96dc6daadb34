"""Which effects explain histograms: on all codes if that succeeds, else on the codes that are understood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.build_verdict import LARGEST_REST
from pchem_pipeline.discrepancy.by_likelihood.comb import (
    Interval,
    doubtful_peaks,
    electrons_of,
    inside,
    valleys,
)
from pchem_pipeline.discrepancy.by_likelihood.gap import LikelihoodGap
from pchem_pipeline.discrepancy.by_likelihood.members import FARTHEST, Member
from pchem_pipeline.discrepancy.by_likelihood.sets import (
    SWAPPED,
    Choice,
    FittedSet,
    SetComparison,
    compare_sets,
    find_rivals,
    of_best_kind,
)
from pchem_pipeline.model.arithmetic.significance import CLEAR

FloatArray = NDArray[np.float64]

_PAYS = 0.5  # of the gap: more must go with a peak that is set aside
_PEAKS_TRIED = 3
_COINCIDE = 0.3  # e-


@dataclass(frozen=True)
class Named:
    """An effect of the explanation.

    Attributes:
        member: as fitted.
        apart: by how much its strength differs when fewer codes are compared.
        rivals: effects that could stand in its place, the best first, with how far the set with each is
            behind the judged one, nats, and the standard error.
        equals: rivals (tags) that do as well within three standard errors.
        weight: what it adds to the score, nats.
    """

    member: Member
    apart: float
    rivals: tuple[tuple[Member, float, float], ...]
    equals: tuple[str, ...]
    weight: float


@dataclass(frozen=True)
class Explanation:
    """What the search came to.

    Attributes:
        sets: fitted and scored on the codes on which effects were compared.
        kept: codes that the gap compares, shape (n, B): all but a peak set aside.
        set_aside: codes that the fit leaves out.
        plain: the fit without effects to all codes.
        best: the named effects, fitted to the codes that the gap compares.
        judged: the set in which they were compared, perhaps with unsteady members.
        named: its effects, the weightiest first.
        unsteady: effects that fit in one view and not in another: stand-ins of something unknown.
        nearest: tags of the best single effects on all codes.
        rest: share of the gap that the judged set leaves among the codes of the sets.
    """

    sets: SetComparison
    kept: NDArray[np.bool_]
    set_aside: tuple[Interval, ...]
    plain: FittedSet
    best: FittedSet
    judged: FittedSet
    named: tuple[Named, ...]
    unsteady: tuple[Member, ...]
    nearest: tuple[str, ...]
    rest: float

    @property
    def peak(self) -> Interval | None:
        """The peak that was set aside."""
        return self.set_aside[0] if self.set_aside else None


def explain(
    sets: SetComparison, candidates: Sequence[Member], replicates: int, rng: np.random.Generator
) -> Explanation:
    """Find the effects that explain histograms.

    Args:
        sets: with all codes.
        candidates: effects at their starts.
        replicates: behind what chance leaves.
        rng: their random numbers.
    """
    choice = compare_sets(sets, candidates)
    nearest = tuple(m.tag for s in choice.fitted[:3] for m in s.members)
    left, floor = _left(sets, choice.best, replicates, rng)
    if left > floor and any(m.tabulated for m in choice.best.members):
        candidates = [c for c in candidates if not c.tabulated]
        choice = compare_sets(sets, candidates)
        left, floor = _left(sets, choice.best, replicates, rng)
    at_first = max(sets.gap(choice.plain), 1e-12)
    if choice.best.members and left <= max(floor, LARGEST_REST * at_first):
        named = [_named(sets, choice.best, m, candidates) for m in choice.best.members]
        return Explanation(
            sets, sets.kept, (), choice.plain, choice.best, choice.best, _sorted(named), (), nearest,
            left / at_first,
        )  # fmt: skip
    fixed_in_dn = combs_coincide(choice.plain.fit.parameters)
    pool = [c for c in candidates if not (c.tabulated or (fixed_in_dn and c.bends_codes))]
    return _narrowed(sets, pool, choice, nearest)


def _left(
    sets: SetComparison, best: FittedSet, replicates: int, rng: np.random.Generator
) -> tuple[float, float]:
    """Return the gap that a set leaves on the scored part, and its floor, nats per sample."""
    gaps = LikelihoodGap(sets.test, sets.kept, 0.0, replicates, rng)
    gap = gaps.gap(sets.problem(best.members), best.fit)
    return gap.value, gap.floor


def combs_coincide(parameters: FloatArray) -> bool:
    """Tell whether the peaks of all pixels lie at the same DN: codes cannot be told from electrons then.

    Args:
        parameters: (H, g, mu, sigma) of the pixels, shape (n, 4).
    """
    gain, bias = np.median(parameters[:, 1]), parameters[:, 2]
    return bool(np.ptp(np.quantile(bias, [0.1, 0.9])) * gain < _COINCIDE)


def _narrowed(
    sets: SetComparison, candidates: Sequence[Member], whole: Choice, nearest: tuple[str, ...]
) -> Explanation:
    """Compare on the codes that are understood, and keep what holds on more of them."""
    plain = whole.plain
    parameters = plain.fit.parameters
    electrons = electrons_of(sets.origin, sets.train.shape[1], parameters)
    peak = _cut_peak(sets, electrons, candidates, whole)
    between = valleys(sets, electrons, float(np.median(parameters[:, 1] * parameters[:, 3])))
    wide = sets.on(~inside(peak, electrons), parameters)
    view = sets.on(~inside(peak + between, electrons), parameters)
    choice = compare_sets(view, candidates, coarse=True)
    steady, unsteady = _steady(wide, choice.best, candidates)
    rest = view.gap(choice.best) / max(view.gap(choice.plain), 1e-12)
    named: list[Named] = []
    best = wide.fit((), parameters)
    if steady:
        start = choice.best.fit.parameters
        fitted = wide.attempt(steady, start)
        best = best if fitted is None else of_best_kind(wide, fitted, candidates)
        there = view.attempt(best.members, start)
        for member in best.members:
            told, apart = choice.best.member(member.tag), 0.0
            assert told is not None  # another kind of it at most
            if there is not None and (other := there.member(member.tag)) is not None:
                apart = _apart(member, other)
            named.append(replace(_named(view, choice.best, told, candidates), member=member, apart=apart))
    return Explanation(
        view, wide.kept, peak, plain, best, choice.best, _sorted(named), tuple(unsteady), nearest, rest
    )


def _cut_peak(
    sets: SetComparison, electrons: FloatArray, candidates: Sequence[Member], whole: Choice
) -> tuple[Interval, ...]:
    """Return the peak without which known effects explain far more, if there is one."""
    best, found = _PAYS * sets.gap(whole.best) * sets.n_test, None
    for interval in doubtful_peaks(sets, electrons)[:_PEAKS_TRIED]:
        view = sets.on(~interval.holds(electrons), whole.plain.fit.parameters)
        left = view.gap(compare_sets(view, candidates, largest=2, coarse=True).best) * view.n_test
        if left < best:
            best, found = left, interval
    return () if found is None else (found,)


def _apart(member: Member, there: Member) -> float:
    """Return how far the strengths of two fits of an effect are apart."""
    name = member.effect.strength
    return abs(float(getattr(member.effect, name)) - float(getattr(there.effect, name))) if name else 0.0


def _steady(
    wide: SetComparison, best: FittedSet, candidates: Sequence[Member]
) -> tuple[list[Member], list[Member]]:
    """Split a set into members that hold on more codes, as fitted there, and those that do not.

    On more codes each member may be exchanged for another effect; those for which one does better, and those
    that change their sign or their strength, stand in for something else.
    """
    fitted = wide.attempt(best.members, best.fit.parameters) if best.members else None
    if fitted is None:
        return [], list(best.members)
    fitted = _exchanged(wide, fitted, candidates)
    steady: list[Member] = []
    unsteady: list[Member] = []
    for member in best.members:
        other = fitted.member(member.tag)
        if other is None or other.at_limit or member.at_limit or not _alike(member, other):
            unsteady.append(member)
            continue
        without = wide.attempt_without(fitted, member)
        better = without is not None and wide.beats(fitted, without, 0.0)
        (steady if better else unsteady).append(other)
    return steady, unsteady


def _exchanged(wide: SetComparison, fitted: FittedSet, candidates: Sequence[Member]) -> FittedSet:
    """Exchange one member of a set for another effect while that is better."""
    plain = wide.fit((), fitted.fit.parameters)
    for _ in fitted.members:
        offers = []
        whole = wide.rise(fitted, plain)
        for member in fitted.members:
            base = wide.attempt_without(fitted, member)
            if base is not None and wide.rise(fitted, base) < SWAPPED * whole:
                offers += find_rivals(wide, fitted, member, candidates)[1][:1]
        best = max(offers, key=lambda s: s.score, default=fitted)
        if not wide.beats(best, fitted, 0.0):
            break
        fitted = best
    return fitted


def _alike(one: Member, other: Member) -> bool:
    """Tell whether two fits of an effect agree in sign and roughly in strength."""
    if not one.effect.strength or one.kind != other.kind:
        return True
    a, b = (float(getattr(m.effect, m.effect.strength)) for m in (one, other))
    return a * b > 0 and max(abs(a), abs(b)) < FARTHEST * min(abs(a), abs(b))


def _named(sets: SetComparison, best: FittedSet, member: Member, candidates: Sequence[Member]) -> Named:
    """Compare a member of a set with what could stand in its place."""
    without, found = find_rivals(sets, best, member, candidates)
    rivals = tuple(
        (other, *sets.difference(rival, best)) for rival in found if (other := rival.new(best)) is not None
    )
    equals = tuple(other.tag for other, behind, error in rivals if -behind < CLEAR * error)
    return Named(member, 0.0, rivals, equals, sets.rise(best, without) if without else 0.0)


def _sorted(named: Sequence[Named]) -> tuple[Named, ...]:
    return tuple(sorted(named, key=lambda n: -n.weight))
