"""What must hold for any pixels and any tiling of the ensemble."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pchem_pipeline.model.electrons.electrons import electron_numbers, thresholds
from pchem_pipeline.model.ensemble.ensemble import DnAxis, nuced_axis
from pchem_pipeline.model.ensemble.totals import EnsembleAxes
from pchem_pipeline.model.maps.maps import display_transform
from pchem_pipeline.model.maps.pixels import PixelParameters
from pchem_pipeline.stages.ensemble.tile import PixelHistograms, ensemble_tile

RNG = np.random.default_rng(21)
N = 40
MAPS = (
    RNG.lognormal(0.7, 0.5, N),
    0.1 * RNG.lognormal(0, 0.05, N),
    RNG.normal(100, 4, N),
    RNG.normal(3.2, 0.2, N),
)
DN = DnAxis(60, 240)
AXES = EnsembleAxes(DN, nuced_axis(PixelParameters(*MAPS), DN), 12)
COUNTS = RNG.poisson(2.0, size=(N, 60)).astype(np.uint16)
OUTSIDE = RNG.poisson(0.3, size=N)
ORIGIN = RNG.integers(80, 100, N)
WITH_GAPS = tuple(np.where(np.arange(N) == 11, np.nan, column) for column in MAPS)


def sums_of(start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
    part = slice(start, stop)
    chosen = PixelHistograms(COUNTS[part] // 2, OUTSIDE[part] // 2)
    everything = PixelHistograms(COUNTS[part], OUTSIDE[part])
    maps = tuple(column[part] for column in WITH_GAPS)
    return ensemble_tile(maps, ORIGIN[part], chosen, everything, AXES)


@given(st.sets(st.integers(1, N - 1)))
@settings(max_examples=30, deadline=None)
def test_any_tiling_gives_the_same_ensemble(cuts: set[int]) -> None:
    borders = [0, *sorted(cuts), N]
    rows = [sums_of(a, b) for a, b in itertools.pairwise(borders)]
    integers, floats = sums_of(0, N)
    np.testing.assert_array_equal(sum(row[0] for row in rows), integers)
    np.testing.assert_allclose(sum(row[1] for row in rows), floats, rtol=1e-12, atol=1e-18)
    assert integers[AXES.integers["pixels"]] == N - 1
    assert integers[AXES.integers["excluded"]] == 1
    # every pixel counts the same, however many samples it has
    inside, outside = (COUNTS // 2).sum(axis=1), OUTSIDE // 2
    expected = np.delete(inside / (inside + outside), 11).sum()
    np.testing.assert_allclose(floats[AXES.floats["share"]].sum(), expected, rtol=1e-12)


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
