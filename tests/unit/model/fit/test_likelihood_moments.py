"""Errors by the likelihood itself: as plain sampling finds them, and right where its curvature is not."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.known_camera import KnownCamera
from scipy.stats import norm, poisson

from pchem_pipeline.model.fit.api import fit_histograms, likelihood_moments
from pchem_pipeline.model.histogram.count import histogram_frames

EXPOSURE, N_FRAMES, SHAPE = 2.0, 4000, (20, 30)
N = SHAPE[0] * SHAPE[1]


def fitted(rng, read_noise):
    camera = KnownCamera.drawn(rng, SHAPE, read_noise=read_noise, gain=(0.08, 0.12))
    _, frames = camera.frames(rng, EXPOSURE, N_FRAMES)
    found = histogram_frames(frames)
    counts, origin = found.counts.reshape(N, -1), found.origin.ravel().astype(np.int64)
    fit = fit_histograms(counts, origin)
    known = np.column_stack([fit.columns, fit.likelihood_gap])
    moments = likelihood_moments(counts, origin, known, fit.outlier_share)
    truth = np.stack([np.full(N, EXPOSURE), camera.gain.ravel(), camera.bias.ravel(), camera.sigma.ravel()])
    return SimpleNamespace(counts=counts, origin=origin, fit=fit, moments=moments, truth=truth.T)


@pytest.fixture(scope="module")
def noisy():
    """A read noise of 0.45 e-: the peaks of the electron numbers are hardly to be seen."""
    return fitted(np.random.default_rng(71), (0.45, 0.45))


def errors_of(found):
    return np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2))


def pulls(made, errors):
    """Return pulls of (H, g, mu, sigma) of pixels whose bias is right and far from ambiguous."""
    off = made.fit.columns - made.truth
    right = (abs(off[:, 2] * made.truth[:, 1]) < 0.5) & (made.fit.likelihood_gap > 5.0)
    return (off / errors)[right]


def test_errors_are_right_where_those_of_the_curvature_are_too_small(noisy):
    z = pulls(noisy, errors_of(noisy.moments))
    limit = 5 / np.sqrt(2 * len(z))
    assert (abs(z.std(axis=0)[:2] - 1) < limit).all()
    assert (z.std(axis=0) < 1 + limit).all()
    assert (pulls(noisy, errors_of(noisy.fit)).std(axis=0)[:2] > 1 + limit).all()


def test_a_bias_that_is_an_electron_off_is_no_surprise(noisy):
    wrong = abs((noisy.fit.bias - noisy.truth[:, 2]) * noisy.truth[:, 1]) > 0.5
    weight = noisy.moments.rival_weight.sum(axis=1)
    assert 0 < wrong.sum() <= weight.sum() + 5 * np.sqrt(weight.sum())
    # the other bias that is given a chance lies an electron away
    some = noisy.moments.rival_weight > 0.05
    away = (noisy.moments.rivals[..., 2] - noisy.fit.bias[:, None]) * noisy.fit.conversion_gain[:, None]
    assert some.any()
    assert (abs(abs(away[some]) - 1) < 0.5).all()


def test_they_are_those_of_the_curvature_where_the_peaks_are_clear():
    clear = fitted(np.random.default_rng(72), (0.2, 0.25))
    ratio = errors_of(clear.moments) / errors_of(clear.fit)
    assert (abs(np.median(ratio, axis=0) - 1) < 0.01).all()
    assert clear.moments.rival_weight.max() < 1e-3


def log_likelihood(theta, codes, counts):
    exposure, gain, bias, sigma = theta.T[:, :, None]
    peaks = (poisson.pmf(k, exposure) * norm.pdf(codes, bias + k / gain, sigma) for k in range(16))
    return np.log(sum(peaks)) @ counts


def test_moments_are_those_of_plain_sampling(noisy):
    """Importance sampling (Student's t of 5 degrees of freedom) of the likelihood of single pixels."""
    rng = np.random.default_rng(73)
    found, curvature = errors_of(noisy.moments), errors_of(noisy.fit)
    clear = np.flatnonzero(noisy.fit.likelihood_gap > 12)[:8]
    plain = []
    for pixel in clear:
        lower = 1.3 * np.linalg.cholesky(noisy.moments.covariance[pixel])
        normal = rng.standard_normal((8000, 4)) / np.sqrt(rng.chisquare(5, (8000, 1)) / 5)
        theta = noisy.fit.columns[pixel] + normal @ lower.T
        proposal = -4.5 * np.log1p((normal**2).sum(axis=1) / 5)
        good = (theta[:, [0, 1, 3]] > 0.01).all(axis=1)
        good &= abs(theta[:, 2] - noisy.fit.bias[pixel]) * noisy.fit.conversion_gain[pixel] < 0.5
        theta, proposal = theta[good], proposal[good]
        seen = np.flatnonzero(noisy.counts[pixel])
        height = log_likelihood(theta, noisy.origin[pixel] + seen, noisy.counts[pixel, seen])
        weight = np.exp(height - proposal - (height - proposal).max())
        weight /= weight.sum()
        assert 1 / (weight**2).sum() > 500
        plain.append(np.sqrt(weight @ (theta - noisy.fit.columns[pixel]) ** 2))
    # the prior is flat here, Jeffreys' across the bias there: up to a tenth less
    assert (abs(np.median(found[clear] / plain, axis=0) - 1) < 0.15).all()
    assert (abs(found[clear] / plain - 1) < 0.3).all()
    assert (np.median(curvature[clear] / plain, axis=0) < 0.95).all()
