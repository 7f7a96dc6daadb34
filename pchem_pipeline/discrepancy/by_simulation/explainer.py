"""Effects are told apart in frames by simulation: what each would do to many statistics, refit included.

The frames are split in three; effects are estimated on the first two parts, compared by cross-validation
between them, and the gap that remains is measured on the third. That one has no part in finding or fitting
anything; what it does not show at all is not named.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import ConfigError, InputError
from pchem_pipeline.discrepancy.build_verdict import Added, Fitted
from pchem_pipeline.discrepancy.by_simulation.additions import (
    AddedRounds,
    Round,
    left_of,
    unexplained_of_its_own,
)
from pchem_pipeline.discrepancy.by_simulation.candidates import (
    MOST_HYPOTHESES,
    Mapper,
    ReplicateSimulator,
    candidate_classes,
    placebo_for,
    serial,
)
from pchem_pipeline.discrepancy.by_simulation.comparison import Comparison, compare
from pchem_pipeline.discrepancy.by_simulation.fingerprints import (
    Choice,
    Hypothesis,
    Noise,
    SetFit,
    choose,
    fit_set,
    share_place,
    tolerance,
)
from pchem_pipeline.discrepancy.by_simulation.frame_stack import FrameStack
from pchem_pipeline.discrepancy.by_simulation.maps import (
    NotFittedError,
    Refit,
    Sensor,
    expected_codes,
    refit_maps,
)
from pchem_pipeline.discrepancy.by_simulation.pixel_likelihood import (
    PixelLikelihood,
    Witness,
    with_details,
)
from pchem_pipeline.discrepancy.by_simulation.refits import Refitted, Refitter
from pchem_pipeline.discrepancy.by_simulation.simulations import Simulations
from pchem_pipeline.discrepancy.by_simulation.suspects import suspected_parts
from pchem_pipeline.discrepancy.by_simulation.unexplained import Unexplained
from pchem_pipeline.discrepancy.effort import Effort, EffortSpentError
from pchem_pipeline.discrepancy.gap import Gap, StatisticsGap
from pchem_pipeline.discrepancy.null import (
    CONVINCING,
    Measured,
    NullModel,
    as_matrix,
    free_of_parameters,
    suspicious,
)
from pchem_pipeline.discrepancy.observe.places import Part, SensorWindow
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.skeleton import search, silent
from pchem_pipeline.discrepancy.splits import block_length, split_frames
from pchem_pipeline.discrepancy.verdict import Discrepancy, Examined
from pchem_pipeline.effects.framework.added_exposure import added_exposures
from pchem_pipeline.effects.framework.compose import along_chain
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence
from pchem_pipeline.effects.framework.registry import effect_classes

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_FEWEST_PIXELS = 32
_NOT_IDENTIFIED = 0.5  # share of ambiguous pixels from which their parameters are no ground for a verdict
_NEAR = 0.1  # relative: so little is not worth another simulation, but can be corrected without one
# standard errors of its strength that an effect must have: the best of some hundred guesses reaches more
# than a single one would by chance
_ESTABLISHED = 4.5
_CLEARLY_LESS = 0.5  # of the gap that named effects leave, the most that may stay with another form
_MOST_BESIDE = 2  # hypotheses of one effect beside a single other one
_DOUBT = 0.2  # of the logarithm of a factor that was fitted without the effects beside it
_DESCRIBED = 0.5  # of the gap, the most that a measured component may leave to be worth telling
_CONFIRMED = 1.0  # the same in the final frames, half as many, which nothing was chosen by


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
    splits = split_frames(numbers, block_length(stack.shape[0], settings.block_frames))
    if bit_depth is None:
        bit_depth = min(int(stack.max()).bit_length() + 1, 24)
    frames = FrameStack(stack, numbers, splits, n_run or int(numbers[-1]) + 1, bit_depth, integration_time)
    frames = replace(frames, window=window)
    return search(FrameExplainer(frames, settings, tuple(model), mapper), tell)


@dataclass(frozen=True)
class _Explanation:
    """All hypotheses of a round, and how their sets compare."""

    hypotheses: tuple[Hypothesis, ...]
    choice: Choice


@dataclass
class _Drawn:
    """A model's fit, the sensors to draw replicates from, and the statistics of those drawn so far."""

    fit: Refit
    sensor: Sensor
    vectors: list[Mapping[str, float]] = field(default_factory=list)


@dataclass
class FrameExplainer:
    """Tells effects apart in frames; see :class:`~pchem_pipeline.discrepancy.skeleton.Explainer`."""

    frames: FrameStack
    settings: DiscrepancySettings
    model: tuple[Effect, ...]
    mapper: Mapper
    samples: str = "frames"
    defects: dict[str, str] = field(default_factory=dict)
    rounds: list[Round] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Refuse unknown candidates before anything is done."""
        self.classes = candidate_classes(self.settings)
        self.untestable = {tag: c.untestable for tag, c in effect_classes().items() if c.untestable}
        self.most_rounds = self.settings.max_rounds
        self.effort = Effort(self.settings.effort)
        self.held: Refitted | None = None
        self.unexplained: Unexplained | None = None
        self.given = self.model
        self.drawn: dict[tuple[Effect, ...], _Drawn] = {}

    @property
    def n_replicates(self) -> int:
        """Parts of simulated stacks so far."""
        return self.work.done

    def split(self) -> tuple[Evidence, Examined]:
        """Observe train and test frames together, then each part near their fit."""
        # parameters of a third of the frames scatter too much to stand for the pixels
        splits = self.frames.splits
        self.plain = self.frames.observe(self.frames.seen)
        self.effort.ambiguous = self.plain.ambiguous
        usable = self.plain.maps.usable
        if usable.size < _FEWEST_PIXELS:
            raise InputError(
                f"a sensor of {usable.size} pixels, fewer than {_FEWEST_PIXELS}: nothing can be compared"
            )
        if usable.sum() < _FEWEST_PIXELS:
            raise InputError(
                f"{int(usable.sum())} of {usable.size} pixels have a usable fit, "
                f"fewer than {_FEWEST_PIXELS}: nothing can be compared; see fit_status, or take more frames"
            )
        found = suspected_parts(self.plain, self.frames.stack[self.frames.seen])
        self.frames = self.frames.with_parts(found).with_ends(self.plain.maps)
        splits = self.frames.splits
        parts = splits.train, splits.test, splits.final
        self.evidence = tuple(self.frames.observe(part, self.plain.maps) for part in parts)
        self.work = Simulations(self.frames, self.plain, self.mapper, self.settings.seed, self.effort)
        self.fit, self.sensor = self.work.mapped(self.model)
        return self.evidence[0], splits.examined(self.frames.stack.shape)

    def null(self) -> tuple[NullModel, Measured]:
        """Simulate and observe the fitted model, refit included."""
        vectors = self.work.replicates(self.model, self.sensor, "r0", self.settings.replicates)
        splits = self.frames.splits
        parts = splits.train, splits.test, splits.final
        own = [self.frames.statistics(part, e) for part, e in zip(parts, self.evidence, strict=True)]
        names = tuple(name for name in own[0] if all(name in each for each in (*own[1:], *vectors)))
        if self.doubt():
            # where the pixels are not identified only what does not rest on their parameters counts
            names = tuple(np.array(names)[free_of_parameters(names)].tolist())
        self.first = NullModel.from_replicates(names, as_matrix(names, vectors))
        self.effort.begin()
        n_samples = self.frames.splits.final.size * int(self.evidence[0].maps.usable.sum())
        self.gaps = StatisticsGap(self.first, n_samples)
        return self.first, Measured(*as_matrix(names, own))

    def doubt(self) -> str:
        """Say which share of the pixels is not identified, and what would help; empty below a half."""
        share, usable = self.plain.ambiguous, float(np.mean(self.plain.maps.usable))
        if share < _NOT_IDENTIFIED and usable > 1.0 - _NOT_IDENTIFIED:
            return ""
        maps, frames = self.plain.maps, self.frames.numbers.size
        noise = np.nanmedian(maps.read_noise_dn * maps.conversion_gain)
        lost = (
            f"the bias of {100 * share:.0f} % of the pixels may be off by an electron"
            if share >= _NOT_IDENTIFIED
            else f"only {100 * usable:.0f} % of the pixels have a fit that can be relied upon"
        )
        return (
            f"{lost} (fitted read noise {noise:.2f} e-, {frames} frames): several exposures fitted together "
            "(pchem joint) identify them; many more frames or a lower read noise may do so, too"
        )

    def gap(self, null: NullModel, z: Measured) -> Gap:
        """Measure the gap in the statistics of the final frames."""
        return self.gaps.gap(z.final, null.mean, null.replicates, null.strengths)

    def suspects(self, null: NullModel, z: Measured) -> bool:
        """Tell whether some statistic deviates so far that a candidate may explain it with others."""
        return suspicious(null, z)

    def explain(self, null: NullModel, z: Measured, disagrees: bool) -> _Explanation | None:
        """Simulate what candidates would do, and choose the set that best predicts held-out frames."""
        self.effort.check("the candidates were compared" if not self.rounds else "another round of effects")
        self.effort.tried.clear()
        hypotheses, choice = self._asked(self.model, _Drawn(self.fit, self.sensor), null, z)
        if choice is None or not (disagrees or choice.advantage > CONVINCING):
            return None
        return _Explanation(hypotheses, choice)

    def _asked(
        self,
        model: tuple[Effect, ...],
        drawn: _Drawn,
        null: NullModel,
        z: Measured,
        slopes: FloatArray | None = None,
    ) -> tuple[tuple[Hypothesis, ...], Choice | None]:
        """Ask every candidate what it would do beside a model, and compare their sets.

        Args:
            model: effects.
            drawn: the fit of the pixels with them.
            null: of that model.
            z: statistics of the data.
            slopes: how the statistics go with those of its strengths that are doubtful, shape (e, m).
        """
        purpose = "/".join([str(len(self.rounds)), *(e.tag for e in model if slopes is not None)])
        simulator = ReplicateSimulator(
            drawn.sensor.usual(self.work.seed_of(f"sensor/{purpose}")),
            model,
            self.frames.acquisition(),
            null.names,
            self.work.counted,
            f"r{len(self.rounds)}",
            self.work.seed_of(f"fingerprint/{purpose}"),
            dict(self.defects),
        )
        shifts = (z.train - null.mean, z.test - null.mean)
        apart = self.frames.seen_apart(self.plain)
        evidence: tuple[Evidence, ...] = (self.plain, *self.evidence[:2])
        most = MOST_HYPOTHESES
        if slopes is not None:
            # what is worth a refit beside a single effect: as the whole shows it, simulated once
            evidence, most = (), _MOST_BESIDE
        beside = self._beside(model, drawn.fit, null, z)
        found = [effect for effect in model if effect not in self.given]
        self.effort.ask(sum(self.frames.samples(part) for part in (Part(), *self.frames.parts)))
        guesses = [
            guess
            for guess in simulator.guesses(self.classes, evidence, apart, beside, most)
            if not share_place((*found, guess))
        ]
        if slopes is None:
            guesses = with_details(
                guesses, self.work.own_samples(model), drawn.fit.maps, self.frames.effects(model), self.effort
            )
        hypotheses = simulator.fingerprints([*guesses, *placebo_for(guesses, self.classes)])
        if slopes is None:
            hypotheses = simulator.refined(hypotheses, (shifts[0] + shifts[1]) / 2.0, self._noise(null, 2))
        choice = choose(hypotheses, shifts, self._noise(null, 1, slopes)) if hypotheses else None
        self.defects |= simulator.defects
        return tuple(hypotheses), choice

    def add(self, explanation: _Explanation, null: NullModel, z: Measured) -> NullModel | None:
        """Put the effects of the best refitted set into the model; None where none is established.

        Asked thrice: of the strengths as the data give them, of the final frames, and whether the gap there
        does not widen. Effects of earlier rounds are fitted anew with the new ones.

        Raises:
            EffortSpentError: the work is at its limit; nothing was added.
        """
        held = tuple(h for this in self.rounds for h in this.added.hypotheses)
        self.drawn = {}
        refitter = self._refitter(z, held)
        try:
            found = compare(
                refitter,
                held,
                explanation.hypotheses,
                explanation.choice,
                self.held,
                lambda best: self._left_by(best, refitter, z),
                Witness(self._likelihood),
                lambda: self._unexplained(z).explains_all(),
            )
        except EffortSpentError as spent:
            tags = dict.fromkeys(h.tag for h in explanation.hypotheses)
            raise EffortSpentError(spent.doing, (t for t in tags if t not in self.effort.tried)) from spent
        self.defects |= {} if found is None else found.failed
        # what was chosen is not lost for the little that is left to do: no limit
        refitter = replace(refitter, allow=lambda _: None)
        added = None if found is None else refitter.sharpened(found.chosen, self.settings.extended_replicates)
        while found is not None and added is not None:
            kept = self._established(added, z)
            if len(kept) == len(added.hypotheses):
                if self._widens(added, null, z):
                    return None
                return self._put(found, added, explanation.hypotheses, null)
            if not kept or {h.tag for h in kept} <= {h.tag for h in held}:
                break
            try:
                added = refitter.sharpened(refitter.refined(kept), self.settings.extended_replicates)
            except NotFittedError:
                break
        return None

    def _left_by(self, best: Refitted, refitter: Refitter, z: Measured) -> Choice | None:
        """Compare what candidates would do beside a refitted set: what that hid stands out there."""
        model = refitter.model(best.effects)
        null = NullModel.from_replicates(self.first.names, best.vectors, self.first)
        null = null.shifted(np.expm1(best.change) @ best.slopes)
        return self._asked(model, self.drawn[model], null, z, best.slopes)[1]

    def _likelihood(self, effects: Sequence[Effect], pixels: int) -> PixelLikelihood | None:
        """Return the likelihood of some pixels beside what the model had at first; None: not one law."""
        present = self.frames.effects([e for e in self.model if e in self.given])
        if not all(effect.everywhere for effect in (*present, *effects)):
            return None
        frames = self.work.own_samples((*present, *effects))
        return PixelLikelihood(frames, self.plain.maps, present, self.effort, pixels)

    def _widens(self, added: Refitted, null: NullModel, z: Measured) -> bool:
        """Tell whether a set, its strengths as the data ask for, leaves a wider gap than without it."""
        mean = added.mean + np.expm1(added.change) @ added.parts
        before = self.gaps.gap(z.final, null.mean, null.replicates)
        return self.gaps.gap(z.final, mean, added.vectors).interval[0] > before.value

    def replaced(self, null: NullModel, z: Measured) -> NullModel | None:
        """Put what no effect with a name makes in the place of all that were added, if it leaves less.

        Effects that leave something merely mimic it.

        Raises:
            EffortSpentError: the work is at its limit; nothing was added.
        """
        unexplained, left = self._unexplained(z), self.gap(null, z)
        found = unexplained.by_itself()
        if found is None:
            return None
        gap = self._gap_of(found, z)
        better = gap.interval[1] < _CLEARLY_LESS * left.value
        # effects that the final frames do not tell from the truth are known to leave something by the others
        as_good = gap.at_floor and (not left.at_floor or unexplained.leaves_nothing(found))
        return self._put_measured(found) if better or as_good else None

    def describe(self, before: Gap, null: NullModel, z: Measured) -> NullModel | None:
        """Measure what no effect explains in the samples, and put it into the model.

        Everywhere, and in each part that differs from the rest: what explains most of train and test counts.
        Without the effects that were added, since one that merely mimics has no place beside it, and with
        those of them that account for what they move themselves: what closes the gap, then in the fewest
        forms, and where both do as well with the effects, which have a name. None where it closes less than
        half of what is left, or of what there was if none of the effects does.

        Raises:
            EffortSpentError: the work is at its limit; nothing was added.
        """
        self.effort.release()
        instead, left = self.replaced(null, z), self.gap(null, z)
        if instead is not None or left.at_floor:
            return instead
        unexplained, sure = self._unexplained(z), self._sure(null, z)
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
            gap = self._gap_of(found, z)
            # effects none of which accounts for what it moves lose their names: then less is better
            alone = (
                _DESCRIBED * min(left.value, before.value)
                if sure
                else min(left.value, _DESCRIBED * before.value)
            )
            most = _DESCRIBED * left.value if kept else alone
            forms = sum(e.measured_parts for e in found.effects)
            rank = (not gap.at_floor, float(forms) if gap.at_floor else gap.value)
            if (gap.at_floor or gap.value < most) and (best is None or rank <= best[0]):
                best = rank, found
            if best is not None and best[0] == (False, 1.0):
                break
        return None if best is None else self._put_measured(best[1])

    def _gap_of(self, found: Refitted, z: Measured) -> Gap:
        return self.gaps.gap(z.final, found.mean, found.vectors)

    def _put_measured(self, found: Refitted) -> NullModel:
        """Put what was measured into the model, without effects that are not beside it, and their rounds."""
        held = {h.tag for this in self.rounds for h in this.added.hypotheses}
        gone = held - found.tags
        self.model = tuple(e for e in self.model if e.tag not in gone)
        changed = [i for i, this in enumerate(self.rounds) if gone & {h.tag for h in this.added.hypotheses}]
        self.rounds = self.rounds[: min(changed, default=len(self.rounds))]
        last = self.rounds[-1].extended if self.rounds else self.first
        return self._put(Comparison(found, (found,)), found, (), last)

    def _unexplained(self, z: Measured) -> Unexplained:
        """Return what measures beside effects that the model had before the search; always the same."""
        if self.unexplained is None:
            self.unexplained = Unexplained(
                self.frames,
                self.plain,
                self._refitter(z, tuple(h for this in self.rounds for h in this.added.hypotheses)),
                self.work.refit,
                lambda model: self.work.mapped(model)[1],
                lambda found: self._established(found, z),
                self.work.seed_of("covariances"),
                self.settings.extended_replicates,
                self.effort,
                self.defects,
            )
        return self.unexplained

    def _sure(self, null: NullModel, z: Measured) -> tuple[Hypothesis, ...]:
        """Return the effects that were added of which the model accounts for what they move."""
        if not self.rounds:
            return ()
        rest = left_of(self.rounds, null, z, self._allowed)
        return tuple(
            h
            for this in self.rounds
            for h, part in zip(this.added.hypotheses, this.added.parts, strict=True)
            if not unexplained_of_its_own(part, rest, this.null)
        )

    def tolerance(self) -> FloatArray | float:
        """Return what is not held against effects that were added: a fraction of what they do."""
        if not self.rounds:
            return 0.0
        parts = np.concatenate([this.added.parts for this in self.rounds])
        return tolerance(parts, self._allowed, self.first.events)

    @property
    def _allowed(self) -> float:
        """Relative error of what effects do at their best fit: their details are never quite the sensor's."""
        return self.settings.model_error / 2.0

    def close(self, before: Gap, null: NullModel, z: Measured, disagrees: bool) -> Added:
        """Measure the gap on the final frames after each effect, and with rivals in its place."""
        return AddedRounds(self.rounds, self.gaps, z, self.settings, self._allowed).close(
            before, null, disagrees
        )

    def fitted(self, model: tuple[Effect, ...]) -> Fitted:
        """Return the maps under the model, with that taken out of H which effects add to single pixels.

        Such exposure is looked for in all frames, since those are fitted in the end; nothing else rests on
        it. The replicates of the search are simulated with the pixels' mean exposure: which ones blink is
        drawn anew.
        """
        frames, plain, maps, expected = self.frames, self.plain, self.fit.maps, None
        assert plain.covariance is not None
        if self.rounds:
            code = self.evidence[0].code
            codes = code.first + np.arange(code.observed.size)
            train = frames.numbers[frames.splits.train]
            expected = expected_codes(maps, frames.effects(self.model), codes, train, self.fit.added)
        model = frames.effects(model)
        try:
            added = added_exposures(model, frames.stack, frames.numbers, plain.maps)
        except ConfigError as error:
            self.defects["added exposure"] = str(error)
            added = None
        if added is not None:
            seen = frames.seen
            maps = refit_maps(
                frames.stack[seen], plain.maps, model, plain.covariance, added, frames.numbers[seen]
            ).maps
        return Fitted(maps, expected, added)

    # -- pieces ---------------------------------------------------------------------------------

    def _beside(self, model: tuple[Effect, ...], fit: Refit, null: NullModel, z: Measured) -> Evidence | None:
        """Return the evidence of the seen frames beside the effects of a model; None where it has none.

        Counts per code beside those that the model expects, and the vector as it deviates from the model's.
        """
        if not model:
            return None
        code, numbers = self.plain.code, self.frames.numbers[self.frames.seen]
        codes = code.first + np.arange(code.observed.size)
        expected = expected_codes(fit.maps, self.frames.effects(model), codes, numbers, fit.added)
        left = dict(zip(null.names, null.pulls(z.both, 2).tolist(), strict=True))
        return replace(
            self.plain, code=code if expected is None else replace(code, expected=expected), z=left
        )

    def _noise(self, null: NullModel, splits: int, slopes: FloatArray | None = None) -> Noise:
        """Return the noise of a shift of the mean of so many splits; ``slopes`` are of doubtful strengths."""
        covariance = null.covariance * (1.0 / splits + 1.0 / null.n_replicates)
        if slopes is not None:
            covariance = covariance + _DOUBT**2 * slopes.T @ slopes
        return Noise(covariance, self.settings.model_error, null.events / splits)

    def _refitter(self, z: Measured, held: tuple[Hypothesis, ...]) -> Refitter:
        """Return what fits effects beside those that the model had before the search."""
        found = {h.tag for h in held}
        present = tuple(e for e in self.model if e.tag not in found)

        def draw(effects: tuple[Effect, ...], count: int) -> tuple[Refit, FloatArray]:
            model = along_chain(present, effects)
            if model not in self.drawn:
                self.drawn[model] = _Drawn(*self.work.mapped(model))
            one = self.drawn[model]
            done = len(one.vectors)
            one.vectors += self.work.replicates(model, one.sensor, "grown", count - done, done)
            return one.fit, as_matrix(self.first.names, one.vectors[:count], self.first.mean)

        events = np.asarray(self._noise(self.first, 2).events)

        def allow(words: str) -> None:
            self.effort.check(f"{words} was fitted")

        return Refitter(draw, self.first, z.both, events, present, allow=allow)

    def _established(self, added: Refitted, z: Measured) -> tuple[Hypothesis, ...]:
        """Return the effects of which the data have certainly some, the final frames too.

        Those had no part in finding them: a true effect of 4.5 standard errors in two thirds of the frames
        misses them once in seventy times; a chance passes once in six.
        """
        first, n = self.first, len(added.vectors)
        certain = _certain(added, z.both - first.mean, self._noise(first, 2))
        noise = replace(self._noise(first, 1), covariance=added.covariance * (1.0 + 1.0 / n))
        final = replace(fit_set(added.hypotheses, z.final - first.mean, noise), certain=certain)
        proven = {h.tag for h in final.established(_CONFIRMED)}
        clear = (1.0 + np.expm1(added.change) > _ESTABLISHED * added.stderr) | certain
        return tuple(
            h for h, is_clear in zip(added.hypotheses, clear, strict=True) if is_clear and h.tag in proven
        )

    def _put(
        self, found: Comparison, added: Refitted, hypotheses: tuple[Hypothesis, ...], null: NullModel
    ) -> NullModel:
        """Put a set into the model, at the strengths to which its replicates correct it."""
        # within a standard error the steps end, too
        near = np.abs(added.change) < np.maximum(_NEAR, added.stderr)
        change = np.where(near, np.expm1(added.change), 0.0)
        try:
            corrected = self._take(added, change)
        except NotFittedError:  # a step too far
            change = np.zeros_like(change)
            corrected = self._take(added, change)
        self.held = added
        extended = NullModel.from_replicates(self.first.names, added.vectors, self.first)
        extended = extended.shifted(np.sum(added.slopes * change[:, None], axis=0))
        fitted = np.array([bool(h.effect.strength) for h in added.hypotheses])
        extended = replace(extended, strengths=added.slopes * (added.stderr * fitted)[:, None])
        errors = dict(zip((h.tag for h in corrected), added.stderr, strict=True))
        now = {h.tag: h for h in corrected}
        self.rounds = [this.updated(now, errors) for this in self.rounds]
        before = {h.tag for this in self.rounds for h in this.added.hypotheses}
        new = tuple(h for h in corrected if h.tag not in before)
        fit = SetFit(
            new, np.ones(len(new)), np.array([errors[h.tag] for h in new]), np.zeros(len(new), np.bool_)
        )
        self.rounds.append(Round(found, fit, hypotheses, null, extended, self.fit.moved))
        return extended

    def _take(self, added: Refitted, change: FloatArray) -> tuple[Hypothesis, ...]:
        """Take a set into the model, its factors changed by shares; fit the pixels with it, and return it."""
        taken = tuple(h.times(1.0 + float(c)) for h, c in zip(added.hypotheses, change, strict=True))
        tags = {h.tag for h in taken}
        model = along_chain([e for e in self.model if e.tag not in tags], [h.effect for h in taken])
        self.fit, self.sensor = self.work.mapped(model)
        self.model = model
        return taken


def _certain(added: Refitted, shift: FloatArray, noise: Noise) -> NDArray[np.bool_]:
    """Tell which effects an exact count asks for, however few events it has."""
    counted = (added.parts * noise.events > 0.0) & (shift > 0.0)
    return np.asarray(counted.any(axis=1))
