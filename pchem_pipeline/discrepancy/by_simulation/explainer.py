"""Effects are told apart in frames by simulation: what each would do to many statistics, refit included.

The frames are split in three; effects are estimated on the first two parts, compared by cross-validation
between them, and the gap that remains is measured on the third. That one has no part in finding or fitting
anything; what it does not show at all is not named.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import ConfigError, InputError
from pchem_pipeline.discrepancy.build_verdict import Added, Fitted
from pchem_pipeline.discrepancy.by_simulation.additions import AddedRounds, Round
from pchem_pipeline.discrepancy.by_simulation.candidates import (
    REPEATS,
    Mapper,
    ReplicateSimulator,
    candidate_classes,
    placebo_for,
    serial,
)
from pchem_pipeline.discrepancy.by_simulation.fingerprints import (
    Choice,
    Hypothesis,
    Noise,
    SetFit,
    choose,
    correction,
    fit_set,
    tolerance,
)
from pchem_pipeline.discrepancy.by_simulation.maps import Refit, equivalent_sensor, expected_codes, refit_maps
from pchem_pipeline.discrepancy.by_simulation.replicate import Acquisition, Replicate
from pchem_pipeline.discrepancy.gap import Gap, StatisticsGap
from pchem_pipeline.discrepancy.null import Measured, NullModel, as_matrix, suspicious
from pchem_pipeline.discrepancy.observe.catalogue import EXACT, STATISTICS
from pchem_pipeline.discrepancy.observe.observe import observe
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.skeleton import search
from pchem_pipeline.discrepancy.splits import Splits, block_length, split_frames
from pchem_pipeline.discrepancy.verdict import Discrepancy, Examined
from pchem_pipeline.effects.framework.added_exposure import added_exposures
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
from pchem_pipeline.effects.framework.registry import effect_classes

__all__ = ["FrameExplainer", "FrameStack", "find_discrepancies"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_FEWEST_PIXELS = 32
_REFINEMENTS = 4
_CLOSE = 0.02  # relative: strengths known so well are not simulated again
_NEAR = 0.1  # relative: so little is not worth another simulation, but can be corrected without one
# standard deviations by which a statistic must move to show how well a simulation predicted it
_MOVED = 4.0
_WORTH = 6.0  # nats by which an effect must better the fit of the others
_CONVINCING = 6.0  # nats that a set must be worth on held-out frames where no statistic deviates by itself
# standard errors of its strength that an effect must have: the best of some hundred guesses reaches more
# than a single one would by chance
_ESTABLISHED = 4.5
_CONFIRMED = 1.0  # the same in the final frames, half as many, which nothing was chosen by
_MISTAKEN = 0.003  # share of pixels with an ambiguous bias from which replicates are fitted from nothing
_FINE_ERROR = 0.02  # model error while strengths are refined: the names are settled, the numbers count


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
    return search(FrameExplainer(frames, settings, tuple(model), mapper))


@dataclass(frozen=True)
class FrameStack:
    """The frames that are looked at.

    Attributes:
        stack: (frame, y, x), DN.
        numbers: of the frames in the run, shape (frame,).
        splits: train, test and final part.
        n_run: frames of the whole run.
        bit_depth: bits of the ADC.
        integration_time: s.
    """

    stack: NDArray[np.unsignedinteger]
    numbers: IntArray
    splits: Splits
    n_run: int
    bit_depth: int
    integration_time: float

    @property
    def seen(self) -> IntArray:
        """Positions of the train and test frames."""
        return np.sort(np.concatenate([self.splits.train, self.splits.test]))

    def observe(self, part: IntArray, maps: PixelMaps | None = None) -> Evidence:
        """Observe some frames, and as replicates are observed: near known maps, and the same pixels.

        A fit from nothing finds a bias that is off by an electron more often than one near the truth: then
        frames and replicates would differ without any effect.
        """
        return observe(
            self.stack[part],
            self.numbers[part],
            n_run=self.n_run,
            block_frames=self.splits.block_frames,
            exclude=None if maps is None else ~maps.usable,
            start=maps,
        )

    def acquisition(self, mistaken: float = 0.0) -> Acquisition:
        """Return how replicates of the train part are taken.

        Args:
            mistaken: share of pixels whose bias may be off by an electron.
        """
        return Acquisition(
            self.numbers[self.splits.train],
            self.n_run,
            self.splits.block_frames,
            self.bit_depth,
            self.integration_time,
            fitted_with=self.numbers[self.splits.test] if mistaken > _MISTAKEN else None,
        )


@dataclass(frozen=True)
class _Explanation:
    """The best set of a round, all hypotheses that it was compared with, and what simulated them."""

    simulator: ReplicateSimulator
    hypotheses: tuple[Hypothesis, ...]
    choice: Choice


@dataclass
class FrameExplainer:
    """Tells effects apart in frames; see :class:`~pchem_pipeline.discrepancy.skeleton.Explainer`."""

    frames: FrameStack
    settings: DiscrepancySettings
    model: tuple[Effect, ...]
    mapper: Mapper
    samples: str = "frames"
    n_replicates: int = 0
    left_out: dict[str, str] = field(default_factory=dict)
    rounds: list[Round] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Refuse unknown candidates before anything is done."""
        self.classes = candidate_classes(self.settings)
        self.untestable = {tag: c.untestable for tag, c in effect_classes().items() if c.untestable}
        self.most_rounds = self.settings.max_rounds

    def split(self) -> tuple[Evidence, Examined]:
        """Observe train and test frames together, then each part near their fit."""
        # parameters of a third of the frames scatter too much to stand for the pixels
        splits = self.frames.splits
        self.plain = self.frames.observe(self.frames.seen)
        usable = self.plain.maps.usable
        if usable.sum() < _FEWEST_PIXELS:
            raise InputError(
                f"{int(usable.sum())} of {usable.size} pixels have a usable fit, "
                f"fewer than {_FEWEST_PIXELS}: nothing can be compared; see fit_status, or take more frames"
            )
        parts = splits.train, splits.test, splits.final
        self.evidence = tuple(self.frames.observe(part, self.plain.maps) for part in parts)
        self.fit, self.maps = self._mapped()
        return self.evidence[0], splits.examined(self.frames.stack.shape)

    def null(self) -> tuple[NullModel, Measured]:
        """Simulate and observe the fitted model, refit included."""
        vectors = self._replicates(self.maps, "r0", self.settings.replicates)
        common = set(STATISTICS).intersection(*vectors, *(e.z for e in self.evidence))
        names = tuple(name for name in STATISTICS if name in common)
        self.first = NullModel.from_replicates(names, as_matrix(names, vectors))
        n_samples = self.frames.splits.final.size * int(self.evidence[0].maps.usable.sum())
        self.gaps = StatisticsGap(self.first, n_samples)
        return self.first, Measured(*(as_matrix(names, [e.z])[0] for e in self.evidence))

    def gap(self, null: NullModel, z: Measured) -> Gap:
        """Measure the gap in the statistics of the final frames."""
        return self.gaps.gap(z.final, null.mean, null.replicates)

    def suspects(self, null: NullModel, z: Measured) -> bool:
        """Tell whether some statistic deviates so far that a candidate may explain it with others."""
        return suspicious(null, z)

    def explain(self, null: NullModel, z: Measured, disagrees: bool) -> _Explanation | None:
        """Simulate what candidates would do, and choose the set that best predicts held-out frames."""
        number = len(self.rounds)
        simulator = ReplicateSimulator(
            self.maps,
            self.model,
            self.frames.acquisition(),
            null.names,
            self._counted,
            f"r{number}",
            self._seed("fingerprint", number),
            dict(self.left_out),
        )
        shifts = (z.train - null.mean, z.test - null.mean)
        guesses = simulator.guesses(self.classes, (self.plain, *self.evidence[:2]))
        placebo = placebo_for(guesses, self.classes)
        hypotheses = simulator.fingerprints([*guesses, *placebo])
        hypotheses = simulator.refined(hypotheses, (shifts[0] + shifts[1]) / 2.0, self._noise(null, 2))
        choice = choose(hypotheses, shifts, self._noise(null, 1)) if hypotheses else None
        self.left_out |= simulator.left_out
        if choice is None or not (disagrees or choice.advantage > _CONVINCING):
            return None
        return _Explanation(simulator, tuple(hypotheses), choice)

    def add(self, explanation: _Explanation, null: NullModel, z: Measured) -> NullModel | None:
        """Put the chosen effects into the model; None, and the model as it was, where none is established.

        Asked three times: of the strengths as few simulations give them, as the replicates correct them, and
        of the final frames.
        """
        before, shift, noise = self.model, z.both - null.mean, self._noise(null, 2)
        simulator, choice = explanation.simulator, explanation.choice
        chosen = self._needed(simulator, choice.present(self.settings.certainty), shift, noise)
        while chosen:
            added = self._added(simulator, chosen, shift, noise)
            if added is None:
                break
            self.model = (*before, *(h.effect for h in added.hypotheses))
            _, maps = self._mapped()
            extended = self._extended_null(maps, f"{simulator.prefix}-grown")  # of the random numbers
            added, extended = self._corrected(added, null, extended, z)
            proven = {h.tag for h in self._confirmed(added, z.final - null.mean, self._noise(null, 1))}
            chosen = tuple(h for h in added.established(_ESTABLISHED) if h.tag in proven)
            if len(chosen) == len(added.hypotheses):
                self.model = (*before, *(h.effect for h in added.hypotheses))
                self.fit, self.maps = self._mapped()
                moved = self.fit.moved
                self.rounds.append(Round(choice, added, explanation.hypotheses, null, extended, moved))
                return extended
        self.model = before
        return None

    def tolerance(self) -> FloatArray | float:
        """Return what is not held against effects that were added: a fraction of what they do."""
        if not self.rounds:
            return 0.0
        parts = np.concatenate([this.added.parts for this in self.rounds])
        return tolerance(parts, self.settings.model_error)

    def close(self, before: Gap, null: NullModel, z: Measured, disagrees: bool) -> Added:
        """Measure the gap on the final frames after each effect, and with rivals in its place."""
        return AddedRounds(self.rounds, self.gaps, z, self.settings).close(before, null, disagrees)

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
            expected = expected_codes(maps, self.model, codes, frames.numbers[frames.splits.train])
        try:
            added = added_exposures(model, frames.stack, frames.numbers, plain.maps)
        except ConfigError as error:
            self.left_out["added exposure"] = str(error)
            added = None
        if added is not None:
            seen = frames.seen
            maps = refit_maps(
                frames.stack[seen], plain.maps, model, plain.covariance, added, frames.numbers[seen]
            ).maps
        return Fitted(maps, expected, added)

    # -- pieces ---------------------------------------------------------------------------------

    def _mapped(self) -> tuple[Refit, PixelMaps]:
        """Return the fit of the seen frames under the present model, and maps to draw replicates from."""
        plain, fit = self.plain, None
        assert plain.covariance is not None
        if self.model:
            seen = self.frames.seen
            fit = refit_maps(
                self.frames.stack[seen],
                plain.maps,
                self.model,
                plain.covariance,
                numbers=self.frames.numbers[seen],
            )
        fit = fit or Refit(plain.maps, {}, plain.covariance)
        return fit, equivalent_sensor(fit.maps, fit.covariance)

    def _replicates(self, maps: PixelMaps, prefix: str, count: int) -> list[Mapping[str, float]]:
        """Simulate and observe the present model ``count`` times."""
        text = "|".join(e.model_dump_json() for e in self.model)
        digest = hashlib.sha256(text.encode()).hexdigest()[:10]
        taken = self.frames.acquisition(self.plain.ambiguous)
        tasks = [
            Replicate(f"{prefix}-null-{digest}-{i}", maps, self.model, self._seed(prefix, i), taken)
            for i in range(count)
        ]
        vectors: list[Mapping[str, float]] = []
        for result in self._counted(tasks):
            if isinstance(result, Exception):
                raise result
            vectors.append(result)
        return vectors

    def _extended_null(self, maps: PixelMaps, prefix: str) -> NullModel:
        """Return the null of the model with effects; statistics that they leave scatter as they did."""
        vectors = self._replicates(maps, prefix, self.settings.extended_replicates)
        return NullModel.from_replicates(self.first.names, as_matrix(self.first.names, vectors), self.first)

    def _counted(self, replicates: Sequence[Replicate]) -> list[Mapping[str, float] | Exception]:
        self.n_replicates += len(replicates)
        return self.mapper(replicates)

    def _seed(self, purpose: str, index: int = 0) -> int:
        text = f"{self.settings.seed}/{purpose}/{index}"
        return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=7).digest(), "little")

    def _noise(self, null: NullModel, splits: int) -> Noise:
        """Return the noise of a shift of the mean of so many splits."""
        covariance = null.covariance * (1.0 / splits + 1.0 / null.n_replicates)
        events = np.array([EXACT.get(name, 0.0) for name in null.names]) / splits
        return Noise(covariance, self.settings.model_error, events)

    def _needed(
        self, simulator: ReplicateSimulator, chosen: tuple[Hypothesis, ...], shift: FloatArray, noise: Noise
    ) -> tuple[Hypothesis, ...]:
        """Drop, the weakest first, what explains little that the others do not at their best strengths.

        The comparison of the sets extrapolates strengths; of a strong effect that leaves enough for another.
        """
        if len(chosen) == 1:
            return chosen
        chosen = _tuned(simulator, chosen, shift, noise)
        fit = fit_set(chosen, shift, noise)
        weight = np.diag(noise.covariance) ** -0.5
        order = np.argsort([float(np.sum((weight * part) ** 2)) for part in fit.parts])
        for one in [chosen[i] for i in order if not fit.certain[i]]:
            others = tuple(h for h in chosen if h.tag != one.tag)
            if others:
                others = _tuned(simulator, others, shift, noise)
                gain = fit.log_score(shift, noise) - fit_set(others, shift, noise).log_score(shift, noise)
                if gain < _WORTH:
                    chosen, fit = others, fit_set(others, shift, noise)
        return chosen

    def _added(
        self, simulator: ReplicateSimulator, chosen: tuple[Hypothesis, ...], shift: FloatArray, noise: Noise
    ) -> SetFit | None:
        """Refine the strengths of the chosen set together; drop what may be nothing; None if that is all."""
        noise = replace(noise, model_error=_FINE_ERROR)
        while chosen:
            chosen = _tuned(simulator, chosen, shift, noise)
            kept = fit_set(chosen, shift, noise).established(_ESTABLISHED)
            if len(kept) == len(chosen):
                break
            chosen = kept
        else:
            return None
        fit = fit_set(chosen, shift, noise)
        near = np.where(np.abs(fit.factors - 1.0) < _NEAR, fit.factors, 1.0)
        last = [
            Hypothesis(h.rescaled(float(c)), h.fingerprint * c) for h, c in zip(chosen, near, strict=True)
        ]
        return SetFit(tuple(last), np.ones(len(last)), fit.stderr / near, fit.certain)

    def _confirmed(self, added: SetFit, shift: FloatArray, noise: Noise) -> tuple[Hypothesis, ...]:
        """Return the effects that the final frames show too, which had no part in finding them.

        A true effect of 4.5 standard errors in two thirds of the frames misses this once in seventy times; a
        chance passes it once in six.
        """
        fit = replace(fit_set(added.hypotheses, shift, noise), certain=added.certain)
        return fit.established(_CONFIRMED)

    def _corrected(
        self, added: SetFit, null: NullModel, extended: NullModel, z: Measured
    ) -> tuple[SetFit, NullModel]:
        """Correct the strengths by the mean of the replicates, of which one simulation was but a sample."""
        total = added.parts.sum(axis=0)
        moved = np.abs(total) > _MOVED
        ratio = np.where(moved, (extended.mean - null.mean) / np.where(moved, total, 1.0), 1.0)
        parts = added.parts * np.clip(ratio, 0.5, 2.0)
        noise = replace(self._noise(extended, 2), model_error=_FINE_ERROR)
        change, stderr = correction(parts, z.both - extended.mean, noise)
        change *= np.array([bool(h.effect.strength) for h in added.hypotheses])
        new = tuple(
            Hypothesis(h.rescaled(1.0 + float(c)), part * (1.0 + c))
            for h, part, c in zip(added.hypotheses, parts, change, strict=True)
        )
        fit = SetFit(new, np.ones(len(new)), stderr / (1.0 + change), added.certain)
        return fit, extended.shifted(np.sum(parts * change[:, None], axis=0))


def _tuned(
    simulator: ReplicateSimulator, chosen: tuple[Hypothesis, ...], shift: FloatArray, noise: Noise
) -> tuple[Hypothesis, ...]:
    """Return a set at the strengths that explain the shift best."""
    [best] = simulator.tuned([chosen], shift, noise, steps=_REFINEMENTS, close=_CLOSE, repeats=REPEATS)
    return best
