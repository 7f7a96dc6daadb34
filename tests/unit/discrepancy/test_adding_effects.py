"""How a chosen set enters the model: what is not needed, or not established in the end, stays outside."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pchem_pipeline.discrepancy.by_simulation.explainer import FrameExplainer, _Explanation
from pchem_pipeline.discrepancy.by_simulation.fingerprints import Hypothesis, Noise, SetFit, seen_among
from pchem_pipeline.discrepancy.null import Measured
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.effects.framework.registry import effect_class

M = 6
NOISE = Noise(np.eye(M), 0.05)
STRENGTHS = {"row_noise": "row_noise_dn", "frame_noise": "frame_noise_dn", "exposure_drift": "drift"}


def hypothesis(tag: str, place: int, size: float) -> Hypothesis:
    effect = effect_class(tag).model_validate({"tag": tag, STRENGTHS[tag]: 0.1})
    return Hypothesis(effect, size * np.eye(M)[place])


ROW, FRAME, DRIFT = hypothesis("row_noise", 0, 40.0), hypothesis("frame_noise", 1, 9.0), hypothesis(
    "exposure_drift", 2, 6.0
)  # fmt: skip


class Exact:
    """A simulator in which strengths are what they are."""

    prefix = "r0"

    def tuned(self, sets: Sequence[Any], *_: Any, **__: Any) -> list[Any]:
        return list(sets)


class Chosen:
    def __init__(self, *hypotheses: Hypothesis) -> None:
        self.hypotheses = hypotheses

    def present(self, certainty: float) -> tuple[Hypothesis, ...]:
        return self.hypotheses


def search(corrected: dict[str, float], monkeypatch: pytest.MonkeyPatch) -> FrameExplainer:
    """Return a search whose replicates correct the strengths to so many standard errors."""
    found = FrameExplainer(None, DiscrepancySettings(), (), list)  # type: ignore[arg-type]
    no_fit = SimpleNamespace(moved={})

    def correct(added: SetFit, *_: Any) -> tuple[SetFit, str]:
        errors = [1.0 / corrected[h.tag] for h in added.hypotheses]
        return SetFit(added.hypotheses, np.ones(len(errors)), np.array(errors), added.certain), "extended"

    monkeypatch.setattr(found, "_noise", lambda *_: NOISE)
    monkeypatch.setattr(found, "_mapped", lambda *_: (no_fit, "maps"))
    monkeypatch.setattr(found, "_extended_null", lambda *_: "extended")
    monkeypatch.setattr(found, "_corrected", correct)
    return found


def add(found: FrameExplainer, *hypotheses: Hypothesis, final: Sequence[Hypothesis] | None = None) -> Any:
    total, last = (sum(h.fingerprint for h in some) for some in (hypotheses, final or hypotheses))
    z = Measured(np.asarray(total), np.asarray(total), np.asarray(last))

    class Nothing:
        mean = np.zeros(M)

    explanation = _Explanation(Exact(), hypotheses, Chosen(*hypotheses))  # type: ignore[arg-type]
    null = found.add(explanation, Nothing(), z)  # type: ignore[arg-type]
    assert null == ("extended" if found.rounds else None)
    return found.rounds[-1] if found.rounds else None


def test_what_the_replicates_correct_to_less_than_a_finding_is_taken_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = search({"row_noise": 12.0, "exposure_drift": 4.0}, monkeypatch)
    added = add(found, ROW, DRIFT)
    assert [h.tag for h in added.added.hypotheses] == ["row_noise"]
    assert [e.tag for e in found.model] == ["row_noise"]
    both = search({"row_noise": 12.0, "exposure_drift": 5.0}, monkeypatch)
    assert len(add(both, ROW, DRIFT).added.hypotheses) == 2


def test_what_the_final_frames_do_not_show_is_taken_back(monkeypatch: pytest.MonkeyPatch) -> None:
    found = search({"row_noise": 12.0, "exposure_drift": 6.0}, monkeypatch)
    assert [h.tag for h in add(found, ROW, DRIFT, final=[ROW]).added.hypotheses] == ["row_noise"]


def test_where_nothing_is_left_the_model_is_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    found = search({"exposure_drift": 3.0}, monkeypatch)
    found.model = (ROW.effect,)
    assert add(found, DRIFT) is None
    assert found.model == (ROW.effect,)


def test_an_effect_that_explains_little_besides_the_others_is_dropped() -> None:
    found = FrameExplainer.__new__(FrameExplainer)
    strong = ROW.fingerprint
    twin = hypothesis("frame_noise", 0, 8.0)  # moves only what the strong one moves
    kept = found._needed(Exact(), (ROW, twin), 1.1 * strong, NOISE)  # type: ignore[arg-type]
    assert [h.tag for h in kept] == ["row_noise"]
    kept = found._needed(Exact(), (ROW, FRAME), strong + FRAME.fingerprint, NOISE)  # type: ignore[arg-type]
    assert [h.tag for h in kept] == ["row_noise", "frame_noise"]


def test_seen_among_needs_the_direction_of_the_effect() -> None:
    others, own = np.array([ROW.fingerprint]), FRAME.fingerprint
    assert seen_among(own, others, ROW.fingerprint + own, NOISE)
    assert not seen_among(own, others, ROW.fingerprint - own, NOISE)
    assert not seen_among(own, others, ROW.fingerprint + 0.2 * own, NOISE)
