"""What must hold for any pixels and any tiling of the ensemble."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pchem_pipeline.model.electrons import electron_numbers, thresholds
from pchem_pipeline.model.ensemble import DnAxis, ensemble_sums, merge_sums, merge_tallies, nuced_axis, tally
from pchem_pipeline.model.maps import display_transform
from pchem_pipeline.model.pixels import PixelParameters

RNG = np.random.default_rng(21)
N = 40
PIXELS = PixelParameters(
    RNG.lognormal(0.7, 0.5, N),
    0.1 * RNG.lognormal(0, 0.05, N),
    RNG.normal(100, 4, N),
    RNG.normal(3.2, 0.2, N),
)
DN = DnAxis(60, 240)
COUNTS = RNG.poisson(2.0, size=(N, 60)).astype(np.uint16)
ORIGIN = RNG.integers(80, 100, N)
AXIS = nuced_axis(PIXELS, DN)


@given(
    exposure=st.floats(1e-6, 1e3),
    gain=st.floats(0.02, 2.0),
    bias=st.floats(-50, 500),
    noise=st.floats(0.01, 1.5),
    data=st.data(),
)
@settings(max_examples=100, deadline=None)
def test_numbers_are_the_thresholds_below(
    exposure: float, gain: float, bias: float, noise: float, data: st.DataObject
) -> None:
    dn = np.array(data.draw(st.lists(st.integers(0, 6000), min_size=1, max_size=30)), dtype=np.uint16)
    maps = [np.full((1, 1), v) for v in (exposure, gain, bias, noise / gain)]
    table = thresholds(exposure, gain, bias, noise / gain, 20_000)
    found = electron_numbers(dn[:, None, None], *maps).ravel()
    expected = np.searchsorted(table, dn)
    # a DN within rounding of a threshold may fall on either side
    safe = np.abs(table[np.minimum(expected, 19_999)] - dn) > 1e-9
    safe &= np.abs(table[np.maximum(expected - 1, 0)] - dn) > 1e-9
    np.testing.assert_array_equal(found[safe], expected[safe])


@given(st.lists(st.floats(allow_nan=True, allow_infinity=False, width=32), min_size=1, max_size=40))
@settings(deadline=None)
def test_display_transform_is_monotone(values: list[float]) -> None:
    array = np.array(values)
    shown = display_transform(array)
    valid = np.isfinite(array)
    assert np.isnan(shown[~valid]).all()
    assert ((shown[valid] > 0) & (shown[valid] < 1)).all()
    order = np.argsort(array[valid], kind="stable")
    steps, rises = np.diff(array[valid][order]), np.diff(shown[valid][order])
    assert (rises[steps == 0] == 0).all()
    assert (rises[steps > 0] > 0).all()
