"""How far an effect moves the scores of a pixel: the exact law of the rounded samples, one pixel at a time.

The efficient score of a polynomial ``He_a(r / sigma) C_b(k; H)`` (Hermite in the noise, Charlier in the
counts) is its expectation given the code, less its projection on the scores of the four parameters of the
PCD (Rao 1948; Neyman 1959). A law that differs from the PCD shifts the mean of that score; the shift of its
standardised sum over ``n`` frames is ``n^(1/2)`` times a number that depends on the pixel's parameters alone.
Dividing what is seen by it estimates the strength of an effect without any simulation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from pchem_pipeline.effects.evidence import PixelMaps
from pchem_pipeline.model.marginal import MarginalModel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pchem_pipeline.effects.base import Effect
    from pchem_pipeline.effects.evidence import Evidence

__all__ = ["PixelLaw", "fit_strength", "select_pixels", "strength_of", "typical_pixels"]

FloatArray = np.ndarray[tuple[int, ...], np.dtype[np.float64]]
_EffectType = TypeVar("_EffectType", bound="Effect")
#: polynomials (a, b) that the four parameters of the PCD take up: bias, exposure, gain, read noise
_PARAMETERS = ((1, 0), (0, 1), (1, 1), (2, 0))
_SMALLEST_MASS = 1e-300
# a pixel's score beyond this many standard deviations of the others is another effect's
_CUT = 4.0
# standard deviations of the noise beyond which the mass of codes is left out
_REACH = 12.0


def select_pixels(maps: PixelMaps, where: NDArray[np.intp]) -> PixelMaps:
    """Return the parameters of some pixels, by their flat indices, each of that shape."""
    names = ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn", "usable")
    return PixelMaps(**{name: np.asarray(getattr(maps, name)).reshape(-1)[where] for name in names})


def typical_pixels(maps: PixelMaps, n: int = 8) -> tuple[NDArray[np.intp], list[NDArray[np.intp]]]:
    """Return up to n pixels that stand for all usable ones, and the pixels that each stands for.

    They are the medians in ``sigma g`` (read noise, e-) of groups of equal size in H. Flat indices.
    """
    usable = np.flatnonzero(np.asarray(maps.usable))
    if usable.size == 0:
        return usable, []
    exposure = np.asarray(maps.quanta_exposure).reshape(-1)
    noise = (np.asarray(maps.read_noise_dn) * np.asarray(maps.conversion_gain)).reshape(-1)
    order = usable[np.argsort(exposure[usable], kind="stable")]
    groups = np.array_split(order, min(n, order.size))
    chosen = [group[np.argsort(noise[group], kind="stable")[group.size // 2]] for group in groups]
    return np.array(chosen, np.intp), groups


class PixelLaw:
    """The PCD of one pixel over its codes, and how another law differs from it.

    Attributes:
        maps: of that pixel, shape (1,) each.
        codes: all DN that matter, shape (n,).
        mass: of the PCD, exactly rounded, shape (n,).
        charge: E[K | x], e-, shape (n,).
        readout: x - mu - E[K | x] / g, DN, shape (n,).
    """

    def __init__(self, maps: PixelMaps, where: int = 0):
        """Tabulate the PCD of one pixel of the maps, by its flat index."""
        self._parameters = exposure, gain, bias, sigma = tuple(
            float(np.asarray(values).reshape(-1)[where])
            for values in (maps.quanta_exposure, maps.conversion_gain, maps.bias, maps.read_noise_dn)
        )
        self.maps = select_pixels(maps, np.array([where]))
        self._analog = float(np.sqrt(max(sigma**2 - 1 / 12, 1e-4)))
        self._counts = _counts(exposure)
        reach = _REACH * max(self._analog, 0.3 / gain)
        levels = bias + self._counts / gain
        self.codes = np.arange(np.floor(levels[0] - reach), np.ceil(levels[-1] + reach) + 1)
        self._parts = [_hermite_cells(a, self.codes, levels, self._analog) for a in range(5)]
        self._weights = [
            _poisson(self._counts, exposure) * _charlier(b, self._counts, exposure) for b in range(4)
        ]
        self.mass = np.maximum(self._weights[0] @ self._parts[0], _SMALLEST_MASS)
        self.charge = ((self._weights[0] * self._counts) @ self._parts[0]) / self.mass
        self.readout = self.codes - bias - self.charge / gain
        self._nuisance = np.stack([self._score(a, b) for a, b in _PARAMETERS])

    def change(self, law: MarginalModel) -> FloatArray:
        """Return the mass of the codes under a law less that under the PCD, shape (n,)."""
        return self.mass_of(law) - self.mass

    def score_shift(self, name: str, change: FloatArray) -> float:
        """Return the mean per sample of a standardised efficient score, no unit.

        Times the root of the number of frames it is the expected score of the pixel.

        Args:
            name: the score, such as "He2C1".
            change: of the mass, shape (n,).
        """
        wanted = self._score(*_orders(name))
        efficient = wanted - self._projection(wanted)
        deviation = np.sqrt(max(float((efficient**2) @ self.mass), _SMALLEST_MASS))
        return float(efficient @ change) / float(deviation)

    def noncentrality(self, change: FloatArray) -> float:
        """Return what a change of the mass adds to chi squared per sample after a refit of the parameters."""
        relative = change / self.mass
        # codes that hold nothing would weigh without limit
        relative[self.mass < 1e-7] = 0.0
        left = relative - self._projection(relative)
        return float((left**2)[self.mass >= 1e-7] @ self.mass[self.mass >= 1e-7])

    def mass_of(self, law: MarginalModel) -> FloatArray:
        """Return the mass of the codes under the law of one pixel with Poisson counts and unshifted edges."""
        exposure, gain, bias, _ = self._parameters
        counts = self._counts
        bend = 1.0 + law.curvature * (counts - 1.0) / 2.0
        levels = bias + (law.level_scale[0] * counts * bend + law.level_shift_e[0]) / gain
        more = law.extra_variance_e2[0] + law.variance_per_electron * counts
        more = (more + law.variance_per_electron2 * counts**2) / gain**2 + law.extra_variance_dn2[0]
        mixture = zip(law.exposure_weights, law.exposure_factors, strict=True)
        weights = np.sum([w * _poisson(counts, exposure * f) for w, f in mixture], axis=0)
        mass = np.zeros(self.codes.size)
        for j in range(law.lobe_weights.shape[1]):
            shift = law.lobe_shift_e[0, j] / gain + law.lobe_shift_dn[0, j]
            shift += law.lobe_shift_sigma[0, j] * self._analog
            sigma = np.sqrt((self._analog * law.lobe_width[0, j]) ** 2 + more)
            mass += law.lobe_weights[0, j] * (weights @ _cells(self.codes, levels + shift, sigma))
        return mass

    def scaled_mass(self, factor: float) -> FloatArray:
        """Return the mass of the codes when the DN per electron of signal and noise is larger by a factor."""
        plain = MarginalModel()
        return self.mass_of(plain.with_levels(scale=factor).with_noise([1.0], width=factor))

    def _score(self, a: int, b: int) -> FloatArray:
        found: FloatArray = (self._weights[b] @ self._parts[a]) / self.mass
        return found

    def _projection(self, score: FloatArray) -> FloatArray:
        """Return the part of a score that the four parameters take up."""
        weighted = self._nuisance * self.mass
        slopes = np.linalg.lstsq(weighted @ self._nuisance.T, weighted @ score, rcond=1e-9)[0]
        found: FloatArray = slopes @ self._nuisance
        return found


@dataclass(frozen=True)
class Strength:
    """An estimated strength.

    Attributes:
        factor: strength to the power of the effect, in units of that of the effect it was compared with.
        sigmas: how many standard errors it is away from zero, with its sign.
    """

    factor: float
    sigmas: float


def fit_strength(evidence: Evidence, effect: Effect, name: str) -> Strength:
    """Return the strength of an effect that makes the mean of a score what it is seen to be.

    Least squares over groups of pixels of similar exposure; the scores of single outlying pixels are cut.

    Args:
        evidence: of one split.
        effect: the effect at some small strength, to compare with.
        name: the score, such as "He2C1".

    Returns:
        Strength to the power ``effect.power`` in units of that of ``effect``; 0 without usable pixels.
    """
    chosen, groups = typical_pixels(evidence.maps)
    seen = np.asarray(evidence.scores[name], np.float64).reshape(-1)
    above = below = 0.0
    for pixel, group in zip(chosen, groups, strict=True):
        scores = seen[group]
        scores = scores[np.isfinite(scores)]
        law = PixelLaw(evidence.maps, int(pixel))
        change = law.change(effect.marginal(MarginalModel(), law.maps))
        shift = law.score_shift(name, change) * np.sqrt(evidence.n_frames)
        if scores.size and np.isfinite(shift):
            middle = np.median(scores)
            mean = np.clip(scores, middle - _CUT, middle + _CUT).mean()
            above += scores.size * shift * mean
            below += scores.size * shift**2
    return Strength(above / below, above / np.sqrt(below)) if below > 0 else Strength(0.0, 0.0)


def strength_of(
    evidence: Evidence, effect: _EffectType, name: str, *, sigmas: float = 3.0, signed: bool = False
) -> list[_EffectType]:
    """Return the effect at the strength that a score shows; empty if it shows none in its direction.

    Args:
        evidence: of one split.
        effect: the effect at some small strength, to compare with.
        name: the score, such as "He2C1".
        sigmas: how many standard errors it must be away from zero.
        signed: whether the strength may have either sign.
    """
    found = fit_strength(evidence, effect, name)
    if (abs(found.sigmas) if signed else found.sigmas) < sigmas:
        return []
    return [effect.scaled(float(np.sign(found.factor) * abs(found.factor) ** (1 / effect.power)))]


def _orders(name: str) -> tuple[int, int]:
    """Return (2, 1) of "He2C1"."""
    hermite, _, charlier = name.partition("C")
    return int(hermite.removeprefix("He") or 0), int(charlier or 0)


def _counts(exposure: float) -> FloatArray:
    spread = 10.0 * np.sqrt(exposure + 1.0)
    return np.arange(max(0.0, np.floor(exposure - spread)), np.ceil(exposure + spread) + 1.0)


def _poisson(counts: FloatArray, mean: float) -> FloatArray:
    from scipy.special import gammaln, xlogy

    found: FloatArray = np.exp(xlogy(counts, mean) - mean - gammaln(counts + 1.0))
    return found


def _charlier(b: int, counts: FloatArray, mean: float) -> FloatArray:
    """Return the monic Charlier polynomial of order b."""
    before, now = np.zeros_like(counts), np.ones_like(counts)
    for n in range(b):
        before, now = now, (counts - n - mean) * now - n * mean * before
    return now


def _hermite_cells(a: int, codes: FloatArray, levels: FloatArray, sigma: float) -> FloatArray:
    """Return the integral of He_a times the normal density over the cell of each code, (level, code)."""
    if a == 0:
        return _cells(codes, levels, np.full(levels.size, sigma))
    edges = (np.append(codes - 0.5, codes[-1] + 0.5) - levels[:, None]) / sigma
    before, now = np.zeros_like(edges), np.ones_like(edges)
    for n in range(a - 1):
        before, now = now, edges * now - n * before
    # He_a phi is minus the derivative of He_{a-1} phi
    found: FloatArray = -np.diff(now * np.exp(-0.5 * edges**2) / np.sqrt(2 * np.pi), axis=1)
    return found


def _cells(codes: FloatArray, levels: FloatArray, sigma: FloatArray) -> FloatArray:
    """Return the normal mass in the cell of each code, (level, code)."""
    from scipy.special import ndtr

    edges = np.append(codes - 0.5, codes[-1] + 0.5)
    found: FloatArray = np.diff(ndtr((edges - levels[:, None]) / sigma[:, None]), axis=1)
    return found
