"""From what was found in histograms to the verdict: steps with their gaps, what is left, and a sentence."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.build_verdict import Addition, gap_change, step_of
from pchem_pipeline.discrepancy.by_likelihood.gap import Meter, carried_over
from pchem_pipeline.discrepancy.by_likelihood.members import Member
from pchem_pipeline.discrepancy.by_likelihood.search import LARGEST_REST, Explanation, Named
from pchem_pipeline.discrepancy.by_likelihood.sets import Arena, FittedSet
from pchem_pipeline.discrepancy.by_likelihood.views import electrons_of
from pchem_pipeline.discrepancy.by_likelihood.words import closing, find_residuals, set_aside_residual
from pchem_pipeline.discrepancy.by_simulation.null import NullModel
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.observe.catalogue import VERSION as STATISTICS_VERSION
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.verdict import (
    Candidate,
    Change,
    Discrepancy,
    Examined,
    Place,
    Pull,
    Rival,
    State,
    Verdict,
)
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps

__all__ = ["Measurements", "tell_histograms"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_MOST_PULLS = 12
_MOST_UNEXPLAINED = 4
_PARAMETERS = ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn")


@dataclass(frozen=True)
class Measurements:
    """What the search measured; see :class:`~pchem_pipeline.discrepancy.verdict.Discrepancy`.

    Attributes:
        parts: train, test and final histograms, shape (n, B) each.
        maps: from a fit to maps of all pixels.
        nulls: of the model before and after.
        z: statistics of the three parts.
        plain: the plain law, fitted to train and test.
    """

    parts: tuple[IntArray, ...]
    settings: DiscrepancySettings
    model: tuple[Effect, ...]
    evidence: Evidence
    maps: Callable[[FittedSet], PixelMaps]
    nulls: tuple[NullModel, NullModel]
    z: tuple[FloatArray, ...]
    places: tuple[Place, ...]
    still: bool
    before: Gap
    plain: FittedSet
    untestable: Mapping[str, str]
    left_out: Mapping[str, str]
    n_replicates: int
    n_pixels: int
    rng: np.random.Generator

    @property
    def mean(self) -> FloatArray:
        """Mean of the statistics of train and test part."""
        return (self.z[0] + self.z[1]) / 2.0

    @property
    def both(self) -> IntArray:
        """Train and test histograms together."""
        return self.parts[0] + self.parts[1]


def tell_histograms(measured: Measurements, found: Explanation | None) -> Discrepancy:
    """Put the verdict together."""
    additions: tuple[Addition, ...] = ()
    final_fit, after = measured.plain, measured.before
    residuals: tuple[Place, ...] = ()
    code_grown = None
    if found is not None:
        teller = _Teller(measured, found)
        additions, after, final_fit = teller.additions()
        code_grown = teller.codes(final_fit)
        if measured.still or after.value > after.floor:
            residuals = teller.residuals(final_fit)
    verdict = _verdict(additions, found)
    pulls = [null.pulls(measured.mean, splits=2) for null in measured.nulls]
    rest = sorted(
        zip(measured.nulls[1].names, pulls[1].tolist(), strict=True), key=lambda item: -abs(item[1])
    )
    left = tuple(Place.of(name, z=z) for name, z in rest[:_MOST_UNEXPLAINED]) if measured.still else ()
    named = tuple(a.effect for a in additions if a.named)
    keep = verdict in ("named", "ambiguous")
    model = (*measured.model, *named) if keep else measured.model
    p_values = [null.global_p(measured.mean, 2) for null in measured.nulls]
    return Discrepancy(
        verdict=Verdict(
            verdict=verdict,
            sentence=_sentence(verdict, additions, found, measured.before, after, residuals),
            effects=tuple(e.tag for e in named),
            model_effects=tuple(e.model_dump(mode="json") for e in model),
            steps=tuple(step_of(added) for added in additions),
            gap=gap_change(measured.before, after, grown=bool(additions)),
            where=measured.places,
            unexplained=(*residuals, *left),
            set_aside=tuple((i.low, i.high) for i in found.set_aside) if found and named and keep else (),
            untestable=dict(measured.untestable),
            left_out=dict(measured.left_out),
            examined=_examined(measured),
            p_global=Change(before=p_values[0], after=p_values[1]),
            replicates=measured.n_replicates,
            versions={"statistics": STATISTICS_VERSION},
        ),
        model=model,
        maps=measured.maps(final_fit),
        evidence=measured.evidence,
        statistics=(measured.nulls[0].names, pulls[0], pulls[1]),
        code_grown=code_grown,
    )


def _examined(measured: Measurements) -> Examined:
    samples = [int(part.sum()) for part in measured.parts]
    return Examined(
        histograms=measured.n_pixels,
        frames=int(sum(part.sum(axis=1).max() for part in measured.parts)),
        rows=(0, 1),
        columns=(0, int(measured.evidence.maps.usable.size)),
        train=samples[0],
        test=samples[1],
        final=samples[2],
    )


@dataclass
class _Teller:
    """Fits the models of the steps to train and test together, and measures their gaps on the final part."""

    measured: Measurements
    found: Explanation

    def __post_init__(self) -> None:
        """Prepare the meter."""
        kept = self.found.kept
        carried = 0.0
        if not kept.all():
            carried = carried_over(self.measured.plain.log_masses, self.measured.parts[2], kept)
        count = max(self.measured.settings.grown_replicates, 40)
        self.meter = Meter(self.measured.parts[2], kept, carried, count, self.measured.rng)

    def additions(self) -> tuple[tuple[Addition, ...], Gap, FittedSet]:
        """Return the added effects, the last gap and the last fit."""
        gap, fitted = self.measured.before, self.measured.plain
        additions: list[Addition] = []
        members: tuple[Member, ...] = ()
        for named in self.found.named:
            members = (*members, named.member)
            grown = self._refit(members)
            after = self.meter.gap(self._problem(members), grown.fit)
            additions.append(self._addition(named, members, gap, after, grown, fitted))
            gap, fitted = after, grown
        return tuple(additions), gap, fitted

    def residuals(self, fitted: FittedSet) -> tuple[Place, ...]:
        """Return the codes that the model does not account for, a peak that was set aside first."""
        counts, kept = self.measured.both.astype(np.float64), self.found.kept
        problem = self._problem(fitted.members)
        expected = self._expected(fitted)
        parameters = fitted.fit.parameters
        electrons = electrons_of(self.found.arena.origin, counts.shape[1], parameters)
        found = find_residuals(
            np.where(kept, counts, 0.0), np.where(kept, expected, 0.0), electrons, parameters
        )
        peak = self.found.peak
        if peak is not None:
            total = self.meter.gap(problem, fitted.fit).value * self.meter.n_samples
            aside = set_aside_residual(
                peak.low,
                peak.high,
                float(np.where(kept, 0.0, counts).sum()),
                float(np.where(kept, 0.0, expected).sum()),
                parameters,
                self.meter.carried / max(total, 1e-12),
            )
            found.insert(0, aside)
        return tuple(found)

    def codes(self, fitted: FittedSet) -> FloatArray | None:
        """Return the samples expected at each code of the evidence, or None if it holds other pixels too."""
        code = self.measured.evidence.code
        expected, origin = self._expected(fitted), self.found.arena.origin
        if self.measured.evidence.maps.usable.sum() != expected.shape[0]:
            return None
        found = np.zeros(code.observed.size)
        for row, first in zip(expected, origin - code.first, strict=True):
            at = first + np.arange(row.size)
            within = (at >= 0) & (at < found.size)
            np.add.at(found, at[within], row[within])
        return np.asarray(found * code.observed.sum() / max(float(self.measured.both.sum()), 1.0))

    def _expected(self, fitted: FittedSet) -> FloatArray:
        """Return the samples of train and test expected at each code given those in codes that are kept."""
        counts, kept = self.measured.both.astype(np.float64), self.found.kept
        mass = self._problem(fitted.members).masses(fitted.fit.theta, fitted.fit.shared)
        inside = np.where(kept, mass, 0.0).sum(axis=1, keepdims=True)
        return np.asarray(mass / inside * np.where(kept, counts, 0.0).sum(axis=1, keepdims=True))

    def _arena(self) -> Arena:
        old = self.found.arena
        return Arena(self.measured.both, old.test, old.origin, self.found.kept, old.present, old.start)

    def _problem(self, members: Sequence[Member]) -> Any:
        return self._arena().problem(members)

    def _refit(self, members: Sequence[Member]) -> FittedSet:
        return self._arena().fit(members, self.found.best.fit.parameters)

    def _addition(
        self,
        named: Named,
        members: tuple[Member, ...],
        before: Gap,
        after: Gap,
        grown: FittedSet,
        previous: FittedSet,
    ) -> Addition:
        member = next(m for m in grown.members if m.tag == named.member.tag)
        candidates = self._candidates(named, member.effect)
        alone = not named.equals
        fits = self.found.rest <= LARGEST_REST or after.value <= after.floor
        chance = self.meter.chance(self._problem(grown.members), grown.fit)
        runner_up = self._gap_with(named, members, chance, relatives=True)
        placebo = self._gap_with(named, members, chance, relatives=False)
        open_ = tuple(c for c in candidates if c.effect in (member.tag, *named.equals))
        return Addition(
            effect=member.effect,
            alone=alone,
            fits=fits,
            candidates=candidates if alone else open_,
            strength_stderr=_stderr(grown, member, named.apart),
            before=before,
            after=after,
            runner_up=runner_up,
            placebo=placebo,
            pulls=self._pulls(),
            moved=_moved(previous, grown),
        )

    def _candidates(self, named: Named, effect: Effect) -> tuple[Candidate, ...]:
        """Return the effect and what could stand in its place, with held-out scores."""
        judged = self.found.judged
        scored = [(effect, 0.0, 0.0)]
        for rival in named.rivals:
            rise, error = self.found.arena.difference(rival, judged)
            other = next((m.effect for m in rival.members if m.tag not in judged.tags), None)
            if other is not None:
                scored.append((other, rise, error))
        weights = np.exp([min(score, 0.0) for _, score, _ in scored])
        weights /= weights.sum()
        return tuple(
            Candidate.of(e, score, error, float(w))
            for (e, score, error), w in zip(scored, weights, strict=True)
        )

    def _gap_with(
        self, named: Named, members: tuple[Member, ...], chance: float, *, relatives: bool
    ) -> Rival | None:
        """Return a rival (a relative of the effect, or one that has nothing to do with it) and its gap."""
        kin = set(type(named.member.effect).separate)
        for rival in named.rivals:
            other = next((m for m in rival.members if m.tag not in self.found.judged.tags), None)
            if other is None or (other.tag in kin) != relatives:
                continue
            others = tuple(m for m in members if m.tag != named.member.tag)
            if any(other.excludes(m) for m in others):
                continue
            try:
                fitted = self._refit((*others, other))
            except ValueError:
                continue
            gap = self.meter.value(self._problem(fitted.members), fitted.fit, chance)
            return Rival(effect=other.tag, gap_after=gap)
        return None

    def _pulls(self) -> tuple[Pull, ...]:
        first, last = self.measured.nulls
        z = self.measured.z[2]
        before, after = first.pulls(z), last.pulls(z)
        telling = np.argsort(-np.abs(before))[:_MOST_PULLS]
        return tuple(
            Pull(
                statistic=first.names[i],
                sentence=STATISTICS[first.names[i]].sentence,
                before=float(before[i]),
                after=float(after[i]),
            )
            for i in telling
        )


def _stderr(grown: FittedSet, member: Member, apart: float) -> float:
    """Return the standard error of a strength: of the fit, and what the choice of the codes makes of it."""
    if not member.effect.strength:
        return float("nan")
    value, error = (float(v[0]) for v in grown.coordinates(member.tag))
    return float(np.hypot(member.coordinates[0].error(value, error), apart))


def _moved(before: FittedSet, after: FittedSet) -> dict[str, dict[str, Any]]:
    """Return how far the parameters of the pixels moved: median, and in standard errors."""
    change = after.fit.parameters - before.fit.parameters
    slopes = after.fit.parameters.copy()
    h, g, _, sigma = after.fit.parameters.T
    slopes = np.stack([h, g, np.ones_like(h), 0.5 * np.exp(after.fit.theta[:, 3]) / sigma], axis=1)
    error = np.sqrt(np.maximum(np.einsum("naa->na", after.fit.own_covariance), 0.0)) * np.abs(slopes)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(error > 0, change / error, np.nan)
    return {
        name: {"median": float(np.median(change[:, i])), "in_stderr": float(np.nanmedian(ratio[:, i]))}
        for i, name in enumerate(_PARAMETERS)
    }


def _verdict(additions: Sequence[Addition], found: Explanation | None) -> State:
    if found is None:
        return "consistent"
    if not additions or any(not a.fits for a in additions):
        return "unexplained"
    return "ambiguous" if any(not a.named for a in additions) else "named"


def _sentence(
    verdict: State,
    additions: Sequence[Addition],
    found: Explanation | None,
    before: Gap,
    after: Gap,
    residuals: Sequence[Place],
) -> str:
    titles = [type(a.effect).title or a.effect.tag for a in additions if a.named]
    left = f"; what is left: {closing(residuals)}" if residuals else ""
    if found is not None and found.unsteady:
        stand_ins = ", ".join(m.tag for m in found.unsteady)
        left += f"; {stand_ins} would describe a part of it, but not on all codes alike, and is not named"
    if verdict == "consistent":
        return "The histograms agree with the model in every statistic tested."
    if verdict == "unexplained":
        nearest = f" (nearest: {', '.join(found.nearest)})" if found and found.nearest else ""
        return f"The histograms disagree with the model, and no known effect explains it{nearest}{left}."
    share = max(after.value, 0.0) / before.value if before.value > 0 else 0.0
    gaps = f"{before.value:.3g} -> {max(after.value, 0.0):.3g} nats per sample (floor {after.floor:.1g})"
    rest = f"; {share:.0%} of the gap is left unexplained" if after.value > after.floor else ""
    if verdict == "named":
        them = "them" if len(titles) > 1 else "it"
        return (
            f"The model was missing {' and '.join(titles)}; with {them} the gap on unseen samples went {gaps}"
            f"{rest}{left}."
        )
    sets = [" or ".join(c.effect for c in a.candidates) for a in additions if not a.named]
    also = f"{' and '.join(titles)} is missing, and " if titles else ""
    lacks = f"{also}{' and '.join(sets)}{rest}{left}"
    return f"The model lacks something that these histograms cannot tell apart: {lacks}."
