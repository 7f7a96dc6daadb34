"""PCH-EM in the plain form of the paper: one start, EM steps, a stop on small changes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.methods import plain_em_numba
from pchem_pipeline.methods.base import Estimates, FloatArray, Method, PixelSamples, Sample, Settings
from pchem_pipeline.model.fit.starts import starting_points
from pchem_pipeline.model.law.inputs import kernel_counts


class PlainEm(Method):
    """EM alone, eqs. (update_eqns) to (gamma_nk) of Hendrickson et al. 2023.

    One starting point in closed form; it stops when no parameter changes relatively by more than a tolerance
    from one step to the next, or after a number of steps. EM slows down with the read noise (its error falls
    by a factor near 1 per step above 0.4 e-), so there it stops early, still near its start; and it never
    leaves a local maximum that is off by one electron.
    """

    name = "plain_em"
    title = "PCH-EM, plain EM of the paper"
    source = "Hendrickson et al. 2023, eqs. (update_eqns) to (gamma_nk)"
    needs = "one sample"
    remark = "does not converge above about 0.4 e- read noise"
    order = 11

    def estimate(self, pixels: PixelSamples, settings: Settings) -> Estimates:
        """Return where EM stops, in the first sample."""
        sample = pixels.samples[0]
        start = closed_form_start(sample)
        parameters, steps = run_em(sample, start, False, settings)
        reasons = {
            "no starting point": ~np.isfinite(start[:, 1]),
            "EM left the allowed range": steps < 0,
            "stopped at the largest number of steps": steps == settings.em_iterations,
        }
        return Estimates.where(parameters, reasons)


def closed_form_start(sample: Sample) -> FloatArray:
    """Return the likeliest closed-form start of each pixel, (H, g, mu, sigma), shape (n, 4), or NaN."""
    return sample.likeliest(starting_points(sample.counts, sample.origin))


def run_em(
    sample: Sample, start: FloatArray, only_light: bool, settings: Settings
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Run EM from given points.

    Args:
        sample: histograms of n pixels.
        start: (H, g, mu, sigma), shape (n, 4), NaN where there is none.
        only_light: bias and read noise are known, H and g are looked for.
        settings: when to stop.

    Returns:
        (H, g, mu, sigma), NaN without a result, and the steps taken (negative: out of range; 0: no start).
    """
    inner = start.copy()
    inner[:, 1] = 1.0 / start[:, 1]
    inner[:, 2] = start[:, 2] - sample.origin
    steps = np.zeros(start.shape[0], np.int64)
    plain_em_numba.em_tile(
        kernel_counts(sample.counts), inner, only_light, settings.em_iterations, settings.em_tolerance, steps
    )
    found = inner.copy()
    found[:, 1] = 1.0 / inner[:, 1]
    found[:, 2] = inner[:, 2] + sample.origin
    return found, steps
