"""What a search does over and over: fit the frames under a model, and draw stacks of that model.

Each is counted; a search ends at a limit of that work (:mod:`pchem_pipeline.discrepancy.effort`).
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.discrepancy.by_simulation.candidates.candidates import Mapper
from pchem_pipeline.discrepancy.by_simulation.frames.frame_stack import FrameStack
from pchem_pipeline.discrepancy.by_simulation.frames.observed import ObservedFrames
from pchem_pipeline.discrepancy.by_simulation.measured.mixture_shifts import without_squares
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import (
    Refit,
    Sensor,
    expected_codes,
    learn_sensor,
    refit_maps,
)
from pchem_pipeline.discrepancy.by_simulation.sensor.population import MANY_MISTAKEN
from pchem_pipeline.discrepancy.by_simulation.sensor.replicate import EVALUATED, Replicate, by_part
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.discrepancy.observe.misplaced import own_lines
from pchem_pipeline.effects.framework.compose import added_exposures
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence


@dataclass
class Mapped:
    """The seen frames under a model: the fit of their pixels, and statistics of replicates drawn so far."""

    fit: Refit
    sensor: Sensor
    vectors: list[Mapping[str, float]] = field(default_factory=list)


@dataclass
class Simulations:
    """Fits of the seen frames, and stacks simulated from them."""

    observed: ObservedFrames
    mapper: Mapper  # runs the simulated stacks
    seed: int  # root of all random numbers
    effort: Effort  # counts the work
    given: tuple[Effect, ...] = ()  # effects that the model had before the search
    known: dict[tuple[Effect, ...], Mapped] = field(default_factory=dict)  # cache of `mapped`

    @property
    def frames(self) -> FrameStack:
        """As they were taken, with their parts."""
        return self.observed.frames

    @property
    def plain(self) -> Evidence:
        """Evidence of the seen frames."""
        return self.observed.plain

    def refit(self, model: tuple[Effect, ...]) -> Refit:
        """Return the fit of the seen frames under a model."""
        frames, plain = self.own_samples(model), self.plain
        assert plain.covariance is not None
        if not model:
            return Refit(plain.maps, {}, plain.covariance)
        own, numbers = self.frames.effects(model), self.frames.seen_numbers
        # where the pixels are drawn anew in every replicate, what they have in the data stays part of H
        steady = [e for e in own if not e.resample_pixels]
        added = added_exposures(steady, frames, numbers, plain.maps)
        fit = refit_maps(frames, plain.maps, own, plain.covariance, added, numbers)
        self.effort.evaluate(fit.evaluated, fit.components, (effect.tag for effect in model))
        return fit

    def expected(self, model: tuple[Effect, ...], evidence: Evidence, numbers: IntArray) -> FloatArray | None:
        """Return the samples that a model expects at each code of some evidence; see `expected_codes`."""
        fit, codes = self.mapped(model).fit, evidence.code.first + np.arange(evidence.code.observed.size)
        return expected_codes(fit.maps, self.frames.effects(model), codes, numbers, fit.added)

    def own_samples(self, model: tuple[Effect, ...]) -> NDArray[np.unsignedinteger]:
        """Return the seen frames without the samples that effects likely gave to other pixels."""
        usable, effects = self.plain.maps.usable, self.frames.effects(model)
        frames = without_squares(self.frames.seen_stack, usable, effects)
        return own_lines(frames, usable, effects)

    def mapped(self, model: tuple[Effect, ...]) -> Mapped:
        """Return the fit of the seen frames under a model, and sensors to draw replicates from.

        Raises:
            NotFittedError: hardly a pixel can be fitted with the model.
        """
        if model not in self.known:
            (first, sensor), seen = self._first, self.frames.seen_stack[:1]
            fit = first if model == self.given else self.refit(model)
            others = tuple(effect for effect in model if effect.replacement(seen) is None)
            if others != model:
                sensor = self._of_replaced(fit, model, others)
            elif model != self.given and self.plain.ambiguous > MANY_MISTAKEN:
                sensor = self._learnt(fit, model, sensor.lost)  # the fits of single pixels say little
            elif model != self.given:
                sensor = sensor.refitted(first.maps, fit.maps)
            if model and self.plain.ambiguous <= MANY_MISTAKEN:
                # simulated with effects and fitted without, sensors must come out as the data do
                sensor = sensor.corrected(self.plain.maps, self._once("fitted", sensor, model).fitted())
            self.known[model] = Mapped(fit, sensor)
        return self.known[model]

    @functools.cached_property
    def _first(self) -> tuple[Refit, Sensor]:
        """The fit of the seen frames under the model before the search, and the sensor learnt from both."""
        fit = self.refit(self.given)
        return fit, self._learnt(fit, self.given)

    def _of_replaced(self, fit: Refit, model: tuple[Effect, ...], others: tuple[Effect, ...]) -> Sensor:
        """Return the sensor under a model that replaces samples, ``others`` without the effects that do so.

        The replacements are in frames drawn of the sensor without: in the seen ones some are replaced, too.
        """
        lost = self._first[1].lost
        before = self._once("before", self._learnt(fit, model, lost), others).simulated()
        return self._learnt(fit, model, lost, before)

    def _learnt(
        self,
        fit: Refit,
        model: tuple[Effect, ...],
        lost: float | None = None,
        before: NDArray[np.unsignedinteger] | None = None,
    ) -> Sensor:
        """Return the sensor learnt from the seen frames and their fit under a model; see `learn_sensor`."""
        self.effort.learn(self.plain.maps.usable.size, fit.components)
        frames, numbers = self.own_samples(model), self.frames.seen_numbers
        effects = self.frames.effects(model)
        return learn_sensor(frames, numbers, fit, effects, self.plain.ambiguous, lost, before)

    def drawn(self, model: tuple[Effect, ...], count: int) -> list[Mapping[str, float]]:
        """Return the statistics of so many replicates of a model, drawn where they are new.

        Raises:
            NotFittedError: hardly a pixel can be fitted with the model.
        """
        one = self.mapped(model)
        done = len(one.vectors)
        one.vectors += self.replicates(model, one.sensor, "grown", count - done, done)
        return one.vectors[:count]

    def forget(self, model: tuple[Effect, ...]) -> None:
        """Forget all models but one: they are not asked for again."""
        self.known = {one: mapped for one, mapped in self.known.items() if one == model}

    def _once(self, purpose: str, sensor: Sensor, model: tuple[Effect, ...]) -> Replicate:
        """Return a stack of the seen frames to draw from a sensor once for a purpose, and count it."""
        seed = self.seed_of(purpose)
        taken = replace(self.frames.acquisition(), numbers=self.frames.seen_numbers)
        one = Replicate(purpose, sensor.draw(seed), model, seed, taken)
        self.effort.replicates += 1
        self.effort.simulate(one.samples, self.plain.evaluated)
        return one

    def replicates(
        self, model: tuple[Effect, ...], sensor: Sensor, prefix: str, count: int, begin: int = 0
    ) -> list[Mapping[str, float]]:
        """Simulate a model, and observe ``count`` parts of it or one more, from number ``begin`` (even) on.

        A simulated stack has two parts, and a sensor of its own.
        """
        text = "|".join(e.model_dump_json() for e in model)
        digest = hashlib.sha256(text.encode()).hexdigest()[:10]
        taken = self.frames.acquisition(as_data=True)
        tasks: list[Replicate] = []
        for i in range(begin // 2, (begin + count + 1) // 2):
            seed = self.seed_of(prefix, i)
            tasks.append(Replicate(f"{prefix}-null-{digest}-{i}", sensor.draw(seed), model, seed, taken))
        vectors: list[Mapping[str, float]] = []
        for result in self.counted(tasks):
            if isinstance(result, Exception):
                raise result
            vectors += by_part(result)
        self.effort.replicates += len(vectors) - len(tasks)
        return vectors

    def counted(self, replicates: Sequence[Replicate]) -> list[Mapping[str, float] | Exception]:
        """Return the statistics of replicates, or what they raised; count the work."""
        self.effort.replicates += len(replicates)
        found = self.mapper(replicates)
        for each, result in zip(replicates, found, strict=True):
            self.effort.simulate(
                each.samples, 0.0 if isinstance(result, Exception) else result.get(EVALUATED, 0.0)
            )
        return found

    def seed_of(self, purpose: str, index: int = 0) -> int:
        """Return the root of the random numbers for a purpose."""
        text = f"{self.seed}/{purpose}/{index}"
        return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=7).digest(), "little")
