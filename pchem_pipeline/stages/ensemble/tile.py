"""What a tile adds to the ensemble, as two rows of numbers that need only be summed.

Frames give every pixel the same number of samples. Ready-made histograms need not, and there every pixel
counts the same: its samples are divided by their number before they are added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.effects.framework.added_exposure import AddedExposure
from pchem_pipeline.effects.framework.compose import PixelPlaces, pixel_maps, sample_law
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.model.electrons.electrons import cell_probabilities, electron_counts
from pchem_pipeline.model.ensemble.ensemble import curve_errors, ensemble_sums, tally
from pchem_pipeline.model.ensemble.extended_ensemble import extended_sums
from pchem_pipeline.model.ensemble.totals import MODEL_ERRORS, EnsembleAxes
from pchem_pipeline.model.maps.pixels import FloatArray, PixelParameters
from pchem_pipeline.stages.fit.fitted_model import deciding_maps

__all__ = ["PixelHistograms", "ensemble_tile"]


@dataclass(frozen=True)
class PixelHistograms:
    """Histograms of some pixels.

    Attributes:
        counts: samples per bin, shape (n, n_bins).
        outside: samples outside of the bins, shape (n,).
    """

    counts: NDArray[np.unsignedinteger[Any]]
    outside: NDArray[np.integer[Any]]

    def of(self, mask: NDArray[np.bool_]) -> PixelHistograms:
        """Return those of the chosen pixels."""
        return PixelHistograms(self.counts[mask], self.outside[mask])

    @property
    def samples(self) -> NDArray[np.int64]:
        """Number of samples of each pixel, shape (n,)."""
        return np.asarray(self.counts.sum(axis=1, dtype=np.int64) + self.outside)


def ensemble_tile(
    maps: tuple[FloatArray, ...],
    origin: NDArray[np.integer[Any]],
    chosen: PixelHistograms,
    everything: PixelHistograms,
    axes: EnsembleAxes,
    effects: Sequence[Effect] = (),
    satellites: tuple[FloatArray, FloatArray] | None = None,
    covariance: FloatArray | None = None,
    added: AddedExposure | None = None,
    places: PixelPlaces | None = None,
) -> tuple[NDArray[np.int64], FloatArray]:
    """Return what some pixels add to the ensemble.

    Args:
        maps: (H, g, mu, sigma) of the pixels, each of shape (n,); NaN where the fit failed.
        origin: DN of bin 0 of their histograms, shape (n,).
        chosen: histograms of the chosen frames.
        everything: histograms of all frames, on the same bins.
        axes: axes of the ensemble.
        effects: of the run's model, the axes being ``extended`` where there are any.
        satellites: amplitude (e-) and weight of the pixels' free satellites, shape (n,); None: none.
        covariance: of the maps, shape (n, 4, 4); None: not known.
        added: exposure that the effects add to the pixels, (j, n); None: nothing.
        places: of the pixels; None: not known.

    Returns:
        A row of integers and a row of floats, in the places that ``axes`` gives.
    """
    integers = np.zeros(list(axes.integers.values())[-1].stop, dtype=np.int64)
    floats = np.zeros(list(axes.floats.values())[-1].stop)
    pixels, mask = PixelParameters.from_maps(maps)
    added = None if added is None else added.of(mask)
    places = None if places is None else places.of(mask)
    deciding = PixelParameters(*deciding_maps(pixels.columns(), effects, added, places))
    integers[axes.integers["pixels"]] = len(pixels)
    integers[axes.integers["excluded"]] = mask.size - len(pixels)
    chosen, everything, origin = chosen.of(mask), everything.of(mask), origin[mask]
    if covariance is not None and not effects:
        errors = curve_errors(pixels, covariance[mask], axes.dn, axes.nuced)
        for name, variance in zip(MODEL_ERRORS, errors, strict=True):
            floats[axes.floats[name]] = variance
    samples, samples_all = chosen.samples, everything.samples
    pairs = np.stack([samples, samples_all], axis=1)
    for n, n_all in np.unique(pairs, axis=0):
        group = (samples == n) & (samples_all == n_all)
        part, decider = (
            PixelParameters(*(column[group] for column in each.columns())) for each in (pixels, deciding)
        )
        sets = (chosen.of(group), int(n)), (everything.of(group), int(n_all))
        if n > 0:
            _add_group(part, decider, origin[group], *sets, axes, integers, floats)
            if effects:
                own = None if satellites is None else (satellites[0][mask][group], satellites[1][mask][group])
                more = None if added is None else added.of(group)
                law = effects, more, None if places is None else places.of(group)
                _add_extended(part, own, int(n), axes, law, floats)
    return integers, floats


def _add_extended(
    pixels: PixelParameters,
    satellites: tuple[FloatArray, FloatArray] | None,
    n: int,
    axes: EnsembleAxes,
    law: tuple[Sequence[Effect], AddedExposure | None, PixelPlaces | None],
    floats: FloatArray,
) -> None:
    """Add what the extended law predicts of pixels that have the same number of samples."""
    effects, added, places = law
    maps = pixel_maps(pixels.columns(), np.ones(len(pixels), bool))
    model = sample_law(effects, maps, added, places)
    extended = extended_sums(pixels, satellites, model, axes.dn, axes.nuced)
    sums = extended.sums
    parts: dict[str, Any] = {
        "pcd": sums.raw,
        "pcd_variance": (sums.raw - sums.raw_square) / n,
        "nuced": sums.nuced,
        "nuced_variance": (sums.nuced - sums.nuced_square) / n,
        "nuced_predicted_sum": extended.nuced_sum,
        "nuced_predicted_sum_square": extended.nuced_sum_square,
    }
    for name, part in parts.items():
        floats[axes.floats[name]] += part


def _add_group(
    pixels: PixelParameters,
    deciding: PixelParameters,
    origin: NDArray[np.integer[Any]],
    chosen: tuple[PixelHistograms, int],
    everything: tuple[PixelHistograms, int],
    axes: EnsembleAxes,
    integers: NDArray[np.int64],
    floats: FloatArray,
) -> None:
    """Add pixels that have the same number of samples; ``deciding`` gives their electron numbers."""
    (histograms, n), (histograms_all, n_all) = chosen, everything
    data = tally(histograms.counts, origin, pixels, axes.dn, axes.nuced)
    data_all = tally(histograms_all.counts, origin, pixels, axes.dn, axes.nuced)
    numbers, beyond = electron_counts(histograms.counts, origin, deciding, axes.n_k)
    cells = cell_probabilities(deciding, axes.n_k)
    outside = int(histograms.outside.sum())
    tallies: dict[str, NDArray[np.int64] | int] = {
        "counts": data.raw,
        "counts_all": data_all.raw,
        "nuced_counts": data.nuced,
        "electron_counts": numbers,
        "outside": data.outside + outside,
        "outside_all": data_all.outside + int(histograms_all.outside.sum()),
        "nuced_outside": data.nuced_outside + outside,
        "electrons_beyond": beyond + outside,
    }
    parts: dict[str, Any] = {
        "share": data.raw / n,
        "share_all": data_all.raw / n_all,
        "nuced_share": data.nuced / n,
        "electron_share": numbers / n,
        "electron_expected": cells.estimated,
        "nuced_sum": data.nuced_sum / n,
        "nuced_sum_square": data.nuced_sum_square / n,
        "error": cells.error.sum(),
        "error_variance": np.sum(cells.error * (1.0 - cells.error)),
    }
    if not axes.extended:
        sums = ensemble_sums(pixels, axes.dn, axes.nuced)
        parts |= {
            "pcd": sums.raw,
            "pcd_variance": (sums.raw - sums.raw_square) / n,
            "nuced": sums.nuced,
            "nuced_variance": (sums.nuced - sums.nuced_square) / n,
        }
    for name, tallied in tallies.items():
        integers[axes.integers[name]] += tallied
    for name, part in parts.items():
        floats[axes.floats[name]] += part
