"""How often the electron numbers of the ensemble are wrong."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.special import gammaln, ndtr, xlogy

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.arithmetic.limits import LEAST_VARIANCE
from pchem_pipeline.model.electrons.electrons import KnownPixels, number_tables
from pchem_pipeline.model.ensemble.totals import EnsembleTotals
from pchem_pipeline.model.law.parameters import UsablePixels
from pchem_pipeline.model.law.sample_law import SampleLaw

_AT_ONCE = 4096  # pixels


def error_rates(totals: EnsembleTotals, pixels: UsablePixels, true: UsablePixels | None) -> dict[str, Any]:
    """Return how often the electron numbers are wrong, where the true ones are known.

    ``expected_error_rate_from_truth`` is that of data of the true parameters decided with the fitted ones;
    ``least_error_rate`` that of numbers decided with the true ones. Frames that the fit has seen err slightly
    less than new ones.

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
        error, least = (errors_of_numbers(deciding, true) for deciding in (pixels, true))
        facts |= {
            "expected_error_rate_from_truth": float(error.mean()),
            "error_rate_stderr": math.sqrt(float(np.mean(error * (1.0 - error))) / compared),
            "least_error_rate": float(least.mean()),
        }
    return facts


def errors_of_numbers(deciding: UsablePixels, data: UsablePixels) -> FloatArray:
    """Return how often numbers that n pixels decide are wrong in data of other parameters, shape (n,).

    The number of a code is right with the probability ``P(k; H) [Phi((x + 1/2 - m_k) / s) - Phi((x - 1/2 -
    m_k) / s)]`` of that code and number, ``m_k = mu + k / g``, s the read noise before rounding.
    """
    errors = np.empty(len(deciding))
    for part in np.array_split(np.arange(errors.size), errors.size // _AT_ONCE + 1):
        some = np.isin(np.arange(errors.size), part)
        known, true = (KnownPixels(pixels.of(some), SampleLaw()) for pixels in (deciding, data))
        tables = number_tables(*true.codes(), known.exposure, known)
        pixel = np.repeat(np.arange(part.size), np.diff(tables.start))
        code = np.arange(pixel.size) - tables.start[pixel] + tables.first[pixel]
        h, g, mu, sigma = (column[pixel] for column in data.of(some).maps)
        k = tables.number.astype(np.float64)
        off, sd = code - mu - k / g, np.sqrt(np.maximum(sigma**2 - QUANTISATION_VARIANCE, LEAST_VARIANCE))
        mass = np.exp(xlogy(k, h) - h - gammaln(k + 1.0)) * (ndtr((off + 0.5) / sd) - ndtr((off - 0.5) / sd))
        errors[part] = 1.0 - np.bincount(pixel, mass, part.size)
    return errors
