"""Acceptance of a fitted set of effects: significance of each, and the remaining gap."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import (
    LARGEST_DECREASE,
    Hypothesis,
    correction,
    counted,
    lesser,
)
from pchem_pipeline.discrepancy.by_simulation.candidates.screening import noise_of_splits
from pchem_pipeline.discrepancy.by_simulation.sets.refits import ESTABLISHED, Refitted
from pchem_pipeline.discrepancy.gap import Gap, StatisticsGap
from pchem_pipeline.discrepancy.null import Measured, NullModel
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.model.arithmetic.significance import CLEAR

# standard errors of a strength in the final frames, half as many, which nothing was chosen by
_CONFIRMED = 1.0
# standard deviations of the plain model beyond the others' part from which on an effect is there, though its
# strength be known badly: so few errors of that do then
_OVERWHELMING = 30.0


@dataclass(frozen=True)
class Acceptance:
    """Judges sets of effects by the statistics ``z`` of the data and the null before anything was added."""

    first: NullModel
    z: Measured
    gaps: StatisticsGap
    settings: DiscrepancySettings

    @property
    def allowed(self) -> float:
        """Relative error of what effects do at their best fit: their details are never quite the sensor's."""
        return self.settings.model_error / 2.0

    def gap(self, null: NullModel) -> Gap:
        """Return the gap of a model."""
        return self.gaps.gap(self.z.final, null.mean, null.replicates, null.strengths)

    def gap_at(self, mean: FloatArray, replicates: FloatArray) -> Gap:
        """Return the gap of a model that gives a mean, (m,), and scatters as replicates do, (b, m)."""
        return self.gaps.gap(self.z.final, mean, replicates)

    def widens(self, added: Refitted) -> bool:
        """Return whether a set, its strengths as the data ask for, leaves a wider gap than without it."""
        mean = added.mean + np.expm1(added.change) @ added.parts
        before = self.gap_at(self.first.mean, self.first.replicates)
        return self.gap_at(mean, added.vectors).interval[0] > before.value

    def established(self, added: Refitted) -> tuple[Hypothesis, ...]:
        """Return the effects that are significant in the data, and in the final frames alone.

        Those had no part in finding them: a true effect of 4.5 standard errors in two thirds of the frames
        misses them once in seventy times; a chance passes once in six. What has no name needs 3 standard
        errors in either; what is beyond doubt, though its strength is known badly (the variance of a noise in
        n frames to sqrt(2 / n)), 3 in the data. Of few events the probability by chance counts instead.
        """
        first, n, model_error = self.first, len(added.vectors), self.settings.model_error
        certain = counted(added.parts, self.z.both - first.mean, noise_of_splits(first, 2, model_error))
        noise = noise_of_splits(first, 1, model_error)
        noise = replace(noise, covariance=added.covariance.times(1.0 + 1.0 / n))
        # about the set at its best fit: strong effects do not add up to what they do together
        left = self.z.final - added.mean
        allowed = noise.of(lesser(added.slopes, added.parts), left)
        change, stderr = correction(added.slopes, left, allowed)
        measured = np.array([type(h.effect).empirical for h in added.hypotheses])
        sure = measured | _overwhelming(added.parts, self.z.both - first.mean, first.std)
        # few forms are tried of what is measured without a name
        clear = np.exp(added.change) > np.where(sure, CLEAR, ESTABLISHED) * added.stderr
        proven = 1.0 + change > np.where(measured, CLEAR, _CONFIRMED) * stderr
        proven &= change > -LARGEST_DECREASE
        there = (clear & proven) | certain | (self._counted(added) & (change > -LARGEST_DECREASE))
        there &= added.slopes.any(axis=1)  # what moves nothing has a strength without an error
        return tuple(h for h, is_there in zip(added.hypotheses, there, strict=True) if is_there)

    def _counted(self, added: Refitted) -> BoolArray:
        """Return which effects account for a count beyond chance, which the final frames have, too."""
        first, z = self.first, self.z
        size = np.abs(added.parts)
        others = size.sum(axis=0) - size
        # of the same probability as so many standard errors of a strength, but of no effect, not of some
        seen, final = (
            np.array([first.p_values(each - rest, splits) for rest in others]) < 2.0 * special.ndtr(-limit)
            for each, splits, limit in ((z.both, 2, ESTABLISHED), (z.final, 1, _CONFIRMED))
        )
        more = np.minimum(z.both, z.final) > first.mean + others
        made = (added.parts > 0.0) & first.moved_by(added.vectors) & (np.abs(added.rest) < CLEAR)
        return np.asarray((seen & final & more & made & first.counts).any(axis=1))


def _overwhelming(parts: FloatArray, shift: FloatArray, scatter: FloatArray) -> BoolArray:
    """Return of which effects some statistic stands out far beyond what all the others make of it, (e,)."""
    others = np.abs(parts).sum(axis=0) - np.abs(parts)
    beyond = (np.abs(shift) - others) * np.sign(shift)
    least = _OVERWHELMING * scatter
    return np.asarray(((beyond * np.sign(parts) > least) & (np.abs(parts) > least)).any(axis=1))
