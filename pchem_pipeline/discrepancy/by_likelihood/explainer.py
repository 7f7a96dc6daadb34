"""Comparison of effects in ready-made histograms by likelihood.

The samples of every pixel are split at random into three parts: one to fit, one to score, one for the final
gap. Effects enter the exact likelihood of the histograms (:mod:`pchem_pipeline.model.fit.shared`), so that no
simulation is needed to name them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pchem_pipeline.discrepancy.build_verdict import Added, Fitted
from pchem_pipeline.discrepancy.by_likelihood.additions import AddedSets
from pchem_pipeline.discrepancy.by_likelihood.gap import on_all_codes
from pchem_pipeline.discrepancy.by_likelihood.members import Member, find_members
from pchem_pipeline.discrepancy.by_likelihood.observed import ObservedHistograms, SampleHistograms
from pchem_pipeline.discrepancy.by_likelihood.search import Explanation, explain
from pchem_pipeline.discrepancy.by_likelihood.sets import FittedSet, SetComparison
from pchem_pipeline.discrepancy.by_simulation.candidates.candidates import candidate_classes
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.null import CONVINCING, Measured, NullModel, as_matrix
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.skeleton import Explainer, Prepared, no_progress, search
from pchem_pipeline.discrepancy.verdict import Discrepancy
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
    """Distinguishes effects in histograms.

    Attributes:
        prepared: the histograms, split, and replicates of the model.
        sets: fits sets of effects to the train part, and scores them by the test part.
        whole: fits them to both, and scores them by the final part.
        bare: fits the rows without any effects.
        members: the candidates.
        effects: of the model, those added included.
        final: the fit of the final model to train and test part.
        found: what the search found, for the final part; None: nothing.
    """

    prepared: Prepared
    observed: ObservedHistograms
    sets: SetComparison
    whole: SetComparison
    bare: SetComparison
    rng: np.random.Generator
    members: Sequence[Member]
    effects: tuple[Effect, ...]
    final: FittedSet
    found: AddedSets | None = None

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
        self.found = AddedSets(found, self.whole)
        return found if found.named else None

    def add(self, explanation: Explanation, null: NullModel) -> NullModel:
        """Put the named effects into the model, and observe histograms drawn from it."""
        masses = on_all_codes(explanation.best.log_masses, explanation.kept, self.sets.plain.log_masses)
        vectors = self.observed.drawn(masses, self.bare, self.prepared.settings.replicates, self.rng)
        return NullModel.from_replicates(null.names, as_matrix(null.names, vectors), effects=True)

    def close(self, before: Gap, null: NullModel, disagreed: bool) -> Added:
        """Fit train and test part together with each effect, and measure the gap on the final part."""
        if self.found is None:
            return Added((), before)
        nulls = self.prepared.first, null
        added, self.final = self.found.close(before, nulls, self.prepared.z, disagreed)
        self.effects = along_chain(self.sets.present, [each.effect for each in added.additions])
        return added

    def fitted(self, model: tuple[Effect, ...]) -> Fitted:
        """Return the parameters of the rows looked at, NaN elsewhere, shape (1, n) or (n, J)."""
        code = None if self.found is None else self.found.codes(self.final, self.observed.evidence)
        return Fitted(self.observed.maps(self.final.fit.parameters), code)


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
