"""The empirical component: what no known effect explains, measured as shifts of the samples.

The histograms of the pixels are taken for mixtures of their law, moved by shifts on a grid; the shares of the
shifts are those of maximum likelihood (Laird 1978; by Newton steps as Kim, Carbonetto, Stephens and Anitescu
2020 take them). Few of them come out different from nothing, and those that the likelihood needs are kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.effects.adc.empirical import Empirical
from pchem_pipeline.effects.framework.compose import pixel_maps, sample_law
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.model.histogram.count import histogram_frames
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.sample_law import SampleLaw

FloatArray = NDArray[np.float64]

_MOST_PIXELS = 600  # that stand for all
_FINE = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0, 48.0, 64.0, 96.0, 128.0)  # DN
_FARTHEST_E = 6.0  # electrons: shifts beyond are hits of particles or the like
_ITERATIONS, _HALVINGS = 20, 8
_CONVERGED = 0.01  # nats
_NOTHING = 1e-300
_MOST_SHIFTS = 6
_CLEAR = 10.0  # nats of likelihood that a shift must be worth
_LEAST = 1e-6  # share


@dataclass(frozen=True)
class _Mixture:
    """Histograms and the mass of their codes by shift.

    Attributes:
        counts: samples of each pixel at each code, shape (n, c).
        mass: of these codes with each shift, the first is none, shape (l, n, c).
    """

    counts: FloatArray
    mass: FloatArray

    def fitted(self, used: Sequence[int]) -> tuple[FloatArray, float]:
        """Return the shares of some of the shifts, (l,), 0 for the others, and the log likelihood, nats.

        ``sum n log(M s) - N sum s`` is concave: Newton steps, each a problem of non-negative least squares,
        halved where they overshoot.
        """
        mass, total = self.mass[list(used)].reshape(len(used), -1), float(self.counts.sum())
        counts = self.counts.ravel()
        share = np.full(len(used), 1e-3 / max(len(used) - 1, 1))
        share[0] = 1.0 - share[1:].sum()
        best = _likelihood(counts, mass, share)
        for _ in range(_ITERATIONS):
            law = np.maximum(share @ mass, _NOTHING)
            slope = mass @ (counts / law)
            scaled = mass * (np.sqrt(counts) / law)
            curvature = scaled @ scaled.T
            curvature += 1e-10 * np.trace(curvature) * np.eye(len(used))
            root = np.linalg.cholesky(curvature)
            target = np.linalg.solve(root, 2.0 * slope - total)
            step = optimize.nnls(root.T, target)[0] - share
            for _ in range(_HALVINGS):
                new = share + step
                new /= max(float(new.sum()), _NOTHING)
                value = _likelihood(counts, mass, new)
                if value > best:
                    break
                step /= 2.0
            else:
                break
            gain, share, best = value - best, new, value
            if gain < _CONVERGED:
                break
        found = np.zeros(len(self.mass))
        found[list(used)] = share
        return found, best


def _likelihood(counts: FloatArray, mass: FloatArray, share: FloatArray) -> float:
    return float(counts @ np.log(np.maximum(share @ mass, _NOTHING)))


def measured_shifts(
    frames: NDArray[np.unsignedinteger], maps: PixelMaps, effects: Sequence[Effect]
) -> Empirical | None:
    """Return the shifts that the samples of some frames need beside a model; None where they need none.

    Args:
        frames: (frame, y, x), DN.
        maps: parameters of the pixels under the model.
        effects: of the model.
    """
    grid = _grid(maps)
    mixture = _mixture(frames, maps, effects, grid)
    if mixture is None or grid.size < 2:
        return None
    every, best = mixture.fitted(range(grid.size))
    used = [0, *(int(i) for i in np.argsort(-every[1:])[:_MOST_SHIFTS] + 1 if every[i] > _LEAST)]
    shares, best = mixture.fitted(used)
    for one in sorted(used[1:], key=lambda i: shares[i]):
        fewer = [i for i in used if i != one]
        without, likelihood = mixture.fitted(fewer)
        if best - likelihood < _CLEAR:
            used, shares, best = fewer, without, likelihood
    moved = [i for i in used[1:] if shares[i] > 0.0]
    if not moved:
        return None
    total = float(shares[moved].sum())
    return Empirical(
        share=total,
        shift_dn=tuple(float(grid[i]) for i in moved),
        weight=tuple(float(shares[i] / total) for i in moved),
    )


def _grid(maps: PixelMaps) -> FloatArray:
    """Return the shifts to look for, none first, DN."""
    farthest = _FARTHEST_E / float(np.median(maps.conversion_gain[maps.usable]))
    sizes = np.array([size for size in _FINE if size <= farthest])
    return np.concatenate([[0.0], -sizes, sizes])


def _mixture(
    frames: NDArray[np.unsignedinteger], maps: PixelMaps, effects: Sequence[Effect], grid: FloatArray
) -> _Mixture | None:
    """Return the histograms and masses of pixels that stand for all; None where the effects give no law."""
    usable = np.flatnonzero(maps.usable.ravel())
    chosen = usable[:: max(usable.size // _MOST_PIXELS, 1)]
    every = maps.maps
    flat = tuple(values.ravel()[chosen] for values in every)
    try:
        law = sample_law(effects, pixel_maps(flat, np.ones(chosen.size, bool)))
    except ConfigError:
        return None
    histograms = histogram_frames(frames)
    counts = histograms.counts.reshape(-1, histograms.counts.shape[2])[chosen].astype(np.float64)
    # the codes of the pixels begin at their own origins
    codes = histograms.origin.ravel()[chosen][:, None] + np.arange(counts.shape[1])
    filled = np.flatnonzero(counts.any(axis=0))
    counts, codes = counts[:, filled[0] : filled[-1] + 1], codes[:, filled[0] : filled[-1] + 1]
    mass = np.stack([sample_mass(_shifted(law, float(shift)), flat, codes) for shift in grid])
    return _Mixture(counts, mass)


def _shifted(law: SampleLaw, shift: float) -> SampleLaw:
    return law if shift == 0.0 else law.with_noise([1.0], shift_dn=shift)
