"""From effects that were added, with their gaps, to the steps of a verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.verdict import (
    Candidate,
    Families,
    GapChange,
    Moved,
    Pull,
    Rival,
    State,
    Step,
    parameters_of,
)
from pchem_pipeline.effects.framework.effect import Effect

__all__ = ["Addition", "gap_change", "step_of"]


@dataclass(frozen=True)
class Addition:
    """An effect added to the model, or the likeliest of several.

    Attributes:
        effect: with its fitted parameters.
        alone: whether it was told from all others.
        fits: whether it explains what it moves itself; where not, the candidates are the nearest known.
        candidates: those compared, the likeliest first.
        strength_stderr: standard error of its strength.
        before, after: gap on the final samples without and with it.
        runner_up, placebo: the next best candidate and one that has nothing to do with it, fitted the same
            way; None where there is none.
        pulls: the statistics that moved most.
        moved: change of each parameter map by its refit with the effect.
    """

    effect: Effect
    alone: bool
    fits: bool
    candidates: tuple[Candidate, ...]
    strength_stderr: float
    before: Gap
    after: Gap
    runner_up: Rival | None
    placebo: Rival | None
    pulls: tuple[Pull, ...]
    moved: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def named(self) -> bool:
        """Whether the verdict names it."""
        return self.alone and self.fits


def step_of(added: Addition) -> Step:
    """Return an addition as ``discrepancy.json`` holds it."""
    state: State = "unexplained" if not added.fits else "named" if added.alone else "ambiguous"
    rivals = {c.effect for c in added.candidates}
    separate = dict(type(added.effect).separate)
    return Step(
        effect=added.effect.tag if added.named else None,
        verdict=state,
        candidates=added.candidates,
        parameters=parameters_of(added.effect, added.strength_stderr),
        gap_before=added.before.value,
        gap_after=added.after.value,
        gap_floor=added.after.floor,
        gap_interval_after=added.after.interval,
        families=Families(before=added.before.families, after=added.after.families),
        runner_up=added.runner_up,
        placebo=added.placebo,
        moved={name: Moved(**change) for name, change in added.moved.items()},
        separate={tag: text for tag, text in separate.items() if tag in rivals or added.named},
        pulls=added.pulls,
    )


def gap_change(before: Gap, after: Gap, *, grown: bool) -> GapChange:
    """Return the gap before and after, and the fraction of it that was closed (0 where nothing was added)."""
    closed = 1.0 - max(after.value, 0.0) / before.value if grown and before.value > 0.0 else 0.0
    return GapChange(
        before=before.value,
        after=after.value,
        floor=after.floor,
        closed_fraction=closed,
        interval_before=before.interval,
        interval_after=after.interval,
    )
