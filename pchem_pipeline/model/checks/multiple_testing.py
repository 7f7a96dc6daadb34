"""Many tests at once: which pixels disagree with the model when chance is allowed for."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.model.arithmetic.robust import chi_square


def false_discovery(probability: NDArray[np.floating[Any]]) -> FloatArray:
    """Return the false-discovery rate at which each of many tests would be called significant.

    The step-up procedure of Benjamini and Hochberg (1995): with the p-values in ascending order,
    ``q_(i) = min_(j >= i) p_(j) n / j``. Among the pixels with q below a limit the expected share of those
    that agree with the model is at most that limit, for independent pixels.

    Of p-values of any shape, NaN where nothing was tested.

    Example:
        >>> false_discovery(np.array([0.01, 0.04, 0.5])).round(2).tolist()
        [0.03, 0.06, 0.5]
    """
    found = np.full(probability.shape, np.nan)
    tested = np.isfinite(probability)
    p = np.asarray(probability[tested], np.float64)
    order = np.argsort(p)  # scipy.stats has this, too, and takes a second to import
    raised = p[order] * (p.size / np.arange(1.0, p.size + 1.0))
    q = np.empty(p.size)
    q[order] = np.minimum(np.minimum.accumulate(raised[::-1])[::-1], 1.0)
    found[tested] = q
    return found


def misfit(chi2: FloatArray, dof: FloatArray) -> FloatArray:
    """Return chi-square as a standard normal deviate (Wilson and Hilferty 1931), large for a poor fit.

    Unlike a p-value it does not run out of digits; NaN where there are no degrees of freedom.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        return chi_square(chi2, np.where(dof > 0, dof, np.nan))


def poorest(chi2: FloatArray, dof: FloatArray, n: int) -> list[tuple[int, int]]:
    """Return (y, x) of the n pixels of the poorest fit, the poorest first; fewer where fewer were tested."""
    score = misfit(chi2, dof).ravel()
    order = np.argsort(-score, kind="stable")[:n]
    return [divmod(int(i), chi2.shape[1]) for i in order if np.isfinite(score[i])]
