"""What the grown fit is given, as the loops take it: the law, the parameters, the free lobes."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.model.law import electron_laws_numba
from pchem_pipeline.model.law.grown_types_numba import Law
from pchem_pipeline.model.law.sample_law import CountLaw, MarginalModel

__all__ = ["HasLobes", "HasParameters", "Parameters", "columns_of", "lobes_of", "pack"]

FloatArray = NDArray[np.float64]

_LAWS: dict[CountLaw, int] = {
    "poisson": electron_laws_numba.POISSON,
    "negative_binomial": electron_laws_numba.NEGATIVE_BINOMIAL,
    "borel": electron_laws_numba.BOREL,
}
_NO_LIMIT = 2**40  # DN
_LOBE_FIELDS = ("weights", "shift_e", "shift_dn", "shift_sigma", "width")


class HasParameters(Protocol):
    """Maps of the four parameters: ``PixelMaps``, ``PixelParameters``, a :class:`FitResult`."""

    @property
    def quanta_exposure(self) -> FloatArray:
        """H, e-."""

    @property
    def conversion_gain(self) -> FloatArray:
        """g, e-/DN."""

    @property
    def bias(self) -> FloatArray:
        """mu, DN."""

    @property
    def read_noise_dn(self) -> FloatArray:
        """sigma, quantisation included, DN."""


@runtime_checkable
class HasLobes(Protocol):
    """Free lobes of the pixels."""

    @property
    def lobe_amplitude_e(self) -> FloatArray:
        """Amplitude, e-; NaN without any."""

    @property
    def lobe_weight(self) -> FloatArray:
        """Weight; 0 without any."""


Parameters = HasParameters | Sequence[ArrayLike]


@functools.cache
def _normal_table() -> FloatArray:
    table = np.empty((int(electron_laws_numba.FARTHEST * electron_laws_numba.STEPS) + 2, 2))
    electron_laws_numba.fill_normal_table(table)
    return table


def pack(model: MarginalModel, n: int) -> Law:
    """Return the model as the loops take it.

    Args:
        model: the law of n pixels.
        n: number of pixels.

    Raises:
        ValueError: if an array has neither 1 nor n rows, or the weights of a mixture do not sum to 1.
    """

    def per_pixel(name: str) -> FloatArray:
        values = np.ascontiguousarray(getattr(model, name), np.float64)
        if values.shape[0] not in (1, n):
            raise ValueError(f"{name} has {values.shape[0]} rows for {n} pixels")
        return values

    shape = np.broadcast_shapes(*(getattr(model, f"lobe_{name}").shape for name in _LOBE_FIELDS))
    lobes = {
        name: np.array(np.broadcast_to(per_pixel(f"lobe_{name}"), shape), order="C") for name in _LOBE_FIELDS
    }
    both = np.broadcast_shapes(model.added_exposure.shape, model.added_weights.shape)
    added = {
        name: np.array(np.broadcast_to(per_pixel(f"added_{name}"), both), order="C")
        for name in ("exposure", "weights")
    }
    for weights in (model.exposure_weights[None], added["weights"], lobes["weights"]):
        if not np.allclose(weights.sum(axis=1), 1.0, rtol=0, atol=1e-6):
            raise ValueError("the weights of a mixture do not sum to 1")
    return Law(
        _LAWS[model.law],
        float(model.dispersion),
        np.ascontiguousarray(model.exposure_weights, np.float64),
        np.ascontiguousarray(model.exposure_factors, np.float64),
        added["exposure"],
        added["weights"],
        per_pixel("level_scale"),
        per_pixel("level_shift_e"),
        float(model.curvature),
        float(model.variance_per_electron),
        float(model.variance_per_electron2),
        per_pixel("extra_variance_e2"),
        per_pixel("extra_variance_dn2"),
        lobes["weights"],
        lobes["shift_e"],
        lobes["shift_dn"],
        lobes["shift_sigma"],
        lobes["width"],
        int(model.edge_first),
        np.ascontiguousarray(model.edge_shift, np.float64),
        -_NO_LIMIT if model.clip_low is None else int(model.clip_low),
        _NO_LIMIT if model.clip_high is None else int(model.clip_high),
        float(model.outlier_share),
        float(model.outlier_share) / model.outlier_codes,
        np.array(model.free_lobe_pattern, np.float64).reshape(-1, 2),
        _normal_table(),
    )


def columns_of(parameters: Parameters) -> FloatArray:
    """Return (H, g, mu, sigma) as an array of shape (n, 4)."""
    if isinstance(parameters, Sequence):
        columns = [np.asarray(values, np.float64).ravel() for values in parameters]
    else:
        names = ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn")
        columns = [np.asarray(getattr(parameters, name), np.float64).ravel() for name in names]
    return np.stack(np.broadcast_arrays(*columns), axis=1)


def lobes_of(parameters: Parameters, lobes: tuple[ArrayLike, ArrayLike] | None, n: int) -> FloatArray:
    """Return amplitude and weight of the pixels' free lobes, shape (n, 2), 0 without any."""
    if lobes is None and isinstance(parameters, HasLobes):
        lobes = parameters.lobe_amplitude_e, parameters.lobe_weight
    found = np.zeros((n, 2))
    if lobes is not None:
        found[:] = np.stack([np.asarray(values, np.float64).ravel() for values in lobes], axis=1)
    return np.nan_to_num(found)
