"""Effects are told apart in frames by simulation: what each would do to many statistics, refit included.

The frames are split in three; effects are estimated on the first two parts, compared by cross-validation
between them, and the gap that remains is measured on the third. That one has no part in finding or fitting
anything; what it does not show at all is not named.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.discrepancy.build_verdict import Added, Fitted
from pchem_pipeline.discrepancy.by_simulation.acceptance import Acceptance
from pchem_pipeline.discrepancy.by_simulation.additions import AddedRounds, ExtendedModel
from pchem_pipeline.discrepancy.by_simulation.candidates.candidates import Mapper, candidate_classes, serial
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import Choice, Hypothesis
from pchem_pipeline.discrepancy.by_simulation.candidates.screening import Screening, noise_of_splits
from pchem_pipeline.discrepancy.by_simulation.frames.frame_stack import FrameStack
from pchem_pipeline.discrepancy.by_simulation.frames.observed import ObservedFrames
from pchem_pipeline.discrepancy.by_simulation.measured.unexplained import Unexplained
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import (
    NotFittedError,
    Refit,
    refit_maps,
)
from pchem_pipeline.discrepancy.by_simulation.sensor.simulations import Simulations
from pchem_pipeline.discrepancy.by_simulation.sets.comparison import Comparison, compare
from pchem_pipeline.discrepancy.by_simulation.sets.pixel_likelihood import (
    HistogramLikelihood,
    PixelLikelihood,
    identifiable_from_histograms,
)
from pchem_pipeline.discrepancy.by_simulation.sets.refits import Refitted, Refitter
from pchem_pipeline.discrepancy.effort import Effort, EffortSpentError
from pchem_pipeline.discrepancy.gap import Gap, StatisticsGap
from pchem_pipeline.discrepancy.null import (
    CONVINCING,
    Measured,
    NullModel,
    as_matrix,
    suspicious,
    without_strays,
)
from pchem_pipeline.discrepancy.observe.places import SensorWindow
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.skeleton import Explainer, Prepared, search, silent
from pchem_pipeline.discrepancy.verdict import Discrepancy
from pchem_pipeline.effects.framework.added_exposure import added_exposures
from pchem_pipeline.effects.framework.compose import along_chain
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.registry import effect_classes

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_CLEARLY_LESS = 0.5  # of the gap that is left without, the most that may stay with what is measured
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
    tell: Callable[[str], None] = silent,
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
        tell: hears what is done next.

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
    tell("computing the statistics of each part")
    observed = ObservedFrames.of(frames)
    tell("simulating the fitted model")
    return search(FrameExplainer.begin(observed, settings, classes, tuple(model), mapper), tell)


@dataclass(frozen=True)
class Explanation:
    """All hypotheses of a round, and how their sets compare."""

    hypotheses: tuple[Hypothesis, ...]
    choice: Choice


@dataclass
class FrameExplainer(Explainer[Explanation]):
    """Tells effects apart in frames.

    Attributes:
        prepared: the frames, split, and the model, drawn.
        observed: the frames.
        work: fits and simulates them.
        screening: asks the candidates what they would do.
        accept: tells by the statistics of the data what is accepted.
        extended: the model, with the rounds of the search.
        doubtful: puts effects into the model that leave nothing but are not certain; None: there are none.
    """

    prepared: Prepared
    observed: ObservedFrames
    work: Simulations
    screening: Screening
    accept: Acceptance
    extended: ExtendedModel
    doubtful: Callable[[], NullModel] | None = None
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
        effort = Effort(settings.effort, ambiguous=observed.plain.ambiguous)
        work = Simulations(observed, mapper, settings.seed, effort)
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
            settings.max_rounds,
            untestable,
            observed.doubt(),
        )
        return cls(
            prepared,
            observed,
            work,
            Screening(observed, work, z, classes, model, settings.model_error, prepared.defects),
            Acceptance(first, z, StatisticsGap(first, observed.final_samples), settings),
            ExtendedModel(work, first, model, model),
        )

    @property
    def model(self) -> tuple[Effect, ...]:
        """The effects that are in the model now."""
        return self.extended.effects

    def gap(self, null: NullModel) -> Gap:
        """Measure the gap in the statistics of the final frames."""
        return self.accept.gap(null)

    def suspects(self, null: NullModel) -> bool:
        """Tell whether some statistic deviates so far that a candidate may explain it with others."""
        return suspicious(null, self.prepared.z)

    def explain(self, null: NullModel, disagrees: bool) -> Explanation | None:
        """Simulate what candidates would do, and choose the set that best predicts held-out frames."""
        number = len(self.extended.rounds)
        self.work.effort.check("another round of effects" if number else "the candidates were compared")
        self.work.effort.tried.clear()
        hypotheses, choice = self.screening.of(self.model, null, number)
        if number == 0:
            self.work.effort.leave_for_fits()
        if choice is None or not (disagrees or choice.advantage > CONVINCING):
            return None
        return Explanation(hypotheses, choice)

    def add(self, explanation: Explanation, null: NullModel) -> NullModel | None:
        """Put the effects of the best refitted set into the model; None where none is established.

        Asked thrice: of the strengths as the data give them, of the final frames, and whether the gap there
        does not widen. Effects of earlier rounds are fitted anew with the new ones.

        Raises:
            EffortSpentError: the work is at its limit; nothing was added.
        """
        self.work.forget(self.model)
        refitter = self._refitter()
        found = self._compared(explanation, refitter)
        if found is None:
            return None
        # what was chosen is not lost for the little that is left to do: no limit
        refitter = replace(refitter, allow=lambda _: None)
        count, held = self.prepared.settings.extended_replicates, {h.tag for h in self.extended.added}
        added = refitter.sharpened(found.chosen, count)
        kept = self.accept.established(added)
        while len(kept) < len(added.hypotheses):
            if {h.tag for h in kept} <= held:
                if not held and refitter.passes_goodness_of_fit(added):
                    put = functools.partial(self.extended.put, found, added, explanation.hypotheses, null)
                    self.doubtful = functools.partial(put, certain=False)
                return None
            try:
                added = refitter.sharpened(refitter.refined(kept), count)
            except NotFittedError:
                return None
            kept = self.accept.established(added)
        if self.accept.widens(added, null):
            return None
        return self.extended.put(found, added, explanation.hypotheses, null)

    def _compared(self, explanation: Explanation, refitter: Refitter) -> Comparison | None:
        """Compare sets of effects after the best fit of each; None where none holds."""
        try:
            return compare(
                refitter,
                self.extended.added,
                explanation.hypotheses,
                explanation.choice,
                self.extended.last,
                lambda best: self._left_by(best, refitter),
                HistogramLikelihood(self._likelihood),
                lambda: self._unexplained.explains_all(),
                lambda unlisted: self._unexplained.clearest(unlisted),
            )
        except EffortSpentError as spent:
            tags = dict.fromkeys(h.tag for h in explanation.hypotheses)
            tried = self.work.effort.tried
            raise EffortSpentError(spent.doing, (t for t in tags if t not in tried)) from spent

    def _refitter(self) -> Refitter:
        """Return what fits effects beside those that the model had before the search."""
        present, data = self.extended.present, self.prepared
        first = data.first

        def draw(effects: tuple[Effect, ...], count: int) -> tuple[Refit, FloatArray]:
            fit, vectors = self.work.drawn(along_chain(present, effects), count)
            return fit, without_strays(as_matrix(first.names, vectors, first.mean))

        def allow(words: str) -> None:
            self.work.effort.check(f"{words} was fitted")

        events = np.asarray(noise_of_splits(first, 2, data.settings.model_error).events)
        return Refitter(draw, first, data.z.both, events, present, allow=allow, defects=data.defects)

    def _left_by(self, best: Refitted, refitter: Refitter) -> Choice | None:
        """Compare what candidates would do beside a refitted set: what that hid stands out there."""
        null = NullModel.from_replicates(self.prepared.first.names, best.vectors, self.prepared.first)
        null = null.shifted(np.expm1(best.change) @ best.slopes)
        model, number = refitter.model(best.effects), len(self.extended.rounds)
        return self.screening.beside(model, null, best.slopes, number)

    def _likelihood(self, effects: Sequence[Effect], pixels: int) -> PixelLikelihood | None:
        """Return the likelihood of some pixels beside what the model had at first; None: not one law."""
        frames = self.observed.frames
        present = frames.effects([e for e in self.model if e in self.extended.given])
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

    def replaced(self, null: NullModel) -> NullModel | None:
        """Put what no effect with a name makes in the place of all that were added, if it leaves less.

        Effects that leave something merely mimic it.

        Raises:
            EffortSpentError: the work is at its limit; nothing was added.
        """
        unexplained, left = self._unexplained, self.gap(null)
        found = unexplained.by_itself()
        if found is None:
            return None
        gap = self.accept.gap_at(found.mean, found.vectors)
        better = gap.interval[1] < _CLEARLY_LESS * left.value
        # effects that the final frames do not tell from the truth are known to leave something by the others
        as_good = gap.at_floor and (not left.at_floor or unexplained.refitter.passes_goodness_of_fit(found))
        return self.extended.put_measured(found) if better or as_good else None

    def probable(self) -> NullModel | None:
        """Put the likeliest effects into the model that leave nothing but are too weak to be certain."""
        return None if self.doubtful is None or self.extended.rounds else self.doubtful()

    def unfinished(self, before: Gap, null: NullModel) -> bool:
        """Tell whether the final frames prove that too much of the gap is left."""
        left = self.gap(null)
        return not left.at_floor and left.too_wide(before.value)

    def describe(self, before: Gap, null: NullModel) -> NullModel | None:
        """Measure what no effect explains in the samples, and put it into the model.

        Everywhere, and in each part that differs from the rest: what explains most of train and test counts.
        Without the effects that were added, since one that merely mimics has no place beside it, and with
        those of them that account for what they move themselves: what closes the gap, then in the fewest
        forms, and where both do as well with the effects, which have a name. None where it closes less than
        half of what is left, or of what there was if none of the effects gets a name.

        Raises:
            EffortSpentError: the work is at its limit; nothing was added.
        """
        self.work.effort.release()
        instead, left = self.replaced(null), self.gap(null)
        additions = self.close(before, null, disagrees=True).additions
        if instead is not None or (left.at_floor and any(each.fits for each in additions)):
            return instead
        unexplained, sure = self._unexplained, self._added.accounted(null)
        named = any(each.named for each in additions)
        best: tuple[tuple[bool, float], Refitted] | None = None
        for kept in ((), sure) if sure else ((),):
            try:
                found = unexplained.measured(kept)
            except EffortSpentError:
                if best is None:
                    raise
                break
            if found is None:
                continue
            gap = self.accept.gap_at(found.mean, found.vectors)
            # beside effects that get no name there is nothing to leave less than
            most = _CLEARLY_LESS * (left.value if kept or named else before.value)
            forms = sum(e.measured_parts for e in found.effects)
            rank = (not gap.at_floor, float(forms) if gap.at_floor else gap.value)
            if (gap.at_floor or gap.value < most) and (best is None or rank <= best[0]):
                best = rank, found
            if best is not None and best[0] == (False, 1.0):
                break
        return None if best is None else self.extended.put_measured(best[1])

    @functools.cached_property
    def _unexplained(self) -> Unexplained:
        """What measures beside effects that the model had before the search; always the same."""
        data, proven = self.prepared, self.accept.established
        replicates = data.settings.extended_replicates
        return Unexplained(self.work, self._refitter(), proven, replicates, data.defects)

    @property
    def _added(self) -> AddedRounds:
        return AddedRounds(self.extended.rounds, self.accept)

    def tolerance(self) -> FloatArray | float:
        """Return what is not held against effects that were added: a fraction of what they do."""
        return self._added.tolerance

    def close(self, before: Gap, null: NullModel, disagrees: bool) -> Added:
        """Measure the gap on the final frames after each effect, and with rivals in its place."""
        return self._added.close(before, null, disagrees)

    def fitted(self, model: tuple[Effect, ...]) -> Fitted:
        """Return the maps under the model, with that taken out of H which effects add to single pixels.

        Such exposure is looked for in all frames, since those are fitted in the end; nothing else rests on
        it. The replicates of the search are simulated with the pixels' mean exposure: which ones blink is
        drawn anew.
        """
        frames, plain, expected = self.observed.frames, self.observed.plain, None
        maps = self.work.mapped(self.model).fit.maps
        assert plain.covariance is not None
        if self.extended.rounds:
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
