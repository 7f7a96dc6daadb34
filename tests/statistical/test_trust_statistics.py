"""Coverage of intervals, calibration of p-values, and what the tail guard is worth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.drawn_pixels import Drawn, draw
from numpy.typing import NDArray
from scipy.special import chdtrc
from scipy.stats import binom, kstest

from pchem_pipeline.model.checks.multiple_testing import false_discovery
from pchem_pipeline.model.checks.shrinkage import Judged, NoisePool, noise_of
from pchem_pipeline.model.ensemble.ensemble import DnAxis, NucedAxis, curve_errors, weighted_mass
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.result import FitResult, quantile_of
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.model.law.parameters import UsablePixels
from pchem_pipeline.model.law.pcd import pcd_mass
from pchem_pipeline.model.law.sample_law import SampleLaw
from pchem_pipeline.model.maps.maps import summarise

Array = NDArray[np.float64]
GUARD_OFF = FitSettings(tail_guard=0)


def judge_together(fit: FitResult) -> FitResult:
    """Return the fit of a sensor's pixels with the word of those that are weakly identified."""
    of_gain, of_sigma = np.sqrt(fit.covariance[:, 1, 1]), np.sqrt(fit.covariance[:, 3, 3])
    together = fit.covariance[:, 1, 3] / (of_gain * of_sigma)
    noise, stderr = noise_of(fit.conversion_gain, fit.read_noise_dn, of_gain, of_sigma, together)
    pixels = Judged(noise, stderr, fit.likelihood_gap)
    pool = NoisePool.of(pixels)
    if pool is None:
        return fit
    word = np.where(pool.weak(pixels, FitSettings()), int(FitStatus.WEAKLY_IDENTIFIED), 0)
    return replace(fit, fit_status=fit.fit_status | word.astype(np.uint16))


def errors(fit: FitResult) -> Array:
    return np.asarray(np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2)))


def spoiled(rng: np.random.Generator, pixels: Drawn, n_outliers: int = 5) -> Drawn:
    """Add single samples anywhere up to 300 DN beyond both ends."""
    n, width = pixels.counts.shape
    counts = np.zeros((n, width + 600), np.uint32)
    counts[:, 300 : 300 + width] = pixels.counts
    for row in counts:
        places = rng.integers(0, 600, n_outliers)
        np.add.at(row, np.where(places < 300, places, places + width), 1)
    return Drawn(counts, pixels.origin - 300, pixels.truth)


@pytest.mark.parametrize("case", [(0.3, 0.25, 2000), (2.0, 0.35, 17_750)])
def test_intervals_cover_the_truth_as_often_as_they_say(case: tuple[float, float, int]) -> None:
    h, noise, n_frames = case
    n = 1500
    pixels = draw(np.random.default_rng(61), np.full(n, h), 11.0, noise, n_frames=n_frames)
    fit = fit_histograms(pixels.counts, pixels.origin)
    assert np.mean(fit.fit_status == 0) > 0.99
    good = fit.fit_status == 0
    values, stderr, truth = fit.columns[good], errors(fit)[good], pixels.truth[good]
    for level in (0.68, 0.95):
        z = quantile_of(level)
        limit = 5 * np.sqrt(level * (1 - level) / n) + 0.005  # the rest: second order at 2000 frames
        settings = FitSettings(intervals="profile", interval_level=level)
        ends = fit_histograms(pixels.counts, pixels.origin, settings=settings).intervals
        assert ends is not None
        ends = ends[good, :4]
        profile = ((ends[:, :, 0] <= truth) & (truth <= ends[:, :, 1])).mean(axis=0)
        normal = (np.abs(values - truth) <= z * stderr).mean(axis=0)
        np.testing.assert_allclose(profile, level, atol=limit)
        np.testing.assert_allclose(normal, level, atol=limit)
        # errors that were a quarter too small would be seen
        assert (np.abs((np.abs(values - truth) <= 0.75 * z * stderr).mean(axis=0) - level) > limit).all()


@pytest.mark.parametrize("case", [(2.0, 0.48, 2000), (8.0, 0.48, 17_750), (2.0, 0.42, 2000)])
def test_pixels_that_pass_together_are_no_selection(case: tuple[float, float, int]) -> None:
    """Judged one by one, those that pass on a poor sensor are the lucky ones, and their intervals miss."""
    h, noise, n_frames = case
    n = 600
    pixels = draw(np.random.default_rng(70), np.full(n, h), 11.0, noise, n_frames=n_frames)
    alone = fit_histograms(pixels.counts, pixels.origin)
    together = judge_together(alone)
    np.testing.assert_array_equal(alone.fit_status, together.fit_status & ~np.uint16(2048))

    def tail(fit: FitResult) -> float:
        """Return the smallest probability of so few intervals, or fewer, that hold the truth."""
        good = fit.fit_status == 0
        held = np.abs(fit.columns - pixels.truth)[good] <= 1.96 * errors(fit)[good]
        return float(binom.cdf(held.sum(axis=0), good.sum(), 0.95).min())

    five = 2.9e-7  # probability beyond five standard deviations, one side
    assert tail(together) > five
    if noise > 0.45:
        assert tail(alone) < five  # what is guarded against
        assert np.mean(alone.fit_status == 0) > 0.02
        assert np.mean(together.fit_status == 0) < 0.01
    else:
        assert np.mean(together.fit_status == 0) > 0.4


def test_pixels_that_were_clear_stay_so_up_to_0_4_electrons() -> None:
    lost = 0
    for h, noise in ((0.1, 0.4), (2.0, 0.4), (8.0, 0.4), (2.0, 0.2)):
        pixels = draw(np.random.default_rng(71), np.full(400, h), 11.0, noise)
        alone = fit_histograms(pixels.counts, pixels.origin)
        assert np.mean(alone.fit_status == 0) > 0.98
        lost += np.count_nonzero((alone.fit_status == 0) & (judge_together(alone).fit_status != 0))
    # fewer than 0.1 % of 1600: a Poisson law of mean 1.6 is above 9 with 4e-6
    assert lost <= 9


def test_goodness_of_fit_is_uniform_with_few_frames_too() -> None:
    n = 4000
    pixels = draw(np.random.default_rng(62), np.full(n, 0.1), 11.0, 0.15, n_frames=600)
    fit = fit_histograms(pixels.counts, pixels.origin)
    tested = fit.goodness_dof > 0
    assert tested.mean() > 0.99
    distance = kstest(fit.goodness_p[tested], "uniform").statistic
    naive = chdtrc(np.floor(fit.goodness_dof[tested]), fit.goodness_chi2[tested])
    # beyond 0.043 lies 6e-7 at 4000; merging bins hides half a parameter, which the naive test does not know
    assert distance < 0.043
    assert kstest(naive, "uniform").statistic > 0.06
    assert (false_discovery(fit.goodness_p) <= 0.05).sum() <= 2


def test_false_discoveries_keep_their_rate() -> None:
    """50 pixels of two exposures among 1500 plain ones: found, and the false ones among those are few."""
    rng = np.random.default_rng(63)
    pixels = draw(rng, np.full(1550, 2.0), 11.0, 0.3)
    counts = pixels.counts.copy()
    low, high = (draw(rng, np.full(50, h), 11.0, 0.3, n_frames=8875) for h in (1.4, 2.6))
    counts[:50] = 0
    for part in (low, high):
        counts[:50, : part.counts.shape[1]] += part.counts[:, : counts.shape[1]]
    q = false_discovery(fit_histograms(counts, pixels.origin).goodness_p)
    found = q <= 0.05
    assert found[:50].all()
    # of 50 / 0.95 some 2.6 are false on average; Poisson of that mean is above 14 with 2e-7
    assert found[50:].sum() <= 14
    assert (q <= 0.9)[50:].sum() > 14  # a looser rate lets more in


@pytest.mark.parametrize("case", [(0.2, 0.2, 17_750), (2.0, 0.3, 17_750), (2.0, 0.3, 2000)])
def test_a_few_outliers_move_nothing(case: tuple[float, float, int]) -> None:
    h, noise, n_frames = case
    pixels = draw(np.random.default_rng(64), np.full(150, h), 11.0, noise, n_frames=n_frames)
    hit = spoiled(np.random.default_rng(65), pixels)
    clean, on = fit_histograms(pixels.counts, pixels.origin), fit_histograms(hit.counts, hit.origin)
    shift = np.abs(on.columns - clean.columns) / errors(clean)
    assert shift.max() < 0.1
    np.testing.assert_allclose(on.outlier_share * (n_frames + 5), 5, atol=1.001)
    np.testing.assert_array_equal(on.fit_status, clean.fit_status)
    off = fit_histograms(hit.counts, hit.origin, settings=GUARD_OFF)
    moved = np.abs(off.columns - clean.columns) / errors(clean)
    assert np.nanmedian(moved.max(axis=1)) > 2  # 20 times as much
    assert (off.outlier_share == 0).all()


def test_the_guard_costs_nothing_on_clean_pixels() -> None:
    pixels = draw(np.random.default_rng(66), np.full(3000, 2.0), 11.0, 0.3, n_frames=2000)
    on = fit_histograms(pixels.counts, pixels.origin)
    off = fit_histograms(pixels.counts, pixels.origin, settings=GUARD_OFF)
    hit = on.outlier_share > 0
    # expected below the floor: 1e-3 per DN times the length of the tails, some DN
    assert hit.mean() < 0.02
    np.testing.assert_array_equal(on.columns[~hit], off.columns[~hit])
    square = [(((fit.columns - pixels.truth) / errors(off)) ** 2).mean(axis=0) for fit in (on, off)]
    assert (square[0] / square[1] < 1.01).all()


def test_sandwich_errors_hold_where_the_model_does_not() -> None:
    """Frames of 1.2 or 2.8 e- at random: the scatter of H is larger than a Poisson law allows."""
    n, h, a, noise = 2000, 2.0, 11.0, 0.3
    origin = 100 - 40
    codes = origin + np.arange(330)
    mass = np.mean([pcd_mass(codes, each, 1 / a, 100.3, noise) for each in (0.6 * h, 1.4 * h)], axis=0)
    counts = np.random.default_rng(67).multinomial(17_750, mass / mass.sum(), n).astype(np.uint32)
    first = np.full(n, origin)
    fit = fit_histograms(counts, first, settings=GUARD_OFF)
    settings = GUARD_OFF.model_copy(update={"errors": "sandwich"})
    sandwich = fit_histograms(counts, first, settings=settings).covariance
    scatter = fit.columns.std(axis=0)[0]
    limit = 5 / np.sqrt(2 * n)
    assert np.median(np.sqrt(sandwich[:, 0, 0])) == pytest.approx(scatter, rel=limit)
    assert np.median(errors(fit)[:, 0]) < scatter * (1 - limit)


def test_the_error_of_the_ensemble_is_its_scatter() -> None:
    rng = np.random.default_rng(68)
    exposure, bias = rng.uniform(0.5, 3, 12), rng.uniform(98, 103, 12)
    dn, nuced = DnAxis(80, 100), NucedAxis(0.1, -10, 70)
    curves, predicted = [], np.zeros(dn.size)
    n = 250
    for _ in range(n):
        pixels = draw(rng, exposure, 11.0, 0.3, bias, n_frames=2000)
        fit = fit_histograms(pixels.counts, pixels.origin)
        some = UsablePixels(*np.ascontiguousarray(fit.columns.T))
        curves.append(weighted_mass(some, dn, np.full(len(some), 1 / len(some))))
        raw, corrected = curve_errors(SampleLaw(), some, fit.covariance, dn, nuced)
        predicted += np.sqrt(raw) / len(some) / n
        assert (corrected[5:] > 0).all()
    scatter = np.std(curves, axis=0)
    seen = np.mean(curves, axis=0) > 1e-4
    ratio = predicted[seen] / scatter[seen]
    # each has a standard error of 4.5 %; the mean over many correlated DN less
    np.testing.assert_allclose(ratio, 1.0, atol=5 / np.sqrt(2 * n))
    assert ratio.mean() == pytest.approx(1.0, abs=0.1)


def test_the_error_of_a_median_is_its_scatter() -> None:
    rng = np.random.default_rng(69)
    found = [summarise(np.exp(rng.standard_normal(300))) for _ in range(600)]
    pulls = np.array([(each.median - 1.0) / each.median_stderr for each in found])
    # a standard deviation of 600 has a standard error of 2.9 %; the spacing of order statistics adds its own
    assert pulls.std() == pytest.approx(1.0, abs=5 / np.sqrt(1200) + 0.05)
    assert abs(pulls.mean()) < 5 / np.sqrt(600)
