"""Photon transfer from a series of exposures: the slope of variance against mean, pixel by pixel."""

from __future__ import annotations

import numpy as np

from pchem_pipeline.methods.base import (
    Estimates,
    FloatArray,
    Method,
    PixelSamples,
    Settings,
    no_estimates,
    register_method,
)


@register_method
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

    def estimate(self, pixels: PixelSamples, settings: Settings) -> Estimates:
        """Return the estimates from all samples."""
        found = [sample.moments() for sample in pixels.samples]
        mean, variance, n_frames = (
            np.stack([getattr(moments, name) for moments in found])
            for name in ("mean", "variance", "n_frames")
        )
        dark = mean[pixels.by_brightness()[0]]
        signal = mean - dark
        offset, slope = _line(signal, variance, np.ones_like(variance))
        floor = np.min(np.where(variance > 0, variance, np.inf), axis=0)
        model = np.maximum(offset + slope * signal, 0.1 * floor)
        with np.errstate(divide="ignore", invalid="ignore"):
            offset, slope = _line(signal, variance, n_frames / model**2)
        out = no_estimates(pixels.n_pixels)
        rising, positive = slope > 0, offset > 0
        out[rising, 1] = 1.0 / slope[rising]
        out[rising, 0] = out[rising, 1] * signal[0][rising]
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
        slope = (weights * (x - mean_x) * (y - mean_y)).sum(axis=0) / (weights * (x - mean_x) ** 2).sum(
            axis=0
        )
        return mean_y - slope * mean_x, slope
