"""The photon counting histogram (PCH) method: distances of peaks, and the valley between them."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

from pchem_pipeline.base.arrays import FloatArray, IntegerArray
from pchem_pipeline.methods.base import Estimates, Method, PixelSamples, no_estimates
from pchem_pipeline.methods.plain_em import closed_form_start
from pchem_pipeline.methods.settings import MethodsSettings


class PeakValley(Method):
    """Gain from the distance of the peaks, read noise from the valley-peak modulation (VPM).

    Starkey and Fossum 2016 (IEEE J. Electron Devices Soc. 4, 129): the histogram is smoothed and its peaks
    are found; the slope of their places against k is 1/g, the place at k = 0 is the bias; the heights P of
    neighbouring peaks give ``H = (k + 1) P[k + 1] / P[k]``; and ``VPM = 1 - P_valley / P_peak`` gives the
    read noise, since half-way between two peaks their tails add up to ``1 - VPM = 2 exp(-1 / (8 s_e^2))``.
    That leaves out all other peaks (Hendrickson and Haefner 2026, arXiv 2603.01199). Here the smoothing is a
    Gaussian of 0.12 of the distance that the likeliest closed-form start has, and its variance is taken off
    again; the lowest peak found is taken for that of no electron. Above 0.425 e- the VPM of two peaks is 0;
    what still looks like peaks there is the tails of the others.
    """

    name = "peak_valley"
    title = "PCH peaks and valleys (VPM)"
    source = "Starkey and Fossum 2016, IEEE J. Electron Devices Soc. 4, 129"
    needs = "one sample"
    remark = "needs resolved peaks (read noise below about 0.3 e-), the lowest at zero electrons"
    order = 41

    def estimate(self, pixels: PixelSamples, settings: MethodsSettings) -> Estimates:
        """Return the estimates from the first sample."""
        sample = pixels.samples[0]
        spacing = 1.0 / closed_form_start(sample)[:, 1]
        spacing[~(spacing < 0.5 * sample.counts.shape[1])] = np.nan
        width = np.maximum(0.12 * spacing, 0.3)  # of the smoothing, a share of the distance of two peaks
        found = no_estimates(pixels.n_pixels)
        for pixel in np.flatnonzero(np.isfinite(spacing)):
            found[pixel] = comb(sample.counts[pixel], spacing[pixel], width[pixel])
        step, first, exposure, valley = found.T
        out = no_estimates(pixels.n_pixels)
        resolved = step > 0
        out[resolved, 0] = exposure[resolved]
        out[resolved, 1] = 1.0 / step[resolved]
        out[resolved, 2] = sample.origin[resolved] + first[resolved]
        with np.errstate(invalid="ignore"):
            variance = (read_noise_of_valley(valley) * step) ** 2 - width**2
            noisy = resolved & (variance > 0)
        out[noisy, 3] = np.sqrt(variance[noisy])
        flat = resolved & ~noisy
        return Estimates.where(out, {"fewer than two peaks": ~resolved, "no valley between the peaks": flat})


def comb(counts: IntegerArray, spacing: float, width: float) -> tuple[float, float, float, float]:
    """Return distance and first place of the peaks, bins, H, and the height of a valley over its peaks.

    A peak counts where it is above the valley beside it by three times the scatter of the smoothed counts.
    The histogram has shape (B,); the first guess of the distance, and the standard deviation of the
    smoothing, are in bins.
    """
    values = gaussian_filter1d(counts.astype(np.float64), width, mode="constant")
    tops, facts = find_peaks(values, prominence=0.0, distance=max(1.0, 0.6 * spacing))
    rise = facts["prominences"]
    noise = 0.5 / (np.sqrt(np.pi) * width)  # share of a count's variance that smoothing leaves
    tops = tops[rise > 3.0 * np.sqrt(noise * (2.0 * values[tops] - rise))]
    if tops.size < 2:
        return (np.nan,) * 4
    # a parabola through three logarithms
    left, middle, right = np.log(np.maximum(values[tops + np.array([[-1], [0], [1]])], 1e-300))
    shift = 0.5 * (left - right) / np.minimum(left - 2.0 * middle + right, -1e-300)
    places, heights = tops + shift, np.exp(middle - 0.25 * (left - right) * shift)
    number = np.rint((places - places[0]) / spacing)
    step, first = np.polyfit(number, places, 1, w=np.sqrt(heights))
    k = min(int(heights.argmax()), tops.size - 2)
    half = np.interp(0.5 * (places[k] + places[k + 1]), np.arange(values.size), values)
    exposure = (number[k] + 1.0) * heights[k + 1] / heights[k]
    return float(step), float(first), float(exposure), float(half / heights[k : k + 2].mean())


def read_noise_of_valley(valley_over_peak: FloatArray) -> FloatArray:
    """Return the read noise in e- of ``1 - VPM``: ``sqrt(1 / (8 ln(2 / (1 - VPM))))``; NaN from 1 on."""
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where((valley_over_peak > 0) & (valley_over_peak < 1), valley_over_peak, np.nan)
        return np.asarray(np.sqrt(1.0 / (8.0 * np.log(2.0 / share))))
