"""Photon transfer from a dark and a bright sample of each pixel."""

from __future__ import annotations

import numpy as np

from pchem_pipeline.methods.base import (
    Estimates,
    Method,
    PixelSamples,
    Settings,
    no_estimates,
    register_method,
)


@register_method
class TwoSamplePhotonTransfer(Method):
    """Gain from the difference of two means over the difference of two variances.

    ``g = (xbar_b - xbar_d) / (s2_b - s2_d)``, ``mu = xbar_d``, ``sigma^2 = s2_d``, ``H = g (xbar - mu)``,
    with b the brightest and d the darkest sample (Hendrickson et al. 2022, J. Opt. Soc. Am. A 39, 2169; arXiv
    2301.08790). The gain needs no dark sample free of electrons, bias and read noise do.
    """

    name = "photon_transfer"
    title = "photon transfer, two samples"
    source = "Hendrickson, Haefner and Preece 2022, J. Opt. Soc. Am. A 39, 2169"
    needs = "a dark and a bright sample"
    remark = "bias and read noise from the dark sample, including its electrons"
    order = 30

    def estimate(self, pixels: PixelSamples, settings: Settings) -> Estimates:
        """Return the estimates from the darkest and the brightest sample."""
        order = pixels.by_brightness()
        dark, bright = (pixels.samples[number].moments() for number in (order[0], order[-1]))
        first = pixels.samples[0].moments()
        out = no_estimates(pixels.n_pixels)
        signal, noise = bright.mean - dark.mean, bright.variance - dark.variance
        good = (signal > 0) & (noise > 0)
        out[good, 1] = signal[good] / noise[good]
        out[good, 0] = out[good, 1] * (first.mean - dark.mean)[good]
        out[good, 2] = dark.mean[good]
        out[good, 3] = np.sqrt(dark.variance[good])
        return Estimates.where(
            out, {"mean or variance of the bright sample not above the dark sample": ~good}
        )


def gain_variance(
    bright_exposure: float, dark_exposure: float, read_noise_e: float, n_bright: float, n_dark: float
) -> float:
    """Return the variance of ln g of the two-sample estimator, by the delta method.

    ``[var(xbar_b) + var(xbar_d) + var(s2_b) + var(s2_d) - 2 cov_b - 2 cov_d] / (H_b - H_d)^2`` in electrons,
    with ``var(s2) = (m4 - s2^2)/n``, ``m4 = H + 3 (H + s_e^2)^2`` and ``cov(xbar, s2) = H/n``.

    Args:
        bright_exposure: H_b, e-.
        dark_exposure: H_d, e-.
        read_noise_e: s_e, e-.
        n_bright: frames of the bright sample.
        n_dark: frames of the dark sample.
    """
    total = 0.0
    for exposure, frames in ((bright_exposure, n_bright), (dark_exposure, n_dark)):
        variance = exposure + read_noise_e**2
        total += (variance + exposure + 2 * variance**2 - 2 * exposure) / frames
    return total / (bright_exposure - dark_exposure) ** 2
