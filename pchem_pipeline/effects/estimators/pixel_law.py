"""The exact law of the rounded samples, one pixel at a time, and how far another law moves its scores.

The efficient score of a polynomial ``He_a(r / sigma) C_b(k; H)`` (Hermite in the noise, Charlier in the
counts) is its expectation given the code, less its projection on the scores of the four parameters of the
PCD (Rao 1948; Neyman 1959). A law that differs from the PCD shifts the mean of that score; the shift of its
standardised sum over ``n`` frames is ``n^(1/2)`` times a number that depends on the pixel's parameters alone.

This is for estimating an effect from a few pixels that stand for all, so clarity comes before speed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.effects.framework.evidence import SCORES
from pchem_pipeline.effects.types import FloatArray, PixelMaps, SampleLaw
from pchem_pipeline.model.arithmetic.robust import chi_square
from pchem_pipeline.model.arithmetic.significance import SMALLEST_EXPECTATION

_SMALLEST_MASS = 1e-100
#: Of a parameter, by which the law is changed to see its slope.
SMALL_CHANGE = 1e-4
SMALLEST_WIDTH = 0.1  # DN: below it peaks are single codes
#: Samples expected beyond the codes of a pixel, on either side, at most.
ALLOWED = 1e-2
# standard deviations of the noise, and electrons, that are considered beyond the peaks
_REACH, _REACH_E = 12.0, 6.0
# samples of a histogram without noise of its own
_SAMPLES = 1e9


def select_pixels(maps: PixelMaps, where: NDArray[np.intp]) -> PixelMaps:
    """Return the parameters of some pixels, by their flat indices, each of that shape."""
    return maps.flat.of(where)


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
    """The PCD of one pixel over the codes that its samples reach, and how another law differs from it.

    What lies beyond the codes does not count: the tails of a sample are looked at by themselves.

    Attributes:
        maps: of that pixel, shape (1,) each.
        codes: DN, shape (n,).
        mass: of the PCD, exactly rounded, shape (n,).
        charge: E[K | x], e-, shape (n,).
        readout: x - mu - E[K | x] / g, DN, shape (n,).
    """

    def __init__(self, maps: PixelMaps, where: int, n_frames: int):
        """Tabulate the PCD of one pixel of the maps, by its flat index, for that many samples."""
        from pchem_pipeline.model.law import cell_scores_numba

        self.maps = select_pixels(maps, np.array([where]))
        exposure, gain, bias, sigma = (
            float(getattr(self.maps, name)[0])
            for name in ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn")
        )
        analog = float(np.sqrt(max(sigma**2 - QUANTISATION_VARIANCE, SMALLEST_WIDTH**2)))
        first, last = _counts(exposure)
        self._wide = _wide_codes(bias + first / gain, bias + last / gain, analog, gain)
        law = np.empty((self._wide.size, cell_scores_numba.N_COLUMNS))
        cell_scores_numba.fill_law(exposure, 1.0 / gain, bias - self._wide[0], analog, first, last, True, law)
        mass = law[:, 0]
        below, above = np.cumsum(mass), np.cumsum(mass[::-1])[::-1]
        inside = (below * n_frames >= ALLOWED) & (above * n_frames >= ALLOWED)
        self.codes = self._wide[inside]
        # between narrow peaks there may be nothing
        within = np.maximum(mass[inside], _SMALLEST_MASS)
        self.mass = np.maximum(self.on_codes(self._wide, mass), _SMALLEST_MASS)
        self._scores = (law[inside] / within[:, None]).T
        self.charge = exposure + np.sqrt(exposure) * self._scores[1]
        self.readout = self.codes - bias - self.charge / gain

    def on_codes(self, codes: FloatArray, mass: FloatArray) -> FloatArray:
        """Return a mass over other codes as one over those of this law, whose sum is 1, shape (n,)."""
        at = (codes - self.codes[0]).astype(np.intp)
        here = (at >= 0) & (at < self.codes.size)
        found: FloatArray = np.bincount(at[here], mass[here], self.codes.size).astype(np.float64)
        return found / max(float(found.sum()), _SMALLEST_MASS)

    def below(self, law: SampleLaw) -> float:
        """Return the probability of a sample below the codes under a law."""
        codes, mass = self.mass_of(law)
        return float(mass[codes < self.codes[0]].sum())

    def change(self, law: SampleLaw) -> FloatArray:
        """Return the mass of the codes under a law less that under the PCD, shape (n,)."""
        return self.on_codes(*self.mass_of(law)) - self.mass

    def score_shift(self, name: str, change: FloatArray) -> float:
        """Return the mean per sample of a standardised efficient score, no unit.

        Times the root of the number of frames it is the expected score of the pixel.

        Args:
            name: the score, such as "He2C1".
            change: of the mass, shape (n,).
        """
        nuisance, tests = self._scores[: -len(SCORES)], self._scores[-len(SCORES) :]
        wanted, weighted = tests[SCORES.index(name)], nuisance * self.mass
        slopes = np.linalg.lstsq(weighted @ nuisance.T, weighted @ wanted, rcond=1e-9)[0]
        efficient = wanted - slopes @ nuisance
        deviation = np.sqrt(max(float((efficient**2) @ self.mass), _SMALLEST_MASS))
        return float(efficient @ change) / float(deviation)

    def goodness(self, change: FloatArray, n_frames: int) -> float:
        """Return how the form of the peaks will fit samples whose mass is changed, as a normal quantile.

        By groups of codes as wide as the read noise.
        """
        first = np.arange(0, self.mass.size, max(round(float(self.maps.read_noise_dn[0])), 1))
        mass, moved = (np.add.reduceat(values, first) for values in (self.mass, change))
        grouped = mass * n_frames >= SMALLEST_EXPECTATION
        degrees = max(int(grouped.sum()) - len(PARAMETERS), 1)
        excess = n_frames * float((moved[grouped] ** 2 / mass[grouped]).sum())
        return float(chi_square(degrees + excess, degrees))

    def mass_of(self, law: SampleLaw) -> tuple[FloatArray, FloatArray]:
        """Return codes, DN, somewhat beyond those of the PCD, and their mass under a law."""
        from pchem_pipeline.model.law.mass import sample_mass

        mass: FloatArray = sample_mass(law, self.maps, self._wide)[0]
        return self._wide, mass

    def scaled(self, factor: float) -> SampleLaw:
        """Return the law whose signal and noise are larger by a factor."""
        return SampleLaw().with_levels(scale=factor).with_noise([1.0], width=factor)


def refitted(
    laws: Sequence[PixelLaw], masses: Sequence[tuple[FloatArray, FloatArray]], n_frames: int
) -> list[PixelLaw]:
    """Return the PCDs that are fitted to samples of other laws: what the fit of the pixels would find.

    Args:
        laws: PCDs of pixels.
        masses: codes and mass of the samples of each.
        n_frames: samples of a pixel.

    Returns:
        The fitted PCDs; that of ``laws`` where the fit fails.
    """
    from pchem_pipeline.model.fit.api import fit_histograms
    from pchem_pipeline.model.fit.settings import FitSettings

    origin = np.array([codes[0] for codes, _ in masses], np.int64)
    counts = np.zeros((len(masses), max(codes.size for codes, _ in masses)), np.uint32)
    for row, (_, mass) in zip(counts, masses, strict=True):
        row[: mass.size] = np.rint(mass * _SAMPLES)
    fit = fit_histograms(counts, origin, settings=FitSettings(tail_guard=0))
    good = np.isfinite(fit.quanta_exposure)
    maps = PixelMaps.known(fit.maps, good)
    return [PixelLaw(maps, i, n_frames) if good[i] else laws[i] for i in range(len(laws))]


def _counts(exposure: float) -> tuple[int, int]:
    """Return the smallest and the largest electron number that count."""
    spread = 10.0 * np.sqrt(exposure + 1.0)
    return max(0, int(np.floor(exposure - spread))), int(np.ceil(exposure + spread))


def _wide_codes(low: float, high: float, sigma: float, gain: float) -> FloatArray:
    reach = max(_REACH * sigma, _REACH_E / gain + 4.0 * sigma)
    return np.arange(np.floor(low - reach), np.ceil(high + reach) + 1)
