"""All four parameters from the first four cumulants of one sample."""

from __future__ import annotations

import numpy as np

from pchem_pipeline.methods.base import Estimates, Method, PixelSamples, no_estimates
from pchem_pipeline.methods.settings import MethodsSettings


class Cumulants(Method):
    """Invert the first four cumulants of the PCD.

    They are ``k1 = mu + H/g``, ``k2 = sigma^2 + H/g^2``, ``k3 = H/g^3`` and ``k4 = H/g^4``; hence ``g =
    k3/k4``, ``H = k3 g^3``, ``mu = k1 - H/g`` and ``sigma^2 = k2 - H/g^2``, with unbiased k-statistics (the
    cumulant method for Poisson-Gaussian noise: Baehler et al. 2022, arXiv 2210.04866). The sample's fourth
    cumulant scatters by about ``sqrt(24 / N) (H + s_e^2)^2`` electrons and should be H, so the method is for
    H below about 1 e-.
    """

    name = "cumulants"
    title = "cumulants"
    source = "cumulants of Poisson-Gaussian noise, as in Baehler et al. 2022, arXiv 2210.04866"
    needs = "one sample"
    remark = "for exposures below about 1 e-; far above, the fourth cumulant is too noisy"
    order = 40

    def estimate(self, pixels: PixelSamples, settings: MethodsSettings) -> Estimates:
        """Return the estimates from the first sample."""
        moments = pixels.samples[0].moments()
        out = no_estimates(pixels.n_pixels)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            answered = (moments.third > 0) & (moments.fourth > 0)
            gain = np.where(answered, moments.third / moments.fourth, np.nan)
            exposure = moments.third * gain**3
            variance = moments.variance - exposure / gain**2
            out[:, 0], out[:, 1], out[:, 2] = exposure, gain, moments.mean - exposure / gain
            out[:, 3] = np.sqrt(np.where(variance > 0, variance, np.nan))
        reasons = {
            "third or fourth cumulant not positive": ~answered,
            "negative variance of the read noise": answered & ~(variance > 0),
        }
        return Estimates.where(out, reasons)
