"""Coverage of intervals, calibration of p-values, and what the tail guard is worth."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.drawn_pixels import draw
from scipy.special import chdtrc
from scipy.stats import binom, kstest

from pchem_pipeline.model.arithmetic.statistics import false_discovery
from pchem_pipeline.model.checks.shrinkage import Judged, NoisePool, noise_of
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import FitStatus


def judge_together(fit):
    """Return the fit of a sensor's pixels with the word of those that are weakly identified."""
    of_gain, of_sigma = errors(fit)[:, [1, 3]].T
    together = fit.covariance[:, 1, 3] / (of_gain * of_sigma)
    noise, stderr = noise_of(fit.conversion_gain, fit.read_noise_dn, of_gain, of_sigma, together)
    pixels = Judged(noise, stderr, fit.likelihood_gap)
    weak = np.logical_or(*NoisePool.of(pixels).reasons(pixels, FitSettings()))
    word = np.where(weak, int(FitStatus.WEAKLY_IDENTIFIED), 0)
    return replace(fit, fit_status=fit.fit_status | word.astype(np.uint16))


def errors(fit):
    return np.asarray(np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2)))


@pytest.mark.parametrize("case", [(2.0, 0.48, 2000), (8.0, 0.48, 17_750), (2.0, 0.42, 2000)])
def test_pixels_that_pass_together_are_no_selection(case):
    """Judged one by one, those that pass on a poor sensor are the lucky ones, and their intervals miss."""
    h, noise, n_frames = case
    n = 600
    pixels = draw(np.random.default_rng(70), np.full(n, h), 11.0, noise, n_frames=n_frames)
    alone = fit_histograms(pixels.counts, pixels.origin)
    together = judge_together(alone)
    np.testing.assert_array_equal(alone.fit_status, together.fit_status & ~np.uint16(2048))

    def tail(fit):
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


def test_goodness_of_fit_is_uniform_with_few_frames_too():
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
