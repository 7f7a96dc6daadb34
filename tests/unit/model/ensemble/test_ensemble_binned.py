"""The ensemble from histograms of the parameter maps, checked cell by cell."""

import itertools

import numpy as np
import pytest
from helpers.drawn_pixels import unlike_pixels
from helpers.plain_law import joint_mass
from scipy.stats import norm, poisson

from pchem_pipeline.model.ensemble.ensemble import DnAxis, NucedAxis, weighted_mass
from pchem_pipeline.model.ensemble.ensemble_binned import (
    HistogramChoice,
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


def test_cells_are_those_of_numpy():
    pixels = unlike_pixels(400)
    columns = (pixels.quanta_exposure, pixels.conversion_gain, pixels.bias)
    cells = joint_cells(columns, HistogramChoice(5, "full", "centre"))
    counts, edges = np.histogramdd(np.stack(columns, axis=1), bins=5)
    centres = np.meshgrid(*((e[1:] + e[:-1]) / 2 for e in edges), indexing="ij")
    expected = np.array([*(c[counts > 0] for c in centres), counts[counts > 0] / 400])
    found = np.vstack([cells.values, cells.share])
    # in the same order
    found, expected = (each[:, np.lexsort(each[:3].round(9))] for each in (found, expected))
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_mean_representative_keeps_the_mean_of_the_map():
    pixels = unlike_pixels(400)
    hot = pixels.quanta_exposure.copy()
    hot[:3] = 500.0
    for span in ("central", "full"):
        cells = joint_cells((hot, pixels.bias), HistogramChoice(6, span, "mean"))
        np.testing.assert_allclose(cells.values @ cells.share, [hot.mean(), pixels.bias.mean()], rtol=1e-12)
        assert cells.share.sum() == pytest.approx(1.0, abs=1e-12)


def test_hot_pixels_do_not_widen_the_bins():
    hot = unlike_pixels(1000).quanta_exposure.clip(1.0, 4.0)  # none but the hot ones is far out
    hot[:3] = 5000.0
    central = joint_cells((hot,), HistogramChoice(20, "central", "centre"))
    full = joint_cells((hot,), HistogramChoice(20, "full", "centre"))
    assert central.share.size > 12
    assert full.share.size == 2
    assert central.values.max() == pytest.approx(5000.0)  # beyond the bins: mean of the occupants


def test_a_constant_map_is_one_cell():
    cells = joint_cells((np.full(9, 2.5),), HistogramChoice(4, "central", "centre"))
    np.testing.assert_allclose(cells.values, [[2.5]])
    np.testing.assert_allclose(cells.share, [1.0])


@pytest.mark.parametrize("representative", ["mean", "centre"])
def test_dependent_is_the_sum_over_cells(representative):
    pixels, dn = unlike_pixels(60), DnAxis(50, 250)
    choice = HistogramChoice(3, "central", representative)
    h, g, mu, sigma = pixels.maps
    cells = joint_cells((h, g, mu, sigma**2), choice)
    expected = sum(w * pcd(dn.dn, *v) for w, v in zip(cells.share, cells.values.T, strict=True))
    np.testing.assert_allclose(epcd_dependent(pixels, dn, choice), expected, rtol=1e-10, atol=1e-13)


@pytest.mark.parametrize("representative", ["mean", "centre"])
def test_independent_is_the_sum_over_all_products(representative):
    pixels, dn = unlike_pixels(60), DnAxis(50, 250)
    choice = HistogramChoice(3, "central", representative)
    h, g, mu, sigma = pixels.maps
    marginals = [joint_cells((column,), choice) for column in (h, g, mu, sigma**2)]
    expected = np.zeros(dn.size)
    for places in itertools.product(*(range(m.share.size) for m in marginals)):
        share = np.prod([m.share[i] for m, i in zip(marginals, places, strict=True)])
        expected += share * pcd(dn.dn, *(m.values[0, i] for m, i in zip(marginals, places, strict=True)))
    np.testing.assert_allclose(epcd_independent(pixels, dn, choice), expected, rtol=1e-9, atol=2e-15)


def test_independent_integrates_narrow_noise_over_the_cell():
    pixels = UsablePixels(np.array([2.0]), np.array([0.5]), np.array([10.3]), np.array([0.6]))
    dn = DnAxis(0, 60)
    density = epcd_independent(pixels, dn, HistogramChoice(2))
    np.testing.assert_allclose(density, weighted_mass(pixels, dn, np.ones(1)), atol=1e-14)
    assert density.sum() == pytest.approx(1.0, abs=1e-12)


def test_independent_on_a_short_axis_is_a_cut_of_the_long_one():
    pixels = unlike_pixels(60)
    long, short = DnAxis(0, 500), DnAxis(110, 20)
    choice = HistogramChoice(8)
    np.testing.assert_allclose(
        epcd_independent(pixels, short, choice), epcd_independent(pixels, long, choice)[110:130], atol=1e-15
    )


def test_nuced_is_the_sum_of_bin_means():
    pixels, axis = unlike_pixels(60), NucedAxis(0.25, -8, 60)
    choice = HistogramChoice(3)
    low, high = (np.arange(60) - 8.5) * 0.25, (np.arange(60) - 7.5) * 0.25

    def bin_mean(h, variance):
        sd = np.sqrt(variance)
        cells = norm.cdf(high, K[:, None], sd) - norm.cdf(low, K[:, None], sd)
        return np.asarray(poisson.pmf(K, h) @ cells / 0.25)

    h, variance = pixels.quanta_exposure, pixels.read_noise_e**2
    joint = joint_cells((h, variance), choice)
    expected = sum(w * bin_mean(*v) for w, v in zip(joint.share, joint.values.T, strict=True))
    np.testing.assert_allclose(nuced_dependent(pixels, axis, choice), expected, rtol=1e-9, atol=1e-13)
    one, two = joint_cells((h,), choice), joint_cells((variance,), choice)
    expected = sum(
        a * b * bin_mean(u, v)
        for a, u in zip(one.share, one.values[0], strict=True)
        for b, v in zip(two.share, two.values[0], strict=True)
    )
    np.testing.assert_allclose(nuced_independent(pixels, axis, choice), expected, rtol=1e-9, atol=1e-13)


def test_binned_electron_mass():
    exposure = unlike_pixels(500).quanta_exposure
    choice = HistogramChoice(10, "full", "centre")
    counts, edges = np.histogram(exposure, bins=10)
    centres = 0.5 * (edges[1:] + edges[:-1])
    expected = counts / 500 @ poisson.pmf(np.arange(20), centres[:, None])
    np.testing.assert_allclose(electron_pmf_binned(exposure, 20, choice), expected, rtol=1e-10)


def test_exposures_far_from_each_other_are_inverted_apart():
    """One hot and one very quiet pixel; the product of the four histograms is summed cell by cell."""
    rng = np.random.default_rng(3)
    n = 40
    exposure, gain = rng.uniform(0.5, 2.0, n), rng.uniform(0.19, 0.21, n)
    exposure[0] = 300.0
    pixels = UsablePixels(exposure, gain, rng.uniform(99.0, 101.0, n), rng.uniform(1.2, 1.6, n))
    dn, choice = DnAxis(80, 2000), HistogramChoice(bins=3)
    h, g, mu, s2 = (joint_cells((each,), choice) for each in (*pixels.maps[:3], pixels.read_noise_dn**2))
    k, expected = np.arange(500), np.zeros(dn.size)
    mass = poisson.pmf(k[:, None], h.values[0]) @ h.share
    for (gain_cell, a), (bias, b), (v, c) in itertools.product(
        *(zip(x.values[0], x.share, strict=True) for x in (g, mu, s2))
    ):
        centre = bias + k / gain_cell
        low, high = (norm.cdf(dn.dn[:, None] + side, centre, np.sqrt(v - 1 / 12)) for side in (-0.5, 0.5))
        expected += a * b * c * ((high - low) @ mass)
    np.testing.assert_allclose(epcd_independent(pixels, dn, choice), expected, atol=1e-13)


def test_what_is_beyond_the_limits_of_the_codes_is_at_these():
    pixels = UsablePixels(*np.outer((1.0, 0.1, 2.0, 3.0), np.ones(30)))
    choice, dn = HistogramChoice(bins=4), DnAxis(0, 16)
    wide = epcd_dependent(pixels, DnAxis(-60, 300), choice)
    for curve in (epcd_dependent, epcd_independent):
        found = within_limits(curve, pixels, dn, choice, (0, 15))
        np.testing.assert_allclose(found[1:-1], wide[61:75], atol=1e-12)
        np.testing.assert_allclose([found[0], found[-1]], [wide[:61].sum(), wide[75:].sum()], atol=1e-6)
        np.testing.assert_array_equal(
            within_limits(curve, pixels, dn, choice, None), curve(pixels, dn, choice)
        )
