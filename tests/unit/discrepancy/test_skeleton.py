"""The way of a search: when it looks once more beside what it has added."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from pchem_pipeline.discrepancy import skeleton
from pchem_pipeline.discrepancy.build_verdict import Added
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.settings import DiscrepancySettings

FLOOR = 1.0
WIDE, CLOSED = (Gap(value, FLOOR, (value - 0.5, value + 0.5), {}) for value in (3.0, 0.5))


def rounds_of(monkeypatch: pytest.MonkeyPatch, gaps: list[Gap], suspects: bool) -> int:
    """Return how often effects were asked for, of a model that leaves these gaps and then agrees."""
    disagreeing = iter([True, *[False] * 9])
    monkeypatch.setattr(skeleton, "disagrees", lambda *_: next(disagreeing))
    monkeypatch.setattr(skeleton, "locate", lambda *_: ())
    monkeypatch.setattr(skeleton, "build_verdict", lambda *_, **__: None)
    asked = []
    by: Any = SimpleNamespace(
        settings=DiscrepancySettings(),
        samples="frames",
        model=(),
        first=0,
        z=SimpleNamespace(both=None),
        most_rounds=5,
        evidence=None,
        examined=None,
        untestable={},
        defects={},
        n_replicates=0,
        doubt=lambda: "",
        gap=lambda null: WIDE if null == 0 else gaps[null - 1],
        suspects=lambda null: suspects,
        explain=lambda null, disagrees: asked.append(null) or (None if null == len(gaps) else "effects"),
        add=lambda explanation, null: null + 1,
        tolerance=lambda: 0.0,
        replaced=lambda null: None,
        unfinished=lambda before, null: False,
        close=lambda before, null, still: Added((), gaps[-1]),
        fitted=lambda model: None,
    )
    skeleton.search(by)
    return len(asked)


def test_what_strong_effects_hide_is_looked_for_while_the_gap_is_wide(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert rounds_of(monkeypatch, [WIDE, CLOSED], suspects=True) == 2
    assert rounds_of(monkeypatch, [WIDE, WIDE], suspects=True) == 3
    # nothing to look for, or nothing left
    assert rounds_of(monkeypatch, [WIDE], suspects=False) == 1
    assert rounds_of(monkeypatch, [CLOSED], suspects=True) == 1
