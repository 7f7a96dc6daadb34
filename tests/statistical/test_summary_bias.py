"""Covariances of independent frames and pixels are zero on average, and real ones are found."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.histogram.summaries import CovarianceMaps, SummaryAccumulator

SHAPE = (30, 40)
FRAMES, BLOCK = 700, 32
SIGMA = 20.0


def covariances(noise: NDArray[np.float64]) -> CovarianceMaps:
    accumulator = SummaryAccumulator(SHAPE, BLOCK)
    accumulator.add(np.rint(1000 + noise).astype(np.uint16))
    return accumulator.finish()[1]


def limit(values: NDArray[np.float64]) -> float:
    """Five standard errors of the mean over the map: each entry has the variance sigma^4 / frames."""
    return 5 * SIGMA**2 / np.sqrt(FRAMES * np.isfinite(values).sum())


def test_independent_frames_and_pixels():
    rng = np.random.default_rng(20)
    maps = covariances(rng.normal(0, SIGMA, (FRAMES, *SHAPE)))
    for name, values in vars(maps).items():
        assert abs(np.nanmean(values)) < limit(values), name
    # the bias that would be there if the blocks' own means were not allowed for is well above the limit
    assert 4 * limit(maps.lag1_covariance) < SIGMA**2 / BLOCK


def test_real_covariances_are_found():
    rng = np.random.default_rng(21)
    rho = 0.05
    white = rng.normal(0, SIGMA, (FRAMES + 1, SHAPE[0] + 1, SHAPE[1] + 1))
    weight = (1 - np.sqrt(1 - 4 * rho**2)) / (2 * rho)  # makes a moving average with correlation rho
    scale = 1 / np.sqrt(1 + weight**2)
    expected = rho * SIGMA**2
    cases = {
        "lag1_covariance": (white[1:] + weight * white[:-1])[:, :-1, :-1],
        "neighbour_covariance_x": (white[:, :, 1:] + weight * white[:, :, :-1])[:-1, :-1],
        "neighbour_covariance_y": (white[:, 1:] + weight * white[:, :-1])[:-1, :, :-1],
    }
    for name, noise in cases.items():
        values = getattr(covariances(scale * noise), name)
        # the lag estimate loses the mean of the block twice over: (1 - 2 / BLOCK) is its first-order factor
        tolerance = 1.2 * limit(values) + (2 * expected / BLOCK if name == "lag1_covariance" else 0)
        assert abs(np.nanmean(values) - expected) < tolerance, name
        assert expected > 4 * limit(values)
