"""Empirical descriptions of several forms, everywhere and by part of the sensor, the best one first."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import error_words
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import Hypothesis
from pchem_pipeline.discrepancy.by_simulation.measured.electrons import electron_chances, measured_electrons
from pchem_pipeline.discrepancy.by_simulation.measured.mixture_shifts import measured_mixture_shifts
from pchem_pipeline.discrepancy.by_simulation.measured.modes import common_scores, measured_mode
from pchem_pipeline.discrepancy.by_simulation.measured.noise import (
    measured_noise,
    measured_wave,
    residual_covariances,
    running_waves,
)
from pchem_pipeline.discrepancy.by_simulation.measured.response import measured_response, residual_responses
from pchem_pipeline.discrepancy.by_simulation.measured.samples import Measurement, PartSamples
from pchem_pipeline.discrepancy.by_simulation.sensor.replicate import simulate_frames
from pchem_pipeline.discrepancy.by_simulation.sensor.simulations import Simulations
from pchem_pipeline.discrepancy.by_simulation.sets.refits import FEW, Refitter, Steps
from pchem_pipeline.discrepancy.effort import EffortSpentError
from pchem_pipeline.discrepancy.observe.observe import fitted_maps
from pchem_pipeline.discrepancy.observe.places import Part
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import PixelMaps

#: Measures a part of the frames, the pixels fitted with some effects, beside some of these.
Model = tuple[Effect, ...]
Measure = Callable[[Part, Model, Model], Measurement | None]

_MEASUREMENTS = 2  # of a component: the pixels are refitted with the first one


class _Likely(NamedTuple):
    """A form that was measured in a part."""

    part: Part
    form: str
    measured: Measurement


@dataclass
class Unexplained:
    """Measures train and test frames beside effects; ``defects`` are forms that failed, and why."""

    work: Simulations
    refitter: Refitter
    defects: dict[str, str] = field(default_factory=dict)
    _done: set[tuple[Hypothesis, ...]] = field(default_factory=set, repr=False)
    _stacks: dict[Model | None, tuple[NDArray[np.unsignedinteger], PixelMaps]] = field(
        default_factory=dict, repr=False
    )
    _recent: dict[tuple[Model | None, Part], PartSamples] = field(default_factory=dict, repr=False)
    _known: dict[tuple[Model | None, Part], dict[Any, Any]] = field(default_factory=dict, repr=False)

    @functools.cached_property
    def _forms(self) -> dict[str, Measure]:
        """The forms that the model does not have already."""
        forms: dict[str, Measure] = {
            "empirical": self._mixture_shifts,
            "empirical_noise": self._noise,
            "empirical_response": self._response,
            "empirical_electrons": self._electrons,
        }
        return {tag: form for tag, form in forms.items() if tag not in {e.tag for e in self.refitter.present}}

    def measured(self, kept: tuple[Hypothesis, ...]) -> Iterator[Steps]:
        """Yield effects with what explains most beside them, each simulated at the size that was measured.

        The likeliest of each form first; forms that are among the effects are not measured again, and nothing
        is twice beside the same effects.

        Raises:
            EffortSpentError: the work is at its limit.
        """
        if kept in self._done:
            return
        self._done.add(kept)
        have = {h.effect.tag for h in kept}
        forms = {tag: form for tag, form in self._forms.items() if tag not in have}
        for likely in self._likeliest(tuple(h.effect for h in kept), forms):
            try:
                yield from self._described(kept, likely.part, self._forms[likely.form])
            except EffortSpentError:
                raise
            # a defect of what is measured must not cost the verdict
            except Exception as error:
                self.defects[likely.form] = error_words(error)

    def _likeliest(self, effects: Model, forms: Mapping[str, Measure]) -> list[_Likely]:
        """Return the forms that explain most beside effects, each in its likeliest part or everywhere."""
        model = self.refitter.model(effects)
        found: dict[str, _Likely] = {}
        self.work.effort.ask(self.work.observed.samples)
        for part, form in itertools.product((Part(), *self.work.frames.parts), forms):
            try:
                one = forms[form](part, model, model)
            # a defect of what is measured must not cost the verdict
            except Exception as error:
                self.defects[form] = error_words(error)
                continue
            if one is not None and (form not in found or one.gain > found[form].measured.gain):
                found[form] = _Likely(part, form, one)
        return sorted(found.values(), key=lambda one: -one.measured.gain)

    def _described(self, kept: tuple[Hypothesis, ...], part: Part, measure: Measure) -> Iterator[Steps]:
        """Yield effects with what is measured in a part beside them, the likeliest first."""
        refitter, effects = self.refitter, tuple(h.effect for h in kept)
        measured: tuple[Effect, ...] = ()
        for _ in range(_MEASUREMENTS):
            seen = measure(part, refitter.model((*effects, *measured[:1])), refitter.model(effects))
            if seen is None:
                return
            # what is measured has its places in the window; those of parts are on the sensor
            on_sensor = (self.work.frames.on_sensor(e) for e in (seen.effect, *seen.others))
            measured = tuple(e.at_place(part.region, part.when) for e in on_sensor)
        for effect in measured:
            refitter.allow(effect.tag)
            vectors = refitter.draw((*effects, effect), FEW)
            shift = vectors.mean(axis=0) - refitter.null.mean - sum(h.fingerprint for h in kept)
            yield refitter.begin((*kept, Hypothesis(effect, shift)))

    def _mixture_shifts(self, part: Part, present: Model, beside: Model) -> Measurement | None:
        """Measure the mixture shifts of a part beside effects, with the pixels refitted with those there."""
        maps, frames = self.work.refit(present).maps, self.work.frames
        own = replace(maps, usable=maps.usable & frames.inside(part))
        if not own.usable.any():
            return None
        some = part.frames(frames.seen_numbers)
        stack = frames.stack[frames.seen[some]]
        return measured_mixture_shifts(stack, frames.seen_numbers[some], own, beside)

    def _noise(self, part: Part, _: Model, beside: Model) -> Measurement | None:
        """Measure what samples of a part share beyond what effects make of them."""
        data, model = self._of(part, None), self._of(part, beside)
        own = data.evidence, data.inside
        wave = measured_wave(data.of(running_waves), model.of(running_waves), *own)
        found = [
            wave,
            measured_mode(data.of(common_scores), model.of(common_scores), data.maps, data.inside),
            measured_noise(data.of(residual_covariances), model.of(residual_covariances), *own),
        ]
        # a wave is in the covariances of all distances, each of which counts by itself
        seen = sorted(filter(None, found), key=lambda one: (one is not wave, -one.gain))
        effects = [effect for one in seen for effect in (one.effect, *one.others)]
        best = max((one.gain for one in seen), default=0.0)
        return Measurement(effects[0], best, tuple(effects[1:])) if effects else None

    def _electrons(self, part: Part, _: Model, beside: Model) -> Measurement | None:
        """Measure what electrons of a part do to each other beyond what effects make of them."""
        data, model = self._of(part, None), self._of(part, beside)
        return measured_electrons(data.of(electron_chances), model.of(electron_chances))

    def _response(self, part: Part, _: Model, beside: Model) -> Measurement | None:
        """Measure which samples of a part go with which beyond what effects make of them."""
        data, model = self._of(part, None), self._of(part, beside)
        return measured_response(
            data.of(residual_responses), model.of(residual_responses), data.evidence, data.inside
        )

    def _of(self, part: Part, model: Model | None) -> PartSamples:
        """Return the seen samples of a part, or as they are in frames simulated with a model."""
        key, frames = (model, part), self.work.frames
        if model not in self._stacks:
            seen = frames.seen_stack, self.work.plain.maps
            self._stacks[model] = seen if model is None else self._simulated(model)
        if key not in self._recent:
            stack, maps = self._stacks[model]
            own = stack, frames.seen_numbers, maps, self.work.plain, frames.inside(part), part
            samples = PartSamples(*own, frames.whole_lines, self._known.setdefault(key, {}))
            # of frames and tables those of the data and of one model are kept, and all that was measured
            self._recent = {k: one for k, one in self._recent.items() if k == (None, part)} | {key: samples}
        return self._recent[key]

    def _simulated(self, model: Model) -> tuple[NDArray[np.unsignedinteger], PixelMaps]:
        """Simulate the frames that are seen under a model, and fit their pixels."""
        seed = self.work.seed_of("covariances")
        drawn = self.work.mapped(model).sensor.usual(seed)
        taken = replace(self.work.frames.acquisition(), numbers=self.work.frames.seen_numbers)
        frames = simulate_frames(drawn, model, seed, taken)
        maps, evaluated = fitted_maps(frames, ~drawn.usable)
        self.work.effort.simulate(frames.size, evaluated)
        return frames, maps
