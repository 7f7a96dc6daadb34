"""Histograms of pixels that follow the PCD exactly, drawn without drawing frames."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.sample_law import SampleLaw


class DrawnHistograms(NamedTuple):
    """Counts (n, B), DN of bin 0 (n,), and the true (H, g, mu, sigma), shape (n, 4)."""

    counts: NDArray[np.uint32]
    origin: IntArray
    truth: FloatArray


def draw_histograms(
    rng: np.random.Generator,
    quanta_exposure: ArrayLike,
    conversion_gain: ArrayLike,
    bias: ArrayLike,
    read_noise_e: ArrayLike,
    n_frames: int,
) -> DrawnHistograms:
    """Draw a histogram of every pixel from the exact mass of eq. (PCD_RV_definition), rounding included.

    The parameters are H >= 0, e-, g, e-/DN, mu, DN, and s_e with quantisation, e-, scalars or of shape (n,).

    Raises:
        ValueError: the read noise is below that of the rounding.
    """
    given = [np.asarray(a, np.float64) for a in (quanta_exposure, conversion_gain, bias, read_noise_e)]
    exposure, gain, offset, noise = (np.ravel(a) for a in np.broadcast_arrays(*given))
    if (noise**2 < QUANTISATION_VARIANCE * gain**2).any():
        raise ValueError("the read noise is below the rounding noise")
    origin = np.floor(offset - 9 * noise / gain).astype(np.int64) - 1
    width = np.ceil((exposure + 11 * np.sqrt(exposure) + 12 * (exposure > 0) + 18 * noise) / gain) + 3
    x = origin[:, None] + np.arange(int(width.max()))
    truth = [exposure, gain, offset, noise / gain]
    mass = sample_mass(SampleLaw(), truth, x, smallest=1e-50)
    counts = rng.multinomial(n_frames, mass / mass.sum(axis=1, keepdims=True))
    return DrawnHistograms(counts.astype(np.uint32), origin, np.stack(truth, axis=1))
