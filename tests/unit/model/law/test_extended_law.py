"""Masses under an extended law, their derivatives, and what the law refuses."""

import numpy as np
import pytest
from helpers.em_trace import evaluated, one_sample
from helpers.extended_reference import EVERYTHING, LAWS, reference_mass
from helpers.plain_law import pcd_mass
from scipy.stats import binom, norm, poisson

from pchem_pipeline.model.fit.api import satellite_threshold
from pchem_pipeline.model.fit.engine import likelihood
from pchem_pipeline.model.law import cells_numba, pixel_numba
from pchem_pipeline.model.law.electron_laws_numba import LOST, _one_law, electron_number
from pchem_pipeline.model.law.inputs import pack
from pchem_pipeline.model.law.mass import sample_mass, sample_parabolas, sample_slopes
from pchem_pipeline.model.law.pcd import log_pcd, pcd
from pchem_pipeline.model.law.sample_law import SampleLaw

PIXELS = [(2.0, 1 / 12, 100.0, 3.0), (0.4, 0.1, 99.3, 2.0), (9.0, 1 / 5.5, 97.7, 1.1)]
COLUMNS = list(np.transpose(PIXELS))
ONE = [column[:1] for column in COLUMNS]
CODES = range(70, 220)


@pytest.mark.parametrize("name", LAWS)
def test_mass_is_the_docstring_term_by_term(name):
    model = LAWS[name]
    got = sample_mass(model, COLUMNS, list(CODES))
    for pixel, row in zip(PIXELS, got, strict=True):
        expected = np.array(reference_mass(model, pixel, CODES))
        np.testing.assert_allclose(row, expected, rtol=0, atol=3e-15)
        seen = expected > 1e-200
        np.testing.assert_allclose(row[seen], expected[seen], rtol=3e-8)
        close = expected > 1e-12
        np.testing.assert_allclose(row[close], expected[close], rtol=1e-11)


def test_an_exposure_beyond_all_pixels_is_not_known():
    """The search went on for an hour, electron number by electron number, and heard no signal."""
    maps = list(np.transpose([PIXELS[0], (6.5e13, 4e5, -1.6e8, 30.0)]))
    counts = np.full((2, 40), 5, np.uint32)
    value, _, _ = sample_parabolas(SampleLaw(), maps, counts, np.array([90, 90]))
    assert np.isfinite(value).tolist() == [True, False]


def test_parts_that_differ_from_pixel_to_pixel_are_those_of_their_pixel():
    laws = [LAWS["levels"], SampleLaw().with_variance(e2=0.04, dn2=0.2), LAWS["skew"]]
    laws[1] = laws[1].with_added_exposure([[0.0, 0.8]], [[0.6, 0.4]])
    both = SampleLaw().with_levels(scale=[0.98, 1, 1], shift_e=[0.2, 0, 0], curvature=0.0)
    both = both.with_variance(e2=[0, 0.04, 0], dn2=[0, 0.2, 0])
    both = both.with_added_exposure([[0, 0], [0, 0.8], [0, 0]], [[1, 0], [0.6, 0.4], [1, 0]])
    both = both.with_noise(
        [[1, 0], [1, 0], [0.7, 0.3]],
        shift_sigma=[[0, 0], [0, 0], [-0.3, 0.7]],
        width=[[1, 1], [1, 1], [0.9, 0.9]],
    )
    got = sample_mass(both, COLUMNS, list(CODES))
    for i, law in enumerate(laws):
        alone = law.with_levels(curvature=-law.curvature)
        expected = sample_mass(alone, [c[i : i + 1] for c in COLUMNS], list(CODES))[0]
        np.testing.assert_allclose(got[i], expected, rtol=1e-12, atol=1e-300)
    part = sample_mass(both.of(np.array([2, 0])), [c[[2, 0]] for c in COLUMNS], list(CODES))
    np.testing.assert_array_equal(part, got[[2, 0]])


def test_neutral_law_is_the_pcd_and_codes_may_differ_by_pixel():
    exposure, gain, bias, sigma = COLUMNS
    codes = np.array([60, 70, 80])[:, None] + np.arange(90)
    analog = gain * np.sqrt(sigma**2 - 1 / 12)
    expected = pcd_mass(codes, exposure[:, None], gain[:, None], bias[:, None], analog[:, None])
    np.testing.assert_allclose(sample_mass(SampleLaw(), COLUMNS, codes), expected, rtol=1e-7, atol=1e-280)
    assert SampleLaw().neutral
    assert not any(model.neutral for name, model in LAWS.items() if name != "neutral")


def test_clipped_codes_hold_all_that_lies_beyond():
    plain = sample_mass(SampleLaw(), ONE, np.arange(50, 600))[0]
    clipped = sample_mass(SampleLaw().with_clip(97, 130), ONE, np.arange(90, 140))[0]
    assert clipped.sum() == pytest.approx(1.0, abs=1e-14)
    expected = np.zeros(100)  # of 60 DN and more
    expected[37:71] = plain[: 97 - 50 + 1].sum(), *plain[98 - 50 : 130 - 50], plain[130 - 50 :].sum()
    np.testing.assert_allclose(clipped, expected[30:80], rtol=1e-12)
    # a window beside the codes that come out, or with their edge at its end, is no special case
    for low in (60, 80, 90, 97, 98, 121, 131):
        window = sample_mass(SampleLaw().with_clip(97, 130), ONE, np.arange(low, low + 10))[0]
        np.testing.assert_allclose(window, expected[low - 60 : low - 50], rtol=1e-12)
    tighter = SampleLaw().with_clip(97, 130).with_clip(95, 120)
    assert (tighter.clip_low, tighter.clip_high) == (97, 120)


def test_outliers_are_spread_evenly_and_weigh_nothing_else():
    laws = SampleLaw(), SampleLaw().with_outliers(1e-3, 1000)
    plain, with_some = (sample_mass(law, ONE, np.arange(70, 200)) for law in laws)
    np.testing.assert_allclose(with_some, 0.999 * plain + 1e-6, rtol=1e-13)


@pytest.mark.parametrize("law", ["poisson", "negative_binomial", "borel", "trapped", "lost"])
@pytest.mark.parametrize("satellite", [0.0, 1.3])
@pytest.mark.parametrize("aside", [False, True])
def test_score_and_information_are_the_derivatives(law, satellite, aside):
    model = EVERYTHING.with_counts(law, 0.06).with_clip(92, 158).with_outliers(1e-3, 4096)
    counts = np.pad(np.arange(67) % 7 * 9 + 1, (2, 21))
    packed = pack([model.with_free_satellites((1.3,))], 1)
    n_peaks = packed.peaks.shape[3] * (1 + packed.pattern.shape[0])
    n_exposures = max(packed.exposures.shape[2], packed.added.shape[3])
    mask = np.where((np.arange(90) >= 10) & (np.arange(90) < 31) & aside, pixel_numba.SET_ASIDE, 0)
    pixel, scratch, centre = one_sample(counts, mask, n_peaks, n_exposures)
    centre += 90
    pixel = pixel._replace(centre=centre)
    cells_numba.resolve(packed, 0, satellite, pixel)
    at = scratch.evaluations[pixel_numba.AT]

    def evaluate(point):
        value = evaluated(pixel, point, pixel_numba.DERIVATIVES, likelihood(True), scratch)
        lower = np.tril(at[0, pixel_numba.INFORMATION : pixel_numba.DAMPING])
        return value, at[0, pixel_numba.SCORE].copy(), lower + np.tril(lower, -1).T

    here = np.array([np.log(1.7), 12.0, 99.7 - centre, np.log(10.0), 0.2 if satellite else 0.0])
    value, score, information = evaluate(here)
    alone = evaluated(pixel, here, pixel_numba.LOGLIK_ALONE, likelihood(True), scratch)
    assert alone == pytest.approx(value, rel=1e-12)
    for i, step in enumerate(np.diag([1e-5, 1e-4, 1e-4, 1e-5, 1e-5])[: 5 if satellite else 4]):
        (above, score_above, _), (below, score_below, _) = evaluate(here + step), evaluate(here - step)
        assert score[i] == pytest.approx((above - below) / 2 / step[i], rel=1e-6, abs=1e-6 * abs(score).max())
        slope = (score_below - score_above) / 2 / step[i]
        np.testing.assert_allclose(information[i], slope, rtol=1e-6, atol=1e-7 * abs(slope).max())


def electron_rows(law, dispersion, exposure, mixtures, n):
    """Return P(k) with its first two slopes in ln H, which are checked by differences, k < n."""
    h = 1e-4
    below, rows, above = (
        np.array([electron_number(law, dispersion, k, exposure * np.exp(s), mixtures) for k in range(n)])
        for s in (-h, 0.0, h)
    )
    np.testing.assert_allclose(rows[:, 1], (above - below)[:, 0] / (2 * h), atol=1e-8)
    np.testing.assert_allclose(rows[:, 2], (above - 2 * rows + below)[:, 0] / h**2, atol=1e-6)
    for k in (0.0, 1.0, 7.0):
        compiled, plain = (f(law, dispersion, k, 2.5) for f in (_one_law, _one_law.py_func))
        np.testing.assert_allclose(plain, compiled, rtol=1e-13)
    return rows


@pytest.mark.parametrize(
    ("law", "dispersion"), [(0, 0.0), (1, 0.3), (1, 1e-4), (1, 0.0), (2, 0.2), (3, 0.2), (3, 0.0)]
)
def test_electron_number_law_sums_to_one_with_the_right_mean_and_slopes(law, dispersion):
    # 0.6 e- of the mean are added, and do not grow with H
    mixtures = np.array([[0.25, 0.75, 0.0], [1.6, 0.8, 0.0], [0.4, 0.6, 0.0], [0.0, 1.0, 0.0]])
    k = np.arange(400)
    rows = electron_rows(law, dispersion, 2.4, mixtures, 400)
    assert rows[:, 0].sum() == pytest.approx(1.0, abs=1e-10)
    assert rows[:, 0] @ k == pytest.approx(3.0, rel=1e-8)
    mixed = 2.4**2 * 0.12 + 0.24
    exposures = 2.4 * np.array([1.6, 0.8])[:, None] + np.array([0.0, 1.0])
    several = (1.0 - (1.0 + exposures) * np.exp(-exposures)) * np.outer([0.25, 0.75], [0.4, 0.6])
    trapped = 3.0 + 2.0 * dispersion * several.sum()
    excess = {0: 3.0, 1: 3.0 + dispersion * (9.0 + mixed), 2: 3.0 / (1 - dispersion) ** 2, 3: trapped}[law]
    assert rows[:, 0] @ (k - 3.0) ** 2 == pytest.approx(excess + mixed, rel=1e-7)


def test_what_is_lost_of_electrons_is_what_chance_takes():
    chance, exposure = 0.08, 2.4
    n = np.arange(80)
    before, gone = poisson.pmf(n, exposure), np.minimum(chance * np.maximum(n - 1, 0), 0.99)
    wanted = [before @ binom.pmf(n - k, n, gone) for k in range(30)]
    one = np.array([[1.0], [1.0], [1.0], [0.0]])
    np.testing.assert_allclose(electron_rows(LOST, chance, exposure, one, 30)[:, 0], wanted, rtol=1e-11)
    # to first order in the chance, as long as no sample loses nearly all
    weak = electron_rows(LOST, 1e-4, exposure, one, 40)[:, 0]
    assert weak @ np.arange(40) == pytest.approx(exposure - 1e-4 * exposure**2, rel=1e-9)
    assert _one_law(LOST, 0.0, 3.0, exposure) == _one_law(0, 0.0, 3.0, exposure)


def test_threshold_of_free_satellites_grows_with_the_number_of_trials():
    one = SampleLaw().with_free_satellites([1.0])
    eight = SampleLaw().with_free_satellites(range(1, 9))
    # half of the chi-square mass: a normal deviate exceeds sqrt(2 rise) with the probability of a trial
    assert norm.sf(np.sqrt(2 * satellite_threshold(one))) == pytest.approx(1e-4, rel=1e-6)
    assert norm.sf(np.sqrt(2 * satellite_threshold(eight))) == pytest.approx(1e-4 / 8, rel=1e-6)


@pytest.mark.parametrize(
    ("law", "codes", "words"),
    [
        (SampleLaw().with_variance(e2=[0.1, 0.2]), [1, 2], "extra_variance_e2 has 2 rows for 3 pixels"),
        (SampleLaw().with_noise([0.5, 0.4]), [1, 2], "must sum to 1"),
        (SampleLaw().with_added_exposure([[0, 1]], [[0.5, 0.4]]), [1, 2], "must sum to 1"),
        (SampleLaw(), [1, 3], "increase by 1"),
    ],
)
def test_laws_that_do_not_fit_the_pixels_are_refused(law, codes, words):
    with pytest.raises(ValueError, match=words):
        sample_mass(law, COLUMNS, codes)


def test_edges_of_several_effects_add_up():
    model = SampleLaw().with_edges(10, [0.1, 0.2]).with_edges(8, [0.3, 0.3, 0.3])
    assert model.edge_first == 8
    np.testing.assert_allclose(model.edge_shift, [0.3, 0.3, 0.4, 0.2])


@pytest.mark.parametrize("name", LAWS)
def test_a_parabola_is_made_of_masses_and_slopes(name):
    """With a sample so far out that the first look at the masses does not reach it."""
    model, maps = LAWS[name], COLUMNS
    origin, n_codes = np.full(3, CODES[0]), len(CODES)
    mass, slopes = sample_slopes(model, maps, origin, n_codes)
    counts = np.random.default_rng(1).poisson(500.0 * mass).astype(np.uint16)
    counts[0, -1] = 1
    value, score, information = sample_parabolas(model, maps, counts, origin)
    relative = slopes / np.maximum(mass, 1e-60)[:, None]
    np.testing.assert_allclose(value, (counts * np.log(np.maximum(mass, 1e-60))).sum(axis=1), rtol=1e-9)
    np.testing.assert_allclose(score, np.einsum("nab,nb->na", relative, counts), rtol=1e-6, atol=1e-6)
    expected = counts.sum(axis=1)[:, None, None] * (slopes @ relative.transpose(0, 2, 1))
    np.testing.assert_allclose(information, expected, rtol=1e-6, atol=1e-6)


def test_codes_without_a_sample_tell_nothing():
    """Far from all peaks, where the list of edges begins, a code may be narrower than nothing."""
    model = SampleLaw().with_edges(53, np.full(500, -1.4))
    maps = tuple(np.array([value]) for value in (4.98, 0.0659, 90.2, 4.65))
    codes = np.full(1, 40)
    counts = np.ones((1, 400), np.uint16)
    mass, slopes = sample_slopes(model, maps, codes, 400)
    usual = mass[0] > 1e-12
    assert (mass[0] < 0).any()
    expected = 400.0 * (slopes[0, :, usual].T / mass[0, usual]) @ slopes[0, :, usual]
    np.testing.assert_allclose(sample_parabolas(model, maps, counts, codes)[2][0], expected, rtol=1e-6)


def test_the_weights_of_exposures_may_differ_by_pixel_where_the_exposures_do_not():
    weights, factors = np.array([[0.5, 0.5], [0.9, 0.1]]), np.array([0.8, 1.2])
    maps = tuple(np.full(2, value) for value in (2.0, 0.1, 100.0, 3.0))
    both, *alone = (
        sample_mass(SampleLaw(exposure_weights=each, exposure_factors=factors), maps, np.arange(60, 220))
        for each in (weights, *weights)
    )
    np.testing.assert_array_equal([alone[0][0], alone[1][1]], both)


def test_the_density_where_there_is_little_to_say():
    x = np.linspace(-30, 30, 13)
    np.testing.assert_allclose(log_pcd(x, 0.0, 0.1, 1.0, 2.5), norm.logpdf(x, 1.0, 2.5), rtol=1e-14)
    # far tails do not underflow, and bad parameters give NaN
    assert log_pcd(-1000.0, 2.0, 0.1, 0.0, 3.0) == pytest.approx(norm.logpdf(-1000, 0, 3) - 2.0, rel=1e-12)
    assert np.isfinite(log_pcd(1e5, 2.0, 0.1, 0.0, 3.0))
    bad = [-1.0, 1.0, 1.0, np.nan], [0.1, 0.0, 0.1, 0.1], 0.0, [3.0, 3.0, -1.0, 3.0]
    assert np.isnan(log_pcd(0.0, *bad)).all()
    np.testing.assert_allclose(
        pcd(x, 1.5, 0.09, 0.2, 3.3), np.exp(log_pcd(x, 1.5, 0.09, 0.2, 3.3)), rtol=1e-12
    )
