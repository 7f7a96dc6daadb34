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

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.base.errors import error_words
from pchem_pipeline.discrepancy.by_likelihood.gap import gap_of, sum_over_samples
from pchem_pipeline.discrepancy.by_likelihood.members import Member, law_of, split_coordinates
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import CLEARLY, shift_bias_by_electrons
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.model.arithmetic.significance import CLEAR, PRICE
from pchem_pipeline.model.fit.shared import Ascent, Samples, SharedFit, SharedProblem, fit_shared
from pchem_pipeline.model.law.sample_law import SampleLaw

_LARGEST_SET = 4  # effects
_LEAST_SHARE = 0.05  # of what a set that misfits explains, that each of its effects must
_FITTED = 3  # candidates fitted in full, of those that a first-order step promises most of
_TOLERANCE = 0.02  # nats; of a misfit more, since it is known no better
_TOLERANCE_PER_SAMPLE = 1e-6
_MOST_STEPS = 20
PROBED = 64  # pixels that tell first whether a long fit is worth it
_SECANT = 0.1  # of the start: where the slope at no effect is taken


@dataclass(frozen=True)
class FittedSet:
    """A set of candidates at their fitted coordinates; its score is the log-likelihood of the other part."""

    members: tuple[Member, ...]
    fit: SharedFit
    log_masses: FloatArray  # of the codes, (n, B)
    score: float  # nats

    @property
    def n_parameters(self) -> int:
        """Number of fitted parameters, those of the pixels included."""
        return int(self.fit.theta.shape[0] * self.fit.samples.n_free + self.fit.shared.size)

    @property
    def kinds(self) -> frozenset[str]:
        """The members without what is fitted."""
        return frozenset(m.kind for m in self.members)

    def member(self, tag: str) -> Member | None:
        """Return a member; None: it has none of that tag."""
        return next((m for m in self.members if m.tag == tag), None)

    def likelier_than(self, other: FittedSet) -> BoolArray:
        """Return which pixels it explains clearly better than another fit, (n,)."""
        return np.asarray(self.fit.log_likelihood > other.fit.log_likelihood + CLEARLY)

    def stderr(self, member: Member) -> dict[str, float]:
        """Return the standard errors of the fitted fields of one of the members."""
        parts = split_coordinates(self.members, np.sqrt(np.diag(self.fit.covariance)))
        errors = zip(member.coordinates, member.start, parts[self.members.index(member)], strict=True)
        return {c.name: c.stderr(float(at), float(error)) for c, at, error in errors}


@dataclass
class SetComparison:
    """Fits sets of effects to one part of the samples and scores them on another."""

    train: IntArray  # histograms, (n, B); a row for each sample of each pixel
    test: IntArray  # the same
    origin: IntArray  # DN of bin 0, (n,)
    kept: BoolArray  # codes that count, (n, B)
    present: tuple[Effect, ...]  # effects that the model has
    start: FloatArray  # (H, g, mu, sigma), (n, 4)
    samples: Samples = field(default_factory=Samples)  # which rows are of one pixel
    failed: dict[str, str] = field(default_factory=dict)  # candidates that could not be fitted, and why; out
    effort: Effort = field(default_factory=lambda: Effort(None))  # ends the search at its limit
    _known: dict[frozenset[str], FittedSet] = field(default_factory=dict, init=False)

    def of(self, rows: slice, start: FloatArray) -> SetComparison:
        """Return the same of some of the rows, with another start (n, 4)."""
        taken = {name: getattr(self, name)[rows] for name in ("train", "test", "origin", "kept")}
        return replace(self, **taken, start=start[rows])

    @functools.cached_property
    def plain(self) -> FittedSet:
        """The fit without candidates."""
        return self.fit(())

    def problem(self, members: Sequence[Member]) -> SharedProblem:
        """Return what a set is fitted to."""
        tags = [m.tag for m in members]

        def law(shared: FloatArray, own: FloatArray) -> SampleLaw:
            found = law_of(self.present, members, shared, own, self.samples)
            self.effort.evaluate(self.train.size, found.components, tags)
            return found

        coordinates = [c for m in members for c in m.coordinates]
        return SharedProblem(
            self.train,
            self.origin,
            self.kept,
            law,
            np.array([c.bounds for c in coordinates], np.float64).reshape(-1, 2),
            np.concatenate([np.zeros(0), *(m.scale for m in members)]),
            self.samples,
        )

    def fit(self, members: Sequence[Member], start: FloatArray | None = None) -> FittedSet:
        """Fit a set from the starts of its members and (H, g, mu, sigma), (n, 4); effects may raise."""
        problem = self.problem(members)
        shared = np.concatenate([np.zeros(0), *(m.start for m in members)])
        tolerance = max(_TOLERANCE, _TOLERANCE_PER_SAMPLE * float(np.where(self.kept, self.test, 0).sum()))
        own = self.start if start is None else start
        fit = fit_shared(problem, own, shared, tolerance=tolerance, max_steps=_MOST_STEPS)
        parts = split_coordinates(members, fit.shared)
        moved = tuple(m.moved(part) for m, part in zip(members, parts, strict=True))
        log_masses = problem.log_masses(fit.theta, fit.shared)
        return FittedSet(moved, fit, log_masses, float((self.test * log_masses).sum()))

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

    def with_right_peaks(self, fitted: FittedSet) -> FittedSet:
        """Return a fit with the bias an electron off in the pixels where that is clearly likelier."""
        for electrons in (-1.0, 1.0):
            fitted = self._electrons_off(fitted, electrons)
        return fitted

    def _electrons_off(self, fitted: FittedSet, electrons: float) -> FittedSet:
        """Return the same with pixels whose bias is so many electrons lower, if it is in some probed ones."""
        if len(self.train) > 2 * PROBED:
            few = self.of(slice(None, None, len(self.train) // PROBED), fitted.fit.parameters)
            probe = few.fit(fitted.members)
            start = shift_bias_by_electrons(few.start, electrons)
            if not few.fit(fitted.members, start).likelier_than(probe).any():
                return fitted
        other = self.fit(fitted.members, shift_bias_by_electrons(fitted.fit.parameters, electrons))
        better = other.likelier_than(fitted)
        if not better.any():
            return fitted
        start = np.where(better[:, None], other.fit.parameters, fitted.fit.parameters)
        both = other if better.all() else self.fit(other.members, start)
        return max(fitted, other, both, key=lambda one: float(one.fit.log_likelihood.sum()))

    def extended(self, base: FittedSet, candidates: Sequence[Member], most: int = _FITTED) -> list[FittedSet]:
        """Fit a set with each of the most promising candidates, the best start of each, the best first."""
        found: dict[str, FittedSet] = {}
        for member in self.promising(base, candidates):
            if len(found) == most:
                break
            if member.tag not in found:
                fitted = self.attempt((*base.members, member), base.fit.parameters)
                if fitted is not None:
                    found[member.tag] = fitted
        return sorted(found.values(), key=lambda s: -s.score)

    def without(self, found: FittedSet, tag: str) -> FittedSet | None:
        """Fit a set without one of its members, from where it is; None where that cannot be done."""
        return self.attempt([m for m in found.members if m.tag != tag], found.fit.parameters)

    def beats(self, one: FittedSet, part: FittedSet, least: float = 0.0) -> bool:
        """Return whether a set predicts better than a part of it, beyond chance and by more than the price.

        And, where it misfits, by a ``least`` share of what it explains.
        """
        rise, error = self.difference(one, part)
        price = PRICE
        if least and not self.gap(one).at_floor:
            price = max(price, least * self.difference(one, self.plain)[0])
        return rise > max(CLEAR * error, price)

    def difference(self, one: FittedSet, other: FittedSet) -> tuple[float, float]:
        """Return the score of one above that of the other, nats, and its standard error."""
        seen = np.where(self.kept, self.test, 0)
        rise, variance = sum_over_samples(seen, one.log_masses - other.log_masses)
        return rise, float(np.sqrt(variance))

    def gap(self, found: FittedSet) -> Gap:
        """Return the gap of the scored part from a set."""
        share = float(self.test.sum() / self.train.sum())
        return gap_of(self.test, found.log_masses, found.n_parameters, share=share, kept=self.kept)

    def promising(self, base: FittedSet, candidates: Sequence[Member]) -> list[Member]:
        """Return candidates after a first-order step each, sorted by the rise that it promises (Rao 1948)."""
        theta = self.samples.theta(base.fit.parameters)
        slopes = self.problem(base.members).slopes(theta, base.fit.shared)
        ranked = []
        for member in candidates:
            if any(member.excludes(m) for m in base.members) or member.tag in self.failed:
                continue
            # an effect of a plug-in may raise anything: the others are compared all the same
            try:
                ranked.append(self._first_step(base, *slopes, member))
            except Exception as error:
                self.failed[member.tag] = error_words(error)
        ranked.sort(key=lambda pair: -pair[0])
        return [member for rise, member in ranked if rise >= 0.0]

    def _first_step(
        self, base: FittedSet, log_masses: FloatArray, derivatives: FloatArray, member: Member
    ) -> tuple[float, Member]:
        """Return the rise that a candidate promises, below 0 at negative strength, and the candidate then."""
        if not member.coordinates:
            return np.inf, member
        theta, shared = self.samples.theta(base.fit.parameters), member.start
        shared[0] *= _SECANT
        problem = self.problem((*base.members, member))
        moved = problem.log_masses(theta, np.concatenate([base.fit.shared, shared]))
        slope = (moved - log_masses) / shared[0]
        derivatives = np.concatenate([derivatives[:, :4], slope[:, None]], axis=1)
        expansion = problem.expansion(log_masses, derivatives)
        ascent = Ascent(theta, np.zeros(1), expansion, np.array([[-np.inf, np.inf]]), np.ones(1))
        variance = float(ascent.covariance()[1][0, 0])
        if not variance > 0.0:
            return 0.0, member
        length = float(ascent.step(np.zeros(theta.shape[0]))[1][0])
        if length * shared[0] <= 0 and member.coordinates[0].bounds[0] >= 0:
            return -1.0, member
        return 0.5 * length**2 / variance, member.placed(length)


def select(
    sets: SetComparison,
    candidates: Sequence[Member],
    start: FittedSet | None = None,
    largest: int = _LARGEST_SET,
) -> FittedSet:
    """Select effects stepwise (Efroymson 1960): one is added, else exchanged, else left out, while that pays.

    Several candidates may be of one effect; ``start`` None: no effect; a set has at most ``largest`` ones.
    """
    best, passed = start or sets.plain, set[frozenset[str]]()
    while best.kinds not in passed:
        passed.add(best.kinds)
        others = [c for c in candidates if c.kind not in best.kinds]
        steps = sets.extended(best, others) if len(best.members) < largest else []
        steps = [one for one in steps if sets.beats(one, best)]
        if not steps:
            smaller = [one for m in best.members if (one := sets.without(best, m.tag)) is not None]
            exchanged = [one for base in smaller for one in sets.extended(base, others, 1)]
            steps = [one for one in exchanged if one.score > best.score] or [
                one for one in smaller if not sets.beats(best, one, _LEAST_SHARE)
            ]
        best = max(steps, key=lambda one: one.score, default=best)
    return best
