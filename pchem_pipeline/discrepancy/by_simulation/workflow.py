"""Discover, name, add, show, and again: from a stack of frames to a verdict and a better model.

Arrays in, verdict out. The frames are split in three; effects are estimated on the first two parts, compared
by cross-validation between them, and the gap that remains is measured on the third. That one has no part in
finding or fitting anything; what it does not show at all is not named.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.discrepancy.by_simulation.build_verdict import Round, tell
from pchem_pipeline.discrepancy.by_simulation.candidates import (
    REPEATS,
    Laboratory,
    Mapper,
    candidate_classes,
    placebo_for,
    serial,
)
from pchem_pipeline.discrepancy.by_simulation.disagreement import Measured, disagrees, suspicious
from pchem_pipeline.discrepancy.by_simulation.equivalent_sensor import likely_truth
from pchem_pipeline.discrepancy.by_simulation.fingerprints import (
    Hypothesis,
    Noise,
    SetFit,
    correction,
    fit_set,
    tolerance,
)
from pchem_pipeline.discrepancy.by_simulation.naming import Choice, choose
from pchem_pipeline.discrepancy.by_simulation.null import NullModel, as_matrix
from pchem_pipeline.discrepancy.by_simulation.refit import (
    Refit,
    expected_codes,
    refit_maps,
    with_steady_exposure,
)
from pchem_pipeline.discrepancy.by_simulation.replicate import Acquisition, Replicate
from pchem_pipeline.discrepancy.observe.catalogue import EXACT, STATISTICS
from pchem_pipeline.discrepancy.observe.observe import observe
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.splits import Splits, block_length, split_frames
from pchem_pipeline.discrepancy.verdict import Discrepancy, Place
from pchem_pipeline.discrepancy.where import locate
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps

__all__ = ["find_discrepancies"]

FloatArray = NDArray[np.float64]

_FEWEST_PIXELS = 32
_REFINEMENTS = 4
_CLOSE = 0.02  # relative: strengths known so well are not simulated again
_NEAR = 0.1  # relative: so little is not worth another simulation, but can be corrected without one
_TELLING = (
    4.0  # standard deviations by which a statistic must move to tell how well a simulation predicted it
)
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
    numbers: NDArray[np.int64] | None = None,
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
    length = block_length(stack.shape[0], settings.block_frames)
    splits = split_frames(numbers, length)
    if bit_depth is None:
        bit_depth = min(int(stack.max()).bit_length() + 1, 24)
    search = _Search(
        stack,
        numbers,
        splits,
        settings,
        n_run or int(numbers[-1]) + 1,
        bit_depth,
        integration_time,
        tuple(model),
        mapper,
    )
    return search.run()


@dataclass(frozen=True)
class _Grown:
    """The model with the effects of a round: how strong they are, what it predicts, and the pixels' fit."""

    added: SetFit
    null: NullModel
    fit: Refit
    maps: PixelMaps


@dataclass
class _Search:
    """The state of the workflow."""

    stack: NDArray[np.unsignedinteger]
    numbers: NDArray[np.int64]
    splits: Splits
    settings: DiscrepancySettings
    n_run: int
    bit_depth: int
    integration_time: float
    model: tuple[Effect, ...]
    mapper: Mapper
    left_out: dict[str, str] = field(default_factory=dict)
    n_replicates: int = 0
    mistaken: float = 0.0  # share of pixels whose bias may be off by an electron

    def run(self) -> Discrepancy:
        """Go through the rounds."""
        classes = candidate_classes(self.settings)
        # parameters of a third of the frames scatter too much to stand for the pixels
        plain = self._observe(self._seen())
        self._check(plain)
        self.mistaken = plain.ambiguous
        train, test, final = (self._observe(part, plain.maps) for part in self._parts())
        fit, maps = self._mapped(plain)
        null, names = self._null(maps, "r0", self.settings.replicates, (train, test, final))
        z = Measured(*(self._row(evidence, names) for evidence in (train, test, final)))
        first = null
        rounds: list[Round] = []
        limit = self.settings.significance
        places = locate(train, null, z.both, limit)
        still = disagrees(null, z, limit)
        search = still or suspicious(null, z)
        while search and len(rounds) < self.settings.max_rounds:
            number = len(rounds)
            laboratory = self._laboratory(maps, names, number)
            shifts = (z.train - null.mean, z.test - null.mean)
            seen = plain, train, test
            hypotheses = self._hypotheses(laboratory, classes, seen, shifts, self._noise(null, 2))
            choice = choose(hypotheses, shifts, self._noise(null, 1)) if hypotheses else None
            self.left_out |= laboratory.left_out
            if choice is None or not (still or choice.advantage > _CONVINCING):
                break
            grown = self._grow(plain, laboratory, choice, null, first, z)
            if grown is None:
                break
            rounds.append(Round(choice, grown.added, tuple(hypotheses), null, grown.null, grown.fit.moved))
            fit, maps, null = grown.fit, grown.maps, grown.null
            search = still = disagrees(null, z, limit, self._tolerance(rounds))
        found = self._result(rounds, first, null, z, places, train, fit.maps, still)
        return with_steady_exposure(found, plain, self.stack, self.numbers, self._seen())

    # -- pieces ---------------------------------------------------------------------------------

    def _parts(self) -> tuple[NDArray[np.int64], ...]:
        return self.splits.train, self.splits.test, self.splits.final

    def _seen(self) -> NDArray[np.int64]:
        """Return the positions of the train and test frames."""
        return np.sort(np.concatenate([self.splits.train, self.splits.test]))

    def _observe(self, part: NDArray[np.int64], maps: PixelMaps | None = None) -> Evidence:
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

    def _refit(self, plain: Evidence) -> Refit:
        """Return the fit of the seen frames under the present model."""
        assert plain.covariance is not None
        if not self.model:
            return Refit(plain.maps, {}, plain.covariance)
        return refit_maps(self.stack[self._seen()], plain.maps, self.model, plain.covariance)

    def _check(self, seen: Evidence) -> None:
        usable = int(seen.maps.usable.sum())
        if usable < _FEWEST_PIXELS:
            raise InputError(
                f"{usable} of {seen.maps.usable.size} pixels have a usable fit, "
                f"fewer than {_FEWEST_PIXELS}: nothing can be compared; see fit_status, or take more frames"
            )

    def _acquisition(self) -> Acquisition:
        return Acquisition(
            self.numbers[self.splits.train],
            self.n_run,
            self.splits.block_frames,
            self.bit_depth,
            self.integration_time,
        )

    def _null(
        self,
        maps: PixelMaps,
        prefix: str,
        count: int,
        measured: Sequence[Evidence],
        before: NullModel | None = None,
    ) -> tuple[NullModel, tuple[str, ...]]:
        """Simulate and observe the present model ``count`` times."""
        text = "|".join(e.model_dump_json() for e in self.model)
        digest = hashlib.sha256(text.encode()).hexdigest()[:10]
        taken = self._acquisition()
        if self.mistaken > _MISTAKEN:
            taken = replace(taken, beside=self.numbers[self.splits.test])
        tasks = [
            Replicate(f"{prefix}-null-{digest}-{i}", maps, self.model, self._seed(prefix, i), taken)
            for i in range(count)
        ]
        self.n_replicates += count
        vectors: list[Mapping[str, float]] = []
        for result in self.mapper(tasks):
            if isinstance(result, Exception):
                raise result
            vectors.append(result)
        names = () if before is None else before.names
        if before is None:
            common = set(STATISTICS).intersection(*vectors, *(e.z for e in measured))
            names = tuple(name for name in STATISTICS if name in common)
        return NullModel.from_replicates(names, as_matrix(names, vectors), before), names

    def _seed(self, purpose: str, index: int = 0) -> int:
        text = f"{self.settings.seed}/{purpose}/{index}"
        return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=7).digest(), "little")

    def _row(self, evidence: Evidence, names: tuple[str, ...]) -> FloatArray:
        return np.asarray(as_matrix(names, [evidence.z])[0])

    def _tolerance(self, rounds: Sequence[Round]) -> FloatArray | float:
        """Return what is not held against effects that were added: a fraction of what they do."""
        if not rounds:
            return 0.0
        parts = np.concatenate([this.added.parts for this in rounds])
        return tolerance(parts, self.settings.model_error)

    def _noise(self, null: NullModel, splits: int) -> Noise:
        """Return the noise of a shift of the mean of so many splits."""
        covariance = null.covariance * (1.0 / splits + 1.0 / null.n_replicates)
        events = np.array([EXACT.get(name, 0.0) for name in null.names]) / splits
        return Noise(covariance, self.settings.model_error, events)

    def _laboratory(self, maps: PixelMaps, names: tuple[str, ...], number: int) -> Laboratory:
        return Laboratory(
            maps,
            self.model,
            self._acquisition(),
            names,
            self._counted,
            f"r{number}",
            self._seed("fingerprint", number),
            dict(self.left_out),
        )

    def _counted(self, replicates: Sequence[Replicate]) -> list[Mapping[str, float] | Exception]:
        self.n_replicates += len(replicates)
        return self.mapper(replicates)

    def _hypotheses(
        self,
        laboratory: Laboratory,
        classes: Mapping[str, type[Effect]],
        evidence: Sequence[Evidence],
        shifts: tuple[FloatArray, FloatArray],
        noise: Noise,
    ) -> list[Hypothesis]:
        guesses = laboratory.guesses(classes, evidence)
        placebo = placebo_for(guesses, classes)
        hypotheses = laboratory.fingerprints([*guesses, *placebo])
        shift = (shifts[0] + shifts[1]) / 2.0
        return laboratory.refined(hypotheses, shift, noise)

    def _grow(
        self,
        plain: Evidence,
        laboratory: Laboratory,
        choice: Choice,
        null: NullModel,
        first: NullModel,
        z: Measured,
    ) -> _Grown | None:
        """Put the chosen effects into the model; None, and the model as it was, where none is established.

        Asked three times: of the strengths as few simulations give them, as the replicates correct them, and
        of the final frames.
        """
        before, shift, noise = self.model, z.both - null.mean, self._noise(null, 2)
        chosen = self._needed(laboratory, choice.present(self.settings.certainty), shift, noise)
        while chosen:
            added = self._added(laboratory, chosen, shift, noise)
            if added is None:
                break
            self.model = (*before, *(h.effect for h in added.hypotheses))
            _, maps = self._mapped(plain)
            count = self.settings.grown_replicates
            grown, _ = self._null(maps, f"{laboratory.prefix}-grown", count, (), first)
            added, grown = self._corrected(added, null, grown, z)
            proven = {h.tag for h in self._confirmed(added, z.final - null.mean, self._noise(null, 1))}
            chosen = tuple(h for h in added.established(_ESTABLISHED) if h.tag in proven)
            if len(chosen) == len(added.hypotheses):
                self.model = (*before, *(h.effect for h in added.hypotheses))
                return _Grown(added, grown, *self._mapped(plain))
        self.model = before
        return None

    def _mapped(self, plain: Evidence) -> tuple[Refit, PixelMaps]:
        """Return the fit under the present model, and the maps that replicates are drawn from."""
        fit = self._refit(plain)
        return fit, likely_truth(fit.maps, fit.covariance)

    def _needed(
        self, laboratory: Laboratory, chosen: tuple[Hypothesis, ...], shift: FloatArray, noise: Noise
    ) -> tuple[Hypothesis, ...]:
        """Drop, the weakest first, what explains little that the others do not at their best strengths.

        The comparison of the sets extrapolates strengths; of a strong effect that leaves enough for another.
        """
        if len(chosen) == 1:
            return chosen
        chosen = _tuned(laboratory, chosen, shift, noise)
        fit = fit_set(chosen, shift, noise)
        weight = np.diag(noise.covariance) ** -0.5
        order = np.argsort([float(np.sum((weight * part) ** 2)) for part in fit.parts])
        for one in [chosen[i] for i in order if not fit.certain[i]]:
            others = tuple(h for h in chosen if h.tag != one.tag)
            if others:
                others = _tuned(laboratory, others, shift, noise)
                gain = fit.log_score(shift, noise) - fit_set(others, shift, noise).log_score(shift, noise)
                if gain < _WORTH:
                    chosen, fit = others, fit_set(others, shift, noise)
        return chosen

    def _added(
        self, laboratory: Laboratory, chosen: tuple[Hypothesis, ...], shift: FloatArray, noise: Noise
    ) -> SetFit | None:
        """Refine the strengths of the chosen set together; drop what may be nothing; None if that is all."""
        noise = replace(noise, model_error=_FINE_ERROR)
        while chosen:
            chosen = _tuned(laboratory, chosen, shift, noise)
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
        self, added: SetFit, null: NullModel, grown: NullModel, z: Measured
    ) -> tuple[SetFit, NullModel]:
        """Correct the strengths by the mean of the replicates, of which one simulation was but a sample."""
        total = added.parts.sum(axis=0)
        moved = np.abs(total) > _TELLING
        ratio = np.where(moved, (grown.mean - null.mean) / np.where(moved, total, 1.0), 1.0)
        parts = added.parts * np.clip(ratio, 0.5, 2.0)
        noise = replace(self._noise(grown, 2), model_error=_FINE_ERROR)
        change, stderr = correction(parts, z.both - grown.mean, noise)
        change *= np.array([bool(h.effect.strength) for h in added.hypotheses])
        new = tuple(
            Hypothesis(h.rescaled(1.0 + float(c)), part * (1.0 + c))
            for h, part, c in zip(added.hypotheses, parts, change, strict=True)
        )
        fit = SetFit(new, np.ones(len(new)), stderr / (1.0 + change), added.certain)
        return fit, grown.shifted(np.sum(parts * change[:, None], axis=0))

    def _result(
        self,
        rounds: list[Round],
        first: NullModel,
        last: NullModel,
        z: Measured,
        places: list[Place],
        train: Evidence,
        maps: PixelMaps,
        still: bool,
    ) -> Discrepancy:
        codes = train.code.first + np.arange(train.code.observed.size)
        grown = expected_codes(maps, self.model, codes, self.splits.train.size) if rounds else None
        return tell(
            rounds,
            code_grown=grown,
            first=first,
            last=last,
            z=z,
            places=places,
            train=train,
            maps=maps,
            model=self.model,
            settings=self.settings,
            still=still,
            left_out=self.left_out,
            n_replicates=self.n_replicates,
            examined=self.splits.examined(self.stack.shape),
        )


def _tuned(
    laboratory: Laboratory, chosen: tuple[Hypothesis, ...], shift: FloatArray, noise: Noise
) -> tuple[Hypothesis, ...]:
    """Return a set at the strengths that explain the shift best."""
    [best] = laboratory.tuned([chosen], shift, noise, steps=_REFINEMENTS, close=_CLOSE, repeats=REPEATS)
    return best
