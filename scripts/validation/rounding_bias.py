"""Bias of the density's and of the exact estimates against the number of DN per electron, 0.7 to 20.

Prints a table. At each 1/g pixels with biases over a whole DN are drawn from the exact
quantised law and fitted with both likelihoods; beside it the bias that the density is predicted to have. All
in standard errors of one pixel, the median over the pixels of the four parameters, the largest of the four.

    python scripts/validation/rounding_bias.py    # a quarter of a CPU minute
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from pchem_pipeline.compute.environment import prepare_environment

prepare_environment()
sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np  # noqa: E402
from helpers.plain_law import pcd_mass  # noqa: E402

from pchem_pipeline.model.errors.expected_information import biased_by_rounding, rounding_bias  # noqa: E402
from pchem_pipeline.model.fit.api import fit_histograms  # noqa: E402
from pchem_pipeline.model.fit.settings import FitSettings  # noqa: E402

STEPS = (0.7, 0.85, 1.0, 1.2, 1.5, 1.8, 2.2, 2.7, 3.3, 4.0, 5.0, 7.0, 10.0, 14.0, 20.0)
NAMES = ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn")


def row(step, exposure, noise, n_pixels, n_frames):
    """Return biases (predicted, of both fits) and shares (fitted, good, named, %) at one number of DN per e-.

    The read noise is analog, e-.
    """
    rng = np.random.default_rng(int(1000 * step))
    bias = 100.0 + (np.arange(n_pixels) + 0.5) / n_pixels
    x = np.arange(int(95 - 9 * noise * step), int(106 + (exposure + 9 * np.sqrt(exposure) + 9) * step) + 5)
    mass = pcd_mass(x[None, :], exposure, 1 / step, bias[:, None], noise)
    counts = rng.multinomial(n_frames, mass / mass.sum(axis=1, keepdims=True)).astype(np.uint32)
    origin = np.full(n_pixels, x[0])
    truth = [np.full(n_pixels, exposure), np.full(n_pixels, 1 / step), bias]
    truth.append(np.full(n_pixels, np.sqrt((noise * step) ** 2 + 1 / 12)))
    frames = np.full(n_pixels, float(n_frames))
    plain = fit_histograms(counts, origin, settings=FitSettings(likelihood="density"))
    exact = fit_histograms(counts, origin, settings=FitSettings(likelihood="exact"), start=plain)
    errors = np.sqrt(np.diagonal(exact.covariance, axis1=1, axis2=2))
    good = exact.fit_status == 0
    predicted = np.abs(rounding_bias(truth, frames)).max(axis=1)
    shifts = []
    for fit in (plain, exact):
        usable = good & np.isfinite(fit.conversion_gain)
        medians = [
            np.median((getattr(fit, name) - truth[i])[usable] / errors[usable, i])
            if usable.sum() > 9
            else np.nan
            for i, name in enumerate(NAMES)
        ]
        shifts.append(float(np.max(np.abs(medians))))
    known = np.isfinite(plain.conversion_gain)
    named = biased_by_rounding([getattr(plain, name) for name in NAMES], frames)
    shares = known.mean(), good.mean(), named.sum() / max(known.sum(), 1)
    return np.median(predicted), *shifts, *(100 * share for share in shares)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pixels", type=int, default=400)
    parser.add_argument("--frames", type=int, default=17_750)
    parser.add_argument("--exposure", type=float, default=2.0, help="H, e-")
    parser.add_argument("--read-noise", type=float, default=0.3, help="analog, e-")
    options = parser.parse_args()
    print(
        f"H = {options.exposure:g} e-, analog read noise {options.read_noise:g} e-, {options.frames} frames, "
        f"{options.pixels} pixels; largest of the four median biases, in standard errors of a pixel "
        f"(noise: {2.2 * 1.2533 / np.sqrt(options.pixels):.2f})\n"
        "   1/g   density    density     exact   density    exact   named\n"
        "  DN/e- predicted    fitted    fitted   fitted %  good %  biased %"
    )
    for step in STEPS:
        biases = row(step, options.exposure, options.read_noise, options.pixels, options.frames)
        print("{:7.2f} {:9.3g} {:9.3g} {:9.3g} {:10.1f} {:7.1f} {:9.1f}".format(step, *biases), flush=True)


if __name__ == "__main__":
    main()
