"""Maximum likelihood of gain and exposure, bias and read noise taken from a dark sample."""

from __future__ import annotations

import numpy as np

from pchem_pipeline.methods.base import Estimates, Method, PixelSamples
from pchem_pipeline.methods.plain_em import closed_form_start, run_em
from pchem_pipeline.methods.settings import MethodsSettings


class DarkAndBrightMle(Method):
    """Maximise the likelihood of the bright sample over H and g, mu and sigma held at those of the dark one.

    After Nakamoto and Hotaka 2022 (Opt. Express 30, 37493; European patent application EP 4 358 533): the
    gain of a photon-counting pixel by maximum likelihood under Poisson electrons and Gaussian readout noise,
    from fewer frames than resolved peaks need. Here mean and standard deviation of the darkest sample are
    taken for mu and sigma, as if it held no electrons. Both starting points, that of photon transfer and that
    of the characteristic function, are climbed by EM steps and the likelier end is kept.
    """

    name = "dark_and_bright_mle"
    title = "MLE with a dark sample"
    source = "after Nakamoto and Hotaka 2022, Opt. Express 30, 37493"
    needs = "a dark and a bright sample"
    remark = "biased by electrons in the dark sample"
    order = 20

    def estimate(self, pixels: PixelSamples, settings: MethodsSettings) -> Estimates:
        """Return the estimates from the darkest and the brightest sample."""
        order = pixels.by_brightness()
        dark, sample = pixels.samples[order[0]].moments(), pixels.samples[order[-1]]
        bright = sample.moments()
        noise = np.sqrt(np.maximum(dark.variance, 1e-6))
        with np.errstate(divide="ignore", invalid="ignore"):
            transfer = (bright.mean - dark.mean) / (bright.variance - dark.variance)
        ends = []
        for gain in (transfer, closed_form_start(sample)[:, 1]):
            start = np.stack([gain * (bright.mean - dark.mean), gain, dark.mean, noise], axis=1)
            start[~((start[:, 0] > 0) & (gain > 0))] = np.nan
            ends.append(run_em(sample, start, True, settings)[0])
        best = sample.likeliest(np.stack(ends, axis=1))
        with np.errstate(invalid="ignore"):
            best[:, 0] = best[:, 1] * (pixels.samples[0].moments().mean - best[:, 2])
        bad = ~np.isfinite(best[:, 1])
        return Estimates.where(best, {"no electrons above the dark sample": bad})
