"""How well the fitted maps predict the ensemble: RMSE of every curve beside its sampling-noise floor.

    python scripts/bench/bench_ensemble.py --size 512 --frames 17750 --chosen 250

A sensor like the paper's is drawn (median read noise 0.305 e-, gain and read noise correlated, a tail of
hot pixels). The histogram of each pixel is drawn from its exact masses, rounding included, fitted by
PCH-EM, and the ensemble of the chosen frames is compared with its predictions. The paper's RMSEs are
1.9e-4 per DN (raw, dependent), 8.3e-4 (independent), 2.3e-4 and 2.7e-4 per e- (NUCed).
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.checks.residuals import central_window, noise_floor, rmse
from pchem_pipeline.model.electrons.electrons import KnownPixels, Outcomes, number_tables
from pchem_pipeline.model.ensemble.ensemble import DnAxis, mass_sums, nuced_axis, tally
from pchem_pipeline.model.ensemble.ensemble_binned import (
    epcd_dependent,
    epcd_independent,
    nuced_dependent,
    nuced_independent,
)
from pchem_pipeline.model.ensemble.settings import EnsembleSettings
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.law.parameters import UsablePixels
from pchem_pipeline.model.law.sample_law import SampleLaw
from pchem_pipeline.simulate.maps import draw_truth
from pchem_pipeline.simulate.settings import SimulateSettings

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from helpers.plain_law import pcd_mass

_CHUNK = 4096
PAPER = {
    "epcd_dependent": 1.9e-4,
    "epcd_independent": 8.3e-4,
    "nuced_dependent": 2.3e-4,
    "nuced_independent": 2.7e-4,
}


def counting_variance(
    total: NDArray[np.float64], square: NDArray[np.float64], n_pixels: int, n_frames: int, width: float = 1.0
) -> NDArray[np.float64]:
    """Return the variance of the density of an ensemble histogram from sums of probabilities over pixels."""
    return np.maximum(total - square, 0.0) / (n_frames * (n_pixels * width) ** 2)


@dataclass
class Clock:
    """CPU seconds of each step."""

    steps: dict[str, float]

    def lap(self, name: str, start: float) -> None:
        """Add the CPU time since ``start`` to a step."""
        self.steps[name] = self.steps.get(name, 0.0) + time.process_time() - start


@dataclass
class Chunk:
    """Some pixels: histograms of the chosen and of all frames, and their fits."""

    origin: NDArray[np.int64]
    chosen: NDArray[np.integer[Any]]
    all_frames: NDArray[np.integer[Any]]
    fitted: tuple[NDArray[np.float64], ...]


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--size", type=int, default=512, help="rows and columns of the sensor")
    parser.add_argument("--frames", type=int, default=17_750, help="frames that the fit sees")
    parser.add_argument("--chosen", type=int, default=250, help="frames in the ensemble, among them")
    parser.add_argument("--bins", type=int, default=EnsembleSettings().parameter_bins)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    clock = Clock({})
    chunks = simulate_and_fit(args.size, args.frames, args.chosen, args.seed, clock)
    compare(chunks, args.frames, args.chosen, args.bins, clock)
    print("\nCPU seconds")
    for name, seconds in clock.steps.items():
        print(f"  {name:<44}{seconds:8.2f}")


def simulate_and_fit(size: int, n_frames: int, n_chosen: int, seed: int, clock: Clock) -> list[Chunk]:
    """Draw the sensor and its histograms, and fit them; pixels of like range together."""
    truth = draw_truth(SimulateSettings(shape=(size, size), seed=seed))
    exposure, gain = truth.quanta_exposure.ravel(), truth.conversion_gain.ravel()
    bias, noise = truth.bias.ravel(), truth.analog_read_noise_e.ravel()
    rng = np.random.default_rng(seed)
    order = np.argsort(exposure / gain)
    chunks = []
    for start in range(0, order.size, _CHUNK):
        part = order[start : start + _CHUNK]
        h, g, mu, s = exposure[part], gain[part], bias[part], noise[part]
        began = time.process_time()
        reach = 7.0 * s / g + 2
        origin = np.floor(mu - reach).astype(np.int64)
        span = np.ceil((h + 8 * np.sqrt(h) + 12) / g + 2 * reach).astype(int)
        dn = origin[:, None] + np.arange(span.max())
        mass = pcd_mass(dn, h[:, None], g[:, None], mu[:, None], s[:, None])
        mass /= mass.sum(axis=1, keepdims=True)
        chosen = rng.multinomial(n_chosen, mass)
        all_frames = (chosen + rng.multinomial(n_frames - n_chosen, mass)).astype(np.uint16)
        clock.lap("draw histograms", began)
        began = time.process_time()
        fit = fit_histograms(all_frames, origin)
        clock.lap("fit", began)
        fitted = fit.maps
        chunks.append(Chunk(origin, chosen.astype(np.uint16), all_frames, fitted))
    return chunks


def compare(chunks: list[Chunk], n_frames: int, n_chosen: int, bins: int, clock: Clock) -> None:
    """Print every RMSE with its floor."""
    columns = zip(*(chunk.fitted for chunk in chunks), strict=True)
    pixels, mask = UsablePixels.from_maps([np.concatenate(each) for each in columns])
    low = min(int(chunk.origin.min()) for chunk in chunks)
    high = max(int(_last(chunk)) for chunk in chunks)
    dn = DnAxis(low, high - low + 1)
    axis = nuced_axis(pixels, dn)
    n = len(pixels)
    print(f"{mask.size} pixels, {mask.size - n} without a value; {n_chosen} of {n_frames} frames")
    print(f"median read noise {np.median(pixels.read_noise_e):.4f} e-, NUCed bins of {axis.width:.4f} e-\n")
    began = time.process_time()
    whole = KnownPixels(pixels, SampleLaw())
    law = number_tables(*whole.codes(), whole.exposure, whole, detailed=True)
    sums = mass_sums(law.mass, law.first, law.start, pixels, dn, axis)
    clock.lap("exact EPCD and NUCed EPCD", began)
    raw, raw_all, nuced = (np.zeros(m) for m in (dn.size, dn.size, axis.size))
    numbers, errors = np.zeros(60, dtype=np.int64), []
    for chunk in chunks:
        part, use = UsablePixels.from_maps(chunk.fitted)
        began = time.process_time()
        data = tally(chunk.chosen[use], chunk.origin[use], part, dn, axis)
        known, histograms = KnownPixels(part, SampleLaw()), (chunk.chosen[use], chunk.origin[use])
        tables = number_tables(*known.codes(*histograms), known.exposure, known, detailed=True)
        numbers += tables.tally(*histograms, numbers.size)[0]
        errors.append(tables.outcomes(numbers.size))
        clock.lap("tally data and electron numbers", began)
        raw += data.raw
        nuced += data.nuced
        raw_all += tally(chunk.all_frames[use], chunk.origin[use], part, dn, axis).raw
    curves = {"epcd_exact": sums.raw / n, "nuced_exact": sums.nuced / n / axis.width}
    for name, function, where in (
        ("epcd_dependent", epcd_dependent, dn),
        ("epcd_independent", epcd_independent, dn),
        ("nuced_dependent", nuced_dependent, axis),
        ("nuced_independent", nuced_independent, axis),
    ):
        began = time.process_time()
        curves[name] = function(pixels, where, bins)  # type: ignore[operator]
        clock.lap(f"{name}, {bins} bins", began)
    total = n_chosen * n
    window, nuced_window = central_window(raw), central_window(nuced)
    floor = noise_floor(counting_variance(sums.raw, sums.raw_square, n, n_chosen), window)
    nuced_variance = counting_variance(sums.nuced, sums.nuced_square, n, n_chosen, axis.width)
    nuced_floor = noise_floor(nuced_variance, nuced_window)
    print(f"{'':22}{'RMSE':>12}{'floor':>12}{'RMSE/floor':>12}   paper")
    found = {}
    for name in sorted(curves):
        is_raw = name.startswith("epcd")
        data_density = raw / total if is_raw else nuced / total / axis.width
        found[name] = rmse(data_density, curves[name], window if is_raw else nuced_window)
        base = floor if is_raw else nuced_floor
        said = f"{PAPER[name]:.1e}" if name in PAPER else ""
        print(f"{name:<22}{found[name]:12.3e}{base:12.3e}{found[name] / base:12.3f}   {said}")
    all_floor = floor * np.sqrt(n_chosen / n_frames)
    error = rmse(raw_all / (n_frames * n), curves["epcd_exact"], window)
    print(f"{'epcd_exact, all frames':<22}{error:12.3e}{all_floor:12.3e}{error / all_floor:12.3f}")
    verdict("raw, exact: RMSE within 1.3 of the floor", found["epcd_exact"] <= 1.3 * floor)
    verdict("raw, exact: RMSE below 1.9e-4", found["epcd_exact"] < 1.9e-4)
    verdict("NUCed, exact: RMSE within 1.3 of the floor", found["nuced_exact"] <= 1.3 * nuced_floor)
    verdict("NUCed, dependent: RMSE below 2.3e-4", found["nuced_dependent"] < 2.3e-4)
    electrons(errors, numbers, total)


def electrons(expected: list[Outcomes], numbers: NDArray[np.int64], total: int) -> None:
    """Print how well the histogram of electron numbers is predicted."""
    error = np.concatenate([each.error for each in expected])
    mass = np.sum([each.estimated for each in expected], axis=0) / error.size
    floor = noise_floor(mass * (1 - mass) / total)
    off = rmse(numbers / total, mass)
    print(f"\nelectron numbers: RMSE {off:.3e}, at most {floor:.3e} from counting noise")
    print(f"expected error rate of the electron numbers {error.mean():.4f}")


def verdict(words: str, holds: bool) -> None:
    """Print whether a figure is reached."""
    print(f"  {'yes' if holds else 'NO ':<4}{words}")


def _last(chunk: Chunk) -> int:
    occupied = chunk.all_frames > 0
    return int((chunk.origin + occupied.shape[1] - 1 - occupied[:, ::-1].argmax(axis=1)).max())


if __name__ == "__main__":
    main()
