"""What samples of known pixels say of their offset by their electron numbers."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.model.law.density_scores_numba import EE, N_MEANS, E, posterior

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
def from_electrons(frame: NDArray[Any], pixels: Pixels, offset: FloatArray, form: FloatArray) -> None:
    """Fill the quadratic form ``form[0] o - form[1] o^2 / 2`` of a log-likelihood in samples' offsets.

    Args:
        frame: DN, shape (y, x).
        pixels: what is known of them.
        offset: DN, about which the log-likelihood is expanded, shape (y, x).
        form: out, shape (2, y, x).
    """
    exposure, gain, bias, sigma = pixels
    means = np.empty(N_MEANS)
    for y in range(frame.shape[0]):
        for x in range(frame.shape[1]):
            form[0, y, x] = form[1, y, x] = 0.0
            if math.isnan(exposure[y, x]):
                continue
            own, value = sigma[y, x], frame[y, x] - bias[y, x] - offset[y, x]
            posterior(value, exposure[y, x], 1.0 / gain[y, x], 0.0, own, means)
            precision = 1.0 / (own * own)
            score, variance = means[E] * precision, means[EE] - means[E] * means[E]
            information = max(precision - variance * precision * precision, _LEAST_INFORMATION * precision)
            # the form is that of the offset itself, not of its change
            form[0, y, x], form[1, y, x] = score + information * offset[y, x], information
