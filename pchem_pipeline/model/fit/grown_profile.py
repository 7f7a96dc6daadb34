"""Parameters of effects and of pixels fitted together: the profile likelihood of one to three numbers.

The log-likelihood summed over pixels is maximised in the parameters that all pixels share, each pixel's own
four being fitted anew at every step. The steps are Fisher's, with the efficient score and the efficient
information: what is left of those of the shared parameters once the pixels' own have been projected out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.model.fit import grown_tile_numba
from pchem_pipeline.model.fit.grown import GrownFit, fit_grown, marginal_mass
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.start import kernel_counts
from pchem_pipeline.model.law.grown_cells_numba import EXACT
from pchem_pipeline.model.law.grown_inputs import Parameters, columns_of, lobes_of, pack
from pchem_pipeline.model.law.sample_law import MarginalModel

__all__ = ["ProfileFit", "profile_effects"]

FloatArray = NDArray[np.float64]
Build = Callable[[FloatArray], MarginalModel]

_DIFFERENCE = 1e-3  # of the scale: step of the numerical derivative in a shared parameter
_LEAST_MASS = 1e-14
_MOST_HALVINGS = 6


@dataclass(frozen=True)
class ProfileFit:
    """Shared parameters at the maximum of the profile likelihood.

    Attributes:
        theta: the shared parameters, shape (d,).
        covariance: inverse of their efficient information, shape (d, d); NaN for one at its bound.
        log_likelihood: summed over the pixels used, nats.
        start_log_likelihood: the same at the start, nats.
        pixels: index of the pixels used, shape (m,).
        fit: fit of these pixels at ``theta``.
        converged: whether the last step promised less than the tolerance.
        rounds: steps taken.
    """

    theta: FloatArray
    covariance: FloatArray
    log_likelihood: float
    start_log_likelihood: float
    pixels: NDArray[np.intp]
    fit: GrownFit
    converged: bool
    rounds: int


def profile_effects(
    counts: NDArray[np.integer],
    origin: NDArray[np.integer],
    start: Parameters,
    build: Build,
    theta: ArrayLike,
    *,
    scales: ArrayLike,
    bounds: Sequence[tuple[float, float]] | None = None,
    settings: FitSettings | None = None,
    max_pixels: int = 512,
    max_rounds: int = 15,
    tolerance: float = 1e-2,
) -> ProfileFit:
    """Fit parameters that all pixels share, each pixel's own four with them.

    Args:
        counts: histograms, shape (n, B), any unsigned type.
        origin: DN of bin 0, shape (n,).
        start: plain (H, g, mu, sigma), each (n,); pixels with NaN are left out.
        build: from the shared parameters (d,) to the law of the n pixels; smooth.
        theta: start of the shared parameters, shape (d,).
        scales: a size of each that matters, for numerical derivatives, shape (d,).
        bounds: lowest and highest value of each; none by default.
        settings: of the pixels' fit.
        max_pixels: largest number of pixels used, evenly spread over those with a start.
        max_rounds: steps allowed.
        tolerance: the search ends when a step promises a smaller rise of the summed log-likelihood, nats.

    Returns:
        The shared parameters with their covariance, and the fit of the pixels used.

    Raises:
        ValueError: if no pixel has a start.
    """
    columns = columns_of(start)
    usable = np.flatnonzero(np.isfinite(columns).all(axis=1))
    if usable.size == 0:
        raise ValueError("no pixel has a start")
    chosen = usable[np.unique(np.linspace(0, usable.size - 1, min(max_pixels, usable.size)).astype(np.intp))]
    counts = kernel_counts(counts)[chosen]
    search = _Search(counts, np.asarray(origin, np.int64)[chosen], build, chosen, settings or FitSettings())
    low, high = _bounds(bounds, np.size(theta))
    here = np.clip(np.asarray(theta, np.float64).ravel(), low, high)
    fit = search.fit(here, columns[chosen], warm=False)
    search.keep = np.isfinite(fit.log_likelihood)
    best = first = search.total(fit)
    converged, rounds = False, 0
    while True:
        score, information = search.efficient(here, np.asarray(scales, np.float64).ravel(), low, high, fit)
        held = ((here <= low) & (score <= 0)) | ((here >= high) & (score >= 0))
        step, covariance = _solve(score, information, held)
        if 0.5 * float(score @ step) < tolerance:
            converged = True
            break
        moved = None if rounds == max_rounds else _line_search(search, here, step, (low, high), fit, best)
        if moved is None:
            break
        here, fit, best = moved
        rounds += 1
    return ProfileFit(here, covariance, best, first, chosen, fit, converged, rounds)


def _line_search(
    search: _Search,
    here: FloatArray,
    step: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
    fit: GrownFit,
    best: float,
) -> tuple[FloatArray, GrownFit, float] | None:
    """Return the first of the halved steps that raises the likelihood, None where none does."""
    for _ in range(_MOST_HALVINGS):
        trial = np.clip(here + step, *bounds)
        fitted = search.fit(trial, columns_of(fit), warm=True)
        total = search.total(fitted)
        if total > best:
            return trial, fitted, total
        step = 0.5 * step
    return None


@dataclass
class _Search:
    """The pixels used, and what is asked of them; ``keep`` marks those that the first fit could do."""

    counts: NDArray[np.integer]
    origin: NDArray[np.int64]
    build: Build
    chosen: NDArray[np.intp]
    settings: FitSettings
    keep: NDArray[np.bool_] | None = None

    def model(self, theta: FloatArray) -> MarginalModel:
        """Return the law of the pixels used, free lobes aside."""
        return self.build(theta).of(self.chosen)

    def fit(self, theta: FloatArray, start: FloatArray, *, warm: bool) -> GrownFit:
        """Fit the pixels' own parameters."""
        columns = list(start.T)
        return fit_grown(self.counts, self.origin, columns, self.model(theta), self.settings, warm=warm)

    def total(self, fit: GrownFit) -> float:
        """Return the summed log-likelihood; minus infinity where a pixel was lost."""
        values = fit.log_likelihood if self.keep is None else fit.log_likelihood[self.keep]
        return float(values.sum()) if np.isfinite(values).all() else -np.inf

    def efficient(
        self, theta: FloatArray, scales: FloatArray, low: FloatArray, high: FloatArray, fit: GrownFit
    ) -> tuple[FloatArray, FloatArray]:
        """Return efficient score and information of the shared parameters."""
        keep = np.flatnonzero(np.isfinite(fit.log_likelihood))
        codes = self.origin[keep, None] + np.arange(self.counts.shape[1])
        model = self.model(theta)
        mass, own = _own_slopes(model.of(keep), fit, keep, codes)
        shared = np.empty((theta.size, *mass.shape))
        for i, scale in enumerate(scales):
            above, below = theta.copy(), theta.copy()
            above[i] = min(theta[i] + _DIFFERENCE * scale, high[i])
            below[i] = max(theta[i] - _DIFFERENCE * scale, low[i])
            ends = [self._mass(point, fit, keep, codes) for point in (above, below)]
            shared[i] = (ends[0] - ends[1]) / (above[i] - below[i])
        return _project(self.counts[keep], mass, own, shared)

    def _mass(
        self, theta: FloatArray, fit: GrownFit, keep: NDArray[np.intp], codes: NDArray[np.int64]
    ) -> FloatArray:
        lobes = fit.lobe_amplitude_e[keep], fit.lobe_weight[keep]
        columns = list(columns_of(fit)[keep].T)
        return marginal_mass(self.model(theta).of(keep), columns, codes, lobes=lobes)


def _own_slopes(
    model: MarginalModel, fit: GrownFit, keep: NDArray[np.intp], codes: NDArray[np.int64]
) -> tuple[FloatArray, FloatArray]:
    """Return the mass of the codes (n, n_codes) and its slopes in the pixels' own parameters (n, 4, ...)."""
    mass = np.full(codes.shape, np.nan)
    slopes = np.full((codes.shape[0], 4, codes.shape[1]), np.nan)
    columns = np.ascontiguousarray(columns_of(fit)[keep])
    lobes = np.ascontiguousarray(lobes_of(fit, None, fit.bias.size)[keep])
    first = np.ascontiguousarray(codes[:, 0])
    grown_tile_numba.slope_tile(first, columns, lobes, pack(model, keep.size), EXACT, mass, slopes)
    return mass, slopes


def _project(
    counts: NDArray[np.integer], mass: FloatArray, own: FloatArray, shared: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return score and information of the shared parameters with the pixels' own projected out."""
    seen = counts.astype(np.float64)
    usable = mass > _LEAST_MASS
    ratio = np.where(usable, seen / np.where(usable, mass, 1.0), 0.0)
    expected = np.where(usable, seen.sum(axis=1, keepdims=True) / np.where(usable, mass, 1.0), 0.0)
    score = np.einsum("dnx,nx->nd", shared, ratio)
    score_own = np.einsum("nix,nx->ni", own, ratio)
    both = np.einsum("dnx,nix,nx->ndi", shared, own, expected)
    information = np.einsum("dnx,enx,nx->nde", shared, shared, expected)
    inside = np.linalg.pinv(np.einsum("nix,njx,nx->nij", own, own, expected), hermitian=True)
    score = score - np.einsum("ndi,nij,nj->nd", both, inside, score_own)
    information = information - np.einsum("ndi,nij,nej->nde", both, inside, both)
    return score.sum(axis=0), information.sum(axis=0)


def _bounds(bounds: Sequence[tuple[float, float]] | None, n: int) -> tuple[FloatArray, FloatArray]:
    pairs = np.array([(-np.inf, np.inf)] * n if bounds is None else list(bounds), np.float64)
    return pairs[:, 0], pairs[:, 1]


def _solve(
    score: FloatArray, information: FloatArray, held: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """Return the step, 0 for what is held, and the covariance, NaN for it."""
    free = np.flatnonzero(~held)
    step, covariance = np.zeros(score.size), np.full((score.size, score.size), np.nan)
    if free.size:
        inverse = np.linalg.pinv(information[np.ix_(free, free)], hermitian=True)
        step[free] = inverse @ score[free]
        covariance[np.ix_(free, free)] = inverse
    return step, covariance
