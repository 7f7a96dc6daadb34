"""Effects added by likelihood, with gap and rivals of each, and the remaining discrepancy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.build_verdict import (
    LARGEST_REST,
    LEAVES_TOO_MUCH,
    MOST_RIVALS,
    Added,
    Addition,
    largest_pulls,
)
from pchem_pipeline.discrepancy.by_likelihood.comb import find_residuals, places_of, set_aside_residual
from pchem_pipeline.discrepancy.by_likelihood.gap import Distance, on_all_codes
from pchem_pipeline.discrepancy.by_likelihood.members import Member
from pchem_pipeline.discrepancy.by_likelihood.search import Explanation, Named
from pchem_pipeline.discrepancy.by_likelihood.sets import FittedSet
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import UNITS
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.null import Measured, NullModel
from pchem_pipeline.discrepancy.verdict import Candidate, Place, Rival
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass
class AddedSets:
    """Fits the models of the steps to train and test together, and measures their gaps on the final part.

    Attributes:
        parts: train, test and final histograms, shape (n, B) each.
        found: what the search came to.
        plain: the fit without effects to train and test.
    """

    parts: tuple[IntArray, ...]
    found: Explanation
    plain: FittedSet

    def __post_init__(self) -> None:
        """Add train and test part: what is added is fitted to both."""
        self.both = self.parts[0] + self.parts[1]
        self.sets = replace(self.found.sets.on(self.found.kept, self.found.sets.start), train=self.both)

    def gap(self, fitted: FittedSet) -> Gap:
        """Return the gap of a fit on the final part.

        Codes that are set aside keep what they have under the plain model: what is not understood does not
        count as closed.
        """
        masses = on_all_codes(fitted.log_masses, self.found.kept, self.plain.log_masses)
        return self.distance(fitted, np.ones_like(self.found.kept), masses).gap

    def distance(self, fitted: FittedSet, kept: NDArray[np.bool_], log_masses: FloatArray) -> Distance:
        """Return the distance of the final part from a fit among some codes."""
        share = float(self.parts[2].sum() / self.both.sum())
        return Distance.of(self.parts[2], kept, log_masses, fitted.n_parameters, share)

    def close(
        self, before: Gap, nulls: tuple[NullModel, NullModel], z: Measured, still: bool
    ) -> tuple[Added, FittedSet]:
        """Return the added effects and what is left, and the fit with all of them.

        Args:
            before: gap without effects.
            nulls: of the model without and with all effects.
            z: statistics of the parts.
            still: whether the data disagree with the final model.
        """
        pulls = [null.pulls(z.both, splits=2) for null in nulls]
        moved = largest_pulls(nulls[0].names, pulls[0], pulls[0], pulls[1])
        gap, fitted = before, self.plain
        additions: list[Addition] = []
        members: tuple[Member, ...] = ()
        for named in self.found.named:
            members = (*members, named.member)
            extended = self._refit(members)
            after = self.gap(extended)
            addition = self._addition(named, members, (gap, after), (fitted, extended))
            additions.append(replace(addition, pulls=moved))
            gap, fitted = after, extended
        left = "" if self.found.rest <= LARGEST_REST or gap.at_floor else LEAVES_TOO_MUCH
        added = Added(
            additions=tuple(replace(each, against=left or each.against) for each in additions),
            after=gap,
            nearest=self.found.nearest,
            stand_ins=tuple(m.tag for m in self.found.unsteady),
            residuals=self.residuals(fitted) if still or not gap.at_floor else (),
            set_aside=self.found.set_aside,
        )
        return added, fitted

    def residuals(self, fitted: FittedSet) -> tuple[Place, ...]:
        """Return the codes that the model does not account for, a peak that was set aside first."""
        counts, kept = self.both.astype(np.float64), self.found.kept
        expected = self._expected(fitted)
        parameters = fitted.fit.parameters
        electrons = places_of(self.sets.origin, counts.shape[1], parameters)
        found = find_residuals(
            np.where(kept, counts, 0.0), np.where(kept, expected, 0.0), electrons, parameters
        )
        for low, high in self.found.set_aside:
            seen, wanted = (float(np.where(kept, 0.0, values).sum()) for values in (counts, expected))
            among = self.distance(fitted, kept, fitted.log_masses).gap.value * self.parts[2][kept].sum()
            share = 1.0 - float(among / (self.gap(fitted).value * self.parts[2].sum()))
            found.insert(0, set_aside_residual(low, high, seen, wanted, parameters, share))
        return tuple(found)

    def codes(self, fitted: FittedSet, evidence: Evidence) -> FloatArray | None:
        """Return the samples expected at each code of the evidence, or None if it holds other pixels too."""
        code = evidence.code
        illuminated = np.tile(~np.array(self.sets.samples.dark), self.both.shape[0] // self.sets.samples.n)
        expected, origin = self._expected(fitted)[illuminated], self.sets.origin[illuminated]
        if evidence.maps.usable.sum() != expected.shape[0]:
            return None
        found = np.zeros(code.observed.size)
        for row, first in zip(expected, origin - code.first, strict=True):
            at = first + np.arange(row.size)
            within = (at >= 0) & (at < found.size)
            np.add.at(found, at[within], row[within])
        return np.asarray(found * code.observed.sum() / max(float(self.both[illuminated].sum()), 1.0))

    def _expected(self, fitted: FittedSet) -> FloatArray:
        """Return the samples of train and test expected at each code given those in codes that are kept."""
        counts, kept = self.both.astype(np.float64), self.found.kept
        mass = self.sets.problem(fitted.members).masses(fitted.fit.theta, fitted.fit.shared)
        inside = np.where(kept, mass, 0.0).sum(axis=1, keepdims=True)
        return np.asarray(mass / inside * np.where(kept, counts, 0.0).sum(axis=1, keepdims=True))

    def _refit(self, members: Sequence[Member]) -> FittedSet:
        return self.sets.fit(members, self.found.best.fit.parameters)

    def _addition(
        self,
        named: Named,
        members: tuple[Member, ...],
        gaps: tuple[Gap, Gap],
        fits: tuple[FittedSet, FittedSet],
    ) -> Addition:
        """Return an effect with the gaps and the fits without and with it, and with rivals in its place."""
        extended = fits[1]
        member = extended.member(named.member.tag)
        assert member is not None  # it was just fitted
        candidates = self._candidates(named, member.effect)
        if named.equals:
            candidates = tuple(c for c in candidates if c.effect in (member.tag, *named.equals))
        rivals = self._rivals(named, members)
        kin = {member.tag, *type(member.effect).separate}
        return Addition(
            effect=member.effect,
            alone=not named.equals,
            against=member.effect.stuck_words(),
            candidates=candidates,
            # of the fit, and what the choice of the codes makes of it
            strength_stderr=float(np.hypot(extended.stderr(member), named.apart)),
            before=gaps[0],
            after=gaps[1],
            rivals=rivals[:MOST_RIVALS],
            placebo=next((r for r in rivals[1:] if r.effect not in kin), None),
            pulls=(),
            moved=_moved(*fits),
        )

    def _candidates(self, named: Named, effect: Effect) -> tuple[Candidate, ...]:
        """Return the effect and what could stand in its place, with held-out scores."""
        scored = [(effect, 0.0, 0.0), *((other.effect, score, error) for other, score, error in named.rivals)]
        weights = np.exp([min(score, 0.0) for _, score, _ in scored])
        weights /= weights.sum()
        return tuple(
            Candidate.of(e, score, error, float(w))
            for (e, score, error), w in zip(scored, weights, strict=True)
        )

    def _rivals(self, named: Named, members: tuple[Member, ...]) -> tuple[Rival, ...]:
        """Return what could stand in the place of an effect, refitted, with its gap, the best first."""
        others = tuple(m for m in members if m.tag != named.member.tag)
        found = []
        for other, behind, error in named.rivals:
            if any(other.excludes(m) for m in others):
                continue
            try:
                fitted = self._refit((*others, other))
            except ValueError:
                continue
            why = f"it predicts unseen samples worse, by {-behind:.3g} ± {error:.2g}"
            if other.tag in named.equals:
                why = "it predicts unseen samples as well: these histograms do not decide"
            found.append(Rival(effect=other.tag, gap_after=self.gap(fitted).value, behind=behind, why=why))
        return tuple(sorted(found, key=lambda rival: -rival.behind))


def _moved(before: FittedSet, after: FittedSet) -> dict[str, dict[str, Any]]:
    """Return how far the parameters of the pixels moved: median over the rows, and in standard errors."""
    change = after.fit.parameters - before.fit.parameters
    h, g, _, sigma = after.fit.parameters.T
    slopes = np.stack([h, g, np.ones_like(h), 0.5 * np.exp(after.fit.row_theta[:, 3]) / sigma], axis=1)
    error = np.sqrt(np.maximum(after.fit.row_variance, 0.0)) * np.abs(slopes)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(error > 0, change / error, np.nan)
    return {
        name: {
            "median": float(np.median(change[:, i])),
            "in_stderr": float(np.nanmedian(ratio[:, i])),
            "unit": unit,
        }
        for i, (name, unit) in enumerate(UNITS.items())
    }
