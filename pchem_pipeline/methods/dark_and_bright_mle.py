"""Maximum likelihood of gain and exposure, bias and read noise taken from a dark sample."""

from __future__ import annotations

import numpy as np

from pchem_pipeline.methods.base import (
    Estimates,
    FloatArray,
    Method,
    PixelSamples,
    Sample,
    Settings,
    no_estimates,
    register_method,
)
from pchem_pipeline.methods.plain_em import first_start, run_em
from pchem_pipeline.model.law.pcd import log_pcd


@register_method
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
    remark = "electrons in the dark sample shift everything: it must be free of them"
    order = 20

    def estimate(self, pixels: PixelSamples, settings: Settings) -> Estimates:
        """Return the estimates from the darkest and the brightest sample."""
        order = pixels.by_brightness()
        dark, sample = pixels.samples[order[0]].moments(), pixels.samples[order[-1]]
        bright = sample.moments()
        noise = np.sqrt(np.maximum(dark.variance, 1e-6))
        best, best_score = no_estimates(pixels.n_pixels), np.full(pixels.n_pixels, -np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            transfer = (bright.mean - dark.mean) / (bright.variance - dark.variance)
        for gain in (transfer, first_start(sample)[:, 1]):
            start = np.stack([gain * (bright.mean - dark.mean), gain, dark.mean, noise], axis=1)
            start[~((start[:, 0] > 0) & (gain > 0))] = np.nan
            found, _ = run_em(sample, start, True, settings)
            score = log_likelihoods(sample, found)
            better = score > best_score
            best[better], best_score[better] = found[better], score[better]
        with np.errstate(invalid="ignore"):
            best[:, 0] = best[:, 1] * (pixels.samples[0].moments().mean - best[:, 2])
        bad = int(np.count_nonzero(~np.isfinite(best[:, 1])))
        return Estimates(best, {"no electrons seen above the dark sample": bad} if bad else {})


def log_likelihoods(sample: Sample, parameters: FloatArray) -> FloatArray:
    """Return the log-likelihood of every pixel, nats, shape (n,); minus infinity without parameters.

    Args:
        sample: histograms.
        parameters: (H, g, mu, sigma), shape (n, 4).
    """
    pixel, bins = np.nonzero(sample.counts)
    values = log_pcd(sample.origin[pixel] + bins, *parameters[pixel].T)
    total = np.bincount(pixel, sample.counts[pixel, bins] * values, minlength=sample.origin.size)
    return np.where(np.isfinite(total), total, -np.inf)
