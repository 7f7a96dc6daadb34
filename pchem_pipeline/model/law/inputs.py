"""What the loops over cells are given: the law of the samples, the parameters, the free satellites."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.base.arrays import FloatArray, IntegerArray
from pchem_pipeline.model.law import electron_laws_numba
from pchem_pipeline.model.law.cells_numba import Law
from pchem_pipeline.model.law.pixel_numba import LAW
from pchem_pipeline.model.law.sample_law import CountLaw, SampleLaw

_LAWS: dict[CountLaw, int] = {
    "poisson": electron_laws_numba.POISSON,
    "negative_binomial": electron_laws_numba.NEGATIVE_BINOMIAL,
    "borel": electron_laws_numba.BOREL,
    "trapped": electron_laws_numba.TRAPPED,
    "lost": electron_laws_numba.LOST,
}
_NO_LIMIT = 2**40  # DN


def pack(models: Sequence[SampleLaw], n: int) -> Law:
    """Return the law of each sample of n pixels as the loops take them.

    Raises:
        ValueError: if an array has neither 1 nor n rows, or the weights of a mixture do not sum to 1.
    """
    parts = [_pack_one(model, n) for model in models]
    numbers, peaks, exposures, added, edges = (_stacked(each) for each in zip(*parts, strict=True))
    n_peaks = np.array([part[1].shape[2] for part in parts], np.int64)
    pattern = np.array(models[0].free_satellite_pattern, np.float64).reshape(-1, 2)
    return Law(numbers, peaks, n_peaks, exposures, added, edges, pattern)


def _pack_one(model: SampleLaw, n: int) -> tuple[NDArray[Any], ...]:
    """Return numbers, peaks, exposures, added exposures and edges, of one row or n, see `Law`."""

    def per_pixel(*names: str) -> FloatArray:
        values = [np.asarray(getattr(model, name), np.float64) for name in names]
        for name, rows in zip(names, values, strict=True):
            if rows.shape[0] not in (1, n):
                raise ValueError(f"{name} has {rows.shape[0]} rows for {n} pixels")
        return np.stack(np.broadcast_arrays(*values), axis=1)

    shifts = ("satellite_shift_e", "satellite_shift_dn", "satellite_shift_sigma")
    peaks = per_pixel("satellite_weights", *shifts, "satellite_width")
    added = per_pixel("added_weights", "added_exposure")
    mixture = np.broadcast_arrays(*np.atleast_2d(model.exposure_weights, model.exposure_factors))
    exposures = np.stack(mixture, axis=1)
    for weights in (exposures[:, 0], added[:, 0], peaks[:, 0]):
        if not np.allclose(weights.sum(axis=1), 1.0, rtol=0, atol=1e-6):
            raise ValueError("the weights of a mixture must sum to 1")
    law = model.law
    numbers = (
        _LAWS[law] if isinstance(law, str) else np.array([_LAWS[str(each)] for each in law]),  # type: ignore[index]
        model.dispersion,
        model.curvature,
        model.variance_per_electron,
        model.variance_per_electron2,
        _limit(model.clip_low, -_NO_LIMIT),
        _limit(model.clip_high, _NO_LIMIT),
        model.outlier_share,
        model.outlier_share / model.outlier_codes,
        model.edge_first,
        *per_pixel("level_scale", "level_shift_e", "extra_variance_e2", "extra_variance_dn2").T,
    )
    rows = np.broadcast_arrays(*[np.atleast_1d(np.asarray(each, np.float64)) for each in numbers])
    packed = np.zeros((rows[0].size, 1), LAW)
    for name, row in zip(LAW.names or (), rows, strict=True):
        packed[name] = row[:, None]
    edges = np.atleast_2d(np.asarray(model.edge_shift, np.float64))
    return packed, peaks, exposures, added, edges


def _limit(value: float | FloatArray | None, none: float) -> FloatArray | float:
    """Return a limit of the scale, ``none`` where there is none."""
    return none if value is None else np.where(np.isnan(value), none, value)


def _stacked(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return arrays of the samples in one, as large as the largest, 0 in columns beyond."""
    most = np.max([part.shape for part in parts], axis=0)
    found = np.zeros((len(parts), *most), parts[0].dtype)
    for own, part in zip(found, parts, strict=True):
        own[..., : part.shape[-1]] = part  # one row is of all pixels
    return found


def satellites_of(satellites: tuple[ArrayLike, ArrayLike] | None, n: int) -> FloatArray:
    """Return amplitude and weight of the pixels' free satellites, shape (n, 2), 0 without any."""
    found = np.zeros((n, 2))
    if satellites is not None:
        found[:] = np.stack([np.asarray(values, np.float64).ravel() for values in satellites], axis=1)
    return np.nan_to_num(found)


def kernel_counts(counts: IntegerArray) -> IntegerArray:
    """Return histograms in the one type that the kernels are compiled for.

    Machine code for another type would round differently in the last bit. Only counts beyond 32 bits keep a
    type of their own.
    """
    wide = counts.dtype.itemsize > 4 and counts.size > 0 and int(counts.max()) > np.iinfo(np.uint32).max
    return np.ascontiguousarray(counts, np.int64 if wide else np.uint32)
