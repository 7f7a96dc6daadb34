"""The exact ensemble: sums of PCDs, tallies of the data, and the mass of the electron number."""

import numpy as np
import pytest
from helpers.drawn_pixels import unlike_pixels
from helpers.plain_law import joint_mass
from scipy.stats import poisson

from pchem_pipeline.model.electrons.electrons import KnownPixels, number_tables
from pchem_pipeline.model.ensemble.ensemble import (
    DnAxis,
    NucedAxis,
    electron_pmf,
    mass_sums,
    nuced_axis,
    poisson_sums,
    tally,
    weighted_mass,
)
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.parameters import UsablePixels, usable_pixels
from pchem_pipeline.model.law.sample_law import SampleLaw


def test_weighted_mass_is_that_of_the_formula():
    # the last one is narrow, at an integer + 0.3: its density at the integers does not add up to 1
    wide = unlike_pixels(30)
    last = (0.0, 1.5), (0.1, 0.5), (100.2, 70.3), (3.0, 0.6)
    pixels = UsablePixels(*(np.append(own, more) for own, more in zip(wide.maps, last, strict=True)))
    dn, share = DnAxis(40, 300), np.random.default_rng(5).random(32)
    rows = [joint_mass(dn.dn, *each).sum(axis=0) for each in zip(*pixels.maps, strict=True)]
    np.testing.assert_allclose(weighted_mass(pixels, dn, share), share @ rows, rtol=1e-10, atol=1e-13)
    part = weighted_mass(pixels, DnAxis(90, 20), share)
    np.testing.assert_allclose(part, (share @ rows)[50:70], rtol=1e-10, atol=1e-13)


def test_a_hot_pixel_keeps_its_mass():
    pixels = UsablePixels(np.array([3000.0]), np.array([0.1]), np.array([100.0]), np.array([3.0]))
    density = weighted_mass(pixels, DnAxis(0, 60_000), np.ones(1))
    assert density.sum() == pytest.approx(1.0, abs=1e-10)
    assert density @ np.arange(60_000) == pytest.approx(100.0 + 30_000.0, rel=1e-10)


def test_poisson_sums_are_those_of_all_pixels():
    exposure = np.array([0.4, 2e5, 0.0, 700.0, 1e-9, 8.0, 41.0])
    columns = np.random.default_rng(2).random((7, 2))
    found = poisson_sums(exposure, columns, 210_000)
    masses = poisson.pmf(np.arange(210_000)[:, None], exposure)
    np.testing.assert_allclose(found, masses @ columns, rtol=1e-8, atol=1e-20)
    np.testing.assert_allclose(electron_pmf(exposure, 30), masses[:30].mean(axis=1), rtol=1e-11, atol=1e-17)


def test_tally_is_that_of_the_samples():
    rng = np.random.default_rng(3)
    pixels, dn, axis = unlike_pixels(12), DnAxis(90, 40), NucedAxis(0.11, -3, 30)
    samples = rng.integers(80, 150, size=(12, 500))
    origin = samples.min(axis=1)
    counts = np.stack([np.bincount(s - o, minlength=80) for s, o in zip(samples, origin, strict=True)])
    result = tally(counts.astype(np.uint16), origin, pixels, dn, axis)
    inside = (samples >= 90) & (samples < 130)
    np.testing.assert_array_equal(result.raw, np.bincount(samples[inside] - 90, minlength=40))
    values = (samples - pixels.bias[:, None]) * pixels.conversion_gain[:, None]
    place = np.floor(values / 0.11 + 0.5).astype(int) + 3
    good = (place >= 0) & (place < 30)
    np.testing.assert_array_equal(result.nuced, np.bincount(place[good], minlength=30))
    assert result.nuced_sum == pytest.approx(values.sum(), rel=1e-12)
    assert result.nuced_sum_square == pytest.approx((values**2).sum(), rel=1e-12)


def test_axis_is_not_stretched_by_one_strange_gain():
    pixels, strange = unlike_pixels(1000), unlike_pixels(1000)
    strange.conversion_gain[7] = 50.0
    axis, usual = (nuced_axis(each, DnAxis(60, 200)) for each in (strange, pixels))
    assert axis.size < 1.2 * usual.size
    assert usual.width == pytest.approx(0.1, rel=0.01)
    assert usual.electrons[0] < -1.0
    assert usual.electrons[-1] > 15.0
    assert nuced_axis(pixels, DnAxis(60, 200), width=0.25).width == 0.25


def test_parameters_must_be_usable():
    good = np.ones(3)
    with pytest.raises(ValueError, match="usable"):
        UsablePixels(good, good, good, np.array([1.0, np.nan, 1.0]))
    with pytest.raises(ValueError, match="equally long"):
        UsablePixels(good, good, good, np.ones(2))
    maps = np.ones((4, 2, 2))
    maps[0, 0, 1] = -1.0
    maps[1, 1, 0] = np.inf
    pixels, mask = UsablePixels.from_maps(list(maps))
    np.testing.assert_array_equal(mask, [[True, False], [False, True]])
    assert len(pixels) == 2
    assert not usable_pixels(good, 0 * good, good, good).any()
    # a runaway fit must neither fill the memory nor overflow an index
    columns = np.outer((2.0, 0.1, 100.0, 3.0), np.ones(6))
    columns[[0, 1, 1, 2, 3], range(5)] = 1e9, 1e-12, 1e9, -1e300, 1e12
    assert usable_pixels(*columns).tolist() == [False] * 5 + [True]


@pytest.mark.parametrize("law", [SampleLaw(), SampleLaw().with_noise([0.5, 0.5], shift_e=[0.0, 0.5])])
def test_masses_are_sorted_onto_both_axes(law):
    pixels, dn = unlike_pixels(8), DnAxis(40, 220)
    axis = NucedAxis(0.1, -100, 400)
    known = KnownPixels(pixels, law)
    tables = number_tables(*known.codes(), known.exposure, known, detailed=True)
    sums = mass_sums(tables.mass, tables.first, tables.start, pixels, dn, axis)
    mass = sample_mass(law, pixels, dn.dn)
    np.testing.assert_allclose(sums.raw, mass.sum(axis=0), atol=1e-11)
    np.testing.assert_allclose(sums.raw_square, (mass**2).sum(axis=0), atol=1e-11)
    values = (dn.dn - pixels.bias[:, None]) * pixels.conversion_gain[:, None]
    place = np.floor(values / axis.width + 0.5).astype(int) - axis.start
    bins = np.array(
        [np.bincount(at, weights=row, minlength=400) for at, row in zip(place, mass, strict=True)]
    )
    np.testing.assert_allclose(sums.nuced, bins.sum(axis=0), atol=1e-11)
    np.testing.assert_allclose(sums.nuced_square, (bins**2).sum(axis=0), atol=1e-11)
    moments = [sums.nuced_sum, sums.nuced_sum_square]
    np.testing.assert_allclose(moments, [(mass * values).sum(), (mass * values**2).sum()], rtol=1e-10)
