"""Samples made by a chain of their own: the extended fit is right within its errors, the plain one is not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from helpers.masses import log_likelihood
from numpy.typing import NDArray

from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.result import FitResult
from pchem_pipeline.model.law.sample_law import SampleLaw

PIXELS, FRAMES = 120, 4000
NAMES = ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn")
PLAIN = SampleLaw()

Rng = np.random.Generator
Samples = Callable[[Rng, NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]], NDArray[np.float64]]


def poisson(rng: Rng, exposure: NDArray[Any]) -> NDArray[np.int64]:
    return rng.poisson(exposure, (PIXELS, FRAMES))


def normal(rng: Rng) -> NDArray[np.float64]:
    return rng.standard_normal((PIXELS, FRAMES))


def dispersed(rng, exposure, gain, bias, noise):
    electrons = rng.poisson(exposure * rng.gamma(1 / 0.08, 0.08, (PIXELS, FRAMES)))
    return bias + (electrons + noise * normal(rng)) / gain


def branching(rng, exposure, gain, bias, noise):
    # every electron has a Poisson number of children, and so have they
    electrons = total = rng.poisson(exposure * (1 - 0.08), (PIXELS, FRAMES))
    while electrons.any():
        electrons = rng.poisson(0.08 * electrons)
        total = total + electrons
    return bias + (total + noise * normal(rng)) / gain


def flickering(rng, exposure, gain, bias, noise):
    factor = rng.choice([0.7, 1.3], (PIXELS, FRAMES))
    return bias + (rng.poisson(exposure * factor) + noise * normal(rng)) / gain


def skewed(rng, exposure, gain, bias, noise):
    low = rng.random((PIXELS, FRAMES)) < 0.7
    shape = np.where(low, -0.3, 0.7) + 0.889 * normal(rng)
    return bias + (poisson(rng, exposure) + noise * shape) / gain


def widening(rng, exposure, gain, bias, noise):
    electrons = poisson(rng, exposure)
    return bias + (electrons + np.hypot(noise, 0.07 * np.sqrt(electrons)) * normal(rng)) / gain


def bent(rng, exposure, gain, bias, noise):
    k = poisson(rng, exposure)
    return bias + (k * (1 + 0.01 * (k - 1) / 2) + noise * normal(rng)) / gain


def rows(rng, exposure, gain, bias, noise):
    return bias + (poisson(rng, exposure) + noise * normal(rng)) / gain + 1.2 * normal(rng)


def straight(rng, exposure, gain, bias, noise):
    return bias + (poisson(rng, exposure) + noise * normal(rng)) / gain


def clipped(rng, exposure, gain, bias, noise):
    return np.clip(straight(rng, exposure, gain, bias, noise), 98, 170)


EDGES = 0.3 * np.sin(2 * np.pi * np.arange(300) / 70)


def uneven(rng, exposure, gain, bias, noise):
    # the code is the number of edges below the signal
    edges = np.arange(50, 350) - 0.5 + EDGES
    return 49.0 + np.searchsorted(edges, straight(rng, exposure, gain, bias, noise))


CASES: dict[str, tuple[Samples, SampleLaw, tuple[str, ...]]] = {
    "negative binomial": (dispersed, PLAIN.with_counts("negative_binomial", 0.08), ("conversion_gain",)),
    "borel": (branching, PLAIN.with_counts("borel", 0.08), ("conversion_gain",)),
    "two exposures": (flickering, PLAIN.with_exposures([0.5, 0.5], [0.7, 1.3]), ("conversion_gain",)),
    "skew": (skewed, PLAIN.with_noise([0.7, 0.3], shift_sigma=[-0.3, 0.7], width=0.889), ("bias",)),
    "variance per electron": (widening, PLAIN.with_variance(per_electron=0.0049), ("read_noise_dn",)),
    "curvature": (bent, PLAIN.with_levels(curvature=0.01), ("conversion_gain",)),
    "variance": (rows, PLAIN.with_variance(dn2=1.44), ("read_noise_dn",)),
    "clip": (clipped, PLAIN.with_clip(98, 170), ("bias", "read_noise_dn", "quanta_exposure")),
    "edges": (uneven, PLAIN.with_edges(50, EDGES), ("conversion_gain", "bias")),
}


def sensor(rng: Rng) -> tuple[NDArray[np.float64], ...]:
    draws = (rng.uniform(1.0, 4.5, PIXELS), 1 / rng.uniform(10, 14, PIXELS), rng.uniform(98, 102, PIXELS))
    return (*draws, rng.uniform(0.2, 0.3, PIXELS))


def histograms(signal: NDArray[np.float64]) -> tuple[NDArray[np.uint32], NDArray[np.int64]]:
    codes = np.rint(signal).astype(np.int64)
    origin = codes.min(axis=1)
    bins = int((codes.max(axis=1) - origin).max()) + 1
    counts = [np.bincount(row - first, minlength=bins) for row, first in zip(codes, origin, strict=True)]
    return np.array(counts, np.uint32), origin


def pulls(fit: FitResult, truth: tuple[NDArray[np.float64], ...], least: float = 0.95) -> NDArray[np.float64]:
    """Mean pull of each parameter in units of its own standard error."""
    exposure, gain, bias, noise = truth
    sigma = np.sqrt((noise / gain) ** 2 + 1 / 12)
    found = np.stack([getattr(fit, name) for name in NAMES], axis=1)
    stderr = np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2))
    each = (found - np.stack([exposure, gain, bias, sigma], axis=1)) / stderr
    good = np.isfinite(each).all(axis=1)
    assert good.mean() > least
    return np.asarray(each[good].mean(axis=0) * np.sqrt(good.sum()))


@pytest.mark.parametrize("name", CASES)
def test_extended_fit_is_unbiased_where_the_plain_one_is_not(name: str) -> None:
    samples, model, wrong = CASES[name]
    rng = np.random.default_rng(7)
    truth = sensor(rng)
    counts, origin = histograms(samples(rng, *(column[:, None] for column in truth)))
    plain = fit_histograms(counts, origin)
    extended = fit_histograms(counts, origin, law=model, start=plain)
    before, after = pulls(plain, truth, 0.8), pulls(extended, truth)
    assert (abs(after) < 5).all(), after
    for parameter in wrong:
        assert abs(before[NAMES.index(parameter)]) > 7, before
    # the goodness of fit is uniform: a tenth of the pixels below 0.1
    share = np.mean(extended.goodness_p[np.isfinite(extended.goodness_p)] < 0.1)
    assert abs(share - 0.1) < 5 * np.sqrt(0.09 / PIXELS)
    # the right law wins on the frames that it was fitted to, all pixels together
    neutral = log_likelihood(counts, origin, fit_histograms(counts, origin, law=PLAIN, start=plain), PLAIN)
    assert np.nansum(extended.log_likelihood - neutral) > (20 if name != "variance" else -5)
