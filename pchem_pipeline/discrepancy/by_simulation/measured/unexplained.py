"""Empirical descriptions of several forms, everywhere and by part of the sensor, the best one first."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import error_words
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import Hypothesis
from pchem_pipeline.discrepancy.by_simulation.measured.electrons import (
    Electrons,
    electron_chances,
    measured_electrons,
)
from pchem_pipeline.discrepancy.by_simulation.measured.modes import Sums, common_scores, measured_mode
from pchem_pipeline.discrepancy.by_simulation.measured.moves import Measurement, measured_moves
from pchem_pipeline.discrepancy.by_simulation.measured.noise import (
    Covariances,
    measured_noise,
    residual_covariances,
)
from pchem_pipeline.discrepancy.by_simulation.measured.response import (
    Responses,
    measured_response,
    residual_responses,
)
from pchem_pipeline.discrepancy.by_simulation.measured.waves import measured_wave
from pchem_pipeline.discrepancy.by_simulation.sensor.replicate import simulate_frames
from pchem_pipeline.discrepancy.by_simulation.sensor.simulations import Simulations
from pchem_pipeline.discrepancy.by_simulation.sets.refits import FEW, Refitted, Refitter
from pchem_pipeline.discrepancy.by_simulation.sets.trials import leaves_little, leaves_nothing
from pchem_pipeline.discrepancy.effort import EffortSpentError
from pchem_pipeline.discrepancy.null import CONVINCING
from pchem_pipeline.discrepancy.observe.observe import fitted_maps
from pchem_pipeline.discrepancy.observe.pairs import laws_of_frames
from pchem_pipeline.discrepancy.observe.places import Part
from pchem_pipeline.discrepancy.observe.waves import Waves, waves_across
from pchem_pipeline.effects.analog.empirical_noise import Changed, Shared
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import PixelMaps

#: Measures a part of the frames, the pixels fitted with some effects, beside some of these.
Model = tuple[Effect, ...]
Measure = Callable[[Part, Model, Model], Measurement | None]

_WORTHWHILE = 0.25  # of the nats of what is clearest: less cannot be all there is
_AS_CLEAR = 0.5  # of these nats, which are not of the same statistics
_MOST_TRIED = 3  # of all forms and parts
_MEASUREMENTS = 2  # of a component: the pixels are refitted with the first one


class _Shared(NamedTuple):
    """How samples vary together: products and waves of residuals, sums of scores, electrons, responses."""

    covariances: Covariances
    waves: Waves
    scores: dict[tuple[Shared, Changed], Sums]
    electrons: Electrons
    responses: Responses | None


SharedBy = Callable[[Part], _Shared]


class _Likely(NamedTuple):
    """A form that was measured in a part."""

    part: Part
    form: str
    measured: Measurement


@dataclass
class Unexplained:
    """Measures frames beside effects.

    Attributes:
        work: fits and simulates the frames; train and test frames are measured.
        refitter: fits effects to their statistics.
        proven: effects of a set of which the data have certainly some.
        replicates: of what is measured.
        defects: forms that failed, and why.
        instead: what leaves little by itself, once it is known.
        alone: what explains most, at its best fit, once it is known; None: it failed or is not certain.
    """

    work: Simulations
    refitter: Refitter
    proven: Callable[[Refitted], Sequence[Hypothesis]]
    replicates: int
    defects: dict[str, str] = field(default_factory=dict)
    instead: Refitted | None = None
    alone: dict[int, Refitted | None] = field(default_factory=dict)

    @functools.cached_property
    def _forms(self) -> dict[str, Measure]:
        """The forms that the model does not have already."""
        known: dict[str, SharedBy] = {}
        data = self._shared(self.work.frames.seen_stack, self.work.plain.maps)
        forms: dict[str, Measure] = {
            "empirical": self._moves,
            "empirical_noise": functools.partial(self._noise_of_samples, data, known),
            "empirical_response": functools.partial(self._response, data, known),
            "empirical_electrons": functools.partial(self._electrons, data, known),
        }
        return {tag: form for tag, form in forms.items() if tag not in {e.tag for e in self.refitter.present}}

    @functools.cached_property
    def _of_all(self) -> list[_Likely]:
        """What explains most without any effect."""
        return self._likeliest((), self._forms)

    def by_itself(self) -> Refitted | None:
        """Return what no known effect makes, where it leaves little by itself; None where it does not."""
        if self.instead is not None:
            return self.instead
        best: Refitted | None = None
        for number, likely in enumerate(self._of_all):
            clear = likely.measured.gain > _WORTHWHILE * self._of_all[0].measured.gain
            if clear and likely.measured.unlisted:
                found = self._alone(number)
                if found is None or not found.effects[0].empirical_unnamed or not self._leaves_little(found):
                    continue
                if best is None or found.score > best.score:
                    best = found
                if self.leaves_nothing(best):
                    break
        self.instead = best
        return best

    def explains_all(self) -> bool:
        """Tell whether the clearest of what no known effect makes leaves nothing by itself."""
        if not self._of_all or not self._of_all[0].measured.unlisted:
            return False
        found = self._alone(0)
        return found is not None and found.effects[0].empirical_unnamed and self.leaves_nothing(found)

    def clearest(self, unlisted: bool = False) -> Refitted | None:
        """Return the clearest by itself, or another that is as clear; None where they leave more than little.

        Several things together are left out: one of them may be an effect that has a name.

        Args:
            unlisted: only what no known effect makes.
        """
        for number, likely in enumerate(self._of_all):
            one, effect = likely.measured, likely.measured.effect
            as_clear = one.gain > _AS_CLEAR * self._of_all[0].measured.gain
            if not as_clear or effect.measured_parts > 1 or (unlisted and not one.unlisted):
                continue
            found = self._alone(number)
            if found is not None and self._leaves_little(found):
                return found
        return None

    def _alone(self, number: int) -> Refitted | None:
        """Return one of what explains most without any effect, at its best fit; it is fitted once."""
        if number not in self.alone:
            self.alone[number] = self._tried((), self._of_all[number], whole=True)
        return self.alone[number]

    def leaves_nothing(self, one: Refitted) -> bool:
        """Tell whether a set leaves no statistic beyond chance."""
        return leaves_nothing(self.refitter, one)

    def _leaves_little(self, one: Refitted) -> bool:
        """Tell whether a set leaves nothing, or so little of what there was that it may be its details."""
        return leaves_little(self.refitter, one)

    def measured(self, kept: tuple[Hypothesis, ...]) -> Refitted | None:
        """Return effects with what is best measured beside them, and with other forms beside all of these."""
        if not kept and self.instead is not None:
            return self.instead
        forms = dict(self._forms)
        found: Refitted | None = None
        while forms and not (found is not None and self._leaves_little(found)):
            beside, better, score = kept, "", -np.inf
            if found is not None:
                beside, score = found.hypotheses, found.score + CONVINCING
            effects = tuple(h.effect for h in beside)
            for likely in self._likeliest(effects, forms) if effects else self._of_all:
                if likely.form not in forms:
                    continue
                try:
                    one = self._tried(beside, likely) if beside else self._first(likely)
                except EffortSpentError:
                    if found is None:
                        raise
                    return found
                if one is not None and one.score > score:
                    found, better, score = one, likely.form, one.score
                    if self._leaves_little(one):
                        break
            if not better:
                break
            del forms[better]
        return found

    def _first(self, likely: _Likely) -> Refitted | None:
        """Return one of what explains most without any effect, as it was fitted by itself if it was."""
        number = self._of_all.index(likely)
        return self.alone[number] if number in self.alone else self._tried((), likely)

    def _tried(self, kept: tuple[Hypothesis, ...], likely: _Likely, whole: bool = False) -> Refitted | None:
        """Return effects with a form beside them; None where it fails or is not certain."""
        try:
            return self._described(kept, likely.part, self._forms[likely.form], whole)
        except EffortSpentError:
            raise
        # a defect of what is measured must not cost the verdict
        except Exception as error:
            self.defects[likely.form] = error_words(error)
            return None

    def _likeliest(self, effects: Model, forms: Mapping[str, Measure]) -> list[_Likely]:
        """Return the parts and forms that explain most beside effects, what is everywhere included."""
        model = self.refitter.model(effects)
        found: list[_Likely] = []
        self.work.effort.ask(self.work.observed.samples)
        for part, form in itertools.product((Part(), *self.work.frames.parts), forms):
            try:
                one = forms[form](part, model, model)
            # a defect of what is measured must not cost the verdict
            except Exception as error:
                self.defects[form] = error_words(error)
                continue
            if one is not None:
                found.append(_Likely(part, form, one))
        return sorted(found, key=lambda one: -one.measured.gain)[:_MOST_TRIED]

    def _described(
        self, kept: tuple[Hypothesis, ...], part: Part, measure: Measure, whole: bool
    ) -> Refitted | None:
        """Return effects with what is measured in a part beside them at their best fit, or None.

        Effects of which nothing is certain beside it are left out; ``whole``: see `Refitter.refined`.
        """
        refitter, effects = self.refitter, tuple(h.effect for h in kept)
        measured: tuple[Effect, ...] = ()
        for _ in range(_MEASUREMENTS):
            seen = measure(part, refitter.model((*effects, *measured[:1])), refitter.model(effects))
            if seen is None:
                return None
            # what is measured has its places in the window; those of parts are on the sensor
            on_sensor = (self.work.frames.on_sensor(e) for e in (seen.effect, *seen.others))
            measured = tuple(e.at_place(part.region, part.when) for e in on_sensor)
        best: Refitted | None = None
        for effect in measured:
            found = self._fitted(kept, effect, whole)
            if found is not None and (best is None or found.score > best.score):
                best = found
            if best is not None and self._leaves_little(best):
                break
        if best is None:
            return None
        proven = {h.tag for h in self.proven(best)}
        if proven == best.tags:
            return best
        if measured[0].tag not in proven:
            return None
        return self._described(tuple(h for h in kept if h.tag in proven), part, measure, whole)

    def _fitted(self, kept: tuple[Hypothesis, ...], effect: Effect, whole: bool) -> Refitted | None:
        """Return effects with what was measured at their best fit; None where that was not gone for."""
        refitter = self.refitter
        refitter.allow(effect.tag)
        _, vectors = refitter.draw((*(h.effect for h in kept), effect), FEW)
        shift = vectors.mean(axis=0) - refitter.null.mean - sum(h.fingerprint for h in kept)
        found = refitter.refined((*kept, Hypothesis(effect, shift)), whole=whole)
        return None if found.short else refitter.sharpened(found, self.replicates)

    def _moves(
        self, part: Part, present: tuple[Effect, ...], beside: tuple[Effect, ...]
    ) -> Measurement | None:
        """Measure the moves of the samples of a part beside effects, with the pixels as they now are."""
        maps = self.work.refit(present).maps
        own = replace(maps, usable=maps.usable & self.work.frames.inside(part))
        if not own.usable.any():
            return None
        numbers = self.work.frames.seen_numbers
        some = part.frames(numbers)
        return measured_moves(self.work.frames.stack[self.work.frames.seen[some]], numbers[some], own, beside)

    def _noise_of_samples(
        self, data: SharedBy, known: dict[str, SharedBy], part: Part, _: Model, beside: Model
    ) -> Measurement | None:
        """Measure what samples of a part share beyond what effects make of them."""
        own, model = data(part), self._made(known, beside)(part)
        inside = self.work.frames.inside(part)
        found = (
            measured_mode(own.scores, model.scores, self.work.plain.maps, inside),
            measured_noise(own.covariances, model.covariances, self.work.plain, inside),
        )
        best = max(filter(None, found), key=lambda one: one.gain, default=None)
        wave = measured_wave(own.waves, model.waves, self.work.plain, inside)
        if wave is None or best is None:
            return wave or best
        # a wave is in the covariances of all distances, each of which counts by itself
        return Measurement(wave.effect, max(wave.gain, best.gain), (best.effect, *best.others))

    def _electrons(
        self, data: SharedBy, known: dict[str, SharedBy], part: Part, _: Model, beside: Model
    ) -> Measurement | None:
        """Measure what electrons of a part do to each other beyond what effects make of them."""
        return measured_electrons(data(part).electrons, self._made(known, beside)(part).electrons)

    def _response(
        self, data: SharedBy, known: dict[str, SharedBy], part: Part, _: Model, beside: Model
    ) -> Measurement | None:
        """Measure which samples of a part follow which beyond what effects make of them."""
        model, inside = self._made(known, beside)(part).responses, self.work.frames.inside(part)
        return measured_response(data(part).responses, model, self.work.plain, inside)

    def _made(self, known: dict[str, SharedBy], model: Model) -> SharedBy:
        """Return the same of frames simulated with a model; ``known`` are those of other models."""
        key = "|".join(e.model_dump_json() for e in model)
        if key not in known:
            known[key] = self._shared(*self._simulated(model))
        return known[key]

    def _simulated(self, model: tuple[Effect, ...]) -> tuple[NDArray[np.unsignedinteger], PixelMaps]:
        """Simulate the frames that are seen under a model, and fit their pixels."""
        seed = self.work.seed_of("covariances")
        drawn = self.work.mapped(model).sensor.usual(seed)
        taken = replace(self.work.frames.acquisition(), numbers=self.work.frames.seen_numbers)
        frames = simulate_frames(drawn, model, seed, taken)
        self.work.effort.simulate(frames.size, drawn.usable.size, 1)
        return frames, fitted_maps(frames, ~drawn.usable)

    def _shared(self, frames: NDArray[np.unsignedinteger], maps: PixelMaps) -> Callable[[Part], _Shared]:
        """Return what measures how the samples of a part vary together in frames like those that are seen."""
        numbers = self.work.frames.seen_numbers

        @functools.cache
        def of(part: Part) -> _Shared:
            some, inside = part.frames(numbers), self.work.frames.inside(part)
            laws = laws_of_frames(frames[some], maps)
            found = residual_covariances(frames[some], numbers[some], laws, maps, inside)
            # the shape of a line beyond the window is not known
            lines = {of: line for of, line in found.lines.items() if of in self.work.frames.whole_lines}
            found = Covariances(found.pairs, lines)
            electrons = electron_chances(frames[some], numbers[some], laws, maps, self.work.plain, inside)
            responses = residual_responses(frames[some], numbers[some], laws, maps, inside)
            scores = common_scores(frames[some], numbers[some], maps, inside)
            waves = waves_across(frames[some], numbers[some], laws, maps, inside)
            return _Shared(found, waves, scores, electrons, responses)

        return of
