"""The system gain K of EMVA 1288: one number for the whole sensor."""

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

_LINEAR_RANGE = 0.7  # of the saturation, EMVA 1288 release 3.1, section on sensitivity


@register_method
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

    def estimate(self, pixels: PixelSamples, settings: Settings) -> Estimates:
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
            linear = signal <= _LINEAR_RANGE * (pixels.adc_limits[1] - mean[dark])
        out = no_estimates(pixels.n_pixels)
        steepness = float((signal * noise)[linear].sum())
        if steepness <= 0:
            return Estimates(out, {"variance does not increase with the mean": pixels.n_pixels})
        gain = float((signal**2)[linear].sum()) / steepness
        out[:] = (gain * signal[0], gain, np.nan, np.sqrt(variance[dark]))
        out[:, 2] = found[dark].mean
        return Estimates(out)
