"""Coverage of the intervals, calibration of the goodness of fit and cost of the tail guard, by simulation.

Pixels are drawn from the exact quantised mass on a grid of quanta exposure, read noise and number of frames,
10,000 in all, and fitted. Printed are

* the share of normal (estimate -+ z stderr) and profile-likelihood intervals that hold the truth, where
  ``fit_status`` is 0 once the pixels of a point were judged together, as the stage ``fit`` does, and its
  distance from nominal in standard errors (of the binomial law, by its exact tail); every point counts,
  however few of its pixels are good;
* the same where the read noise makes a sensor lose its good pixels, and for a sensor of unlike pixels: the
  share of good pixels one by one and together, and the largest distance in each case;
* the standard errors against the scatter of the estimates, with information and with sandwich errors;
* p-values of the goodness of fit: shares below 1 %, 5 %, 50 %, and pixels called misfits at a rate of false
  discoveries of 5 %;
* the tail guard: its share of clean samples, its cost in efficiency, and how far outliers move the estimates
  with and without it.

    python scripts/validation/uncertainties.py            # a CPU minute, kernels compiled
    python scripts/validation/uncertainties.py --quick    # a tenth of the pixels
"""

from __future__ import annotations

import argparse
import itertools
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import bdtr, bdtrc, ndtri

from pchem_pipeline.compute.environment import prepare_environment

prepare_environment()
sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from helpers.drawn_pixels import Drawn  # noqa: E402
from helpers.plain_law import pcd_mass  # noqa: E402

from pchem_pipeline.model.arithmetic.statistics import false_discovery  # noqa: E402
from pchem_pipeline.model.checks.shrinkage import Judged, NoisePool, noise_of  # noqa: E402
from pchem_pipeline.model.fit.api import fit_histograms  # noqa: E402
from pchem_pipeline.model.fit.result import FitResult, quantile_of  # noqa: E402
from pchem_pipeline.model.fit.settings import FitSettings  # noqa: E402
from pchem_pipeline.model.fit.status import FitStatus  # noqa: E402

Array = NDArray[np.float64]
NAMES = ("H", "g", "mu", "sigma", "s_e")
LEVELS = (0.68, 0.95)
STEP = 11.0  # DN per electron
GRID = tuple(itertools.product((0.1, 0.5, 2.0, 8.0), (0.2, 0.3, 0.4, 0.48), (2_000, 17_750)))
GUARD_OFF = FitSettings(tail_guard=0)


def electron_noise(fit: FitResult) -> tuple[Array, Array]:
    """Return s_e = g sigma of each pixel and its standard error, e-."""
    of_gain, of_sigma = np.sqrt(fit.covariance[:, 1, 1]), np.sqrt(fit.covariance[:, 3, 3])
    together = fit.covariance[:, 1, 3] / (of_gain * of_sigma)
    return noise_of(fit.conversion_gain, fit.read_noise_dn, of_gain, of_sigma, together)


def judge_together(fit: FitResult) -> FitResult:
    """Return the fit of a sensor's pixels with the word of those that are weakly identified."""
    pixels = Judged(*electron_noise(fit), fit.likelihood_gap)
    pool = NoisePool.of(pixels)
    if pool is None:
        return fit
    word = np.where(np.logical_or(*pool.reasons(pixels, FitSettings())), int(FitStatus.WEAKLY_IDENTIFIED), 0)
    return replace(fit, fit_status=fit.fit_status | word.astype(np.uint16))


def draw(
    rng: np.random.Generator,
    n: int,
    exposure: ArrayLike,
    noise: ArrayLike,
    n_frames: int,
    spread: tuple[float, ...] = (1.0,),
) -> Drawn:
    """Draw pixels of one kind whose bias lies anywhere between two DN.

    ``exposure`` and ``noise`` are in e-, one or (n,), quantisation included; ``spread`` holds factors of the
    exposure, equally likely in each frame.
    """
    bias = rng.uniform(100.0, 101.0, n)
    light, noises = (np.broadcast_to(np.asarray(values, np.float64), n) for values in (exposure, noise))
    analog = np.sqrt(noises**2 - 1.0 / (12.0 * STEP**2))
    loudest, most = float(noises.max()), float(light.max())
    first = int(np.floor(100.0 - 9.0 * loudest * STEP))
    width = int((most + 11.0 * np.sqrt(most) + 12.0 + 18.0 * loudest) * STEP)
    codes = first + np.arange(width)
    columns = [values[:, None] for values in (light, bias, analog)]
    parts = [pcd_mass(codes, columns[0] * each, 1.0 / STEP, *columns[1:]) for each in spread]
    mass = np.mean(parts, axis=0)
    counts = rng.multinomial(n_frames, mass / mass.sum(axis=1, keepdims=True)).astype(np.uint32)
    truth = np.column_stack([light, np.full(n, 1.0 / STEP), bias, noises * STEP])
    return Drawn(counts, np.full(n, first, np.int64), truth)


def inside(truth: Array, low: Array, high: Array) -> NDArray[np.bool_]:
    """Tell which intervals hold the truth."""
    return (low <= truth) & (truth <= high)


def coverage(pixels: Drawn, fit: FitResult) -> tuple[int, Array]:
    """Return the number of good pixels and the covered shares by kind (normal, profile), level, quantity."""
    good = fit.fit_status == 0
    if not good.any():
        return 0, np.full((2, len(LEVELS), len(NAMES)), np.nan)
    noise, stderr = electron_noise(fit)
    values = np.column_stack([fit.columns, noise])[good]
    errors = np.column_stack([np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2)), stderr])[good]
    truth = np.column_stack([pixels.truth, pixels.truth[:, 1] * pixels.truth[:, 3]])[good]
    found = np.empty((2, len(LEVELS), len(NAMES)))
    for place, level in enumerate(LEVELS):
        z = quantile_of(level)
        found[0, place] = inside(truth, values - z * errors, values + z * errors).mean(axis=0)
        settings = FitSettings(intervals="profile", interval_level=level)
        profile = fit_histograms(pixels.counts, pixels.origin, settings=settings).intervals
        assert profile is not None
        ends = profile[good]
        found[1, place] = inside(truth, ends[:, :, 0], ends[:, :, 1]).mean(axis=0)
    return int(good.sum()), found


def print_coverage(rng: np.random.Generator, n: int) -> None:
    """Print the coverage at each point of the grid and over all of it."""
    print(f"\nCoverage of nominal 68 % and 95 % intervals in %, {n} pixels a point, fit_status 0 only")
    head = "".join(f"{name:>7s}" for name in NAMES)
    print(f"{'H':>5s}{'s_e':>6s}{'N':>7s}{'good':>6s} {'':8s}|{head} |{head}")
    total, worst = 0, np.zeros(2)
    sums = np.zeros((2, len(LEVELS), len(NAMES)))
    for exposure, noise, n_frames in GRID:
        pixels = draw(rng, n, exposure, noise, n_frames)
        good, found = coverage(pixels, judge_together(fit_histograms(pixels.counts, pixels.origin)))
        if good == 0:
            print(f"{exposure:5g}{noise:6.2f}{n_frames:7d}{good:6d}")
            continue
        for kind, rows in zip(("normal", "profile"), found, strict=True):
            cells = " |".join("".join(f"{100 * v:7.1f}" for v in row) for row in rows)
            print(f"{exposure:5g}{noise:6.2f}{n_frames:7d}{good:6d} {kind:8s}|{cells}")
        total += good
        sums += good * found
        worst = np.maximum(worst, np.abs(deviations(found, good)).max(axis=(1, 2)))
    for kind, rows, far in zip(("normal", "profile"), sums / total, worst, strict=True):
        cells = " |".join("".join(f"{100 * v:7.2f}" for v in row) for row in rows)
        print(f"{'all':18s}{total:6d} {kind:8s}|{cells}")
        off = " |".join("".join(f"{v:7.1f}" for v in row) for row in deviations(rows, total))
        print(f"{'standard errors from nominal':33s}|{off}; at most {far:.1f} at a point")


def print_edges(rng: np.random.Generator, n: int) -> None:
    """Print the share of good pixels and how far coverage is from nominal where good ones grow few."""
    print(
        f"\nWhere good pixels grow few, {n} pixels a row: share of good ones in %, and the largest distance"
    )
    print("of normal and profile coverage from nominal in standard errors, judged one by one and together")
    far = f"{'normal':>8s}{'profile':>8s}"
    print(f"{'H':>12s}{'s_e':>14s}{'N':>7s} | one by one{far} | together {far}")
    points = itertools.product((2.0, 8.0), np.arange(0.36, 0.525, 0.02), (2_000, 17_750))
    rows: list[tuple[str, str, ArrayLike, ArrayLike, int]] = [
        (f"{exposure:g}", f"{noise:.2f}", exposure, noise, n_frames) for exposure, noise, n_frames in points
    ]
    for spread in (0.05, 0.15):
        light, noises = np.exp(rng.normal(np.log(2.0), 0.4, n)), np.exp(rng.normal(np.log(0.4), spread, n))
        rows += [("2 -+ 40 %", f"0.4 -+ {100 * spread:.0f} %", light, noises, m) for m in (2_000, 17_750)]
    for light_words, noise_words, light, noises, n_frames in rows:
        pixels = draw(rng, n, light, noises, n_frames)
        fit = fit_histograms(pixels.counts, pixels.origin)
        cells = []
        for each in (fit, judge_together(fit)):
            good, found = coverage(pixels, each)
            distance = np.abs(deviations(found, good)).max(axis=(1, 2)) if good else (np.nan, np.nan)
            cells.append(f"{100 * good / n:9.1f} {distance[0]:8.1f}{distance[1]:8.1f}")
        print(f"{light_words:>12s}{noise_words:>14s}{n_frames:7d} | {' | '.join(cells)}")


def deviations(shares: Array, n: int) -> Array:
    """Return how far covered shares of n are from nominal, levels before the last axis.

    The probability of a share as small or smaller (large or larger) under the nominal level, told as that
    many standard deviations of a normal law; 0 where it is above a half.
    """
    level = np.broadcast_to(np.array(LEVELS)[:, None], shares.shape)
    held = np.rint(shares * n)
    below, above = bdtr(held, n, level), np.where(held > 0, bdtrc(np.maximum(held - 1, 0), n, level), 1.0)
    tail = np.clip(np.minimum(below, above), 1e-300, 0.5)
    return np.where(below < above, 1.0, -1.0) * ndtri(tail)


def print_errors(rng: np.random.Generator, n: int) -> None:
    """Print standard errors over the scatter of the estimates, with the model right and wrong."""
    print(f"\nMedian standard error over the scatter of the estimates, {n} pixels, H = 2, N = 17,750")
    print(f"{'samples':34s}{'errors':13s}" + "".join(f"{name:>8s}" for name in NAMES[:4]))
    for words, spread in (("of a PCD", (1.0,)), ("of two exposures, 1.2 and 2.8 e-", (0.6, 1.4))):
        pixels = draw(rng, n, 2.0, 0.3, 17_750, spread)
        fit = fit_histograms(pixels.counts, pixels.origin, settings=GUARD_OFF)
        values = fit.columns
        values[:, 2] -= pixels.truth[:, 2]
        scatter = values.std(axis=0)
        settings = GUARD_OFF.model_copy(update={"errors": "sandwich"})
        sandwich = fit_histograms(pixels.counts, pixels.origin, settings=settings).covariance
        for name, covariance in (("information", fit.covariance), ("sandwich", sandwich)):
            errors = np.median(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)), axis=0)
            print(f"{words:34s}{name:13s}" + "".join(f"{v:8.3f}" for v in errors / scatter))


def print_goodness(rng: np.random.Generator, n: int) -> None:
    """Print how uniform the p-values are on clean pixels, and what false-discovery control makes of them."""
    print(
        f"\nGoodness of fit of clean pixels, {n} a point: share of p below 1, 5, 50 % (in %); misfits at 5 %"
    )
    print(f"{'H':>5s}{'s_e':>6s}{'N':>7s}{'1 %':>8s}{'5 %':>8s}{'50 %':>8s}{'misfits':>9s}")
    for exposure, noise, n_frames in (
        (0.1, 0.2, 600),
        (2.0, 0.3, 600),
        (0.1, 0.3, 17_750),
        (2.0, 0.3, 17_750),
    ):
        pixels = draw(rng, n, exposure, noise, n_frames)
        p = fit_histograms(pixels.counts, pixels.origin).goodness_p
        shares = "".join(f"{100 * np.nanmean(p < limit):8.2f}" for limit in (0.01, 0.05, 0.5))
        misfits = int((false_discovery(p) <= 0.05).sum())
        print(f"{exposure:5g}{noise:6.2f}{n_frames:7d}{shares}{misfits:9d}")
    print(f"standard errors of the shares: {100 * np.sqrt(0.01 * 0.99 / n):.2f}, ", end="")
    print(f"{100 * np.sqrt(0.05 * 0.95 / n):.2f}, {50 / np.sqrt(n):.2f}")


def print_guard(rng: np.random.Generator, n: int) -> None:
    """Print what the tail guard costs on clean pixels, and what it is worth on others."""
    print(f"\nTail guard: {n} clean pixels a point, then the same with 5 outliers in each")
    head = "".join(f"{name:>8s}" for name in NAMES[:4])
    print(f"{'H':>5s}{'s_e':>6s}{'N':>7s}{'hit':>8s}{'cost %':>8s} | on:{head} | off:{head}")
    for exposure, noise, n_frames in (
        (0.1, 0.2, 17_750),
        (2.0, 0.3, 17_750),
        (2.0, 0.3, 2_000),
        (8.0, 0.4, 17_750),
    ):
        pixels = draw(rng, n, exposure, noise, n_frames)
        on = fit_histograms(pixels.counts, pixels.origin)
        off = fit_histograms(pixels.counts, pixels.origin, settings=GUARD_OFF)
        errors = np.sqrt(np.diagonal(off.covariance, axis1=1, axis2=2))
        mean_square = [np.nanmean(((fit.columns - pixels.truth) / errors) ** 2, axis=0) for fit in (on, off)]
        cost = 100.0 * (mean_square[0] / mean_square[1] - 1.0).max()
        hit, good = spoiled(rng, pixels), off.fit_status == 0
        shifts = []
        for settings, clean in ((FitSettings(), on), (GUARD_OFF, off)):
            moved = fit_histograms(hit.counts, hit.origin, settings=settings).columns - clean.columns
            shifts.append(np.nanquantile(np.abs(moved / errors)[good], 0.99, axis=0))
        cells = [" ".join(f"{v:7.3f}" for v in row) for row in shifts]
        share = np.mean(on.outlier_share > 0)
        words = f"{exposure:5g}{noise:6.2f}{n_frames:7d}{share:8.4f}{cost:8.3f}"
        print(f"{words} |     {cells[0]} |      {cells[1]}")
    print("hit: share of clean pixels that lose a sample; cost: rise of the mean square error of the worst")
    print("parameter; guard on and off: shift by the outliers that 99 % of the good pixels stay below, s.e.")


def spoiled(rng: np.random.Generator, pixels: Drawn) -> Drawn:
    """Add 5 frames anywhere up to 400 DN beyond either end of each histogram."""
    n, width = pixels.counts.shape
    counts = np.zeros((n, width + 800), np.uint32)
    counts[:, 400 : 400 + width] = pixels.counts
    for row in counts:
        places = np.concatenate([rng.integers(0, 380, 2), rng.integers(width + 420, width + 800, 3)])
        np.add.at(row, places, 1)
    return Drawn(counts, pixels.origin - 400, pixels.truth)


def main() -> None:
    layout = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=layout)
    parser.add_argument("--pixels", type=int, default=10_000, help="pixels of the coverage study")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="a tenth of the pixels")
    options = parser.parse_args()
    share = 10 if options.quick else 1
    rng = np.random.default_rng(options.seed)
    print_coverage(rng, max(30, options.pixels // share // len(GRID)))
    print_edges(rng, max(100, options.pixels // share // 20))
    print_errors(rng, 2000 // share)
    print_goodness(rng, 4000 // share)
    print_guard(rng, 2000 // share)


if __name__ == "__main__":
    main()
