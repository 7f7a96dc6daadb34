"""Which effects explain histograms: on all codes if that succeeds, else on the codes that are understood."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.discrepancy.build_verdict import LARGEST_REST
from pchem_pipeline.discrepancy.by_likelihood.comb import doubtful_peaks, valleys
from pchem_pipeline.discrepancy.by_likelihood.members import FARTHEST, Member
from pchem_pipeline.discrepancy.by_likelihood.sets import FittedSet, SetComparison, select
from pchem_pipeline.model.arithmetic.significance import CLEAR
from pchem_pipeline.model.fit.guard import Interval, electrons_of, inside

_PAYS = 0.5  # of the gap: more must go with a peak that is set aside
_PEAKS_TRIED = 3
_COINCIDE = 0.3  # e-


@dataclass(frozen=True)
class Named:
    """An effect of the explanation, and the rivals that could stand in its place, the best first.

    With each rival is the gain of the set with it over the chosen one, nats, and its standard error.
    """

    member: Member
    rivals: tuple[tuple[Member, float, float], ...]
    apart: float = 0.0  # by how much its strength differs when fewer codes are compared

    @property
    def equals(self) -> tuple[str, ...]:
        """The rivals (tags) that do as well within three standard errors."""
        return tuple(other.tag for other, behind, error in self.rivals if -behind < CLEAR * error)


@dataclass(frozen=True)
class Explanation:
    """What the search found."""

    kept: BoolArray  # codes that the gap compares, (n, B): all but a peak set aside
    set_aside: tuple[Interval, ...]  # codes that the fit leaves out
    best: FittedSet  # the named effects, fitted to the codes that the gap compares
    named: tuple[Named, ...]  # its effects, the weightiest first, each with its rivals
    stand_ins: tuple[str, ...]  # tags of effects that fit in one view and not in another
    rest: float  # share of the gap that is left among the codes on which effects were compared
    rise: tuple[float, float]  # gain of the set over none on these codes, nats, and its standard error


def explain(sets: SetComparison, candidates: Sequence[Member]) -> Explanation:
    """Find the effects, among candidates at their starts, that explain histograms on all codes or fewer."""
    best = select(sets, candidates)
    right = best
    if sets.samples.n == 1 and best.members:  # bias frames leave no choice of the bias
        right = sets.with_right_peaks(best)
    if right is not best:
        moved = replace(sets, start=right.fit.parameters)
        again = select(moved, candidates)
        # what misfits all the same may be anything, such as a peak of no electron that is cut
        if moved.gap(again).at_floor:
            sets, best = moved, again
    rest, rise = _rest(sets, best), sets.difference(best, sets.plain)
    if best.members and (rest <= LARGEST_REST or sets.gap(best).at_floor):
        named = tuple(_named(sets, best, candidates))
        return Explanation(sets.kept, (), best, named, (), rest, rise)
    fixed_in_dn = combs_coincide(sets.plain.fit.parameters)
    pool = [c for c in candidates if not (c.tabulated or (fixed_in_dn and c.law.edge_shift.size))]
    return _narrowed(sets, pool)


def _rest(sets: SetComparison, best: FittedSet) -> float:
    """Return the share of the gap of the plain law that a set leaves."""
    return sets.gap(best).value / max(sets.gap(sets.plain).value, 1e-12)


def combs_coincide(parameters: FloatArray) -> bool:
    """Return whether peaks of pixels (n, 4) lie at the same DN: codes cannot be told from electrons then."""
    gain, bias = np.median(parameters[:, 1]), parameters[:, 2]
    return bool(np.ptp(np.quantile(bias, [0.1, 0.9])) * gain < _COINCIDE)


def _narrowed(sets: SetComparison, candidates: Sequence[Member]) -> Explanation:
    """Select on the codes that are understood, and keep what is selected on more of them, too."""
    parameters = sets.plain.fit.parameters
    electrons = electrons_of(sets.origin, sets.train.shape[1], parameters[:, 1], parameters[:, 2])

    def excluding(*intervals: Interval) -> SetComparison:
        return replace(sets, kept=~inside(intervals, electrons), start=parameters)

    excess = _excess(sets, select(sets, candidates))
    peak = _cut_peak({p: excluding(p) for p in doubtful_peaks(sets.train, electrons)}, candidates, excess)
    between = valleys(sets.train, electrons, float(np.median(parameters[:, 1] * parameters[:, 3])))
    wide, view = excluding(*peak), excluding(*peak, *between)
    judged = select(view, candidates)
    there = wide.attempt(judged.members, judged.fit.parameters)
    there = select(wide, candidates, there, len(judged.members))
    steady = [other for m in judged.members if (other := there.member(m.tag)) and _alike(m, other)]
    best = wide.attempt(steady, judged.fit.parameters) or wide.plain
    again = view.attempt(best.members, judged.fit.parameters) or judged
    named = tuple(
        replace(one, member=fitted, apart=_apart(fitted, other))
        for one in _named(view, judged, candidates)
        if (fitted := best.member(one.member.tag)) and (other := again.member(one.member.tag))
    )
    stand_ins = tuple(m.tag for m in judged.members if best.member(m.tag) is None)
    rest, rise = _rest(view, judged), view.difference(judged, view.plain)
    return Explanation(wide.kept, peak, best, named, stand_ins, rest, rise)


def _cut_peak(
    views: Mapping[Interval, SetComparison], candidates: Sequence[Member], excess: float
) -> tuple[Interval, ...]:
    """Return the peak that views leave out without which a candidate leaves far less than an excess, nats."""
    likely = sorted(views, key=lambda peak: _excess(views[peak], views[peak].plain))[:_PEAKS_TRIED]
    left = {p: _excess(views[p], select(views[p], candidates, largest=1)) for p in likely}
    best = min(left, key=lambda peak: left[peak], default=None)
    return () if best is None or left[best] >= _PAYS * excess else (best,)


def _excess(sets: SetComparison, found: FittedSet) -> float:
    """Return the gap that a set leaves, nats of all samples together."""
    return sets.gap(found).value * float(np.where(sets.kept, sets.test, 0).sum())


def _apart(member: Member, there: Member) -> float:
    """Return how far the strengths of two fits of an effect are apart."""
    name = member.effect.strength
    return abs(float(getattr(member.effect, name)) - float(getattr(there.effect, name))) if name else 0.0


def _alike(one: Member, other: Member) -> bool:
    """Return whether two fits of an effect agree in sign and roughly in strength, neither at a limit."""
    if one.at_limit or other.at_limit:
        return False
    if not one.effect.strength or one.kind != other.kind:
        return True
    a, b = (float(getattr(m.effect, m.effect.strength)) for m in (one, other))
    return a * b > 0 and max(abs(a), abs(b)) < FARTHEST * min(abs(a), abs(b))


def _named(sets: SetComparison, best: FittedSet, candidates: Sequence[Member]) -> list[Named]:
    """Return the members of a set with what could stand in their places, the weightiest first."""
    found = []
    for member in best.members:
        others = [c for c in candidates if c.tag != member.tag]
        without = sets.without(best, member.tag)
        instead = [] if without is None else sets.extended(without, others)
        rivals = tuple((one.members[-1], *sets.difference(one, best)) for one in instead)
        found.append((best.score if without is None else without.score, Named(member, rivals)))
    return [named for _, named in sorted(found, key=lambda pair: pair[0])]
