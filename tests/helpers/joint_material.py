"""Several exposures of simulated pixels for the tests of the joint fit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from helpers.drawn_pixels import draw
from numpy.typing import NDArray


class Series(NamedTuple):
    """Histograms of J samples, which are dark, and the true parameters."""

    counts: list[NDArray[np.uint32]]
    origins: list[NDArray[np.int64]]
    dark: list[bool]
    exposures: list[float]


def draw_series(
    rng: np.random.Generator,
    exposures: list[float],
    electron_noise: float,
    n_pixels: int,
    *,
    step: float = 10.0,
    bias: float = 100.3,
    n_frames: int = 4000,
) -> Series:
    """Draw n pixels at each exposure; an exposure of 0 is a sample without electrons."""
    counts, origins = [], []
    for exposure in exposures:
        if exposure > 0:
            drawn = draw(rng, np.full(n_pixels, exposure), step, electron_noise, bias, n_frames)
            counts.append(drawn.counts)
            origins.append(drawn.origin)
            continue
        sd = np.sqrt((electron_noise * step) ** 2 - 1 / 12)
        codes = np.rint(bias + sd * rng.standard_normal((n_pixels, n_frames))).astype(np.int64)
        low, width = codes.min(), int(np.ptp(codes)) + 1
        counts.append(np.stack([np.bincount(row - low, minlength=width) for row in codes]).astype(np.uint32))
        origins.append(np.full(n_pixels, low))
    return Series(counts, origins, [exposure == 0 for exposure in exposures], exposures)
