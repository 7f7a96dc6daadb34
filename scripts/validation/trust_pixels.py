"""Pixels drawn at random, fitted by the package, judged by a likelihood of its own in plain numpy.

The judge shares no code with the package. The mass of a code x is ``sum_k Poisson(k; H)
[Phi((x + 1/2 - m_k) / s) - Phi((x - 1/2 - m_k) / s)]`` with ``m_k = mu + a k``, a DN per electron, s the read
noise before rounding; a code at a limit of the ADC holds all that is beyond it. It is climbed by damped
scoring steps from the truth, from the fit and from other gains and biases.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, ndtr

from pchem_pipeline import fit_counts
from pchem_pipeline.model.fit import status

Array = NDArray[np.float64]
NAMES = ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn")
LIMITS = (0, 2**18 - 1)  # codes of the ADC of pixels that are clipped, DN
GAINS = (1 / 3, 1 / 2, 2 / 3, 1.0, 3 / 2, 2.0, 3.0)  # of the starts, over the true DN per electron
SHIFTS = (-2, -1, 0, 1, 2)  # of their bias, electrons
BETTER, UNLIKELY = 3.0, 15.0  # nats: a rival that counts, a truth that is excluded
_LARGEST = 4_000_000  # bins of one call of the fit
_CELLS = 400  # beyond it starts are climbed on merged codes
_LOG_FACTORIAL = gammaln(np.arange(1, 4002, dtype=float))


@dataclass(frozen=True)
class Pixel:
    """Samples of a pixel, DN, and their true (H, g, mu, sigma); ``number`` draws it again."""

    number: int
    samples: NDArray[np.int64]
    truth: Array
    clipped: str

    @property
    def regime(self) -> dict[str, float | str]:
        """Return H, read noise (e-), DN per electron, frames and the clipped end."""
        exposure, gain, _, sigma = self.truth
        noise = gain * (sigma**2 - 1 / 12) ** 0.5
        return {
            "H": exposure,
            "noise": noise,
            "step": 1 / gain,
            "frames": self.samples.size,
            "clipped": self.clipped,
        }


def draw(number: int) -> Pixel:
    """Draw a pixel from the whole box; every fourth is clipped at one end."""
    rng = np.random.default_rng(number)
    exposure, step = np.exp(rng.uniform(np.log((0.001, 1.2)), np.log((60, 1500))))
    frames, noise = int(np.exp(rng.uniform(np.log(100), np.log(20_000)))), rng.uniform(0.05, 1.0)
    bias, clipped = rng.uniform(1000, 1100), rng.choice(["", "", "", "", "", "", "low", "high"])
    values = (rng.poisson(exposure, frames) + noise * rng.normal(size=frames)) * step
    sd = np.hypot(noise * step, 12**-0.5)
    if clipped == "low":
        bias = LIMITS[0] + rng.uniform(0, 3) * sd
    elif clipped == "high":
        bias = LIMITS[1] - np.quantile(values, rng.uniform(0.7, 0.999))
    samples = np.rint(values + bias).astype(np.int64)
    samples = samples.clip(*LIMITS) if clipped else samples
    return Pixel(number, samples, np.array([exposure, 1 / step, bias, sd]), str(clipped))


@dataclass
class Fits:
    """What the package says of pixels: parameters and errors (pixel, 4), status words."""

    values: Array
    stderr: Array
    words: NDArray[np.int64]


def fit(pixels: list[Pixel]) -> Fits:
    """Fit pixels, those of like width and limits in one call."""
    n = len(pixels)
    found = Fits(np.full((n, 4), np.nan), np.full((n, 4), np.nan), np.zeros(n, np.int64))
    widths = np.array([np.ptp(pixel.samples) + 1 for pixel in pixels])
    group = 2 * np.ceil(np.log2(widths)).astype(int) + [bool(pixel.clipped) for pixel in pixels]
    for each in np.unique(group):
        members = np.flatnonzero(group == each)
        for some in np.array_split(members, -(-members.size * widths[members].max() // _LARGEST)):
            origin = np.array([pixels[i].samples.min() for i in some])
            width = widths[some].max()
            counts = np.stack(
                [
                    np.bincount(pixels[i].samples - o, minlength=width)
                    for i, o in zip(some, origin, strict=True)
                ]
            )
            result = fit_counts(counts, origin, adc_limits=LIMITS if each % 2 else None)
            found.values[some] = np.column_stack([getattr(result, name) for name in NAMES])
            found.stderr[some] = np.sqrt(np.diagonal(result.covariance, axis1=1, axis2=2))
            found.words[some] = result.fit_status
    return found


class Judge:
    """The likelihood of one pixel; parameters are rows of (log H, log a, mu, log s)."""

    def __init__(self, pixel: Pixel, merge: int = 1) -> None:
        """Count the codes, ``merge`` neighbours together except those at a limit."""
        codes, counts = np.unique(pixel.samples, return_counts=True)
        ends = np.isin(codes, LIMITS) if pixel.clipped else np.zeros(codes.size, bool)
        first = (codes - codes[0]) // merge
        inner, where = np.unique(first[~ends], return_inverse=True)
        low = inner * merge + codes[0] - 0.5
        self.low, self.high = low, low + merge
        if pixel.clipped:
            self.low, self.high = low.clip(LIMITS[0] + 0.5), self.high.clip(None, LIMITS[1] - 0.5)
        self.counts = np.concatenate([np.bincount(where, counts[~ends], inner.size), counts[ends]])
        at_low = codes[ends] == LIMITS[0]
        self.open_low = np.where(at_low, -np.inf, LIMITS[1] - 0.5)
        self.open_high = np.where(at_low, LIMITS[0] + 0.5, np.inf)

    def scores(self, theta: Array) -> tuple[Array, Array]:
        """Return log-likelihoods (start,) and scores of the cells (start, cell, 4)."""
        log_h, a, mu, s = theta[:, :1], np.exp(theta[:, 1:2]), theta[:, 2:3], np.exp(theta[:, 3:])
        nearest = np.rint(((self.low + self.high) / 2 - mu) / a).clip(0, 4000)
        reach = int(np.ceil(7 * (s / a).max() + ((self.high - self.low).max(initial=0) / a).max() / 2)) + 1
        k = nearest[:, :, None] + np.arange(-reach, reach + 1)
        parts = [_mass(theta, self.low, self.high, k)]
        if self.open_low.size:
            most = int(np.exp(log_h).max() + 12 * np.exp(log_h / 2).max() + 30)
            k = np.broadcast_to(np.arange(most, dtype=float), (len(theta), self.open_low.size, most))
            parts.append(_mass(theta, self.open_low, self.open_high, k))
        mass, slopes = (np.concatenate(each, axis=1) for each in zip(*parts, strict=True))
        mass = mass.clip(1e-300)
        return np.log(mass) @ self.counts, slopes / mass[:, :, None]

    def climb(self, theta: Array, steps: int) -> tuple[Array, Array]:
        """Return better parameters and their log-likelihoods, by damped scoring steps."""
        theta = _bounded(theta)
        damping = np.full(len(theta), 1e-2)
        height, scores = self.scores(theta)
        for _ in range(steps):
            slope = np.einsum("sjp,j->sp", scores, self.counts)
            square = np.einsum("sjp,sjq,j->spq", scores, scores, self.counts, optimize=True)
            diagonal = np.einsum("spp->sp", square) + 1e-9
            square[:, range(4), range(4)] += damping[:, None] * diagonal + 1e-9
            step = np.linalg.solve(square, slope[:, :, None])[:, :, 0]
            gain = (step * slope).sum(axis=1) / 2
            if (gain < 1e-4).all():
                break
            tried = _bounded(theta + step.clip(-1, 1) * [1, 1, 0, 1] + step * [0, 0, 1, 0])
            new_height, new_scores = self.scores(tried)
            up = new_height > height
            theta[up], height[up], scores[up] = tried[up], new_height[up], new_scores[up]
            damping = np.where(up, damping / 5, damping * 8).clip(1e-6, 1e6)
        return theta, height


def _mass(theta: Array, low: Array, high: Array, k: Array) -> tuple[Array, Array]:
    """Return masses (start, cell) and slopes (start, cell, 4), summed over the electron numbers k."""
    log_h, a, mu, s = (
        column[:, None, None]
        for column in (theta[:, 0], np.exp(theta[:, 1]), theta[:, 2], np.exp(theta[:, 3]))
    )
    index = k.clip(0, 4000).astype(np.int64)
    weight = np.exp(k * log_h - np.exp(log_h) - _LOG_FACTORIAL[index]) * (k >= 0)
    mean = mu + a * k
    below, above = (low[:, None] - mean) / s, (high[:, None] - mean) / s
    right = below > 0  # there the difference of the upper tails keeps its digits
    mass = ndtr(np.where(right, -below, above)) - ndtr(np.where(right, -above, below))
    at_below, at_above = np.exp(-0.5 * below**2), np.exp(-0.5 * above**2)
    by_mean = (at_below - at_above) * (weight / (np.sqrt(2 * np.pi) * s))
    flat = (
        np.where(np.isfinite(below), below, 0) * at_below - np.where(np.isfinite(above), above, 0) * at_above
    )
    mass *= weight
    slopes = (mass * (k - np.exp(log_h)), by_mean * a * k, by_mean, flat * weight / np.sqrt(2 * np.pi))
    return mass.sum(axis=2), np.stack([each.sum(axis=2) for each in slopes], axis=2)


def _bounded(theta: Array) -> Array:
    """Keep H from 1e-4 to 1,000 e-, s from 0.001 DN to 1.5 e-."""
    out = theta.copy()
    out[:, 0] = out[:, 0].clip(np.log(1e-4), np.log(1e3))
    out[:, 3] = np.clip(out[:, 3], np.log(1e-3), out[:, 1] + np.log(1.5))
    return out


def _theta(values: Array) -> Array:
    """Return (log H, log a, mu, log s) of (H, g, mu, sigma)."""
    h, g, mu, sigma = values
    return np.array([np.log(h), -np.log(g), mu, 0.5 * np.log(max(sigma**2 - 1 / 12, 1e-6))])


def _values(theta: Array) -> Array:
    return np.array([np.exp(theta[0]), np.exp(-theta[1]), theta[2], np.sqrt(np.exp(2 * theta[3]) + 1 / 12)])


def _starts(truth: Array, mean: float, variance: float) -> Array:
    """Return other gains and biases with the mean of the samples, and its read noise or its variance."""
    rows = []
    _, gain, bias, sigma = truth
    for factor in GAINS:
        a = factor / gain
        for shift in SHIFTS:
            if factor == 1 and shift == 0:
                continue
            mu = bias + shift * a
            h = max((mean - mu) / a, 1e-3)
            left = np.sqrt(max(variance - h * a**2, (0.05 * a) ** 2))
            rows += [_theta(np.array([h, 1 / a, mu, s])) for s in ({sigma, left} if factor != 1 else {sigma})]
    return np.array(rows)


@dataclass
class Judgement:
    """Heights of truth and judge over the fit (nats), the judge's parameters, what is off, the verdict."""

    truth: float
    best: float
    at: Array
    beyond: list[str]
    kind: str


def judge(pixel: Pixel, values: Array, stderr: Array, good: NDArray[np.bool_]) -> Judgement:
    """Tell whether the quantities of a fit that are called good (4,) are wrong.

    ``off``: a parameter is beyond 5 standard errors (and a floor of 0.5 %, of the bias 0.01 e-) from the
    truth, and a maximum elsewhere is more than 3 nats higher, or the truth more than 15 lower or its maximum
    higher. ``rival``: the fit is near the truth, yet a maximum more than 3 nats higher is 3 standard errors,
    an electron or 20 % of the gain away.
    """
    exact = Judge(pixel)
    merge = max(1, int(pixel.truth[3] / 3)) if exact.counts.size > _CELLS else 1
    coarse = Judge(pixel, merge) if merge > 1 else exact
    others, height = coarse.climb(_starts(pixel.truth, pixel.samples.mean(), pixel.samples.var()), 4)
    others, height = coarse.climb(others[np.argsort(-height)[:8]], 12)
    kept = others[np.argsort(-height)[:3]]
    here, there = exact.scores(np.stack([_theta(values), _theta(pixel.truth)]))[0]
    climbed, heights = exact.climb(np.vstack([_theta(pixel.truth), _theta(values), kept]), 30)
    best = int(np.argmax(heights))
    at, own = _values(climbed[best]), heights[0]
    floor = np.array(
        [0.005 * pixel.truth[0], 0.005 * pixel.truth[1], 0.01 / pixel.truth[1], 0.005 * pixel.truth[3]]
    )
    errors = np.nan_to_num(stderr, nan=np.inf)  # a sigma at its bound has none
    beyond = good & (np.abs(values - pixel.truth) > 5 * errors + floor)
    far = (good & (np.abs(at - values) > 3 * errors + floor)).any()
    far |= good[2] and abs(at[2] - values[2]) * values[1] > 0.5
    far |= good[1] and abs(at[1] / values[1] - 1) > 0.2
    higher = bool(heights[best] - here > BETTER and far)
    kind = (
        "off"
        if beyond.any() and (higher or own > here + 0.5 or here - there > UNLIKELY)
        else "rival"
        if higher
        else ""
    )
    return Judgement(
        there - here,
        heights[best] - here,
        at,
        [name for name, b in zip(NAMES, beyond, strict=True) if b],
        kind,
    )


def good_words(words: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell which quantities (pixel, 4) of which pixels are called good."""
    return np.column_stack([(words & int(status.FAILED | status.flags_of(name))) == 0 for name in NAMES])
