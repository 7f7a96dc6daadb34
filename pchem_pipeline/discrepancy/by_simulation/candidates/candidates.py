"""The candidates: every effect's guesses about itself, what they would do, and how strong they must be."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import (
    FAR,
    FAR_SHARE_OF_PART,
    LARGEST_FACTOR,
    PRICE_OF_MORE,
    Hypothesis,
    Noise,
    fit_set,
    log_density,
)
from pchem_pipeline.discrepancy.by_simulation.sensor.replicate import Acquisition, Replicate
from pchem_pipeline.discrepancy.by_simulation.sets.pixel_likelihood import (
    MOST_IN_A_PART,
    identifiable_from_histograms,
    note_defect,
)
from pchem_pipeline.discrepancy.by_simulation.sets.refits import DampedSteps
from pchem_pipeline.discrepancy.observe.catalogue import check_signature
from pchem_pipeline.discrepancy.observe.places import Part, SensorWindow
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.effects.framework.compose import along_chain
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
from pchem_pipeline.effects.framework.registry import effect_class, effect_classes
from pchem_pipeline.model.arithmetic.significance import CERTAIN, POSSIBLE

Vector = Mapping[str, float]
#: Runs replicates and returns their statistics in the same order; an exception in place of those that failed.
Mapper = Callable[[Sequence[Replicate]], "list[Vector | Exception]"]

MOST_HYPOTHESES = 6  # of one effect
# times as many hypotheses of all effects in all parts: each is a simulation, and most are in vain
_MOST_IN_PARTS = 6
_REFINED = 12  # hypotheses of which the strength is refined by a second simulation
_STEPS = 2  # that refine a strength
_STRONGER = 4.0  # times the fingerprint of a hypothesis that is too weak to be seen
_CLOSE = 0.15  # relative: a strength known so well is not simulated again
REPEATS = 3  # simulations of the hypotheses that sets are made of
_CHANCE_OF_MEAN = 1.0  # standard errors of the mean of several simulations, below which it is nothing


def serial(replicates: Sequence[Replicate]) -> list[Vector | Exception]:
    """Do the work here, one after the other."""
    found: list[Vector | Exception] = []
    for replicate in replicates:
        try:
            found.append(replicate())
        # an effect of a plug-in may raise anything: the others are compared all the same
        except Exception as error:
            found.append(error)
    return found


def candidate_classes(settings: DiscrepancySettings) -> dict[str, type[Effect]]:
    """Return the effects to consider by tag; those that no such frames can show are not among them.

    Raises:
        ConfigError: a candidate is unknown.
    """
    wanted = tuple(effect_classes()) if settings.candidates is None else settings.candidates
    known = {tag: effect_class(tag) for tag in (*wanted, *settings.exclude)}
    return {
        tag: effect
        for tag, effect in known.items()
        if tag not in settings.exclude and not effect.untestable and not effect.empirical
    }


@dataclass
class ReplicateSimulator:
    """Simulates what candidates would do on top of the present model."""

    maps: PixelMaps  # parameters of the pixels under the model
    model: tuple[Effect, ...]
    acquisition: Acquisition  # of the split that is simulated
    names: tuple[str, ...]  # of the statistics
    mapper: Mapper  # runs the replicates
    seed: int  # of the random numbers that all candidates share
    defects: dict[str, str] = field(default_factory=dict)  # candidates that failed, and why; out
    _rows: dict[str, FloatArray] = field(default_factory=dict)

    def guesses(
        self,
        classes: Mapping[str, type[Effect]],
        evidence: Sequence[Evidence],
        parts: Sequence[tuple[Part, Evidence]] = (),
        beside: Evidence | None = None,
        most: int = MOST_HYPOTHESES,
    ) -> list[Effect]:
        """Ask every candidate for hypotheses; one that raises is a defect.

        The first evidence in which a candidate sees anything counts; that ``beside`` the effects of the model
        comes first, and where an estimator sees nothing there although the leading statistics of its effect
        deviate, what is typical is a guess. The evidence of a part of the sensor or run gives hypotheses that
        act there only. What the model has at some places is looked for at others. Of one effect, everywhere,
        there are ``most`` at most; in parts six times as many of all effects together, the likeliest of each
        first, and of these the ones whose leading statistics stand out most.
        """
        known = [] if beside is None else [beside]
        found: list[Effect] = []
        placed: list[tuple[int, float, Effect]] = []
        window = self.acquisition.window or SensorWindow.whole(self.maps.bias.shape)
        for tag, effect in classes.items():
            taken = [present for present in self.model if present.tag == tag]
            if tag in self.defects or any(present.everywhere for present in taken):
                continue
            try:
                check_signature(effect.signature)
                guessed = next(filter(None, (list(effect.estimate(e)) for e in (*known, *evidence))), [])
                if not guessed and known and known[0].strongest(*effect.signature[:2]) > CERTAIN:
                    guessed = list(effect.typical())
                for each in guessed[:1]:
                    identifiable_from_histograms(each)  # asked of each later: a defect shows here
                found += [] if taken else [window.found(each) for each in guessed[:most]]
                for part, own in parts:
                    clear = own.strongest(*effect.signature[:2])
                    for rank, each in enumerate(list(effect.estimate(own))[:MOST_IN_A_PART]):
                        there = window.found(each, part)
                        if not any(self._overlap(there, present, window.shape) for present in taken):
                            found.append(there)
                            placed.append((rank, -clear, there))
            # an estimator of a plug-in may raise anything: the others are compared all the same
            except Exception as error:
                note_defect(self.defects, tag, error)
        placed.sort(key=lambda item: item[:2])
        left_out = {id(each) for _, _, each in placed[_MOST_IN_PARTS * most :]}
        return [each for each in found if id(each) not in left_out]

    def _overlap(self, one: Effect, other: Effect, shape: tuple[int, int]) -> bool:
        """Return whether two effects meet in some pixel in some frame."""
        pixels = one.region is None or other.region is None or one.region.overlap(other.region, shape) > 0
        n_run = self.acquisition.n_run
        return pixels and (one.when is None or other.when is None or one.when.overlap(other.when, n_run) > 0)

    def fingerprints(self, effects: Sequence[Effect], repeats: int = 1) -> list[Hypothesis]:
        """Simulate each effect ``repeats`` times on the random numbers of the model; failures: defects."""
        if not effects:
            return []
        shown = [effect.representative(self.acquisition.numbers) for effect in effects]
        self._simulate([None, *(effect for effect, _ in shown)], repeats)
        base = self._known(None, repeats)
        return [
            Hypothesis(
                effect,
                share * _without_chance(self._known(one, repeats) - base),
                1 + sum(effect.tag == each.tag for each in self.model),
            )
            for effect, (one, share) in zip(effects, shown, strict=True)
            if all(self._replicate(one, j).key in self._rows for j in range(repeats))
        ]

    def _simulate(self, effects: Sequence[Effect | None], repeats: int) -> None:
        """Simulate the model with each effect, and with none (which must succeed), unless that is known."""
        tasks = [(effect, self._replicate(effect, j)) for effect in effects for j in range(repeats)]
        new = {task.key: (effect, task) for effect, task in tasks if task.key not in self._rows}
        results = self.mapper([task for _, task in new.values()]) if new else []
        for (effect, task), result in zip(new.values(), results, strict=True):
            if not isinstance(result, Exception):
                self._rows[task.key] = np.array([result.get(name, 0.0) for name in self.names], np.float64)
            elif effect is None:
                raise result
            else:
                note_defect(self.defects, effect.tag, result)

    def _known(self, effect: Effect | None, repeats: int) -> FloatArray:
        """Return the statistics of the model with an effect, shape (repeat, statistic)."""
        return np.array([self._rows[self._replicate(effect, j).key] for j in range(repeats)])

    def refined(
        self, hypotheses: Sequence[Hypothesis], shift: FloatArray, noise: Noise, told: Sequence[Effect] = ()
    ) -> list[Hypothesis]:
        """Bring the strengths of the most promising hypotheses to what the data ask for, each by itself.

        Those that promise little, and effects ``told`` by the histograms, are left as they are.
        """
        if not hypotheses:
            return []
        hypotheses = self._visible(hypotheses, told)
        fits = [fit_set([h], shift, noise) for h in hypotheses]
        scores = np.array([fit.log_score(shift, noise) for fit in fits])
        order = np.argsort(-scores, kind="stable")
        near = scores.max() - FAR - FAR_SHARE_OF_PART * (scores.max() - log_density(shift, noise.covariance))
        best = hypotheses[int(order[0])]

        def promising(i: int) -> bool:
            if scores[i] >= near:
                return True
            pair = fit_set([best, hypotheses[i]], shift, noise)
            helps = pair.log_score(shift, noise) > scores.max() + PRICE_OF_MORE / 2.0
            return bool(helps) and hypotheses[i].tag != best.tag

        chosen = [int(i) for i in order if fits[i].factors[0] > 0.0 and promising(int(i))][:_REFINED]
        free = [i for i in chosen if not any(hypotheses[i].effect is effect for effect in told)]
        tuned = self._tuned([hypotheses[i] for i in free], shift, noise)
        best_of = {i: hypotheses[i] for i in chosen} | dict(zip(free, tuned, strict=True))
        sharp = {id(h.effect): h for h in self.fingerprints([h.effect for h in best_of.values()], REPEATS)}
        better = {i: sharp.get(id(one.effect), one) for i, one in best_of.items()}
        return [better.get(int(i), hypotheses[i]) for i in order]

    def _visible(self, hypotheses: Sequence[Hypothesis], told: Sequence[Effect]) -> list[Hypothesis]:
        """Return hypotheses, four times as strong where chance hides all that they do.

        Of effects ``told`` by the histograms the strengths stay, and their fingerprint is a quarter of that.
        """
        faint = {id(h): h.rescaled(_STRONGER) for h in hypotheses if np.abs(h.fingerprint).max() < CERTAIN}
        seen = {id(h.effect): h for h in self.fingerprints(list(faint.values()))}

        def shown(h: Hypothesis) -> Hypothesis:
            stronger = seen.get(id(faint.get(id(h))), h)
            if stronger is not h and any(h.effect is effect for effect in told):
                return replace(h, fingerprint=stronger.fingerprint / _STRONGER)
            return stronger

        return [shown(h) for h in hypotheses]

    def _tuned(self, hypotheses: Sequence[Hypothesis], shift: FloatArray, noise: Noise) -> list[Hypothesis]:
        """Tune the strength of each by simulation; a step that predicts worse is halved."""
        ways = [DampedSteps(h, _as_simulated(h, shift, noise)) for h in hypotheses]
        for _ in range(_STEPS):
            proposals = [_proposal(way, shift, noise) for way in ways]
            effects = [effect for effect in proposals if effect is not None]
            simulated = {id(h.effect): h for h in self.fingerprints(effects)}
            for way, proposal in zip(ways, proposals, strict=True):
                if (new := simulated.get(id(proposal))) is not None:
                    way.judge(new, _as_simulated(new, shift, noise))
        return [way.best for way in ways]

    def _replicate(self, effect: Effect | None, repeat: int) -> Replicate:
        effects = self.model if effect is None else along_chain(self.model, (effect,))
        # of the model and its purpose, too: the same effects come with other strengths
        text = json.dumps([self.seed, *(each.model_dump(mode="json") for each in effects)], sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()[:10]
        label = f"{'base' if effect is None else effect.tag}-{digest}-{repeat}"
        return Replicate(label, self.maps, effects, self.seed + repeat, self.acquisition)


def _without_chance(shifts: FloatArray) -> FloatArray:
    """Return the mean of shifts (repeat, statistic) without chance, which would bias strengths low."""
    mean, repeats = shifts.mean(axis=0), shifts.shape[0]
    # below the one a single simulation shows nothing, above the other all of it
    low, high, error = POSSIBLE, CERTAIN, np.ones_like(mean)
    if repeats > 1:
        scatter = shifts.std(axis=0, ddof=1)
        # few simulations do not know their scatter well: never below that of most statistics
        error = np.maximum(scatter, np.sqrt(np.mean(scatter**2))) / np.sqrt(repeats)
        low, high = _CHANCE_OF_MEAN, POSSIBLE
    weight = np.clip((np.abs(mean) - low * error) / np.maximum((high - low) * error, 1e-12), 0.0, 1.0)
    return np.asarray(mean * weight)


def _proposal(way: DampedSteps[Hypothesis], shift: FloatArray, noise: Noise) -> Effect | None:
    """Return the effect at the strength to try next; None where it is what the data ask for."""
    fit = fit_set([way.best], shift, noise)
    if fit.settled(_CLOSE):
        return None
    factor = np.clip(fit.factors[0], 1.0 / LARGEST_FACTOR, LARGEST_FACTOR) ** way.length
    effect = way.best.rescaled(float(factor))
    return None if effect == way.best.effect else effect


def _as_simulated(hypothesis: Hypothesis, shift: FloatArray, noise: Noise) -> float:
    """Return the log score of an effect at the very strength that was simulated."""
    part = hypothesis.fingerprint[None]
    left = shift - part[0]
    return log_density(left, noise.of(part, left))
