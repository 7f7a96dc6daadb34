"""Moments of the parameters over the likelihood, along the profile of the bias."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.fit import engine, profile_numba
from pchem_pipeline.model.fit.climb_numba import Limits
from pchem_pipeline.model.fit.tile_numba import Histograms
from pchem_pipeline.model.law.cells_numba import Law

FloatArray = NDArray[np.float64]

#: Standard errors between the biases that are looked at, and how many there are at most on either side; a
#: normal law summed in steps of 1.25 has a variance right to 1e-4.
_SPACING, _MOST = 1.25, 40
#: Nats below the maximum at which a likelihood that falls on counts no longer.
_DEEPEST = 9.0


@dataclass(frozen=True)
class Moments:
    """What a likelihood says of how far estimates may be from the truth.

    Attributes:
        covariance: mean square deviations of (H_1 ... H_J, g, mu, sigma) from their estimates as far as the
            bias is right within half an electron, shape (n, J + 3, J + 3); NaN without a regular maximum.
        rival_weight: probability that the bias is an electron lower or higher, shape (n, 2).
        rivals: mean parameters there, shape (n, 2, J + 3); the estimates where nothing is there.
    """

    covariance: FloatArray
    rival_weight: FloatArray
    rivals: FloatArray

    @classmethod
    def joined(cls, n: int, parts: Iterable[tuple[NDArray[np.intp], Moments]]) -> Moments:
        """Return the moments of n pixels, put together from those of some of them each."""
        found = cls(np.full((n, 4, 4), np.nan), np.zeros((n, 2)), np.full((n, 2, 4), np.nan))
        for pixels, part in parts:
            for each in fields(cls):
                getattr(found, each.name)[pixels] = getattr(part, each.name)
        return found


def moments_along_bias(
    given: Histograms,
    law: Law,
    limits: Limits,
    evaluate: Any,
    parameters: FloatArray,
    satellites: FloatArray,
    reach: FloatArray,
) -> Moments:
    """Return the moments of the likelihood over the parameters, along the profile of the bias.

    Args:
        given: histograms; codes left out by the tail guard do not count.
        law: of the samples.
        limits: bounds and limits.
        evaluate: the likelihood.
        parameters: at the maximum, shape (n, J + 3); NaN where there is none.
        satellites: amplitude (e-) and weight of the pixels' free satellites, shape (n, 2).
        reach: distance on either side within which another maximum may lie, e-, shape (n,).
    """
    n, size = parameters.shape
    nodes = 2 * _MOST + 1
    found, heights = np.zeros((n, nodes, size)), np.full((n, nodes), -np.inf)
    across = np.zeros((n, nodes, size, size))
    profile_numba.walk_tile(
        *(given, law, limits, evaluate, engine.climb(), profile_numba.Maxima(parameters, satellites)),
        *(_SPACING, reach, _DEEPEST, found, across, heights),
    )
    walked = heights > -np.inf
    # Laplace's volume across the bias would multiply this; Jeffreys' prior of what is across divides by it
    weight = np.exp(np.minimum(heights, _DEEPEST))
    off = np.where(walked[:, :, None], found - parameters[:, None], 0.0)
    electrons = off[:, :, size - 2] * parameters[:, None, size - 3]
    here, beside = abs(electrons) < 0.5, (electrons <= -0.5, electrons >= 0.5)
    with np.errstate(invalid="ignore", divide="ignore"):
        own = np.where(here, weight, 0.0)
        own /= own.sum(axis=1, keepdims=True)
        rest = np.stack([np.where(side, weight, 0.0) for side in beside], axis=1)
        share = rest.sum(axis=2) / weight.sum(axis=1, keepdims=True)
        rest /= rest.sum(axis=2, keepdims=True)
    covariance = np.einsum("nt,nti,ntj->nij", own, off, off)
    covariance += np.einsum("nt,ntij->nij", own, np.nan_to_num(across))
    covariance[~walked[:, _MOST]] = np.nan
    rivals = parameters[:, None] + np.einsum("nst,nti->nsi", np.nan_to_num(rest), off)
    return Moments(covariance, np.nan_to_num(share), rivals)
