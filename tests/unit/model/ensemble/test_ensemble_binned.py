"""The ensemble from histograms of the parameter maps, checked cell by cell."""

import itertools

import numpy as np
import pytest
from helpers.drawn_pixels import unlike_pixels
from helpers.plain_law import joint_mass
from scipy.stats import norm, poisson

from pchem_pipeline.model.ensemble.ensemble import DnAxis, NucedAxis, weighted_mass
from pchem_pipeline.model.ensemble.ensemble_binned import (
    electron_pmf_binned,
    epcd_dependent,
    epcd_independent,
    joint_cells,
    nuced_dependent,
    nuced_independent,
    within_limits,
)
from pchem_pipeline.model.law.parameters import UsablePixels

K = np.arange(150)


def pcd(dn, h, g, mu, variance):
    return joint_mass(dn, h, g, mu, np.sqrt(variance), K.size).sum(axis=0)


def edges_of(column, bins):
    """Return the edges of equal bins over the central part of a map, the last one closed, and two beyond."""
    first, last = np.percentile(column, [1.0, 99.0])
    beyond = 0.5 * (last - first)
    inner = np.linspace(max(column.min(), first - beyond), min(column.max(), last + beyond), bins + 1)
    return np.r_[-1e9, inner[:-1], np.nextafter(inner[-1], np.inf), 1e9]


def test_cells_are_those_of_numpy_with_the_means_of_their_pixels():
    pixels = unlike_pixels(400)
    columns = (pixels.quanta_exposure, pixels.conversion_gain, pixels.bias)
    cells = joint_cells(columns, 5)
    counts = np.histogramdd(np.stack(columns, axis=1), bins=[edges_of(each, 5) for each in columns])[0]
    np.testing.assert_allclose(np.sort(cells.share), np.sort(counts[counts > 0]) / 400, rtol=1e-12)
    np.testing.assert_allclose(cells.values @ cells.share, np.mean(columns, axis=1), rtol=1e-12)
    constant = joint_cells((np.full(9, 2.5),), 4)
    np.testing.assert_allclose([*constant.values[0], *constant.share], [2.5, 1.0])


def test_hot_pixels_do_not_widen_the_bins():
    hot = unlike_pixels(1000).quanta_exposure.clip(1.0, 4.0)  # none but the hot ones is far out
    hot[:3] = 5000.0
    cells = joint_cells((hot,), 20)
    assert cells.share.size > 12
    assert cells.values.max() == pytest.approx(5000.0)


def products(columns, bins):
    """Return the share and the values of each combination of the bins of maps."""
    marginals = [joint_cells((column,), bins) for column in columns]
    for parts in itertools.product(*(zip(m.share, m.values[0], strict=True) for m in marginals)):
        shares, values = zip(*parts, strict=True)
        yield np.prod(shares), values


def test_curves_are_sums_over_cells_and_over_all_products():
    pixels, dn, bins = unlike_pixels(60), DnAxis(50, 250), 3
    columns = (*pixels.maps[:3], pixels.read_noise_dn**2)
    cells = joint_cells(columns, bins)
    expected = sum(w * pcd(dn.dn, *v) for w, v in zip(cells.share, cells.values.T, strict=True))
    np.testing.assert_allclose(epcd_dependent(pixels, dn, bins), expected, rtol=1e-10, atol=1e-13)
    expected = sum(w * pcd(dn.dn, *v) for w, v in products(columns, bins))
    np.testing.assert_allclose(epcd_independent(pixels, dn, bins), expected, rtol=1e-9, atol=2e-15)


def test_independent_integrates_narrow_noise_over_the_cell():
    pixels = UsablePixels(np.array([2.0]), np.array([0.5]), np.array([10.3]), np.array([0.6]))
    dn = DnAxis(0, 60)
    density = epcd_independent(pixels, dn, 2)
    np.testing.assert_allclose(density, weighted_mass(pixels, dn, np.ones(1)), atol=1e-14)
    assert density.sum() == pytest.approx(1.0, abs=1e-12)


def test_independent_on_a_short_axis_is_a_cut_of_the_long_one():
    pixels = unlike_pixels(60)
    short, long = (epcd_independent(pixels, axis, 8) for axis in (DnAxis(110, 20), DnAxis(0, 500)))
    np.testing.assert_allclose(short, long[110:130], atol=1e-15)


def test_nuced_is_the_sum_of_bin_means():
    pixels, axis, bins = unlike_pixels(60), NucedAxis(0.25, -8, 60), 3
    low, high = (np.arange(60) - 8.5) * 0.25, (np.arange(60) - 7.5) * 0.25

    def bin_mean(h, variance):
        sd = np.sqrt(variance)
        cells = norm.cdf(high, K[:, None], sd) - norm.cdf(low, K[:, None], sd)
        return np.asarray(poisson.pmf(K, h) @ cells / 0.25)

    columns = pixels.quanta_exposure, pixels.read_noise_e**2
    joint = joint_cells(columns, bins)
    expected = sum(w * bin_mean(*v) for w, v in zip(joint.share, joint.values.T, strict=True))
    np.testing.assert_allclose(nuced_dependent(pixels, axis, bins), expected, rtol=1e-9, atol=1e-13)
    expected = sum(w * bin_mean(*v) for w, v in products(columns, bins))
    np.testing.assert_allclose(nuced_independent(pixels, axis, bins), expected, rtol=1e-9, atol=1e-13)


def test_binned_electron_mass():
    exposure = unlike_pixels(500).quanta_exposure
    cells = joint_cells((exposure,), 10)
    expected = cells.share @ poisson.pmf(np.arange(20), cells.values[0][:, None])
    np.testing.assert_allclose(electron_pmf_binned(exposure, 20, 10), expected, rtol=1e-10)


def test_exposures_far_from_each_other_are_inverted_apart():
    """One hot and one very quiet pixel; the product of the four histograms is summed cell by cell."""
    rng = np.random.default_rng(3)
    n = 40
    exposure, gain = rng.uniform(0.5, 2.0, n), rng.uniform(0.19, 0.21, n)
    exposure[0] = 300.0
    pixels = UsablePixels(exposure, gain, rng.uniform(99.0, 101.0, n), rng.uniform(1.2, 1.6, n))
    dn, bins = DnAxis(80, 2000), 3
    h, k, expected = joint_cells((exposure,), bins), np.arange(500), np.zeros(dn.size)
    mass = poisson.pmf(k[:, None], h.values[0]) @ h.share
    for share, (g, mu, s2) in products((*pixels.maps[1:3], pixels.read_noise_dn**2), bins):
        low, high = (
            norm.cdf(dn.dn[:, None] + side, mu + k / g, np.sqrt(s2 - 1 / 12)) for side in (-0.5, 0.5)
        )
        expected += share * ((high - low) @ mass)
    np.testing.assert_allclose(epcd_independent(pixels, dn, bins), expected, atol=1e-13)


def test_what_is_beyond_the_limits_of_the_codes_is_at_these():
    pixels = UsablePixels(*np.outer((1.0, 0.1, 2.0, 3.0), np.ones(30)))
    bins, dn = 4, DnAxis(0, 16)
    wide = epcd_dependent(pixels, DnAxis(-60, 300), bins)
    for curve in (epcd_dependent, epcd_independent):
        found = within_limits(curve, pixels, dn, bins, (0, 15))
        np.testing.assert_allclose(found[1:-1], wide[61:75], atol=1e-12)
        np.testing.assert_allclose([found[0], found[-1]], [wide[:61].sum(), wide[75:].sum()], atol=1e-6)
        np.testing.assert_array_equal(within_limits(curve, pixels, dn, bins, None), curve(pixels, dn, bins))
