"""Pixels that do not follow the model: speed of their fit, and better maxima that the search passed by.

Signal-dependent noise, repeated frames, skewed noise, telegraph noise, nonlinearity and DNL, at read noises
of 0.15 to 0.6 e- and exposures of 0.05 to 10 e-. Histograms are drawn by numpy alone. What the fit found
is compared with climbs from a fine grid of gains and read noises, on poor pixels; a better maximum counts
where it is more than 0.1 nats above.

    python scripts/bench/bench_poor_fit.py             # two to three minutes
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.result import FitResult
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import FitStatus

Array = NDArray[np.float64]
KINDS = ("signal noise", "repeated frames", "skewed noise", "telegraph", "nonlinearity", "DNL", "good")
SCALES = np.geomspace(0.5, 2.0, 25)
NOISES = (0.2, 0.35, 0.5)


def electrons(rng: np.random.Generator, kind: str, h: float, noise: float, n: int) -> Array:
    """Return the signal of a pixel in e-, read noise included."""
    if kind == "repeated frames":
        n = n // 5
    k = rng.poisson(h, n).astype(np.float64)
    signal = k + noise * rng.standard_normal(n)
    if kind == "signal noise":
        signal += 0.15 * np.sqrt(k) * rng.standard_normal(n)
    elif kind == "repeated frames":
        signal = np.repeat(signal, 5)
    elif kind == "skewed noise":
        signal += noise * 0.8 * (rng.exponential(1.0, n) - 1.0)
    elif kind == "telegraph":
        signal += rng.choice([-1.0, 0.0, 1.0], p=[0.1, 0.8, 0.1], size=n) * 0.7
    elif kind == "nonlinearity":
        signal += 0.02 * k * (k - 1)
    return signal


def pixels(
    rng: np.random.Generator, kind: str, n: int, n_frames: int
) -> tuple[NDArray[np.uint16], NDArray[np.int64]]:
    """Return histograms of pixels of a kind."""
    values = []
    for _ in range(n):
        h, noise = float(np.exp(rng.uniform(np.log(0.05), np.log(10)))), rng.uniform(0.15, 0.6)
        dn = rng.uniform(95, 105) + rng.uniform(8, 14) * electrons(rng, kind, h, noise, n_frames)
        if kind == "DNL":
            dn += 0.25 * np.cos(np.pi * np.rint(dn))
        values.append(np.rint(dn).astype(np.int64))
    origin = np.array([each.min() - 1 for each in values])
    width = max(int(each.max() - first) for each, first in zip(values, origin, strict=True)) + 2
    counts = [np.bincount(each - first, minlength=width) for each, first in zip(values, origin, strict=True)]
    return np.array(counts, np.uint16), origin


def best_of_grid(counts: NDArray[np.uint16], origin: NDArray[np.int64], found: FitResult) -> Array:
    """Return the highest log-likelihood of climbs from many starts."""
    codes = origin[:, None] + np.arange(counts.shape[1])
    n = counts.sum(axis=1)
    mean = (counts * codes).sum(axis=1) / n
    variance = (counts * (codes - mean[:, None]) ** 2).sum(axis=1) / n
    own = np.where(np.isfinite(found.conversion_gain), 1 / found.conversion_gain, 0.5 * np.sqrt(variance))
    best = np.full(n.size, -np.inf)
    settings = FitSettings(tail_guard=0.0)
    for scale in SCALES:
        for noise in NOISES:
            step = own * scale
            h = variance / step**2 - noise**2
            start = np.stack([h, 1 / step, mean - h * step, noise * step], axis=1)
            start[~(h > 0.03)] = np.nan
            again = fit_histograms(counts, origin, settings=settings, start=start)
            fitted = np.isfinite(again.bias)
            best = np.where(fitted, np.fmax(best, again.log_likelihood), best)
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--pixels", type=int, default=2000, help="of each kind")
    parser.add_argument("--checked", type=int, default=200, help="of those, compared with the grid")
    parser.add_argument("--frames", type=int, nargs="*", default=[4000, 17_750, 1000])
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    settings = FitSettings(tail_guard=0.0)
    print(
        f"{'':18s}{'frames':>8s}{'poor':>8s}{'pixels/s':>10s}{'evaluations':>13s}{'checked':>9s}{'missed':>8s}"
    )
    for n_frames in options.frames:
        for kind in KINDS:
            counts, origin = pixels(rng, kind, options.pixels, n_frames)
            fit_histograms(counts[:8], origin[:8])
            seconds = []
            for _ in range(2):
                started = time.process_time()
                found = fit_histograms(counts, origin)
                seconds.append(time.process_time() - started)
            poor = (found.fit_status & int(FitStatus.POOR_FIT)) != 0
            some = np.flatnonzero(poor)[: options.checked]
            missed = 0
            if some.size:
                alone = fit_histograms(counts[some], origin[some], settings=settings)
                best = best_of_grid(counts[some], origin[some], alone)
                missed = int((np.isfinite(alone.bias) & (best > alone.log_likelihood + 0.1)).sum())
            rate, evaluations = counts.shape[0] / min(seconds), found.n_iterations.mean()
            print(
                f"{kind:18s}{n_frames:8d}{poor.mean():8.1%}{rate:10.0f}{evaluations:13.1f}{some.size:9d}{missed:8d}",
                flush=True,
            )


if __name__ == "__main__":
    main()
