"""How often the electron numbers of the ensemble are wrong."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pchem_pipeline.model.electrons.electrons import KnownPixels, number_tables
from pchem_pipeline.model.ensemble.totals import EnsembleTotals
from pchem_pipeline.model.law.parameters import FloatArray, UsablePixels
from pchem_pipeline.model.law.sample_law import SampleLaw

_CHUNK = 1 << 16  # pixels whose tables are held at a time


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
        error, least = (_error(true, deciding) for deciding in (pixels, true))
        facts |= {
            "expected_error_rate_from_truth": float(error.mean()),
            "error_rate_stderr": math.sqrt(float(np.mean(error * (1.0 - error))) / compared),
            "least_error_rate": float(least.mean()),
        }
    return facts


def _error(true: UsablePixels, deciding: UsablePixels) -> FloatArray:
    """Return how often numbers that some parameters decide are wrong in data of others, shape (n,)."""
    out = np.empty(len(true))
    for first in range(0, out.size, _CHUNK):
        part = slice(first, first + _CHUNK)
        data, decided = (
            KnownPixels([column[part] for column in each.maps], SampleLaw()) for each in (true, deciding)
        )
        out[part] = number_tables(*data.codes(), decided.exposure, decided).outcomes(1, data).error
    return out
