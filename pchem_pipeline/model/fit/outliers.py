"""Histograms without the samples that the tail guard of the fit leaves out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.errors import information_numba
from pchem_pipeline.model.fit.settings import FitSettings

__all__ = ["without_outliers"]


def without_outliers(
    counts: NDArray[np.integer],
    origin: NDArray[np.integer],
    parameters: NDArray[np.float64],
    outlier_share: NDArray[np.float64],
    settings: FitSettings | None = None,
) -> NDArray[np.integer]:
    """Return histograms without the samples that the fit left out.

    Args:
        counts: histograms, shape (n, B).
        origin: DN of bin 0, shape (n,).
        parameters: fitted (H, g, mu, sigma), shape (n, 4).
        outlier_share: share of the samples that the fit left out, shape (n,).
        settings: of that fit; the defaults if None.

    Returns:
        The histograms, same shape and type; the very same array where nothing was left out.
    """
    settings = settings or FitSettings()
    pixels = np.flatnonzero(outlier_share > 0)
    if settings.tail_guard == 0 or pixels.size == 0:
        return counts
    kept = counts.copy()
    some = np.ascontiguousarray(counts[pixels])
    trimmed = np.empty_like(some)
    information_numba.trim_tile(
        some,
        np.ascontiguousarray(origin, np.int64)[pixels],
        np.ascontiguousarray(parameters[pixels]),
        settings.tail_guard,
        trimmed,
    )
    kept[pixels] = trimmed
    return kept
