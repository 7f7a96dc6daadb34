"""The check of an estimator by simulation: it finds a wrong estimator."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import ttest_1samp

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.discrepancy import skeleton
from pchem_pipeline.discrepancy.build_verdict import Added, Addition, Findings
from pchem_pipeline.discrepancy.effort import Effort
from pchem_pipeline.discrepancy.estimator_check import recovered_strength
from pchem_pipeline.discrepancy.gap import Gap
from pchem_pipeline.discrepancy.null import Measured, NullModel
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.effects.framework.registry import effect_class
from pchem_pipeline.effects.operators.curve import Clipping
from pchem_pipeline.effects.operators.offsets import ColumnNoise

STACKS = {"stacks": 5, "n_frames": 400, "shape": (16, 16)}


class TwiceTooLarge(ColumnNoise):
    """Column noise with an estimator that does not know what it does."""

    @classmethod
    def estimate(cls, evidence):
        return [guess.scaled(2.0) for guess in ColumnNoise.estimate(evidence)]


def test_a_right_estimator_passes_and_a_wrong_one_does_not():
    right = recovered_strength(ColumnNoise(column_noise_dn=1.0), **STACKS)
    assert ttest_1samp(right, 1.0).pvalue > 1e-4
    assert right.std() < 0.2
    wrong = recovered_strength(TwiceTooLarge(column_noise_dn=1.0), **STACKS)
    np.testing.assert_allclose(wrong, 2 * right)
    assert ttest_1samp(wrong, 1.0).pvalue < 1e-4


class RowBefore(ColumnNoise):
    """Adds a share of the row before, without saying so."""

    def apply(self, values, context):
        return values + 0.5 * np.roll(values, 1, axis=1)


class FrameBefore(ColumnNoise):
    """Adds a share of the frame before, without saying so."""

    def apply(self, values, context):
        return values + 0.5 * np.roll(values, 1, axis=0)


class EveryOtherRowOfABand(ColumnNoise):
    """Counts rows from the first one of the band that it is given."""

    def apply(self, values, context):
        return values + np.arange(values.shape[1])[:, None] % 2


class Misspelled(ColumnNoise):
    """Has a signature that no statistic has."""

    signature = ("space.colum.readout.variance",)


@pytest.mark.parametrize(
    ("effect", "words"),
    [
        (RowBefore(column_noise_dn=1.0), "set `reach_rows` to how many"),
        (FrameBefore(column_noise_dn=1.0), "set `reach_frames` to how many"),
        (EveryOtherRowOfABand(column_noise_dn=1.0), "set `reach_rows` to how many"),
        (Misspelled(column_noise_dn=1.0), r"names no statistics: space\.colum\.readout\.variance"),
        (Clipping(high=900.0), "'clipping' has no strength"),
    ],
)
def test_an_effect_that_is_declared_wrongly_is_refused(effect, words):
    with pytest.raises(ConfigError, match=words):
        recovered_strength(effect, **STACKS)


NAMES = tuple(STATISTICS)[:40]
NULL = NullModel.from_replicates(NAMES, np.random.default_rng(5).normal(0.0, 1.0, (60, 40)))


def state_of(before: float, after: float, pull: float, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the verdict where an effect was added that takes the gap from one value to another."""
    z = NULL.mean + pull * NULL.std * np.eye(40)[0]
    gaps = [Gap(value, 3e-5, (0.0, 0.0), {}) for value in (before, after)]
    effect = effect_class("noise_skew")(share=0.1)
    addition = Addition(effect, True, "", (), {}, gaps[0], gaps[1], (), ())
    monkeypatch.setattr(skeleton, "locate", lambda *_: [])
    monkeypatch.setattr(skeleton, "build_verdict", lambda found, *_, **__: found)
    unused, measured = [None, None], Measured(z, z, z)
    data = skeleton.Prepared(DiscrepancySettings(), "frames", *unused, NULL, measured, Effort(None), {})
    by: Any = SimpleNamespace(
        prepared=data, model=(), gap=lambda _: gaps[0], suspects=lambda _: True, explain=lambda *_: True,
        add=lambda *_: NULL, limit="", candidates=(), tolerance=lambda: 0.0,
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
