"""Electron numbers of histograms under the PCD, by the thresholds between neighbouring numbers.

Without effects the most probable k rises with the code, so the last code of each k says it all, and what lies
between two of them is a difference of two tails: a few numbers for each k instead of a table over codes
(:mod:`pchem_pipeline.model.electrons.electrons`, which holds for any law).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.electrons import thresholds_numba
from pchem_pipeline.model.electrons.electrons import LARGEST_NUMBER, Outcomes
from pchem_pipeline.model.law.inputs import kernel_counts
from pchem_pipeline.model.law.parameters import FloatArray, UsablePixels


def numbers_by_thresholds(
    counts: NDArray[np.integer[Any]], origin: NDArray[np.integer[Any]], pixels: UsablePixels, n_k: int
) -> tuple[NDArray[np.int64], int, Outcomes]:
    """Return the samples of each electron number, how many have a larger one, and what is expected.

    Args:
        counts: samples per bin, shape (n, n_bins).
        origin: DN of bin 0, shape (n,).
        pixels: the n pixels.
        n_k: number of electron numbers, k = 0 .. n_k - 1.
    """
    observed, expected, errors = np.zeros(n_k, np.int64), np.zeros(n_k), np.empty(len(pixels))
    inputs = kernel_counts(counts), np.asarray(origin, np.int64), pixels.columns
    beyond = thresholds_numba.sum_by_thresholds(*inputs, LARGEST_NUMBER, observed, expected, errors)
    return observed, int(beyond), Outcomes(expected, errors)


def errors_by_thresholds(deciding: UsablePixels, data: UsablePixels) -> FloatArray:
    """Return how often numbers that some parameters decide are wrong in samples of others, shape (n,).

    Args:
        deciding: n pixels.
        data: what their samples follow.
    """
    errors = np.empty(len(deciding))
    thresholds_numba.fill_errors(deciding.columns, data.columns, errors)
    return errors
