"""The photon counting histogram (PCH) method: distances of peaks, and the valley between them."""

from __future__ import annotations

import numpy as np

from pchem_pipeline.methods import peak_valley_numba
from pchem_pipeline.methods.base import (
    Estimates,
    FloatArray,
    Method,
    PixelSamples,
    Settings,
    no_estimates,
    register_method,
)
from pchem_pipeline.methods.plain_em import first_start
from pchem_pipeline.model.law.inputs import kernel_counts

_SMOOTHING = 0.12  # standard deviation of the smoothing in units of the distance of two peaks


@register_method
class PeakValley(Method):
    """Gain from the distance of the peaks, read noise from the valley-peak modulation (VPM).

    Starkey and Fossum 2016 (IEEE J. Electron Devices Soc. 4, 129): the histogram is smoothed and its peaks
    are found; the slope of their places against k is 1/g, the place at k = 0 is the bias; the heights P of
    neighbouring peaks give ``H = (k + 1) P[k + 1] / P[k]``; and ``VPM = 1 - P_valley / P_peak`` gives the
    read noise, since half-way between two peaks their tails add up to ``1 - VPM = 2 exp(-1 / (8 s_e^2))``.
    That leaves out all other peaks (Hendrickson and Haefner 2026, arXiv 2603.01199). Here the smoothing is a
    Gaussian of 0.12 of the distance that the characteristic function suggests, and its variance is taken off
    again; the lowest peak found is taken for that of no electron. Above 0.425 e- the VPM of two peaks is 0;
    what still looks like peaks there is the tails of the others.
    """

    name = "peak_valley"
    title = "PCH peaks and valleys (VPM)"
    source = "Starkey and Fossum 2016, IEEE J. Electron Devices Soc. 4, 129"
    needs = "one sample"
    remark = "peaks must be resolved (below about 0.3 e-), and the lowest must be that of no electron"
    order = 41

    def estimate(self, pixels: PixelSamples, settings: Settings) -> Estimates:
        """Return the estimates from the first sample."""
        sample = pixels.samples[0]
        spacing = 1.0 / first_start(sample)[:, 1]
        spacing[~(spacing < 0.5 * sample.counts.shape[1])] = np.nan
        width = np.maximum(_SMOOTHING * spacing, 0.3)
        found = np.full((pixels.n_pixels, 5), np.nan)
        peak_valley_numba.peaks_tile(kernel_counts(sample.counts), spacing, width, found)
        _, step, first, exposure, valley = found.T
        out = no_estimates(pixels.n_pixels)
        resolved = step > 0
        out[resolved, 0] = exposure[resolved]
        out[resolved, 1] = 1.0 / step[resolved]
        out[resolved, 2] = sample.origin[resolved] + first[resolved]
        with np.errstate(invalid="ignore"):
            variance = (read_noise_of_valley(valley) * step) ** 2 - width**2
            noisy = resolved & (variance > 0)
        out[noisy, 3] = np.sqrt(variance[noisy])
        fewer, flat = int(np.count_nonzero(~resolved)), int(np.count_nonzero(resolved & ~noisy))
        reasons = {"fewer than two peaks": fewer, "no valley between the peaks": flat}
        return Estimates(out, {words: n for words, n in reasons.items() if n})


def read_noise_of_valley(valley_over_peak: FloatArray) -> FloatArray:
    """Return the read noise in e- of ``1 - VPM``: ``sqrt(1 / (8 ln(2 / (1 - VPM))))``; NaN from 1 on."""
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where((valley_over_peak > 0) & (valley_over_peak < 1), valley_over_peak, np.nan)
        return np.asarray(np.sqrt(1.0 / (8.0 * np.log(2.0 / share))))
