"""What every candidate would do beside a model, and how their sets compare by that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.discrepancy.by_simulation.candidates.candidates import MOST_HYPOTHESES, ReplicateSimulator
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import (
    Hypothesis,
    Noise,
    SetFit,
    held_out_gain,
    likeliest_sets,
    seconds,
    share_place,
)
from pchem_pipeline.discrepancy.by_simulation.frames.observed import ObservedFrames
from pchem_pipeline.discrepancy.by_simulation.sensor.simulations import Simulations
from pchem_pipeline.discrepancy.by_simulation.sets.pixel_likelihood import Histograms
from pchem_pipeline.discrepancy.null import Measured, NullModel
from pchem_pipeline.discrepancy.observe.places import Part
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence

_MOST_BESIDE = 2  # hypotheses of one effect beside a single other one
_DOUBT = 0.2  # of the logarithm of a factor that was fitted without the effects beside it


def noise_of_splits(null: NullModel, splits: int, model_error: float) -> Noise:
    """Return the noise of the mean of so many splits less the mean of the replicates."""
    covariance = null.covariance.times(1.0 / splits + 1.0 / null.n_replicates)
    return Noise(covariance, model_error, null.events / splits)


@dataclass(frozen=True)
class Screened:
    """What the candidates would do beside a model: all and sets of them, the likeliest first.

    ``gain`` is that of the first set over none in predicting held-out frames, less its price, nats.
    """

    hypotheses: tuple[Hypothesis, ...]
    sets: list[SetFit]
    gain: float


@dataclass(frozen=True)
class Screening:
    """Simulates the candidates."""

    observed: ObservedFrames
    work: Simulations
    z: Measured  # statistics of the data
    classes: Mapping[str, type[Effect]]  # of the candidates, by tag
    given: tuple[Effect, ...]  # effects that the model had before the search
    model_error: float  # relative error of a fingerprint
    defects: dict[str, str] = field(default_factory=dict)  # candidates that failed, and why; out

    def of(self, model: tuple[Effect, ...], null: NullModel) -> Screened:
        """Return what they would do beside a model with this null: everywhere and in the parts, by split."""
        simulator = self._simulator(model, null, "0")
        evidence = (self.observed.plain, *self.observed.parts[:2])
        histograms = Histograms(
            self.work.own_samples(model),
            self.work.mapped(model).fit.maps,
            self.observed.frames.effects(model),
            self.work.effort,
            self.observed.frames.samples_of,
            self.defects,
        )
        guesses = histograms.with_numbers(self._guesses(simulator, model, null, evidence, MOST_HYPOTHESES))
        parts = self.observed.frames.parts
        suggested = self._apart(model, histograms.suggested(self.classes, parts, guesses))
        hypotheses = simulator.fingerprints([*guesses, *suggested])
        shift = self.z.both - null.mean
        noise = noise_of_splits(null, 2, self.model_error)
        hypotheses = simulator.refined(hypotheses, shift, noise, histograms.told)
        # what they do to pixels that are led astray says little about them: others do not go before them
        hypotheses.sort(key=lambda h: all(h.effect is not each for each in suggested))
        hypotheses += seconds(hypotheses)
        sets = likeliest_sets(hypotheses, shift, noise)
        shifts = self.z.train - null.mean, self.z.test - null.mean
        of_split = noise_of_splits(null, 1, self.model_error)
        gain = held_out_gain(sets[0].hypotheses, shifts, of_split) if sets else 0.0
        return Screened(tuple(hypotheses), sets, gain)

    def beside(self, model: tuple[Effect, ...], null: NullModel, slopes: FloatArray) -> list[SetFit]:
        """Return the likeliest sets beside a refitted one in a model with this null.

        ``slopes`` are those of the statistics by the uncertain strengths of the set, shape (e, m).
        """
        simulator = self._simulator(model, null, "/".join(["0", *(e.tag for e in model)]))
        guesses = self._guesses(simulator, model, null, (), _MOST_BESIDE)
        hypotheses = simulator.fingerprints(guesses)
        noise = noise_of_splits(null, 2, self.model_error)
        doubtful = replace(noise, covariance=noise.covariance.with_modes(_DOUBT * slopes))
        return likeliest_sets(hypotheses, self.z.both - null.mean, doubtful)

    def _simulator(self, model: tuple[Effect, ...], null: NullModel, purpose: str) -> ReplicateSimulator:
        return ReplicateSimulator(
            self.work.mapped(model).sensor.usual(self.work.seed_of(f"sensor/{purpose}")),
            model,
            self.observed.frames.acquisition(),
            null.names,
            self.work.counted,
            self.work.seed_of(f"fingerprint/{purpose}"),
            self.defects,
        )

    def _guesses(
        self,
        simulator: ReplicateSimulator,
        model: tuple[Effect, ...],
        null: NullModel,
        evidence: tuple[Evidence, ...],
        most: int,
    ) -> list[Effect]:
        """Return the guesses of all candidates that are not where a found effect of their kind is."""
        left = dict(zip(null.names, null.pulls(self.z.both, 2).tolist(), strict=True))

        def evidence_of(part: Part, own: Evidence) -> tuple[Part, Evidence]:
            """Beside the model of all frames a part may show what fits of its few samples have taken up."""
            z = {name: max(z, left.get(f"{name}@{part.text}", z), key=abs) for name, z in own.z.items()}
            return part, replace(own, z=z)

        apart = [evidence_of(*each) for each in self.observed.frames.seen_apart(self.observed.plain)]
        beside = self._evidence_beside(model, left)
        self.work.effort.ask(self.observed.samples)
        return self._apart(model, simulator.guesses(self.classes, evidence, apart, beside, most))

    def _apart(self, model: tuple[Effect, ...], guesses: Sequence[Effect]) -> list[Effect]:
        """Return the guesses that are not where a found effect of their kind is."""
        found = [effect for effect in model if effect not in self.given]
        return [guess for guess in guesses if not share_place((*found, guess))]

    def _evidence_beside(self, model: tuple[Effect, ...], left: dict[str, float]) -> Evidence | None:
        """Return the evidence of the seen frames beside the effects of a model; None where it has none."""
        if not model:
            return None
        plain = self.observed.plain
        expected = self.work.expected(model, plain, self.observed.frames.seen_numbers)
        code = plain.code if expected is None else replace(plain.code, expected=expected)
        return replace(plain, code=code, z=left)
