"""How often the electron numbers of the ensemble are wrong."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pchem_pipeline.model.electrons.thresholds import errors_by_thresholds
from pchem_pipeline.model.ensemble.totals import EnsembleTotals
from pchem_pipeline.model.law.parameters import UsablePixels


def error_rates(totals: EnsembleTotals, pixels: UsablePixels, true: UsablePixels | None) -> dict[str, Any]:
    """Return how often the electron numbers are wrong, where the true ones are known.

    What one should expect follows from the fitted parameters alone (``expected_error_rate``) or, better, from
    data of the true parameters decided with the fitted ones; the least possible rate is that of numbers
    decided with the true ones. Frames that the fit has seen err slightly less than new ones.

    Args:
        totals: the sums over all tiles.
        pixels: fitted parameters of all pixels with a value.
        true: true parameters of the same pixels, or None where they are not known or not all there is.

    Returns:
        Numbers for the attributes of the group; none where nothing was compared.
    """
    compared = totals.count("compared")
    if not compared:
        return {}
    sizes = totals.counts("error_sizes")
    frames = compared / totals.count("pixels")
    facts: dict[str, Any] = {
        "error_rate": 1.0 - int(sizes[0]) / compared,
        "error_rate_stderr": math.sqrt(float(totals.variance("error_variance")[0]) / frames),
        "error_sizes": [int(n) for n in sizes],
        "mean_error": totals.count("signed_error") / compared,
        "samples_compared": compared,
    }
    if true is not None:
        error, least = (errors_by_thresholds(deciding, true) for deciding in (pixels, true))
        facts |= {
            "expected_error_rate_from_truth": float(error.mean()),
            "error_rate_stderr": math.sqrt(float(np.mean(error * (1.0 - error))) / compared),
            "least_error_rate": float(least.mean()),
        }
    return facts
