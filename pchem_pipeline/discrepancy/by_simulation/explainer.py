"""Effects are distinguished in frames by simulation: what each would do to many statistics, refit included.

The frames are split in three; effects are estimated and compared on the first two parts, and the gap that
remains is measured on the third, which has no part in finding or fitting anything.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.discrepancy.build_verdict import Added, Fitted
from pchem_pipeline.discrepancy.by_simulation.acceptance import Acceptance
from pchem_pipeline.discrepancy.by_simulation.additions import Extension
from pchem_pipeline.discrepancy.by_simulation.candidates.candidates import Mapper, candidate_classes, serial
from pchem_pipeline.discrepancy.by_simulation.candidates.details import standard_errors
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import Hypothesis, SetFit
from pchem_pipeline.discrepancy.by_simulation.candidates.screening import Screened, Screening
from pchem_pipeline.discrepancy.by_simulation.frames.frame_stack import FrameStack
from pchem_pipeline.discrepancy.by_simulation.frames.observed import ObservedFrames
from pchem_pipeline.discrepancy.by_simulation.measured.unexplained import Unexplained
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import refit_maps
from pchem_pipeline.discrepancy.by_simulation.sensor.simulations import Simulations
from pchem_pipeline.discrepancy.by_simulation.sets.pixel_likelihood import (
    HistogramLikelihood,
    PixelLikelihood,
    identifiable_from_histograms,
)
from pchem_pipeline.discrepancy.by_simulation.sets.refits import Refitted, Refitter, Steps
from pchem_pipeline.discrepancy.by_simulation.sets.rivals import Comparison, chosen
from pchem_pipeline.discrepancy.by_simulation.sets.search import Search, compare
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.discrepancy.gap import Gap, StatisticsGap
from pchem_pipeline.discrepancy.null import (
    CONVINCING,
    Measured,
    NullModel,
    as_matrix,
    disagrees,
    suspicious,
    without_strays,
)
from pchem_pipeline.discrepancy.observe.places import SensorWindow
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.skeleton import Explainer, Prepared, no_progress, search
from pchem_pipeline.discrepancy.verdict import Discrepancy
from pchem_pipeline.effects.framework.compose import added_exposures, along_chain
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.registry import effect_classes

_CLEARLY_LESS = 0.5  # of the gap, the most that may stay with what is measured
_MOST_JUDGED = 5  # sets that are asked for on the final frames
_LIKELIHOODS = 6  # that are remembered


def find_discrepancies(
    stack: NDArray[np.unsignedinteger],
    numbers: IntArray | None = None,
    settings: DiscrepancySettings | None = None,
    *,
    n_run: int | None = None,
    bit_depth: int | None = None,
    integration_time: float = 1.0,
    model: Sequence[Effect] = (),
    mapper: Mapper = serial,
    window: SensorWindow | None = None,
    progress: Callable[[str], None] = no_progress,
) -> Discrepancy:
    """Find where frames disagree with the fitted model, name the effects, and add them.

    Args:
        stack: frames (frame, y, x), DN, unsigned.
        numbers: frame numbers in the run, increasing, shape (n,); None: 0, 1, 2, ...
        settings: the section ``discrepancy``; the defaults if None.
        n_run: frames of the whole run; None: up to the last of ``numbers``.
        bit_depth: bits of the ADC; None: as many as the largest DN needs, and one more.
        integration_time: s.
        model: effects that the model has already; none of them is added again.
        mapper: runs the simulated stacks; None of the answers depends on how.
        window: of the sensor that the frames are; None: all of it.
        progress: is given what is done next.

    Returns:
        The verdict, with everything that supports it.

    Raises:
        InputError: the frames or usable pixels are too few.
        ConfigError: a candidate is unknown.
        PchEmError: the present model cannot be simulated.
    """
    settings = settings or DiscrepancySettings()
    numbers = np.arange(stack.shape[0], dtype=np.int64) if numbers is None else numbers
    frames = FrameStack.of(
        stack,
        numbers,
        settings.block_frames,
        n_run=n_run,
        bit_depth=bit_depth,
        integration_time=integration_time,
        window=window,
    )
    classes = candidate_classes(settings)
    progress("computing the statistics of each part")
    observed = ObservedFrames.of(frames)
    progress("simulating the fitted model")
    by = FrameExplainer.begin(observed, settings, classes, tuple(model), mapper)
    return search(replace(by, progress=progress), progress)


@dataclass
class FrameExplainer(Explainer[Screened]):
    """Distinguishes effects in frames."""

    prepared: Prepared  # the frames, split, and replicates of the model
    observed: ObservedFrames
    work: Simulations  # fits and simulates the frames
    screening: Screening
    accept: Acceptance
    given: tuple[Effect, ...]  # effects that the model had before the search
    extension: Extension | None = None  # the effects that it adds; None: none yet
    progress: Callable[[str], None] = no_progress  # is given what is done next
    _likelihoods: dict[tuple[int, tuple[Effect, ...], tuple[Effect, ...]], PixelLikelihood] = field(
        default_factory=dict, repr=False
    )

    @classmethod
    def begin(
        cls,
        observed: ObservedFrames,
        settings: DiscrepancySettings,
        classes: dict[str, type[Effect]],
        model: tuple[Effect, ...],
        mapper: Mapper,
    ) -> FrameExplainer:
        """Simulate and observe the fitted model, refit included: the null distribution of the statistics."""
        effort = Effort(settings.effort)
        work = Simulations(observed, mapper, settings.seed, effort, model)
        vectors = work.replicates(model, work.mapped(model).sensor, "r0", settings.replicates)
        own = observed.statistics()
        names = observed.names([*own, *vectors])
        first = NullModel.from_replicates(names, as_matrix(names, vectors), effects=bool(model))
        effort.begin()
        untestable = {tag: c.untestable for tag, c in effect_classes().items() if c.untestable}
        z = Measured(*as_matrix(names, own))
        prepared = Prepared(
            settings,
            "frames",
            observed.parts[0],
            observed.examined(),
            first,
            z,
            effort,
            untestable,
            observed.doubt(),
        )
        screening = Screening(observed, work, z, classes, model, settings.model_error, prepared.defects)
        accept = Acceptance(first, z, StatisticsGap(first, observed.final_samples), settings)
        return cls(prepared, observed, work, screening, accept, model)

    @property
    def model(self) -> tuple[Effect, ...]:
        """The effects that are in the model now."""
        return self.given if self.extension is None else self.extension.model

    def gap(self, null: NullModel) -> Gap:
        """Measure the gap in the statistics of the final frames."""
        return self.accept.gap(null)

    def suspects(self, null: NullModel) -> bool:
        """Return whether some statistic deviates so far that a candidate may explain it with others."""
        return suspicious(null, self.prepared.z)

    def explain(self, null: NullModel, disagreed: bool) -> Screened | None:
        """Simulate what candidates would do; None where data agree and no set predicts held-out frames."""
        self.work.effort.check("the candidates were compared")
        screened = self.screening.of(self.given, null)
        self.candidates = [h.tag for h in screened.hypotheses]
        self.work.effort.leave_for_fits()
        return screened if disagreed or screened.gain > CONVINCING else None

    def add(self, explanation: Screened, null: NullModel) -> NullModel | None:
        """Put the effects of the best refitted set into the model; None where none is established.

        Where a set is not, what is established of it is one more that is tried, and the next best is judged.
        Where data and model disagree, one that leaves nothing is taken in the end, though it is not certain.
        """
        self.work.forget(self.given)
        refitter, settings = self._refitter(), self.prepared.settings

        def report(best: str) -> None:
            used = self.work.effort.used
            self.progress(f"refitting the pixels with the likeliest effects; best so far: {best}; {used}")

        sets = Search(refitter, HistogramLikelihood(self._likelihood), report=report)
        own, measured = (explanation.hypotheses, explanation.sets), self._measured(refitter)
        compare(sets, *own, lambda best: self._left_by(best, refitter), measured, settings.max_rounds)
        self.work.effort.choose()
        # what was chosen is not lost for the little that is left to do: no limit
        refitter = replace(refitter, allow=lambda _: None)
        disagree = disagrees(null, self.prepared.z, settings.significance)
        doubtful: tuple[Comparison, Refitted] | None = None
        for _ in range(_MOST_JUDGED):
            found = chosen(sets)
            if sets.limit is not None and not sets.complete:
                self.limit = self.work.effort.limit_words(sets.limit, self.candidates)
            if found is None:
                break
            added = refitter.sharpened(found.chosen, settings.extended_replicates)
            kept = self.accept.established(added)
            if len(kept) == len(added.hypotheses) and self._closes(added):
                return self._put(found, added, explanation, certain=True)
            if disagree and doubtful is None and not kept and refitter.passes_goodness_of_fit(found.chosen):
                doubtful = found, added
            sets.rejected.append(found.chosen)
            if 0 < len(kept) < len(added.hypotheses):
                sets.at_best_fit(kept)
        return None if doubtful is None else self._put(*doubtful, explanation, certain=False)

    def _closes(self, added: Refitted) -> bool:
        """Test whether a set does not widen the gap of the final frames, or closes half if it is measured."""
        before, after = self.gap(self.prepared.first), self.accept.gap_at(added.mean, added.vectors)
        if any(type(effect).empirical for effect in added.effects):
            return after.at_floor or after.value < _CLEARLY_LESS * before.value
        return not self.accept.widens(added)

    def _put(self, found: Comparison, added: Refitted, explanation: Screened, *, certain: bool) -> NullModel:
        by_law = HistogramLikelihood(self._likelihood).standard_errors(found.chosen.hypotheses)
        refitter = replace(self._refitter(), allow=lambda _: None)
        stderr = standard_errors(refitter, found.chosen, added.stderr, by_law)
        own = self.accept, found, added, stderr, explanation.hypotheses, certain
        self.extension = Extension.of(self.work, self.given, *own)
        return self.extension.last

    def _measured(self, refitter: Refitter) -> Callable[[tuple[Hypothesis, ...]], Iterator[Steps]]:
        """Return what measures samples beside effects, for which some work is kept."""
        unexplained = Unexplained(self.work, refitter, self.prepared.defects)

        def measured(kept: tuple[Hypothesis, ...]) -> Iterator[Steps]:
            self.work.effort.measure()
            return unexplained.measured(kept)

        return measured

    def _refitter(self) -> Refitter:
        """Return what fits effects beside those that the model had before the search."""
        present, data = self.given, self.prepared
        first = data.first

        def draw(effects: tuple[Effect, ...], count: int) -> FloatArray:
            vectors = self.work.drawn(along_chain(present, effects), count)
            return without_strays(as_matrix(first.names, vectors, first.mean))

        def allow(words: str) -> None:
            self.work.effort.check(f"{words} was fitted")

        return Refitter(draw, first, data.z.both, present, allow=allow, defects=data.defects)

    def _left_by(self, best: Refitted, refitter: Refitter) -> list[SetFit]:
        """Return what is likely beside a refitted set."""
        null = NullModel.from_replicates(self.prepared.first.names, best.vectors, self.prepared.first)
        null = null.shifted(np.expm1(best.change) @ best.slopes)
        return self.screening.beside(refitter.model(best.effects), null, best.slopes)

    def _likelihood(self, effects: Sequence[Effect], pixels: int) -> PixelLikelihood | None:
        """Return the likelihood of some pixels beside what the model had at first; None: not one law."""
        present = self.observed.frames.effects(self.given)
        if not all(effect.everywhere for effect in (*present, *effects)):
            return None
        # a law has all samples; others may have replaced some
        key = pixels, present, tuple(effect for effect in effects if not identifiable_from_histograms(effect))
        if key not in self._likelihoods:
            if len(self._likelihoods) >= _LIKELIHOODS:
                del self._likelihoods[next(iter(self._likelihoods))]
            samples = self.work.own_samples((*present, *effects))
            self._likelihoods[key] = PixelLikelihood(
                samples, self.observed.plain.maps, present, self.work.effort, pixels, self.prepared.defects
            )
        return self._likelihoods[key]

    def tolerance(self) -> FloatArray | float:
        """Return what is not held against effects that were added: a fraction of what they do."""
        return 0.0 if self.extension is None else self.extension.tolerance

    def close(self, before: Gap, null: NullModel, disagreed: bool) -> Added:
        """Measure the gap on the final frames after each effect, and with rivals in its place."""
        return Added((), before) if self.extension is None else self.extension.close(before, disagreed)

    def fitted(self, model: tuple[Effect, ...]) -> Fitted:
        """Return the maps under the model, without the exposure that effects add to single pixels."""
        frames, plain, expected = self.observed.frames, self.observed.plain, None
        maps = self.work.mapped(self.model).fit.maps
        assert plain.covariance is not None
        if self.extension is not None:
            train = frames.numbers[frames.splits.train]
            expected = self.work.expected(self.model, self.prepared.evidence, train)
        model = frames.effects(model)
        try:
            added = added_exposures(model, frames.stack, frames.numbers, plain.maps)
        except ConfigError as error:
            self.prepared.defects["added exposure"] = str(error)
            added = None
        if added is not None:
            own = frames.seen_stack, plain.maps, model, plain.covariance, added, frames.seen_numbers
            maps = refit_maps(*own).maps
        return Fitted(maps, expected, added, lambda effect: next(iter(frames.effects([effect])), effect))
