"""How near the joint fit of several exposures comes to its Cramer-Rao bound, up to a read noise of 1 e-.

Prints a table: pixels are drawn from the exact quantised law at each read noise, fitted jointly,
and their errors compared with the joint bound: over all pixels that have a value, and over those with a good
fit (``fit_status`` 0); beside it one sample of the middle exposure with all the frames. Where fewer pixels
are good, a neighbouring gain was nearly as likely in the others, or was taken: those that are good are a
selection, so the ratio over all pixels says what the method does, and that over the good ones what a user
keeps. Between 0.42 and 0.55 e-, where the peaks of the brightest sample fade, no estimate reaches the bound:
it takes for certain which electron each of them belongs to, and its error in H3 is a tenth of an electron.

    python scripts/validation/joint_efficiency.py    # half a CPU minute
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from pchem_pipeline.compute.environment import prepare_environment

prepare_environment()
sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

import numpy as np  # noqa: E402
from helpers.bounds import cramer_rao  # noqa: E402
from helpers.plain_law import pcd_mass  # noqa: E402

from pchem_pipeline.model.fit.api import fit_histograms  # noqa: E402

NOISES = (0.2, 0.3, 0.4, 0.45, 0.5, 0.55, 0.6, 0.7, 0.8, 0.9, 1.0)
EXPOSURES = (0.5, 3.0, 12.0)
STEP, BIAS = 10.0, 100.3


def draw(rng, exposure, noise, n_pixels, n_frames):
    """Return histograms and their first DN, drawn from the exact law."""
    analog = np.sqrt(noise**2 - 1 / (12 * STEP**2))
    first = int(BIAS - 9 * noise * STEP)
    last = int(BIAS + (exposure + 9 * np.sqrt(exposure) + 9 + 9 * noise) * STEP)
    mass = pcd_mass(np.arange(first, last), exposure, 1 / STEP, BIAS, analog)
    counts = rng.multinomial(n_frames, mass / mass.sum(), size=n_pixels)
    return counts.astype(np.uint32), np.full(n_pixels, first)


def row(noise, n_pixels, n_frames):
    """Return a row of the table: simulated and fitted at one read noise; errors of g relative to g."""
    rng = np.random.default_rng(int(1000 * noise))
    exposures = (*EXPOSURES, 0.0)
    drawn = [draw(rng, exposure, noise, n_pixels, n_frames) for exposure in exposures]
    counts, origins = zip(*drawn, strict=True)
    found = fit_histograms(counts, origins, dark=[exposure == 0 for exposure in exposures])
    j = len(exposures)
    bound = np.sqrt(np.diagonal(cramer_rao(exposures, 1 / STEP, noise * STEP, n_frames)))
    errors = {
        j: found.conversion_gain - 1 / STEP,
        j + 1: found.bias - BIAS,
        j + 2: found.read_noise_dn - noise * STEP,
        2: found.quanta_exposure[:, 2] - EXPOSURES[2],
    }
    good = found.fit_status == 0
    of_all, of_good = (
        tuple(float(np.sqrt((values[chosen] ** 2).mean()) / bound[place]) for place, values in errors.items())
        for chosen in (np.isfinite(found.conversion_gain), good)
    )
    pulls = (errors[j] / np.sqrt(found.covariance[:, j, j]))[good]
    total = n_frames * j
    one = cramer_rao(EXPOSURES[1], 1 / STEP, noise * STEP, total)
    single = fit_histograms(*draw(rng, EXPOSURES[1], noise, n_pixels, total))
    error = single.conversion_gain * STEP - 1
    known = error[np.isfinite(error)]
    rmse = float(np.sqrt((known**2).mean())) if known.size else float("nan")
    good_alone = ((single.fit_status & ~np.uint16(64)) == 0).mean()
    alone = [100 * each for each in (np.sqrt(one[1, 1]) * STEP, rmse, good_alone)]
    return 100 * bound[j] * STEP, *of_all, *of_good, pulls.std(), 100 * good.mean(), *alone


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pixels", type=int, default=300)
    parser.add_argument("--frames", type=int, default=4000, help="of each sample")
    options = parser.parse_args()
    print(
        f"samples H = {EXPOSURES} e- and a bias, {options.frames} frames each, {options.pixels} pixels, "
        f"{STEP:g} DN/e-; one sample: H = {EXPOSURES[1]:g} with all {4 * options.frames} frames\n"
        f"a ratio is known to {1 / np.sqrt(2 * options.pixels):.3f}\n"
        "          joint bound   RMSE / bound, all pixels       good pixels                 pull   good |"
        " one sample: bound   RMSE   good\n"
        "   s_e     sd(g)/g %      g     mu  sigma     H3      g     mu  sigma     H3    sd(g)      % |"
        "       sd(g)/g %      %      %"
    )
    layout = "{:6.2f} {:13.3f} " + 8 * "{:6.3f} " + "{:8.3f} {:6.1f} | {:15.3f} {:6.2f} {:6.1f}"
    for noise in NOISES:
        print(layout.format(noise, *row(noise, options.pixels, options.frames)), flush=True)


if __name__ == "__main__":
    main()
