"""Photon transfer: the gain from how the variance grows with the mean; two samples, a series, EMVA 1288."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.methods.base import Estimates, Method, PixelSamples, no_estimates
from pchem_pipeline.methods.settings import MethodsSettings


class PhotonTransferSeries(Method):
    """Weighted straight line through variance against mean (the photon transfer curve).

    ``s2_j = sigma^2 + (xbar_j - mu)/g``: the slope is 1/g (Janesick 2007, Photon Transfer; Beecken and Fossum
    1996, Appl. Opt. 35, 3471). Weights are ``n / (2 s2^2)``, with s2 from an unweighted line first, since
    weights from the measured variances favour those that came out small. The darkest sample gives mu; the
    line at mu gives sigma^2.
    """

    name = "photon_transfer_series"
    title = "photon transfer, series"
    source = "Janesick 2007, Photon Transfer; Beecken and Fossum 1996, Appl. Opt. 35, 3471"
    needs = "a series of samples"
    remark = "bias from the mean of the darkest sample, including its electrons"
    order = 31

    def estimate(self, pixels: PixelSamples, settings: MethodsSettings) -> Estimates:
        """Return the estimates from all samples."""
        return _of_line(pixels, range(len(pixels.samples)))


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

    def estimate(self, pixels: PixelSamples, settings: MethodsSettings) -> Estimates:
        """Return the estimates from the darkest and the brightest sample."""
        order = pixels.by_brightness()
        return _of_line(pixels, (order[0], order[-1]))


class Emva1288(Method):
    """K (DN/e-) as the slope, through the origin, of temporal variance against mean, both above dark.

    EMVA Standard 1288, release 3.1 and release 4.0 Linear: means and temporal variances are averaged over the
    pixels, the darkest sample is the dark one, points above 70 % of saturation are left out, and the fit has
    no offset and equal weights, as in the reference implementation (github.com/EMVA1288/emva1288,
    ``process/results.py``). Then g = 1/K and the temporal dark noise is ``sqrt(s2_dark)``, with its
    quantisation part. Every pixel gets the same g, H and read noise; its own dark mean is its bias.
    """

    name = "emva1288"
    title = "EMVA 1288 (sensor-wide K)"
    source = "EMVA Standard 1288, release 4.0 Linear"
    needs = "a dark and a bright sample"
    remark = "one gain for all pixels"
    order = 32
    sensor_wide = True

    def estimate(self, pixels: PixelSamples, settings: MethodsSettings) -> Estimates:
        """Return the sensor's K as the gain of every pixel."""
        found = [sample.moments() for sample in pixels.samples]
        # the same pixels in every sample: those that have a variance in all of them
        seen = np.all([np.isfinite(moments.variance) for moments in found], axis=0)
        if not seen.any():
            return Estimates(no_estimates(pixels.n_pixels), {"no frames": pixels.n_pixels})
        mean = np.array([moments.mean[seen].mean() for moments in found])
        variance = np.array([moments.variance[seen].mean() for moments in found])
        dark = pixels.by_brightness()[0]
        signal, noise = mean - mean[dark], variance - variance[dark]
        linear = np.ones(mean.size, np.bool_)
        if pixels.adc_limits is not None:
            # of the saturation: EMVA 1288 release 3.1, section on sensitivity
            linear = signal <= 0.7 * (pixels.adc_limits[1] - mean[dark])
        out = no_estimates(pixels.n_pixels)
        steepness = float((signal * noise)[linear].sum())
        if steepness <= 0:
            return Estimates(out, {"variance does not increase with the mean": pixels.n_pixels})
        gain = float((signal**2)[linear].sum()) / steepness
        out[:] = (gain * signal[0], gain, np.nan, np.sqrt(variance[dark]))
        out[:, 2] = found[dark].mean
        return Estimates(out)


def _of_line(pixels: PixelSamples, chosen: Sequence[int]) -> Estimates:
    """Return the estimates from the line through some samples, the darkest among them."""
    found = [pixels.samples[number].moments() for number in chosen]
    mean, variance, n_frames = (
        np.stack([getattr(moments, name) for moments in found]) for name in ("mean", "variance", "n_frames")
    )
    dark = pixels.samples[pixels.by_brightness()[0]].moments().mean
    signal = mean - dark
    offset, slope = _line(signal, variance, np.ones_like(variance))
    floor = np.min(np.where(variance > 0, variance, np.inf), axis=0)
    model = np.maximum(offset + slope * signal, 0.1 * floor)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset, slope = _line(signal, variance, n_frames / model**2)
    out = no_estimates(pixels.n_pixels)
    rising, positive = (slope > 0) & (signal > 0).any(axis=0), offset > 0
    out[rising, 1] = 1.0 / slope[rising]
    out[rising, 0] = out[rising, 1] * (pixels.samples[0].moments().mean - dark)[rising]
    out[rising, 2] = dark[rising]
    good = rising & positive
    out[good, 3] = np.sqrt(offset[good])
    bad = {
        "variance does not increase with the mean": ~rising,
        "the line gives no read noise": rising & ~positive,
    }
    return Estimates.where(out, bad)


def _line(x: FloatArray, y: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return offset and slope of a weighted line for every pixel; x, y, weights: (sample, pixel)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        total = weights.sum(axis=0)
        mean_x, mean_y = (weights * x).sum(axis=0) / total, (weights * y).sum(axis=0) / total
        square = (weights * (x - mean_x) ** 2).sum(axis=0)
        slope = (weights * (x - mean_x) * (y - mean_y)).sum(axis=0) / square
        return mean_y - slope * mean_x, slope


def gain_variance(
    bright_exposure: float, dark_exposure: float, read_noise_e: float, n_bright: float, n_dark: float
) -> float:
    """Return the variance of ln g of the two-sample estimator, by the delta method.

    ``[var(xbar_b) + var(xbar_d) + var(s2_b) + var(s2_d) - 2 cov_b - 2 cov_d] / (H_b - H_d)^2`` in electrons,
    with ``var(s2) = (m4 - s2^2)/n``, ``m4 = H + 3 (H + s_e^2)^2`` and ``cov(xbar, s2) = H/n``.
    """
    total = 0.0
    for exposure, frames in ((bright_exposure, n_bright), (dark_exposure, n_dark)):
        variance = exposure + read_noise_e**2
        total += (variance + exposure + 2 * variance**2 - 2 * exposure) / frames
    return total / (bright_exposure - dark_exposure) ** 2
