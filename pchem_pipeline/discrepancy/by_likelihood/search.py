"""Which effects explain histograms: on all codes if that succeeds, else on the codes that are understood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.build_verdict import LARGEST_REST
from pchem_pipeline.discrepancy.by_likelihood.comb import doubtful_peaks, places_of, valleys
from pchem_pipeline.discrepancy.by_likelihood.members import FARTHEST, Member
from pchem_pipeline.discrepancy.by_likelihood.sets import FittedSet, SetComparison, select
from pchem_pipeline.model.arithmetic.significance import CLEAR
from pchem_pipeline.model.fit.excluding_codes import Interval, inside

FloatArray = NDArray[np.float64]

_PAYS = 0.5  # of the gap: more must go with a peak that is set aside
_PEAKS_TRIED = 3
_COINCIDE = 0.3  # e-


@dataclass(frozen=True)
class Named:
    """An effect of the explanation.

    Attributes:
        member: as fitted.
        weight: what it adds to the score, nats.
        rivals: effects that could stand in its place, the best first, with how far the set with each is
            behind the judged one, nats, and the standard error.
        apart: by how much its strength differs when fewer codes are compared.
    """

    member: Member
    weight: float
    rivals: tuple[tuple[Member, float, float], ...]
    apart: float = 0.0

    @property
    def equals(self) -> tuple[str, ...]:
        """The rivals (tags) that do as well within three standard errors."""
        return tuple(other.tag for other, behind, error in self.rivals if -behind < CLEAR * error)


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


def explain(sets: SetComparison, candidates: Sequence[Member]) -> Explanation:
    """Find the effects that explain histograms.

    Args:
        sets: with all codes.
        candidates: effects at their starts.
    """
    plain = sets.fit(())
    nearest = tuple(m.tag for one in sets.extended(plain, candidates) for m in one.members)
    for pool in (candidates, [c for c in candidates if not c.tabulated]):
        best = select(sets, pool)
        gap, rest = sets.distance(best).gap, _rest(sets, best, plain)
        if best.members and (gap.at_floor or rest <= LARGEST_REST):
            named = _named(sets, best, candidates)
            return Explanation(sets, sets.kept, (), plain, best, best, named, (), nearest, rest)
    fixed_in_dn = combs_coincide(plain.fit.parameters)
    pool = [c for c in pool if not (fixed_in_dn and c.law.edge_shift.size)]
    return _narrowed(sets, pool, plain, best, nearest)


def _rest(sets: SetComparison, best: FittedSet, plain: FittedSet) -> float:
    """Return the share of the gap of the plain law that a set leaves."""
    left, whole = (sets.distance(one).gap.value for one in (best, plain))
    return left / max(whole, 1e-12)


def combs_coincide(parameters: FloatArray) -> bool:
    """Tell whether the peaks of all pixels lie at the same DN: codes cannot be told from electrons then.

    Args:
        parameters: (H, g, mu, sigma) of the pixels, shape (n, 4).
    """
    gain, bias = np.median(parameters[:, 1]), parameters[:, 2]
    return bool(np.ptp(np.quantile(bias, [0.1, 0.9])) * gain < _COINCIDE)


def _narrowed(
    sets: SetComparison,
    candidates: Sequence[Member],
    plain: FittedSet,
    whole: FittedSet,
    nearest: tuple[str, ...],
) -> Explanation:
    """Select on the codes that are understood, and keep what is selected on more of them, too."""
    parameters = plain.fit.parameters
    electrons = places_of(sets.origin, sets.train.shape[1], parameters)
    peak = _cut_peak(sets, electrons, candidates, whole)
    between = valleys(sets, electrons, float(np.median(parameters[:, 1] * parameters[:, 3])))
    wide = sets.on(~inside(peak, electrons), parameters)
    view = sets.on(~inside((*peak, *between), electrons), parameters)
    judged = select(view, candidates)
    there = wide.attempt(judged.members, judged.fit.parameters)
    there = (
        wide.fit((), parameters)
        if there is None
        else select(wide, candidates, there, largest=len(there.members), least=0.0)
    )
    steady = [m for m in judged.members if (other := there.member(m.tag)) and _alike(m, other)]
    unsteady = tuple(m for m in judged.members if m not in steady)
    best = wide.fit([there.member(m.tag) or m for m in steady], parameters)
    again = view.fit(best.members, parameters)
    named = [
        replace(one, member=fitted, apart=_apart(fitted, other))
        for one in _named(view, judged, candidates)
        if (fitted := best.member(one.member.tag)) and (other := again.member(one.member.tag))
    ]
    rest = _rest(view, judged, view.fit(()))
    return Explanation(view, wide.kept, peak, plain, best, judged, tuple(named), unsteady, nearest, rest)


def _cut_peak(
    sets: SetComparison, electrons: FloatArray, candidates: Sequence[Member], whole: FittedSet
) -> tuple[Interval, ...]:
    """Return the peak without which known effects explain far more, if there is one."""
    views = [
        (sets.on(~inside([peak], electrons), whole.fit.parameters), peak)
        for peak in doubtful_peaks(sets, electrons)
    ]
    views.sort(key=lambda pair: _nats(pair[0], pair[0].fit(())))
    least, found = _PAYS * _nats(sets, whole), None
    for view, peak in views[:_PEAKS_TRIED]:
        left = _nats(view, select(view, candidates, largest=1))
        if left < least:
            least, found = left, peak
    return () if found is None else (found,)


def _nats(sets: SetComparison, found: FittedSet) -> float:
    """Return the gap that a set leaves, of all samples together."""
    return sets.distance(found).gap.value * sets.n_test


def _apart(member: Member, there: Member) -> float:
    """Return how far the strengths of two fits of an effect are apart."""
    name = member.effect.strength
    return abs(float(getattr(member.effect, name)) - float(getattr(there.effect, name))) if name else 0.0


def _alike(one: Member, other: Member) -> bool:
    """Tell whether two fits of an effect agree in sign and roughly in strength, neither at a limit."""
    if one.at_limit or other.at_limit:
        return False
    if not one.effect.strength or one.kind != other.kind:
        return True
    a, b = (float(getattr(m.effect, m.effect.strength)) for m in (one, other))
    return a * b > 0 and max(abs(a), abs(b)) < FARTHEST * min(abs(a), abs(b))


def _named(sets: SetComparison, best: FittedSet, candidates: Sequence[Member]) -> tuple[Named, ...]:
    """Return the members of a set with what could stand in their places, the weightiest first."""
    found = []
    for member in best.members:
        without = sets.without(best, member.tag)
        if without is None:
            found.append(Named(member, 0.0, ()))
            continue
        others = [c for c in candidates if c.tag != member.tag]
        rivals = [(one.members[-1], *sets.difference(one, best)) for one in sets.extended(without, others)]
        found.append(Named(member, best.score - without.score, tuple(rivals)))
    return tuple(sorted(found, key=lambda n: -n.weight))
