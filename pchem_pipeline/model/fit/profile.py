"""Profiles of the likelihood: ends of intervals, and moments of the parameters along that of the bias."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IndexArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.fit import engine, profile_numba
from pchem_pipeline.model.fit.climb_numba import Limits
from pchem_pipeline.model.fit.tile_numba import Histograms
from pchem_pipeline.model.law import pixel_numba as px
from pchem_pipeline.model.law.cells_numba import Law

#: Standard errors between the biases that are looked at, and how many there are at most on either side; a
#: normal law summed in steps of 1.25 has a variance right to 1e-4.
_SPACING, _MOST = 1.25, 40
#: Nats below the maximum at which a likelihood that falls on counts no longer.
_DEEPEST = 9.0
_OUTER = 30  # fixed values tried for an end
_CLOSE = 1e-4  # of the root of the drop
_FARTHEST = 60.0  # roots from the maximum
_LEAST_VARIANCE = 1e-12  # DN^2


class Moments(NamedTuple):
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


class Profile:
    """The likelihood of n pixels about their maxima.

    Attributes:
        theta: parameters at the maximum, mu in DN, shape (n, J + N_SHARED).
        loglik: there, nats, shape (n,).
        covariance: of (H_1 ... H_J, 1/g, mu, v, q), 0 for what stays, NaN without a regular maximum.
    """

    def __init__(
        self, given: Histograms, law: Law, limits: Limits, parameters: FloatArray, satellites: FloatArray
    ) -> None:
        """Climb to the maximum near the fit of each pixel, codes left out by the tail guard not counted.

        The fit is (H_1 ... H_J, g, mu, sigma), shape (n, J + 3), NaN where there is none, with amplitude (e-)
        and weight of the pixels' free satellites, shape (n, 2).
        """
        self._given, self._law, self._limits = given, law, limits
        self._n, self._amplitudes = given.dark.size, np.ascontiguousarray(satellites[:, 0])
        self._rounding = QUANTISATION_VARIANCE if limits.cells else 0.0
        n, (exposure, gain, bias, sigma) = self._n, np.split(parameters, self._n + np.arange(3), axis=1)
        lit = ~given.dark & (exposure > 0.0)
        variance = np.maximum(sigma**2 - self._rounding, _LEAST_VARIANCE)
        log_exposure = np.where(lit, np.log(np.where(lit, exposure, 1.0)), limits.bound)
        start = np.hstack([log_exposure, 1.0 / gain, bias, np.log(variance), satellites[:, 1:]])
        self._fixed = np.zeros(start.shape, np.bool_)
        self._fixed[:, :n] = given.dark
        self._fixed[:, n + px.SATELLITE] = ~(satellites[:, 1] > 0.0)
        pixels = np.flatnonzero(np.isfinite(parameters).all(axis=1))
        self.theta, self.loglik = np.full(start.shape, np.nan), np.full(len(start), -np.inf)
        self.covariance = np.full((*start.shape, start.shape[1]), np.nan)
        self.theta[pixels], self.loglik[pixels], self.covariance[pixels] = self._climb(pixels, start[pixels])

    def _climb(
        self,
        pixels: IndexArray,
        theta: FloatArray,
        place: IndexArray | int | None = None,
        tied: BoolArray | bool = False,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Climb from theta, one parameter fixed; see :func:`.profile_numba.climb_tile`."""
        m, size = theta.shape
        found, loglik, covariance = theta.copy(), np.empty(m), np.empty((m, size, size))
        fixed = self._fixed[pixels]
        if place is not None:
            fixed[np.arange(m), place] = True
        profile_numba.climb_tile(
            *(self._given, pixels, self._law, self._limits, engine.likelihood(self._limits.cells)),
            *(engine.climb(), self._amplitudes[pixels], fixed, np.broadcast_to(tied, m).copy()),
            *(found, loglik, covariance, np.empty((m, px.N_BLOCK))),
        )
        return found, loglik, covariance

    def _direction(self, pixels: IndexArray, target: IndexArray) -> FloatArray:
        """Return the change of all coordinates per standard error of a parameter; the last is ``sigma g``."""
        n, m = self._n, np.arange(pixels.size)
        tied, place = target == n + 3, np.minimum(target, n + px.LOG_VARIANCE)
        best, covariance = self.theta[pixels], self.covariance[pixels]
        slope = 1.0 / (1.0 + self._rounding * np.exp(-best[:, n + px.LOG_VARIANCE]))
        by_step = 2.0 / best[:, n + px.STEP]
        along = covariance[m, :, place]
        of_both = slope[:, None] * along - by_step[:, None] * covariance[:, :, n + px.STEP]
        along = np.where(tied[:, None], of_both, along)
        own = along[m, place]
        along[m, place] = np.where(tied, slope * own - by_step * along[:, n + px.STEP], own)
        along /= np.sqrt(along[m, place])[:, None]
        along[:, :n] *= np.exp(-best[:, :n])  # of log H
        return along

    def _moved(
        self, theta: FloatArray, direction: FloatArray, distance: FloatArray, tied: BoolArray
    ) -> FloatArray:
        """Return theta and so many directions; tied: log (sigma g)^2 stands in the place of v."""
        place, step = self._n + px.LOG_VARIANCE, self._n + px.STEP
        found = theta + distance[:, None] * direction
        wider = np.exp(distance * direction[:, place]) * (found[:, step] / theta[:, step]) ** 2
        variance = (np.exp(theta[:, place]) + self._rounding) * wider - self._rounding
        found[tied, place] = np.log(np.maximum(variance, _LEAST_VARIANCE))[tied]
        return found

    def ends(self, root: float) -> FloatArray:
        """Return where the profile of each parameter has fallen by ``root^2 / 2``, by a secant on the root.

        Returns:
            Lower and upper ends of (H_1 ... H_J, g, mu, sigma, sigma g), shape (n, J + 4, 2), NaN where the
            likelihood does not fall far enough.
        """
        n = self._n
        place_of = np.minimum(np.arange(n + 4), n + px.LOG_VARIANCE)
        variance = np.diagonal(self.covariance, axis1=1, axis2=2)[:, place_of]  # 0 of what stays
        pixels, target = (np.repeat(each, 2) for each in np.nonzero(variance > 0.0))
        side = np.arange(pixels.size) % 2
        place, tied = place_of[target], target == n + 3
        direction = self._direction(pixels, target) * (2.0 * side - 1.0)[:, None]
        theta, top = self.theta[pixels], self.loglik[pixels]
        # distances at which the likelihood has fallen by less and by more, and the roots of the drop there
        distance, drop = np.repeat([[[0.0], [np.inf]]] * 2, pixels.size, axis=2)
        ahead, reached = np.full(pixels.size, root), np.zeros(pixels.size, np.bool_)
        active = np.arange(pixels.size)
        for _ in range(_OUTER):
            more = ahead[active] - distance[0, active]
            start = self._moved(theta[active], direction[active], more, tied[active])
            found, loglik, _ = self._climb(pixels[active], start, place[active], tied[active])
            fallen = np.sqrt(np.maximum(2.0 * (top[active] - loglik), 0.0))
            reached[active] = abs(fallen - root) < _CLOSE * root
            nearer = (fallen < root) | reached[active]
            theta[active[nearer]] = found[nearer]
            which = (~nearer).astype(np.intp)
            distance[which, active], drop[which, active] = ahead[active], fallen
            active = active[~reached[active]]
            (near, far), (below, above) = distance[:, active], drop[:, active]
            share = np.where(np.isinf(above), 0.5, np.clip((root - below) / (above - below), 0.05, 0.95))
            farther = np.minimum(3.0, root / np.maximum(below, 0.1 * root) * 1.02) * ahead[active]
            bracketed = np.isfinite(far)
            width = np.where(bracketed, far, 0.0) - near
            ahead[active] = np.where(bracketed, near + share * width, farther)
            closed = bracketed & (width < 1e-7 * root)
            reached[active] = closed & np.isfinite(above)
            active = active[~closed & (bracketed | (farther <= _FARTHEST * root))]
            if active.size == 0:
                break
        parameters, _ = self._natural(theta)
        values = np.column_stack([parameters, parameters[:, n] * parameters[:, n + 2]])
        side = np.where(target == n + px.STEP, 1 - side, side)  # a larger step is a smaller gain
        ends = np.full((len(self.theta), n + 4, 2), np.nan)
        ends[pixels, target, side] = np.where(reached, values[np.arange(pixels.size), target], np.nan)
        return ends

    def _along_bias(self, reach: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Find the best other parameters at biases on both sides, ``reach`` e- in any case, shape (n,).

        Returns:
            (H_1 ... H_J, g, mu, sigma), those of the maximum in the middle, shape (n, 2 m + 1, J + 3); the
            covariances of all but the bias, 0 for what stays, (n, 2 m + 1, J + 3, J + 3); the log-likelihood
            above that of the maximum, (n, 2 m + 1), -inf where nothing was looked at.
        """
        n, count, nodes = self._n, len(self.theta), 2 * _MOST + 1
        found, heights = np.zeros((count, nodes, n + 3)), np.full((count, nodes), -np.inf)
        across = np.zeros((count, nodes, n + 3, n + 3))
        regular = np.flatnonzero(np.isfinite(self.covariance[:, 0, 0]))
        direction = self._direction(regular, np.full(regular.size, n + px.BIAS))
        for side in (-1, 0, 1):
            pixels, theta, along = regular, self.theta[regular], direction
            for i in range(1 if side == 0 else _MOST):
                place = _MOST + side * (i + 1)
                theta, loglik, covariance = self._climb(pixels, theta + side * _SPACING * along, n + px.BIAS)
                fine = np.isfinite(covariance[:, 0, 0])
                pixels, theta, along = pixels[fine], theta[fine], along[fine]
                height = loglik[fine] - self.loglik[pixels]
                found[pixels, place], slope = self._natural(theta)
                own = covariance[fine, : n + 3, : n + 3]
                across[pixels, place] = own * slope[:, :, None] * slope[:, None, :]
                heights[pixels, place] = height
                walked = np.abs(theta[:, n + px.BIAS] - self.theta[pixels, n + px.BIAS])
                going = ~((walked > reach[pixels] * self.theta[pixels, n + px.STEP]) & (height < -_DEEPEST))
                pixels, theta, along = pixels[going], theta[going], along[going]
                if pixels.size == 0:
                    break
        return found, across, heights

    def moments(self, parameters: FloatArray, reach: FloatArray) -> Moments:
        """Return the moments of the likelihood over the parameters, along the profile of the bias.

        About parameters at the maximum, shape (n, J + 3), NaN where there is none. Another maximum may lie
        within ``reach`` on either side, e-, shape (n,).
        """
        size = parameters.shape[1]
        found, across, heights = self._along_bias(reach)
        walked = heights > -np.inf
        # Laplace's volume across the bias would multiply this; Jeffreys' prior across divides by it
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
        covariance = np.einsum("nt,nti,ntj->nij", own, off, off) + np.einsum("nt,ntij->nij", own, across)
        covariance[~walked[:, _MOST]] = np.nan
        rivals = parameters[:, None] + np.einsum("nst,nti->nsi", np.nan_to_num(rest), off)
        return Moments(covariance, np.nan_to_num(share), rivals)

    def _natural(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (H_1 ... H_J, g, mu, sigma), and their slopes in (H_1 ... H_J, 1/g, mu, v), (m, J + 3)."""
        n = self._n
        variance = np.exp(theta[:, n + px.LOG_VARIANCE])
        gain, sigma = 1.0 / theta[:, n + px.STEP], np.sqrt(variance + self._rounding)
        slope = np.ones((len(theta), n + 3))
        slope[:, n + px.STEP], slope[:, n + px.LOG_VARIANCE] = -(gain**2), 0.5 * variance / sigma
        exposure = np.where(self._given.dark, 0.0, np.exp(theta[:, :n]))
        return np.column_stack([exposure, gain, theta[:, n + px.BIAS], sigma]), slope
