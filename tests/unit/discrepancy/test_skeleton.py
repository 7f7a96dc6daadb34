"""The search itself, on an explainer that is made up."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pchem_pipeline.discrepancy import skeleton
from pchem_pipeline.discrepancy.build_verdict import Added, Addition, Findings
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.null import Measured, NullModel
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.effects.framework.registry import effect_class

NAMES = tuple(STATISTICS)[:40]
NULL = NullModel.from_replicates(NAMES, np.random.default_rng(5).normal(0.0, 1.0, (60, 40)))


def state_of(before: float, after: float, pull: float, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the verdict where an effect was added that takes the gap from one value to another."""
    z = NULL.mean + pull * NULL.std * np.eye(40)[0]
    gaps = [Gap(value, 3e-5, (0.0, 0.0), {}) for value in (before, after)]
    effect = effect_class("noise_skew")(share=0.1)
    addition = Addition(effect, True, "", (), 0.01, gaps[0], gaps[1], (), None, ())
    monkeypatch.setattr(skeleton, "locate", lambda *_: [])
    monkeypatch.setattr(skeleton, "build_verdict", lambda found, *_, **__: found)
    unused: Any = None
    data = skeleton.Prepared(
        DiscrepancySettings(), "frames", unused, unused, NULL, Measured(z, z, z), Effort(None), {}
    )
    by: Any = SimpleNamespace(
        prepared=data, model=(), gap=lambda _: gaps[0], suspects=lambda _: True, explain=lambda *_: True,
        add=lambda *_: NULL, limit="", tolerance=lambda: 0.0,
        close=lambda *_: Added((addition,), gaps[1]), fitted=lambda _: None,
    )  # fmt: skip
    found: Any = skeleton.search(by)
    assert isinstance(found, Findings)
    return found.state


@pytest.mark.parametrize(
    ("before", "after", "pull", "state"),
    [
        # as seen of a sensor without anything: skewed noise that the final frames do not confirm
        (1.3e-5, 2.6e-5, 0.0, "consistent"),
        (1.3e-5, 0.6e-5, 0.0, "named"),
        (9.0e-5, 2.0e-5, 0.0, "named"),
        (1.3e-5, 2.6e-5, 30.0, "ambiguous"),
    ],
)
def test_data_that_agree_are_not_made_doubtful_by_what_they_do_not_confirm(
    monkeypatch: pytest.MonkeyPatch, before: float, after: float, pull: float, state: str
) -> None:
    # the added effect accounts for the pull, in so far as there is one
    monkeypatch.setattr(
        skeleton, "disagrees", lambda null, z, *rest: abs(z.both - NULL.mean).max() > 10.0 and not rest[1:]
    )
    assert state_of(before, after, pull, monkeypatch) == state
