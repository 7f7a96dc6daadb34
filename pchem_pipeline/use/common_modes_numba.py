"""What samples of known pixels say of their offset by their electron numbers."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel

FloatArray = NDArray[np.float64]

_LEAST_INFORMATION = 0.05  # of that of a sample whose electron number is known


class Pixels(NamedTuple):
    """What is known of the pixels, shape (y, x) each.

    Attributes:
        exposure: H to expect, e-; NaN: a pixel that is left out.
        gain: g, e-/DN.
        bias: mu, DN.
        sigma: noise of the pixel alone, DN.
    """

    exposure: FloatArray
    gain: FloatArray
    bias: FloatArray
    sigma: FloatArray


@kernel
def _score(difference: float, exposure: float, gain: float, sigma: float, reach: int) -> tuple[float, float]:
    """Return the slope of the log-likelihood in an offset, 1/DN, and the information, 1/DN^2.

    Args:
        difference: x - mu - offset, DN.
        exposure: H, e-.
        gain: g, e-/DN.
        sigma: DN.
        reach: electron numbers on either side of the nearest that are summed.
    """
    precision = 1.0 / (sigma * sigma)
    nearest = max(math.floor(difference * gain + 0.5), 0)
    low = max(nearest - reach, 0)
    prior, total, first, second = 1.0, 0.0, 0.0, 0.0
    base = (difference - nearest / gain) ** 2
    for k in range(low, nearest + reach + 1):
        residual = difference - k / gain
        weight = prior * math.exp(0.5 * precision * (base - residual * residual))
        total += weight
        first += weight * residual
        second += weight * residual * residual
        prior *= exposure / (k + 1.0)
    mean = first / total
    variance = second / total - mean * mean
    information = precision - variance * precision * precision
    return mean * precision, max(information, _LEAST_INFORMATION * precision)


@kernel
def from_electrons(frame: NDArray[Any], pixels: Pixels, offset: FloatArray, form: FloatArray) -> None:
    """Fill the quadratic form ``form[0] o - form[1] o^2 / 2`` of a log-likelihood in samples' offsets.

    Args:
        frame: DN, shape (y, x).
        pixels: what is known of them.
        offset: DN, about which the log-likelihood is expanded, shape (y, x).
        form: out, shape (2, y, x).
    """
    exposure, gain, bias, sigma = pixels
    for y in range(frame.shape[0]):
        for x in range(frame.shape[1]):
            form[0, y, x] = form[1, y, x] = 0.0
            if math.isnan(exposure[y, x]):
                continue
            reach = 2 + math.ceil(4.0 * sigma[y, x] * gain[y, x])
            difference = frame[y, x] - bias[y, x] - offset[y, x]
            score, information = _score(difference, exposure[y, x], gain[y, x], sigma[y, x], reach)
            # the form is that of the offset itself, not of its change
            form[0, y, x], form[1, y, x] = score + information * offset[y, x], information
