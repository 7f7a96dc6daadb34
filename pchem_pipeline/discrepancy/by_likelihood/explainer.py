"""Comparison of effects in ready-made histograms by likelihood.

The samples of every pixel are split at random into three parts: one to fit, one to score, one for the final
gap. Effects enter the exact likelihood of the histograms (:mod:`pchem_pipeline.model.fit.shared`), so that no
simulation is needed to name them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.discrepancy.build_verdict import (
    LARGEST_REST,
    LEAVES_TOO_MUCH,
    Added,
    Addition,
    Fitted,
    largest_pulls,
)
from pchem_pipeline.discrepancy.by_likelihood.comb import find_residuals
from pchem_pipeline.discrepancy.by_likelihood.gap import on_all_codes
from pchem_pipeline.discrepancy.by_likelihood.members import Member, find_members
from pchem_pipeline.discrepancy.by_likelihood.observed import ObservedHistograms, SampleHistograms
from pchem_pipeline.discrepancy.by_likelihood.search import Explanation, Named, explain
from pchem_pipeline.discrepancy.by_likelihood.sets import FittedSet, SetComparison
from pchem_pipeline.discrepancy.by_simulation.candidates.candidates import candidate_classes
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import changes
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.null import CONVINCING, Measured, NullModel, as_matrix
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.skeleton import Explainer, Prepared, no_progress, search
from pchem_pipeline.discrepancy.verdict import Candidate, Discrepancy, Place, Pull, Rival
from pchem_pipeline.effects.framework.compose import along_chain
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.registry import effect_classes
from pchem_pipeline.effects.operators.fate import SpuriousCharge
from pchem_pipeline.model.arithmetic.significance import CLEAR
from pchem_pipeline.model.fit.shared import Samples

_SPURIOUS = SpuriousCharge.model_fields["tag"].default


def find_in_histograms(
    samples: Sequence[SampleHistograms],
    settings: DiscrepancySettings | None = None,
    *,
    model: Sequence[Effect] = (),
    width: int | None = None,
    progress: Callable[[str], None] = no_progress,
) -> Discrepancy:
    """Find where histograms disagree with the fitted model, name the effects, and add them.

    Several samples of the same pixels share g, mu and sigma: what looks alike in one exposure (branching and
    over-dispersion, say) depends on the exposure in its own way.

    Args:
        samples: one or more, of the same pixels.
        settings: the section ``discrepancy``; the defaults if None.
        model: effects that the model has already; none of them is added again.
        width: pixels in a row of the sensor; None: it has one row.
        progress: is given what is done next.

    Returns:
        The verdict, with everything that supports it.

    Raises:
        InputError: the samples are too few, or not of the same pixels.
        PchEmError: no pixel has a usable fit.
        ConfigError: a candidate is unknown.
    """
    settings = settings or DiscrepancySettings()
    classes = candidate_classes(settings)
    rng = np.random.default_rng(settings.seed)
    progress("computing the statistics of each part")
    observed = ObservedHistograms.of(samples, rng)
    times = [sample.integration_time for sample in samples]
    progress("simulating the fitted model")
    found = search(HistogramExplainer.begin(observed, settings, classes, tuple(model), times, rng), progress)
    n, n_illuminated = samples[0].counts.shape[0], sum(not sample.bias for sample in samples)
    row = width or n
    shape = n // row, row
    whole = (0, shape[0]), (0, row)
    verdict = found.verdict.on_sensor(shape, *whole, lambda _, x: divmod(x // n_illuminated, row))
    return replace(found, verdict=verdict)


@dataclass
class HistogramExplainer(Explainer[Explanation]):
    """Distinguishes effects in histograms."""

    prepared: Prepared  # the histograms, split, and replicates of the model
    observed: ObservedHistograms
    sets: SetComparison  # fits sets of effects to the train part, and scores them by the test part
    whole: SetComparison  # fits them to both, and scores them by the final part
    bare: SetComparison  # fits the rows without any effects
    rng: np.random.Generator
    members: Sequence[Member]  # the candidates
    effects: tuple[Effect, ...]  # of the model, those added included
    final: FittedSet  # the fit of the final model to train and test part
    found: Explanation | None = None  # what the search found; None: nothing

    @classmethod
    def begin(
        cls,
        observed: ObservedHistograms,
        settings: DiscrepancySettings,
        classes: Mapping[str, type[Effect]],
        model: tuple[Effect, ...],
        times: Sequence[float | None],
        rng: np.random.Generator,
    ) -> HistogramExplainer:
        """Fit the model to the train part, and observe histograms drawn from it, each with its own fit.

        ``times`` are the integration times of the samples of a pixel, s; None: not known.
        """
        effort = Effort(settings.effort)
        train, test, final = observed.parts
        every = np.ones(train.shape, np.bool_)
        own = observed.origin, every, model, observed.start, observed.layout
        defects: dict[str, str] = {}
        sets = SetComparison(train, test, *own, defects, effort)
        line = _on_a_line(sets, settings, times)
        if line is not None:
            sets, classes = line, {**classes, _SPURIOUS: SpuriousCharge}
        members, untestable = find_members(classes, observed.evidence, model, defects)
        always = {t: c.untestable for t, c in effect_classes().items() if c.untestable and t not in classes}
        bare = replace(sets, present=(), start=sets.plain.fit.parameters)
        seen = [observed.statistics(part, bare) for part in observed.parts]
        vectors = observed.drawn(sets.plain.log_masses, bare, settings.replicates, rng)
        names = tuple(name for name in STATISTICS if all(name in each for each in (*vectors, *seen)))
        whole = replace(sets, start=bare.start, train=train + test, test=final)
        effort.begin()
        first = NullModel.from_replicates(names, as_matrix(names, vectors), effects=bool(model))
        z = Measured(*(as_matrix(names, [row])[0] for row in seen))
        untestable = dict(sorted((always | untestable).items()))
        data = observed.evidence, observed.examined(), first, z, effort
        # what the parameters bend is no evidence against them: each candidate is fitted with them
        prepared = Prepared(settings, "histograms", *data, untestable, defects=defects)
        return cls(prepared, observed, sets, whole, bare, rng, members, model, whole.plain)

    @property
    def model(self) -> tuple[Effect, ...]:
        """The effects that are in the model now."""
        return self.effects

    def gap(self, null: NullModel) -> Gap:
        """Measure the gap of the likelihood on the final part."""
        return self.whole.gap(self.whole.plain)

    def suspects(self, null: NullModel) -> bool:
        """Return whether several samples fit badly together although no statistic of one deviates."""
        return self.observed.joint and not self.gap(null).at_floor

    def explain(self, null: NullModel, disagreed: bool) -> Explanation | None:
        """Find the set of effects that best predicts the test part, on the codes that are understood.

        Raises:
            EffortSpentError: the work is at its limit; nothing was found.
        """
        self.candidates = [m.tag for m in self.members]
        found = explain(self.sets, self.members)
        rise, error = found.rise
        if not disagreed and (not found.named or rise < max(CONVINCING, CLEAR * error)):
            return None
        self.found = found
        return found if found.named else None

    def add(self, explanation: Explanation, null: NullModel) -> NullModel:
        """Put the named effects into the model, and observe histograms drawn from it."""
        masses = on_all_codes(explanation.best.log_masses, explanation.kept, self.sets.plain.log_masses)
        vectors = self.observed.drawn(masses, self.bare, self.prepared.settings.replicates, self.rng)
        return NullModel.from_replicates(null.names, as_matrix(null.names, vectors), effects=True)

    def close(self, before: Gap, null: NullModel, disagreed: bool) -> Added:
        """Fit train and test part together with each effect, and measure the gap on the final part."""
        found, first, z = self.found, self.prepared.first, self.prepared.z
        if found is None:
            return Added((), before)
        pulls = [each.pulls(z.both, splits=2) for each in (first, null)]
        moved = largest_pulls(first.names, pulls[0], pulls[0], pulls[1])
        gap, fitted, start = before, self.whole.plain, found.best.fit.parameters
        additions: list[Addition] = []
        for named in found.named:
            extended = self.compared.fit((*fitted.members, named.member), start)
            after, rivals = self._gap(extended), self._rivals(named, fitted, start)
            additions.append(_addition(named, (gap, after), (fitted, extended), rivals, moved))
            gap, fitted = after, extended
        left = "" if found.rest <= LARGEST_REST or gap.at_floor else LEAVES_TOO_MUCH
        self.final = fitted
        self.effects = along_chain(self.sets.present, [each.effect for each in additions])
        return Added(
            additions=tuple(replace(each, against=left or each.against) for each in additions),
            after=gap,
            stand_ins=found.stand_ins,
            residuals=self._residuals(found) if disagreed or not gap.at_floor else (),
            set_aside=found.set_aside,
        )

    def fitted(self, model: tuple[Effect, ...]) -> Fitted:
        """Return the parameters of the rows looked at, NaN elsewhere, shape (1, n) or (n, J)."""
        code = None if self.found is None else self._codes()
        return Fitted(self.observed.maps(self.final.fit.parameters), code)

    @functools.cached_property
    def compared(self) -> SetComparison:
        """The same as ``whole``, without the codes that were set aside."""
        return self.whole if self.found is None else replace(self.whole, kept=self.found.kept)

    def _gap(self, fitted: FittedSet) -> Gap:
        """Return the gap of a fit; codes set aside keep the plain law, and nothing of theirs is closed."""
        masses = on_all_codes(fitted.log_masses, self.compared.kept, self.whole.plain.log_masses)
        return self.whole.gap(replace(fitted, log_masses=masses))

    def _rivals(self, named: Named, before: FittedSet, start: FloatArray) -> tuple[Rival, ...]:
        """Return what could stand in the place of an effect, refitted, with its gap, the best first."""
        found = []
        for other, behind, error in named.rivals:
            if any(other.excludes(m) for m in before.members):
                continue
            try:
                gap = self._gap(self.compared.fit((*before.members, other), start))
            except ValueError:
                continue
            why = f"it predicts unseen samples worse, by {-behind:.3g} ± {error:.2g} nats"
            if other.tag in named.equals:
                why = "it predicts unseen samples as well: these histograms do not decide"
            found.append(Rival(effect=other.tag, gap_after=gap.value, behind=behind, why=why))
        return tuple(found)

    def _expected(self) -> FloatArray:
        """Return the samples of train and test expected at each code given those in codes that are kept."""
        counts, kept = self.compared.train.astype(np.float64), self.compared.kept
        mass = self.compared.problem(self.final.members).masses(self.final.fit.theta, self.final.fit.shared)
        inside = np.where(kept, mass, 0.0).sum(axis=1, keepdims=True)
        return np.asarray(mass / inside * np.where(kept, counts, 0.0).sum(axis=1, keepdims=True))

    def _residuals(self, found: Explanation) -> tuple[Place, ...]:
        """Return the codes that the model does not account for, a peak that was set aside first."""
        own = self.compared.origin, self.final.fit.parameters, found.set_aside
        return tuple(find_residuals(self.compared.train.astype(np.float64), self._expected(), *own))

    def _codes(self) -> FloatArray | None:
        """Return the samples expected at each code of the evidence, or None if it holds other pixels too."""
        code, train = self.observed.evidence.code, self.compared.train
        illuminated = self.compared.samples.illuminated(train.shape[0])
        expected, origin = self._expected()[illuminated], self.compared.origin[illuminated]
        if self.observed.evidence.maps.usable.sum() != expected.shape[0]:
            return None
        at = (origin - code.first)[:, None] + np.arange(expected.shape[1])
        within, size = (at >= 0) & (at < code.observed.size), code.observed.size
        found = np.bincount(at[within], expected[within], minlength=size)
        return np.asarray(found * code.observed.sum() / max(float(train[illuminated].sum()), 1.0))


def _addition(
    named: Named,
    gaps: tuple[Gap, Gap],
    fits: tuple[FittedSet, FittedSet],
    rivals: tuple[Rival, ...],
    pulls: tuple[Pull, ...],
) -> Addition:
    """Return an effect with the gaps and the fits without and with it, and with rivals in its place."""
    before, after = fits
    member = after.members[-1]
    compared = [(member, 0.0, 0.0), *named.rivals]
    weights = special.softmax([min(score, 0.0) for _, score, _ in compared])
    return Addition(
        effect=member.effect,
        alone=not named.equals,
        against=member.effect.stuck_words(),
        candidates=tuple(
            Candidate.of(each.effect, score, error, float(weight))
            for (each, score, error), weight in zip(compared, weights, strict=True)
            if not named.equals or each.tag in (member.tag, *named.equals)
        ),
        # of the fit; that of the strength with what the choice of the codes makes of it
        stderr={
            name: float(np.hypot(error, named.apart if name == member.effect.strength else 0.0))
            for name, error in after.stderr(member).items()
        },
        before=gaps[0],
        after=gaps[1],
        rivals=rivals,
        pulls=pulls,
        moved=changes(before.fit.parameters, after.fit.parameters, after.fit.stderr),
    )


def _on_a_line(
    free: SetComparison, settings: DiscrepancySettings, times: Sequence[float | None]
) -> SetComparison | None:
    """Return the same with exposures in proportion to time, where a line with spurious charge fits, or None.

    That distinguishes the charge, which does not grow with time, from dark current.
    """
    dark = free.samples.dark
    illuminated = [time for time, is_dark in zip(times, dark, strict=True) if not is_dark]
    wanted = settings.candidates is None or _SPURIOUS in settings.candidates
    unwanted = {*settings.exclude, *(effect.tag for effect in free.present)}
    if None in illuminated or len(set(illuminated)) < 2 or not wanted or _SPURIOUS in unwanted:
        return None
    line = Samples(dark, tuple(time or 0.0 for time in times))
    straight = replace(free, samples=line)
    best = straight.fit([Member.of(SpuriousCharge.typical()[0])])
    return None if free.beats(free.plain, best) else straight
