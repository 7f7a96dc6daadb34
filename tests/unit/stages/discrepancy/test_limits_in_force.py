"""Codes at which samples pile up are in the model that a search starts from, and are not named again."""

from types import SimpleNamespace

from pchem_pipeline.effects.adc.clipping import Clipping
from pchem_pipeline.stages.discrepancy.discrepancy import _limits


def context(low, high):
    return SimpleNamespace(sensor=SimpleNamespace(seen_limits=(low, high)))


def test_the_limits_of_the_run_are_in_the_model_of_the_search_once():
    assert _limits(context(None, None), ()) == ()
    assert _limits(context(None, 135), ()) == (Clipping(high=135),)
    assert _limits(context(40, 135), ()) == (Clipping(low=40, high=135),)
    assert _limits(context(None, 135), (Clipping(high=130),)) == ()
