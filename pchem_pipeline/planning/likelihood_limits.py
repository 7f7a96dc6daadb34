"""What the Cramer-Rao bound does not see: electron numbers off by one, and the error of rounding.

Both are distances between laws, found by maximising an expected log-likelihood: how near the fit of
infinitely many frames comes with every electron number one too large or too small, and where it ends when the
data are rounded and the model is not.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from pchem_pipeline.model.pcd import QUANTISATION_VARIANCE, log_pcd, pcd_mass
from pchem_pipeline.planning.point import FloatArray, Point

__all__ = ["Ambiguity", "ambiguity", "rounding_shift"]

_COARSE = 0.9  # DN: rounding errors fall as exp(-2 pi^2 sigma^2), to 1e-7 here
_OFFSETS = (1.0, 0.75, 0.5, 1.25)  # e- off at the brightest sample; the rival lies near 1
_LEAST_EXPOSURE = 0.02


@dataclass(frozen=True)
class Ambiguity:
    """How one frame tells the truth from the nearest rival that is an electron off.

    Attributes:
        mean: expected gap of the log-likelihoods, nats per frame; infinite where there is no rival.
        variance: of that gap, nats^2 per frame.
    """

    mean: float
    variance: float

    def frames(self, gap: float = 5.0, sigmas: float = 3.0) -> float:
        """Return the frames after which the gap exceeds ``gap`` nats, even where it comes out low."""
        if self.mean <= 0 or not np.isfinite(self.mean):
            return 0.0 if self.mean > 0 else float("inf")
        spread = sigmas * np.sqrt(self.variance)
        root = (spread + np.sqrt(spread**2 + 4 * self.mean * gap)) / (2 * self.mean)
        return float(np.ceil(root**2))


def ambiguity(exposures: Sequence[float], shares: Sequence[float], read_noise_e: float) -> Ambiguity:
    """Return how well samples tell the truth from rivals with other electron numbers, per frame.

    The exposure of the brightest sample is held half an electron or more off, and everything else is fitted.
    With one sample the rival is the neighbour ``(H -+ 1, mu +- 1/g)``; with bias frames too it has another
    gain. Where
    there is no second maximum, the mean is infinite: the bound alone says what the samples tell.

    Args:
        exposures: H of the samples, e-; 0 for bias frames.
        shares: of the frames that each has, adding up to 1.
        read_noise_e: s_e, e-.
    """
    lit = [(float(h), float(p)) for h, p in zip(exposures, shares, strict=True) if h > 0 and p > 0]
    dark = sum(float(p) for h, p in zip(exposures, shares, strict=True) if h == 0)
    lit.sort()
    laws = [_Law.of(h, p, read_noise_e) for h, p in lit]
    top = lit[-1][0]
    found = Ambiguity(float("inf"), 0.0)
    for side in (-1.0, 1.0):
        heights: list[tuple[float, Ambiguity]] = []
        step = None
        for offset in (offset for offset in _OFFSETS if top + side * offset >= _LEAST_EXPOSURE):
            rival = _Rival(laws, dark, read_noise_e, top + side * offset)
            starts = [step] if step is not None else rival.starts([h for h, _ in lit])
            step, _ = min((_descend(rival.cost, start) for start in starts), key=lambda end: end[1])
            heights.append((offset, rival.at(step)))
        heights.sort(key=lambda each: each[0])
        for (_, nearer), (_, farther) in itertools.pairwise(heights):
            # a second maximum only where the distance falls again on the way outwards
            if farther.mean < min(nearer.mean, found.mean):
                found = farther
    return found


@dataclass(frozen=True)
class _Law:
    """The true density of a sample in electrons, on nodes."""

    y: FloatArray
    weights: FloatArray
    log_density: FloatArray
    share: float

    @classmethod
    def of(cls, exposure: float, share: float, noise: float) -> _Law:
        width = 9 * np.sqrt(exposure) + 9
        y = np.arange(max(0.0, exposure - width) - 8 * noise, exposure + width + 8 * noise, noise / 3)
        log_density = log_pcd(y, exposure, 1.0, 0.0, noise)
        weights = np.exp(log_density)
        keep = weights > 1e-14 * weights.max()
        return cls(y[keep], weights[keep] / weights[keep].sum(), log_density[keep], share)


@dataclass(frozen=True)
class _Rival:
    """Laws with the brightest exposure held; free are (ln g, g mu, ln sigma, ln of the other H)."""

    laws: Sequence[_Law]
    dark: float
    noise: float
    brightest: float

    def starts(self, exposures: Sequence[float]) -> list[FloatArray]:
        """Return where to start: all electron numbers shifted, and all of them scaled."""
        shift = self.brightest - exposures[-1]
        shifted = [np.log(max(h + shift, _LEAST_EXPOSURE)) for h in exposures[:-1]]
        scale = self.brightest / exposures[-1]
        scaled = [np.log(h * scale) for h in exposures[:-1]]
        noise = np.log(self.noise)
        starts = [np.array([0.0, -shift, noise, *shifted])]
        if self.dark > 0 or shifted:
            starts.append(np.array([np.log(scale), 0.0, noise, *scaled]))
        return starts

    def gaps(self, step: FloatArray) -> list[FloatArray]:
        """Return the log-likelihood ratios of truth and rival on the nodes of every sample."""
        gain, bias, sigma = np.exp(step[0]), step[1], np.exp(step[2])
        exposures = [*np.exp(step[3:]), self.brightest]
        return [
            law.log_density - log_pcd(law.y, h, gain, bias, sigma)
            for law, h in zip(self.laws, exposures, strict=True)
        ]

    def cost(self, step: FloatArray) -> float:
        """Return the expected gap per frame, nats."""
        total = sum(
            law.share * float(law.weights @ gap) for law, gap in zip(self.laws, self.gaps(step), strict=True)
        )
        return total + self.dark * self._dark_gap(step)[0]

    def at(self, step: FloatArray) -> Ambiguity:
        """Return mean and variance of the gap per frame."""
        variance = self.dark * self._dark_gap(step)[1]
        for law, gap in zip(self.laws, self.gaps(step), strict=True):
            mean = float(law.weights @ gap)
            variance += law.share * float(law.weights @ (gap - mean) ** 2)
        return Ambiguity(self.cost(step), variance)

    def _dark_gap(self, step: FloatArray) -> tuple[float, float]:
        """Return mean and variance of the gap of one bias frame: two normal laws."""
        ratio, shift = np.exp(2 * (np.log(self.noise) - step[2])), step[1] / np.exp(step[2])
        mean = 0.5 * (ratio - 1 - np.log(ratio) + shift**2)
        return float(mean), float(0.5 * (ratio - 1) ** 2 + ratio * shift**2)


def _descend(cost: Callable[[FloatArray], float], start: FloatArray) -> tuple[FloatArray, float]:
    """Return the minimum next to a start, and its height."""
    result = minimize(cost, start, method="BFGS", options={"gtol": 1e-6, "maxiter": 200})
    return np.asarray(result.x, np.float64), float(result.fun)


def rounding_shift(point: Point) -> FloatArray:
    """Return the error of the fit from infinitely many rounded frames, root mean square over the place of mu.

    The fit treats rounding as noise of 1/12 DN^2 (Hendrickson et al. 2023, eq. X_density), which holds as
    long as sigma is not small against a DN.

    Returns:
        Of (H, ln g, g mu, ln sigma), shape (4,); zeros where sigma is above 0.9 DN.
    """
    sigma = point.read_noise_dn
    if sigma >= _COARSE:
        return np.zeros(4)
    exposure, gain = point.quanta_exposure, point.conversion_gain
    analog = gain * np.sqrt(max(sigma**2 - QUANTISATION_VARIANCE, 0.0))
    last = (exposure + 12 * np.sqrt(exposure) + 12) / gain + 12 * sigma
    x = np.arange(np.floor(-12 * sigma) - 1, last + 2)
    shifts = [_shift(x, point, analog, offset) for offset in (0.0, 0.25, 0.5, 0.75)]
    return np.asarray(np.sqrt(np.mean(np.square(shifts), axis=0)))


def _shift(x: FloatArray, point: Point, analog: float, offset: float) -> FloatArray:
    """Return the error of the fit with the bias at one place between two DN."""
    exposure, gain = point.quanta_exposure, point.conversion_gain
    mass = pcd_mass(x, exposure, gain, offset, analog)
    used = mass > 1e-14 * mass.max()
    places, weights = x[used], mass[used] / mass[used].sum()
    origin = np.array([np.log(exposure), np.log(gain), offset, np.log(point.read_noise_dn)])

    def cost(step: FloatArray) -> float:
        h, g, mu, s = origin + step
        return -float(weights @ log_pcd(places, np.exp(h), np.exp(g), mu, np.exp(s)))

    step, _ = _descend(cost, np.zeros(4))
    return np.array([exposure * np.expm1(step[0]), step[1], step[2] * gain, step[3]])
