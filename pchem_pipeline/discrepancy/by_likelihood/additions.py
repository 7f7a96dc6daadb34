"""Effects added by likelihood, with gap and rivals of each, and the remaining discrepancy."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.discrepancy.build_verdict import (
    LARGEST_REST,
    LEAVES_TOO_MUCH,
    Added,
    Addition,
    largest_pulls,
)
from pchem_pipeline.discrepancy.by_likelihood.comb import find_residuals
from pchem_pipeline.discrepancy.by_likelihood.gap import on_all_codes
from pchem_pipeline.discrepancy.by_likelihood.search import Explanation, Named
from pchem_pipeline.discrepancy.by_likelihood.sets import FittedSet, SetComparison
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import changes
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.null import Measured, NullModel
from pchem_pipeline.discrepancy.verdict import Candidate, Place, Rival
from pchem_pipeline.effects.framework.evidence import Evidence


@dataclass
class AddedSets:
    """Fits what the search found to train and test part together, and measures gaps on the final part.

    ``whole`` does so with all codes.
    """

    found: Explanation
    whole: SetComparison

    @functools.cached_property
    def sets(self) -> SetComparison:
        """The same as ``whole`` without the codes that were set aside."""
        return replace(self.whole, kept=self.found.kept)

    def gap(self, fitted: FittedSet) -> Gap:
        """Return the gap of a fit; codes set aside keep the plain law, and nothing of theirs is closed."""
        masses = on_all_codes(fitted.log_masses, self.found.kept, self.whole.plain.log_masses)
        return self.whole.gap(replace(fitted, log_masses=masses))

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
        gap, fitted = before, self.whole.plain
        additions: list[Addition] = []
        for named in self.found.named:
            extended = self.sets.fit((*fitted.members, named.member), self.found.best.fit.parameters)
            after = self.gap(extended)
            addition = self._addition(named, (gap, after), (fitted, extended))
            additions.append(replace(addition, pulls=moved))
            gap, fitted = after, extended
        left = "" if self.found.rest <= LARGEST_REST or gap.at_floor else LEAVES_TOO_MUCH
        added = Added(
            additions=tuple(replace(each, against=left or each.against) for each in additions),
            after=gap,
            stand_ins=self.found.stand_ins,
            residuals=self.residuals(fitted) if still or not gap.at_floor else (),
            set_aside=self.found.set_aside,
        )
        return added, fitted

    def residuals(self, fitted: FittedSet) -> tuple[Place, ...]:
        """Return the codes that the model does not account for, a peak that was set aside first."""
        own = self.sets.origin, fitted.fit.parameters, self.found.set_aside
        return tuple(find_residuals(self.sets.train.astype(np.float64), self._expected(fitted), *own))

    def codes(self, fitted: FittedSet, evidence: Evidence) -> FloatArray | None:
        """Return the samples expected at each code of the evidence, or None if it holds other pixels too."""
        code = evidence.code
        illuminated = self.sets.samples.illuminated(self.sets.train.shape[0])
        expected, origin = self._expected(fitted)[illuminated], self.sets.origin[illuminated]
        if evidence.maps.usable.sum() != expected.shape[0]:
            return None
        at = (origin - code.first)[:, None] + np.arange(expected.shape[1])
        within, size = (at >= 0) & (at < code.observed.size), code.observed.size
        found = np.bincount(at[within], expected[within], minlength=size)
        return np.asarray(found * code.observed.sum() / max(float(self.sets.train[illuminated].sum()), 1.0))

    def _expected(self, fitted: FittedSet) -> FloatArray:
        """Return the samples of train and test expected at each code given those in codes that are kept."""
        counts, kept = self.sets.train.astype(np.float64), self.found.kept
        mass = self.sets.problem(fitted.members).masses(fitted.fit.theta, fitted.fit.shared)
        inside = np.where(kept, mass, 0.0).sum(axis=1, keepdims=True)
        return np.asarray(mass / inside * np.where(kept, counts, 0.0).sum(axis=1, keepdims=True))

    def _addition(self, named: Named, gaps: tuple[Gap, Gap], fits: tuple[FittedSet, FittedSet]) -> Addition:
        """Return an effect with the gaps and the fits without and with it, and with rivals in its place."""
        before, after = fits
        member = after.members[-1]
        compared = [(member, 0.0, 0.0), *named.rivals]
        weights = special.softmax([min(score, 0.0) for _, score, _ in compared])
        return Addition(
            effect=member.effect,
            alone=not named.equals,
            against=member.effect.stuck_words(),
            candidates=tuple(
                Candidate.of(each.effect, score, error, float(weight))
                for (each, score, error), weight in zip(compared, weights, strict=True)
                if not named.equals or each.tag in (member.tag, *named.equals)
            ),
            # of the fit; that of the strength with what the choice of the codes makes of it
            stderr={
                name: float(np.hypot(error, named.apart if name == member.effect.strength else 0.0))
                for name, error in after.stderr(member).items()
            },
            before=gaps[0],
            after=gaps[1],
            rivals=self._rivals(named, before),
            pulls=(),
            moved=changes(before.fit.parameters, after.fit.parameters, after.fit.stderr),
        )

    def _rivals(self, named: Named, before: FittedSet) -> tuple[Rival, ...]:
        """Return what could stand in the place of an effect, refitted, with its gap, the best first."""
        found, start = [], self.found.best.fit.parameters
        for other, behind, error in named.rivals:
            if any(other.excludes(m) for m in before.members):
                continue
            try:
                gap = self.gap(self.sets.fit((*before.members, other), start))
            except ValueError:
                continue
            why = f"it predicts unseen samples worse, by {-behind:.3g} ± {error:.2g} nats"
            if other.tag in named.equals:
                why = "it predicts unseen samples as well: these histograms do not decide"
            found.append(Rival(effect=other.tag, gap_after=gap.value, behind=behind, why=why))
        return tuple(found)
