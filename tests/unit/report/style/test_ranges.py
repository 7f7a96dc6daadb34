"""Axes that a few odd pixels cannot wreck, and colours by rank."""

import numpy as np
import pytest

from pchem_pipeline.model.maps.ordered import Ordered
from pchem_pipeline.report.style.ranges import histogram_edges, map_colours, robust_range


def test_hot_pixels_do_not_stretch_the_axis_and_are_counted() -> None:
    rng = np.random.default_rng(1)
    values = rng.normal(0.3, 0.02, 10_000)
    values[:7] = 50.0
    values[7:9] = np.nan
    shown = robust_range(values)
    assert shown.high < 0.5
    assert shown.n_outside == 7 + int(((values[9:] > shown.high) | (values[9:] < shown.low)).sum())
    assert shown.n_missing == 2
    assert f"{shown.n_outside} outside the axis" in shown.remark()
    assert "2 without a value" in shown.remark()
    all_of_them = robust_range(np.linspace(1.0, 2.0, 500))
    assert (all_of_them.low, all_of_them.high, all_of_them.n_outside) == (1.0, 2.0, 0)
    assert all_of_them.remark() == ""


def test_decades_make_a_logarithmic_axis_but_not_for_signed_data() -> None:
    values = np.exp(np.random.default_rng(2).normal(0.0, 2.0, 2000))
    assert robust_range(values).logarithmic
    assert not robust_range(values - values.mean()).logarithmic


def test_edges_cover_the_range_with_a_bounded_number_of_bins() -> None:
    values = np.random.default_rng(3).normal(size=200_000)
    shown = robust_range(values)
    edges = histogram_edges(values, shown, 50)
    assert edges.size - 1 == 50
    np.testing.assert_allclose([edges[0], edges[-1]], [shown.low, shown.high])


def colours(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """The colour of each value, 0 to 1, NaN where there is none."""
    found = np.searchsorted(edges, values, side="right") / edges.size
    return np.where(np.isfinite(values), found, np.nan)


def test_the_colour_bar_of_the_stretch_tells_the_physical_value() -> None:
    """At a labelled level the colour of a pixel is that level: Appendix C, F_beta(level) is its rank."""
    values = np.random.default_rng(4).gamma(2.0, size=(200, 200))
    edges, bar = map_colours(Ordered.of(values))
    for (level, _), share in zip(bar, (0.0, 0.15625, 0.5, 0.84375, 1.0), strict=True):
        at = np.quantile(values, share)
        nearest = np.unravel_index(np.argmin(np.abs(values - at)), values.shape)
        assert colours(values, edges)[nearest] == pytest.approx(level, abs=0.005)
    assert float(bar[2][1]) == pytest.approx(float(np.median(values)), rel=0.01)


def test_the_stretch_keeps_order_and_gaps() -> None:
    values = np.array([[3.0, 1.0, np.nan], [2.0, 1000.0, 2.0]])
    colour = colours(values, map_colours(Ordered.of(values))[0])
    assert np.isnan(colour[0, 2])
    assert colour[1, 0] == colour[1, 2]
    assert colour[0, 1] < colour[1, 0] < colour[0, 0] < colour[1, 1]


def test_nothing_to_stretch_and_one_value() -> None:
    assert map_colours(Ordered.of(np.full((3, 3), np.nan)))[1] == ()
    edges, bar = map_colours(Ordered.of(np.full(4, 7.0)))
    assert colours(np.array([7.0]), edges) == pytest.approx(0.5, abs=0.003)
    assert bar == ((0.5, "7.00"),)
    _, bar = map_colours(Ordered.of(np.linspace(100.001, 100.009, 99)))
    assert len({text for _, text in bar}) == 5  # labels tell close values apart
