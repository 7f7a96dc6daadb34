"""What the Cramer-Rao bound does not see: electron numbers off by one, and quite other gains.

Both are distances between laws, found by maximising an expected log-likelihood: how near the fit of
infinitely many frames comes with every electron number one too large or too small, or with another gain.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.special import logsumexp

from pchem_pipeline.base.units import FEW_STEP
from pchem_pipeline.model.law.pcd import log_pcd
from pchem_pipeline.model.law.telegraph import LEAST_EXPOSURE
from pchem_pipeline.planning.point import FloatArray

_OFFSETS = (1.0, 0.75, 0.5, 1.25)  # e- off at the brightest sample; the rival lies near 1
_GAIN_CHANGES = (0.1, 0.2)  # of ln g
_PHASE = 0.3  # DN from a whole number to the bias


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
    gain. Where there is no second maximum, the mean is infinite: the bound alone says what the samples tell.

    Args:
        exposures: H of the samples, e-; 0 for bias frames.
        shares: of the frames that each has, adding up to 1.
        read_noise_e: s_e, e-.
    """
    lights, laws, dark = _split_off_bias(exposures, shares, read_noise_e)
    top, noise = lights[-1], np.log(read_noise_e)
    found = Ambiguity(float("inf"), 0.0)
    for side in (-1.0, 1.0):
        heights: list[tuple[float, Ambiguity]] = []
        step = None
        for offset in (offset for offset in _OFFSETS if top + side * offset >= LEAST_EXPOSURE):
            held = top + side * offset
            rival = _Rival(laws, dark, read_noise_e, 2 + len(lights), float(np.log(held)))
            shift, scale = held - top, held / top
            starts = [rival.free([0.0, -shift, noise, *_logs([h + shift for h in lights])])]
            if dark > 0 or len(lights) > 1:
                starts.append(rival.free([np.log(scale), 0.0, noise, *_logs([h * scale for h in lights])]))
            if step is not None:
                starts = [step]
            step, _ = min((_descend(rival.cost, start) for start in starts), key=lambda end: end[1])
            heights.append((offset, rival.at(step)))
        heights.sort(key=lambda each: each[0])
        for (_, nearer), (_, farther) in itertools.pairwise(heights):
            # a second maximum only where the distance falls again on the way outwards
            if farther.mean < min(nearer.mean, found.mean):
                found = farther
    return found


def gain_rival(
    exposures: Sequence[float],
    shares: Sequence[float],
    read_noise_e: float,
    nearest: float = 0.1,
    gain: float = 0.0,
) -> Ambiguity:
    """Return how well samples tell the truth from laws with quite another gain, per frame.

    The bound looks at the peak of the likelihood alone. Where peaks of the histogram are weak and electrons
    many, chance makes other gains as likely, and a fit ends there. Whole numbers show a comb of g cycles per
    DN at ``1 - g`` as well: near 2 DN per electron that is another one.

    Args:
        exposures: H of the samples, e-; 0 for bias frames.
        shares: of the frames that each has, adding up to 1.
        read_noise_e: s_e, e-.
        nearest: smallest change of ln g to look at.
        gain: g, e-/DN; matters where a DN is no small part of an electron.
    """
    few = gain > 1.0 / FEW_STEP
    lights, laws, dark = _split_off_bias(exposures, shares, read_noise_e, gain if few else 0.0)
    found, top = Ambiguity(float("inf"), 0.0), lights[-1]
    changes = [side * offset for offset in _GAIN_CHANGES for side in (-1.0, 1.0) if offset > nearest - 1e-9]
    # the same means, and without bias frames the same mean variance: H g^-2
    starts = [(c, 0.0 if dark > 0 else float(np.mean(lights) * (1 - np.exp(c)))) for c in changes]
    if few and gain < 1.0:
        # its peaks lie on the same whole numbers
        nearly = _PHASE + top * (2 * gain - 1) * (1 - gain) / gain**2
        numbers = np.round(nearly) + np.array([-1.0, 0.0, 1.0])
        starts += [(np.log(1 / gain - 1), float((m - _PHASE) * gain / (1 - gain))) for m in numbers]
    for change, bias in starts:
        rival = _Rival(laws, dark, read_noise_e, 0, change)
        others = [(h - bias) * np.exp(change) for h in lights]
        start = rival.free([change, bias, np.log(read_noise_e), *_logs(others)])
        step, height = _descend(rival.cost, start)
        if height < found.mean:
            found = rival.at(step)
    return found


def _split_off_bias(
    exposures: Sequence[float], shares: Sequence[float], noise: float, step: float = 0.0
) -> tuple[list[float], list[_Law], float]:
    """Return the exposures with electrons, rising, their laws, and the share of bias frames."""
    pairs = list(zip(map(float, exposures), map(float, shares), strict=True))
    lit = sorted((h, p) for h, p in pairs if h > 0 and p > 0)
    dark = sum(p for h, p in pairs if h == 0)
    return [h for h, _ in lit], [_Law.of(h, p, noise, step) for h, p in lit], dark


def _logs(exposures: Sequence[float]) -> list[float]:
    return [float(np.log(max(h, LEAST_EXPOSURE))) for h in exposures]


@dataclass(frozen=True)
class _Law:
    """The true density of a sample in electrons, on nodes: so close that sums are integrals, or whole DN."""

    y: FloatArray
    weights: FloatArray
    log_density: FloatArray
    share: float

    @classmethod
    def of(cls, exposure: float, share: float, noise: float, step: float = 0.0) -> _Law:
        width = 9 * np.sqrt(exposure) + 9
        low, high = max(0.0, exposure - width) - 8 * noise, exposure + width + 8 * noise
        y = np.arange(low, high, noise / 2.5)
        if step:
            y = step * (np.arange(np.floor(low / step), np.ceil(high / step)) - _PHASE)
        log_density = log_pcd(y, exposure, 1.0, 0.0, noise)
        weights = np.exp(log_density)
        keep = weights > 1e-14 * weights.max()
        return cls(y[keep], weights[keep] / weights[keep].sum(), log_density[keep], share)


@dataclass(frozen=True)
class _Rival:
    """Laws with one of (ln g, g mu, ln sigma, ln H of each lit sample) held, and the others free."""

    laws: Sequence[_Law]
    dark: float
    noise: float
    place: int
    value: float

    def free(self, theta: Sequence[float]) -> FloatArray:
        """Return the parameters without the held one."""
        return np.delete(np.asarray(theta, np.float64), self.place)

    def gaps(self, step: FloatArray) -> tuple[list[FloatArray], FloatArray]:
        """Return the log-likelihood ratios of truth and rival on the nodes of every sample, and the rival."""
        theta = np.insert(step, self.place, self.value)
        gain, bias, sigma = np.exp(theta[0]), theta[1], np.exp(theta[2])
        gaps = []
        for law, h in zip(self.laws, np.exp(theta[3:]), strict=True):
            other = log_pcd(law.y, h, gain, bias, sigma)
            # on whole numbers a density need not add up to 1
            gaps.append(law.log_density - other - logsumexp(law.log_density) + logsumexp(other))
        return gaps, theta

    def cost(self, step: FloatArray) -> float:
        """Return the expected gap per frame, nats."""
        gaps, theta = self.gaps(step)
        total = sum(law.share * float(law.weights @ gap) for law, gap in zip(self.laws, gaps, strict=True))
        return total + self.dark * self._dark_gap(theta)[0]

    def at(self, step: FloatArray) -> Ambiguity:
        """Return mean and variance of the gap per frame."""
        gaps, theta = self.gaps(step)
        variance = self.dark * self._dark_gap(theta)[1]
        for law, gap in zip(self.laws, gaps, strict=True):
            mean = float(law.weights @ gap)
            variance += law.share * float(law.weights @ (gap - mean) ** 2)
        return Ambiguity(self.cost(step), variance)

    def _dark_gap(self, theta: FloatArray) -> tuple[float, float]:
        """Return mean and variance of the gap of one bias frame: two normal laws."""
        ratio, shift = np.exp(2 * (np.log(self.noise) - theta[2])), theta[1] / np.exp(theta[2])
        mean = 0.5 * (ratio - 1 - np.log(ratio) + shift**2)
        return float(mean), float(0.5 * (ratio - 1) ** 2 + ratio * shift**2)


def _descend(cost: Callable[[FloatArray], float], start: FloatArray) -> tuple[FloatArray, float]:
    """Return the minimum next to a start, and its height."""
    result = minimize(cost, start, method="BFGS", options={"gtol": 1e-6, "maxiter": 100})
    return np.asarray(result.x, np.float64), float(result.fun)
