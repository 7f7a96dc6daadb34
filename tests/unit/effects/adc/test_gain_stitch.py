"""Stitch point of two gains: the forward model, its law, and what the estimator makes of it."""

import numpy as np
import pytest
from helpers.small_sensors import context_of, seen
from hidden.chain import hide

from pchem_pipeline.effects.operators.curve import GainStitch


def test_above_the_level_the_scale_has_another_slope():
    values = np.linspace(90, 150, 601).reshape(1, 1, -1)
    kink = GainStitch(gain_change=0.1, level_dn=120.0).apply(values, context_of((1, 601), 1))
    np.testing.assert_allclose(kink, np.maximum(values, 120 + 1.1 * (values - 120)))
    step = GainStitch(gain_change=-0.1, level_dn=120.0, origin_dn=100.0).apply(
        values, context_of((1, 601), 1)
    )
    np.testing.assert_array_equal(step[values <= 120], values[values <= 120])
    np.testing.assert_allclose(step[values > 120], 100 + 0.9 * (values[values > 120] - 100))


@pytest.mark.parametrize("seed", [180100, 180101, 180103])  # a kink, a step down, a step up
def test_an_independent_camera_s_stitch_is_found(seed):
    hiding = hide(("gain_stitch",), 5.0, seed, (24, 24), 1500)
    (hidden,) = hiding.effects
    found = GainStitch.estimate(seen(hiding.frames))[0]
    change = hidden.parameters["sign"] * hidden.strength
    low, high = hidden.sensor.code_range
    if hidden.parameters["agree"] == "black":
        # the step is what is seen of it
        step = found.gain_change * (found.level_dn - found.origin_dn)
        assert step == pytest.approx(change * (hidden.code - hidden.origin), rel=0.2)
        assert abs(found.level_dn - hidden.code) <= 1.0
    else:
        assert found.gain_change == pytest.approx(change, rel=0.5)
        assert abs(found.level_dn - hidden.code) < 0.15 * (high - low)
