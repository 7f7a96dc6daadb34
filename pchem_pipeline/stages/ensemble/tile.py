"""What a tile adds to the ensemble, as two rows of numbers that need only be summed.

Frames give every pixel the same number of samples. Ready-made histograms need not, and there every pixel
counts the same: its samples are divided by their number before they are added.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.model.electrons.electrons import KnownPixels, number_tables
from pchem_pipeline.model.ensemble.ensemble import (
    MODEL_ERRORS,
    EnsembleAxes,
    PixelErrors,
    curve_errors,
    mass_sums,
    tally,
)
from pchem_pipeline.model.law.inputs import kernel_counts
from pchem_pipeline.model.law.parameters import UsablePixels
from pchem_pipeline.model.law.sample_law import SampleLaw


@dataclass(frozen=True)
class PixelHistograms:
    """Histograms of some pixels, along one axis or of rows and columns of the sensor."""

    counts: NDArray[np.integer[Any]]  # samples per bin, shape (..., n_bins)
    origin: NDArray[np.integer[Any]]  # DN of bin 0, shape (...)
    outside: NDArray[np.integer[Any]]  # samples outside of the bins, shape (...)

    def of(self, chosen: BoolArray | tuple[slice, slice]) -> PixelHistograms:
        """Return those of the chosen pixels."""
        if isinstance(chosen, np.ndarray) and chosen.all():
            return self
        return PixelHistograms(self.counts[chosen], self.origin[chosen], self.outside[chosen])

    @property
    def samples(self) -> IntArray:
        """Number of samples of each pixel."""
        return np.asarray(self.counts.sum(axis=-1, dtype=np.int64) + self.outside)

    def cut(self, low: NDArray[Any], high: NDArray[Any]) -> PixelHistograms:
        """Return them along one axis, with as many bins as the widest range ``low`` to ``high`` (y, x) needs.

        A hot pixel widens the histograms of the whole sensor.
        """
        bins = self.counts.shape[2]
        first, size = occupied(self.origin, low, high, bins)
        y, x = np.ogrid[: first.shape[0], : first.shape[1]]
        kept = self.counts if size == bins else sliding_window_view(self.counts, size, axis=2)[y, x, first]
        return PixelHistograms(
            kernel_counts(kept).reshape(first.size, size), (self.origin + first).ravel(), self.outside.ravel()
        )


def occupied(origin: NDArray[Any], low: NDArray[Any], high: NDArray[Any], bins: int) -> tuple[IntArray, int]:
    """Return the first of so many bins, the same number for each pixel, between which all samples lie."""
    begin, end = np.clip(low - origin, 0, bins), np.clip(high + 1 - origin, 0, bins)
    size = max(1, int(np.max(end - begin)))
    return np.minimum(begin, bins - size), size


def ensemble_tile(
    maps: tuple[FloatArray, ...],
    chosen: PixelHistograms,
    everything: PixelHistograms,
    axes: EnsembleAxes,
    law: SampleLaw | None = None,
    satellites: tuple[FloatArray, FloatArray] | None = None,
    errors: PixelErrors | None = None,
) -> tuple[IntArray, FloatArray]:
    """Return what some pixels add to the ensemble: rows of integers and floats, in the places of ``axes``.

    The maps are (H, g, mu, sigma) of the pixels, each of shape (n,), NaN where the fit failed; ``chosen`` are
    the histograms of the chosen frames, ``everything`` those of all. The law (None: that of the PCD) is that
    of the samples; satellites are amplitude (e-) and weight of the pixels' free ones, shape (n,) each.
    """
    integers = np.zeros(list(axes.integers.values())[-1].stop, dtype=np.int64)
    floats = np.zeros(list(axes.floats.values())[-1].stop)
    pixels, mask = UsablePixels.from_maps(maps)
    law = (law or SampleLaw()).of(mask)
    satellites = None if satellites is None else (satellites[0][mask], satellites[1][mask])
    integers[axes.integers["pixels"]] = len(pixels)
    integers[axes.integers["excluded"]] = mask.size - len(pixels)
    same = chosen is everything
    chosen = chosen.of(mask)
    everything = chosen if same else everything.of(mask)
    samples = chosen.samples
    samples_all = samples if same else everything.samples
    if errors is not None:
        some, covariance = errors.of(mask).sampled(pixels, samples_all)
        found = curve_errors(law.of(some), pixels.of(some), covariance, axes.dn, axes.nuced)
        for name, variance in zip(MODEL_ERRORS, found, strict=True):
            floats[axes.floats[name]] = variance
    for n, n_all in sorted({*zip(samples.tolist(), samples_all.tolist(), strict=True)}):
        if n == 0:
            continue
        group = (samples == n) & (samples_all == n_all)
        part = pixels.of(group)
        levels = None if satellites is None else (satellites[0][group], satellites[1][group])
        of_group = chosen.of(group)
        sets = (of_group, n), (of_group if same else everything.of(group), n_all)
        tallies, parts = _group_sums(KnownPixels(part, law.of(group), levels), part, *sets, axes)
        for name, tallied in tallies.items():
            integers[axes.integers[name]] += np.asarray(tallied, np.int64)  # floats are whole numbers
        for name, summed in parts.items():
            floats[axes.floats[name]] += summed
    return integers, floats


def _group_sums(
    known: KnownPixels,
    pixels: UsablePixels,
    chosen: tuple[PixelHistograms, int],
    everything: tuple[PixelHistograms, int],
    axes: EnsembleAxes,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the tallies and sums of pixels that have the same number of samples."""
    (histograms, n), (histograms_all, n_all) = chosen, everything
    counts, origin = histograms.counts, histograms.origin
    data = data_all = tally(counts, origin, pixels, axes.dn, axes.nuced)
    if histograms_all is not histograms:
        data_all = tally(histograms_all.counts, histograms_all.origin, pixels, axes.dn)
    low, high = known.codes(counts, origin)
    if np.any(known.law.outlier_share):  # may be anything, on the whole axis
        low, high = np.minimum(low, axes.dn.start), np.maximum(high, axes.dn.start + axes.dn.size - 1)
    tables = number_tables(low, high, known.exposure, known, detailed=True)
    numbers, beyond = tables.tally(counts, origin, axes.n_k)
    estimated, error = tables.outcomes(axes.n_k)
    predicted = mass_sums(tables.mass, tables.first, tables.start, pixels, axes.dn, axes.nuced)
    tallies: dict[str, Any] = {
        "counts": data.raw,
        "counts_all": data_all.raw,
        "nuced_counts": data.nuced,
        "electron_counts": numbers,
        "outside": n * len(pixels) - data.raw.sum(),
        "outside_all": n_all * len(pixels) - data_all.raw.sum(),
        "nuced_outside": n * len(pixels) - data.nuced.sum(),
        "electrons_beyond": beyond + int(histograms.outside.sum()),
    }
    parts: dict[str, Any] = {
        "share": data.raw / n,
        "share_all": data_all.raw / n_all,
        "nuced_share": data.nuced / n,
        "electron_share": numbers / n,
        "electron_expected": estimated,
        "nuced_sum": data.nuced_sum / n,
        "nuced_sum_square": data.nuced_sum_square / n,
        "error": error.sum(),
        "error_variance": np.sum(error * (1.0 - error)),
        "pcd": predicted.raw,
        "pcd_variance": (predicted.raw - predicted.raw_square) / n,
        "nuced": predicted.nuced,
        "nuced_variance": (predicted.nuced - predicted.nuced_square) / n,
        "nuced_predicted_sum": predicted.nuced_sum,
        "nuced_predicted_sum_square": predicted.nuced_sum_square,
    }
    return tallies, parts
