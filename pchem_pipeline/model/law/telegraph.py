"""Exposures that blink: the steps and states of a pixel whose exposure is switched between levels.

The samples are those of a hidden Markov model (Baum et al. 1970): each of one or two independent processes
adds its step to the pixel's own exposure while it is up, the electrons are Poisson, and the comb is that of
the pixel's fit. Frames that were not observed only let the states forget.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize
from scipy.special import gammaln

from pchem_pipeline.base.arrays import FloatArray, IntArray, IntegerArray
from pchem_pipeline.model.law import telegraph_numba

# rise of the log-likelihood, nats, that the first and the second process must bring; pixels of constant
# exposure reach the first by chance in about one of 340
_RISES = (6.0, 5.0)
# rise that one of the starts must bring by itself, nats: one pixel in fifty of constant exposure does
_PROMISING = 2.0
LEAST_EXPOSURE = 0.02  # e-
_LARGEST_STEP = 50.0  # e-
_LEAST_SHARE = 0.02
_SHORTEST = 0.5  # frames
# starts: correlation times (as parts of the run, on a logarithmic scale), shares, and steps in units of the
# root of the exposure
_TIMES = (0.2, 0.45, 0.65)
_SHARES = (0.3, 0.7)
_STEPS = (0.3, 0.8)
_REFINED = 2


class _Series:
    """The samples of a pixel, and their law given the exposure."""

    def __init__(self, samples: IntegerArray, frames: IntArray, pixel: FloatArray) -> None:
        exposure, gain, bias, sigma = (float(v) for v in pixel)
        codes, place = np.unique(samples, return_inverse=True)
        self.samples = np.ascontiguousarray(place, np.int64)
        self.gaps, gap_of = np.unique(np.diff(frames, prepend=frames[0]), return_inverse=True)
        self.gap_of = np.ascontiguousarray(gap_of, np.int64)
        self.run = float(frames[-1] - frames[0] + 1)
        self.mean = exposure
        most = (float(codes[-1]) - bias) * gain + 8.0 * gain * sigma
        self.electrons = np.arange(max(int(most), int(2.0 * exposure), 0) + 2.0)
        z = (codes[:, None] - bias - self.electrons / gain) / sigma
        self.comb = np.exp(-0.5 * z * z)
        self.factorial = gammaln(self.electrons + 1.0)

    def emission(self, exposures: FloatArray) -> FloatArray:
        """Return the relative probability of each code at each exposure, (codes, exposures)."""
        poisson = np.exp(self.electrons[:, None] * np.log(exposures) - exposures - self.factorial[:, None])
        # a code that the comb forbids tells nothing of the state
        return np.asarray(np.maximum(self.comb @ poisson, 1e-30))

    def height(self, theta: FloatArray, states: bool = False) -> tuple[float, FloatArray]:
        """Return the log-likelihood, and the probability of each state in each frame if asked for."""
        exposure, step, share, tau = unpacked(theta)
        emission = self.emission(exposure + added_of(step))
        start, moves = transitions(share, tau, self.gaps)
        state = np.empty((self.samples.size if states else 0, start.size))
        height = telegraph_numba.filtered(emission, self.samples, start, moves, self.gap_of, state)
        return float(height), state

    def climbed(self, theta: FloatArray) -> tuple[float, FloatArray]:
        """Return the highest log-likelihood from a start, and where it is."""
        logit = np.log(1.0 / _LEAST_SHARE - 1.0)
        process = [
            (np.log(LEAST_EXPOSURE), np.log(_LARGEST_STEP)),
            (-logit, logit),
            (np.log(_SHORTEST), np.log(max(self.run, 4.0 * _SHORTEST))),
        ]
        bounds = [(np.log(LEAST_EXPOSURE), None), *process * (theta.size // 3)]
        found = minimize(lambda t: -self.height(t)[0], theta, method="L-BFGS-B", bounds=bounds)
        return -float(found.fun), np.asarray(found.x)


def unpacked(theta: FloatArray) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """Return exposure, steps, shares and times of (log H, then log A, logit share, log tau of each)."""
    rest = theta[1:].reshape(-1, 3)
    return float(np.exp(theta[0])), np.exp(rest[:, 0]), 1.0 / (1.0 + np.exp(-rest[:, 1])), np.exp(rest[:, 2])


def added_of(step: FloatArray) -> FloatArray:
    """Return what each state adds: bit d of its number says whether process d is up."""
    states = np.arange(1 << step.size)
    return np.asarray(((states[:, None] >> np.arange(step.size)) & 1) @ step)


def transitions(share: FloatArray, tau: FloatArray, gaps: IntegerArray) -> tuple[FloatArray, FloatArray]:
    """Return the probabilities of the states, (s,), and from each to each over gaps, (g, s, s).

    Over a gap, frames, each process keeps its state with its correlation, of time tau, frames, or takes one
    by chance, up for a share; the first process is the lowest bit of a state's number.
    """
    start, moves = np.ones(1), np.ones((gaps.size, 1, 1))
    for s, t in zip(share, tau, strict=True):
        kept, own = np.exp(-gaps / t)[:, None, None], np.array([1.0 - s, s])
        one = kept * np.eye(2) + (1.0 - kept) * own
        start = np.kron(own, start)
        moves = np.einsum("gab,gij->gaibj", one, moves).reshape(gaps.size, start.size, start.size)
    return start, moves


def find_telegraph(
    samples: IntegerArray, frames: IntArray, pixel: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Return how a pixel's exposure blinks, or None where a constant one explains the samples as well.

    The samples, DN, have increasing frame numbers; the pixel is (H, g, mu, sigma), H the mean exposure.

    Returns:
        Of the states of d processes the exposure that each adds, e-, shape (2 ** d,), the first 0; part of
        these frames spent in each, shape (2 ** d,).
    """
    series = _Series(samples, frames, pixel)
    theta = np.log([series.mean])
    found = series.height(theta)[0]
    for rise in _RISES:
        starts = _starts(series, theta)
        if not starts or starts[0][0] < found + _PROMISING:
            break
        height, best = max((series.climbed(start) for _, start in starts[:_REFINED]), key=lambda f: f[0])
        if height < found + rise:
            break
        found, theta = height, best
    if theta.size == 1:
        return None
    return added_of(unpacked(theta)[1]), series.height(theta, states=True)[1].mean(axis=0)


def _starts(series: _Series, theta: FloatArray) -> list[tuple[float, FloatArray]]:
    """Return starts with one process more at the same mean exposure and how high each is, highest first."""
    exposure = float(np.exp(theta[0]))
    found = []
    for time in _TIMES:
        tau = max(series.run**time, 2.0 * _SHORTEST)
        for share in _SHARES:
            for step in np.asarray(_STEPS) * np.sqrt(exposure):
                own = exposure - share * step
                if own > 0.1 * exposure:
                    more = [np.log(step), np.log(share / (1.0 - share)), np.log(tau)]
                    start = np.array([np.log(own), *theta[1:], *more])
                    found.append((series.height(start)[0], start))
    return sorted(found, key=lambda f: f[0], reverse=True)
