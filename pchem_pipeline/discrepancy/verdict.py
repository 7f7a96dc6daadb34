"""What the workflow found, as ``discrepancy.json`` tells it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.observe.catalogue import VERSION as STATISTICS_VERSION
from pchem_pipeline.discrepancy.where import Place
from pchem_pipeline.effects.framework.added_exposure import AddedExposure
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps

__all__ = ["Candidate", "Discrepancy", "Pull", "Residual", "Step", "Verdict", "unit_of"]

Verdict = Literal["named", "ambiguous", "unexplained", "consistent"]
SCHEMA = 1


@dataclass(frozen=True)
class Candidate:
    """An effect that was compared.

    Attributes:
        effect: with its fitted parameters.
        score: held-out log score against the chosen one, nats (0 for the chosen one).
        stderr: of that difference, nats.
        probability: among all candidates.
    """

    effect: Effect
    score: float
    stderr: float
    probability: float

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON data."""
        return {
            "effect": self.effect.tag,
            "score": self.score,
            "stderr": self.stderr,
            "probability": self.probability,
            "parameters": self.effect.model_dump(mode="json", exclude={"tag"}),
        }


@dataclass(frozen=True)
class Pull:
    """Deviation of one statistic before and after, in standard deviations."""

    statistic: str
    before: float
    after: float

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON data."""
        sentence = STATISTICS[self.statistic].sentence
        return {"statistic": self.statistic, "sentence": sentence, "before": self.before, "after": self.after}


@dataclass(frozen=True)
class Residual:
    """Samples of some codes that the model does not account for.

    Attributes:
        words: where, which way and how many.
        direction: "+" (more than the model has) or "-".
        z: signed root of the Poisson deviance, standard deviations.
        p: chance of one like it anywhere.
        dn: first and last code, DN.
        seen, expected: samples.
        share: of the gap that is left.
    """

    words: str
    direction: str
    z: float
    p: float
    dn: tuple[int, int]
    seen: float
    expected: float
    share: float

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON data."""
        return {
            "statistic": "code.smooth",
            "channel": STATISTICS["code.smooth"].channel,
            "sentence": self.words,
            "direction": self.direction,
            "z": self.z,
            "p": self.p,
            "dn": list(self.dn),
            "seen": self.seen,
            "expected": self.expected,
            "share_of_gap": self.share,
        }


@dataclass(frozen=True)
class Step:
    """One effect added to the model, or one that could not be told from others.

    Attributes:
        effect: the named effect; None where it is ambiguous or does not fit.
        candidates: those compared, the likeliest first.
        strength_stderr: standard error of its strength.
        before, after: gap on the final frames without and with it.
        runner_up, placebo: (tag, gap) of the next best candidate and of one that has nothing to do with it,
            fitted the same way; None where there is none.
        pulls: the statistics that moved most.
        fits: whether it explains what it moves itself; where not, the candidates are the nearest known.
        moved: change of each parameter map by its refit with the effect: median, and in standard errors.
    """

    effect: Effect | None
    candidates: tuple[Candidate, ...]
    strength_stderr: float
    before: Gap
    after: Gap
    runner_up: tuple[str, float] | None
    placebo: tuple[str, float] | None
    pulls: tuple[Pull, ...]
    fits: bool = True
    moved: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def verdict(self) -> Verdict:
        """Verdict of this step alone."""
        if not self.fits:
            return "unexplained"
        return "ambiguous" if self.effect is None else "named"

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON data."""
        shown = self.effect if self.effect is not None else self.candidates[0].effect
        separate = dict(type(shown).separate)
        rivals = {c.effect.tag for c in self.candidates}
        return {
            "effect": None if self.effect is None else self.effect.tag,
            "verdict": self.verdict,
            "candidates": [c.to_json() for c in self.candidates],
            "parameters": _parameters(shown, self.strength_stderr),
            "gap_before": self.before.value,
            "gap_after": self.after.value,
            "gap_floor": self.after.floor,
            "gap_interval_after": list(self.after.interval),
            "families": {"before": self.before.families, "after": self.after.families},
            "runner_up": _tagged(self.runner_up),
            "placebo": _tagged(self.placebo),
            "moved": {name: dict(change) for name, change in self.moved.items()},
            "separate": {t: m for t, m in separate.items() if t in rivals or self.effect is not None},
            "pulls": [p.to_json() for p in self.pulls],
        }


@dataclass(frozen=True)
class Discrepancy:
    """The result of the workflow.

    Attributes:
        verdict: named, ambiguous, unexplained or consistent.
        sentence: the verdict for people.
        steps: what was added, in order of weight.
        model: effects that the model has now, those it had before included.
        gap_before, gap_after: on the final frames, with no new effect and with all.
        where: the disagreements found.
        unexplained: statistics that still deviate: name, and standard deviations.
        untestable: effects that such frames cannot show, and why.
        left_out: candidates that failed, and why.
        global_p: chance of the largest deviation, before and after.
        examined: frames, rows and columns looked at.
        n_replicates: simulated stacks in all.
        maps: parameters of the pixels examined, under the final model.
        evidence: of the train frames.
        statistics: names, and deviations before and after, for pictures.
        residuals: codes that the final model does not account for (ready-made histograms).
        set_aside: codes that its fit leaves out, by their place on a pixel's comb: intervals, e-; None: no
            limit.
        added: exposure that the effects add to single pixels beside the H of ``maps``; None: nothing.
        code_grown: samples expected at each code of ``evidence.code`` from the final model; None where
            nothing was added or the model gives no law.
    """

    verdict: Verdict
    sentence: str
    steps: tuple[Step, ...]
    model: tuple[Effect, ...]
    gap_before: Gap
    gap_after: Gap
    where: tuple[Place, ...]
    unexplained: tuple[tuple[str, float], ...]
    untestable: Mapping[str, str]
    left_out: Mapping[str, str]
    global_p: tuple[float, float]
    examined: Mapping[str, Any]
    n_replicates: int
    maps: PixelMaps
    evidence: Evidence
    statistics: tuple[tuple[str, ...], NDArray[np.float64], NDArray[np.float64]]
    residuals: tuple[Residual, ...] = ()
    set_aside: tuple[tuple[float | None, float | None], ...] = ()
    code_grown: NDArray[np.float64] | None = None
    added: AddedExposure | None = None

    @property
    def effects(self) -> tuple[str, ...]:
        """Tags of the named effects."""
        return tuple(s.effect.tag for s in self.steps if s.effect is not None)

    @property
    def closed_fraction(self) -> float:
        """Fraction of the gap that the added effects closed; 0 where there was none."""
        before = self.gap_before.value
        if before <= 0.0 or not self.steps:
            return 0.0
        return 1.0 - max(self.gap_after.value, 0.0) / before

    def to_json(self) -> dict[str, Any]:
        """Return the content of ``discrepancy.json``."""
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "sentence": self.sentence,
            "effects": list(self.effects),
            "model_effects": [e.model_dump(mode="json") for e in self.model],
            "steps": [s.to_json() for s in self.steps],
            "gap": {
                "unit": "nats/sample",
                "before": self.gap_before.value,
                "after": self.gap_after.value,
                "floor": self.gap_after.floor,
                "closed_fraction": self.closed_fraction,
                "interval_before": list(self.gap_before.interval),
                "interval_after": list(self.gap_after.interval),
            },
            "where": [_place(p) for p in self.where],
            "untestable": list(self.untestable),
            "untestable_reasons": dict(self.untestable),
            "unexplained": [r.to_json() for r in self.residuals]
            + [{"statistic": n, "z": z, "sentence": STATISTICS[n].sentence} for n, z in self.unexplained],
            "set_aside": [list(interval) for interval in self.set_aside],
            "examined": dict(self.examined),
            "left_out": dict(self.left_out),
            "p_global": {"before": self.global_p[0], "after": self.global_p[1]},
            "replicates": self.n_replicates,
            "versions": {"statistics": STATISTICS_VERSION},
        }


def _place(place: Place) -> dict[str, Any]:
    statistic = STATISTICS[place.statistic]
    return {
        "statistic": place.statistic,
        "channel": statistic.channel,
        "direction": place.direction,
        "z": place.z,
        "p": place.p,
        "sentence": statistic.sentence,
        "pixels": [list(pixel) for pixel in place.pixels],
        "dn": list(place.dn),
        "frames": list(place.frames),
    }


def _tagged(item: tuple[str, float] | None) -> dict[str, Any] | None:
    return None if item is None else {"effect": item[0], "gap_after": item[1]}


def _parameters(effect: Effect, stderr: float) -> dict[str, Any]:
    """Return the numbers of an effect; only its strength was fitted and has a standard error."""
    found: dict[str, Any] = {}
    for name, value in effect.model_dump(exclude={"tag"}).items():
        if isinstance(value, int | float) and not isinstance(value, bool):
            fitted = name == effect.strength and np.isfinite(stderr)
            found[name] = {
                "value": value,
                "stderr": float(stderr) if fitted else None,
                "unit": unit_of(type(effect), name),
            }
    return found


def unit_of(effect: type[Effect], name: str) -> str:
    """Return the unit that the description of a field ends with, or nothing."""
    text = effect.model_fields[name].description or ""
    last = text.rpartition(",")[2].strip() if "," in text else ""
    return last if len(last) <= 20 and last != "no unit" else ""
