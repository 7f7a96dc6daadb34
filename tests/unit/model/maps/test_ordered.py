"""Order statistics of a sorted map are the numbers that numpy gives for the map."""

import numpy as np
import pytest

from pchem_pipeline.model.maps.ordered import Ordered, median_of


def _maps():
    rng = np.random.default_rng(4)
    for n in (1, 2, 3, 4, 7, 50, 51, 20_001):
        yield rng.standard_normal(n)
        yield rng.integers(0, 4, n).astype(np.float64)
        yield np.exp(4.0 * rng.standard_normal(n))


@pytest.mark.parametrize("values", list(_maps()), ids=lambda values: f"n{values.size}")
def test_every_number_is_that_of_numpy_to_the_bit(values):
    found = Ordered.of(values)
    shares = np.random.default_rng(values.size).random(9)
    np.testing.assert_array_equal(found.quantiles(shares), np.quantile(values, shares))
    assert found.median == median_of(values) == np.median(values)
    assert found.robust_sd == 1.4826 * float(np.median(np.abs(values - np.median(values))))
    for rank in (-1.0, 0.3 * values.size, values.size + 1.0):
        assert found.at_rank(rank) == np.interp(rank, np.arange(values.size), np.sort(values))
    edges = np.linspace(np.quantile(values, 0.1) - 1e-9, values.max(), 9)
    np.testing.assert_array_equal(found.histogram(edges), np.histogram(values, edges)[0])
    middle = values[values.size // 2]
    assert (found.n_below(middle), found.n_above(middle)) == (
        (values < middle).sum(),
        (values > middle).sum(),
    )
    np.testing.assert_array_equal(
        found.within(0.0, middle).values, np.sort(values[(values >= 0.0) & (values <= middle)])
    )
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    np.testing.assert_array_equal(
        found.shares(values), ((np.cumsum(counts) - 0.5 * counts) / values.size)[inverse]
    )


def test_what_has_no_value_or_is_left_out_is_counted():
    values = np.array([[3.0, np.nan, 1.0], [np.inf, 2.0, 7.0]])
    found = Ordered.of(values, values == 7.0)
    np.testing.assert_array_equal(found.values, [1.0, 2.0, 3.0])
    assert (found.n_missing, found.n_left_out) == (2, 1)
    assert median_of(values, values == 7.0) == 2.0
    nothing = Ordered.of(np.full(3, np.nan))
    assert np.isnan(median_of(np.full(3, np.nan)))
    assert np.isnan(nothing.median)
    assert np.isnan(nothing.robust_sd)


def test_a_map_is_not_changed():
    values = np.array([3.0, -np.inf, 1.0, 2.0, np.nan])
    before = values.copy()
    assert Ordered.of(values, values == 3.0).median == 1.5
    assert median_of(values, values == 3.0) == 1.5
    np.testing.assert_array_equal(values, before)
