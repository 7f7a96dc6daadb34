"""The model as rounds of a search add effects to it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.by_simulation.additions import Round
from pchem_pipeline.discrepancy.by_simulation.candidates.fingerprints import Hypothesis, SetFit
from pchem_pipeline.discrepancy.by_simulation.sensor.maps import NotFittedError
from pchem_pipeline.discrepancy.by_simulation.sensor.simulations import Simulations
from pchem_pipeline.discrepancy.by_simulation.sets.comparison import Comparison
from pchem_pipeline.discrepancy.by_simulation.sets.refits import Refitted, lesser
from pchem_pipeline.discrepancy.null import NullModel
from pchem_pipeline.effects.framework.compose import along_chain
from pchem_pipeline.effects.framework.effect import Effect

FloatArray = NDArray[np.float64]

_NEAR = 0.1  # relative: so little is not worth another simulation, but can be corrected without one


@dataclass
class ExtendedModel:
    """Effects, and how they came.

    Attributes:
        work: fits the pixels with them.
        first: null of the model before anything was added.
        given: effects that it had then.
        effects: those that it has now.
        rounds: in which the others were added.
        last: the set that was added last, at its best fit; None: nothing was.
    """

    work: Simulations
    first: NullModel
    given: tuple[Effect, ...]
    effects: tuple[Effect, ...]
    rounds: list[Round] = field(default_factory=list)
    last: Refitted | None = None

    @property
    def added(self) -> tuple[Hypothesis, ...]:
        """The effects of all rounds."""
        return tuple(h for this in self.rounds for h in this.added.hypotheses)

    @property
    def present(self) -> tuple[Effect, ...]:
        """The effects beside which those of the rounds are fitted."""
        return self._without(self.added)

    def _without(self, gone: tuple[Hypothesis, ...]) -> tuple[Effect, ...]:
        """Return its effects without some, whatever their strengths are now."""
        keys = {h.effect.key for h in gone}
        return tuple(e for e in self.effects if e.key not in keys)

    def put(
        self,
        found: Comparison,
        added: Refitted,
        hypotheses: tuple[Hypothesis, ...],
        null: NullModel,
        *,
        certain: bool = True,
    ) -> NullModel:
        """Put a set into the model, at the strengths to which its replicates correct it; return the null.

        Args:
            found: how it was chosen.
            added: the set with many replicates.
            hypotheses: all candidates of the round.
            null: of the model before it.
            certain: whether its effects are beyond doubt.
        """
        # within a standard error the steps end, too
        near = np.abs(added.change) < np.maximum(_NEAR, added.stderr)
        change = np.where(near, np.expm1(added.change), 0.0)
        try:
            corrected = self._take(added, change)
        except NotFittedError:  # a step too far
            change = np.zeros_like(change)
            corrected = self._take(added, change)
        self.last = added
        extended = NullModel.from_replicates(self.first.names, added.vectors, self.first)
        slopes = lesser(added.slopes, added.parts)
        extended = extended.shifted(np.sum(slopes * change[:, None], axis=0))
        fitted = np.array([bool(h.effect.strength) for h in added.hypotheses])
        extended = replace(extended, strengths=slopes * (added.stderr * fitted)[:, None])
        errors = dict(zip((h.tag for h in corrected), added.stderr, strict=True))
        now = {h.tag: h for h in corrected}
        self.rounds = [this.updated(now, errors) for this in self.rounds]
        before = {h.tag for h in self.added}
        new = tuple(h for h in corrected if h.tag not in before)
        fit = SetFit(
            new, np.ones(len(new)), np.array([errors[h.tag] for h in new]), np.zeros(len(new), np.bool_)
        )
        moved = self.work.mapped(self.effects).fit.moved
        self.rounds.append(Round(found, fit, hypotheses, null, extended, moved, certain))
        return extended

    def put_measured(self, found: Refitted) -> NullModel:
        """Put what was measured into the model, without effects that are not beside it, and their rounds."""
        gone = {h.tag for h in self.added} - found.tags
        self.effects = self._without(tuple(h for h in self.added if h.tag in gone))
        changed = [i for i, this in enumerate(self.rounds) if gone & {h.tag for h in this.added.hypotheses}]
        self.rounds = self.rounds[: min(changed, default=len(self.rounds))]
        null = self.rounds[-1].extended if self.rounds else self.first
        return self.put(Comparison(found, (found,)), found, (), null)

    def _take(self, added: Refitted, change: FloatArray) -> tuple[Hypothesis, ...]:
        """Take a set into the model, its factors changed by shares, and return it.

        Raises:
            NotFittedError: no pixels can be fitted with that.
        """
        taken = tuple(h.times(1.0 + float(c)) for h, c in zip(added.hypotheses, change, strict=True))
        effects = along_chain(self._without(taken), [h.effect for h in taken])
        self.work.mapped(effects)
        self.effects = effects
        return taken
