"""Starting points of PCH-EM in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.model.fit import engine, tile_numba
from pchem_pipeline.model.law.inputs import kernel_counts, pack
from pchem_pipeline.model.law.sample_law import SampleLaw

_CENTRAL_LOBE = 0.6  # 1/sd: the central lobe of any sample has fallen by then


def starting_points(counts: NDArray[np.integer], origin: NDArray[np.integer]) -> FloatArray:
    """Return two starting points (H, g, mu, sigma) of every pixel, shape (n, 2, 4); NaN where there is none.

    The empirical characteristic function of a PCD, ``phi(f) = mean exp(2 pi i f x)``, has
    ``log|phi| = -2 pi^2 f^2 sigma^2 - H (1 - cos 2 pi f / g)``, which is fitted by weighted least squares for
    a grid of gains (good for H < 15). The second start has g where ``|phi|`` is largest beyond its central
    lobe; ``phi(g) = exp(-2 pi^2 sigma^2 g^2 + 2 pi i mu g)`` then gives sigma and mu, the mean H.
    Of histograms, shape (n, B), with the DN of bin 0, shape (n,).
    """
    counts = kernel_counts(counts)
    n, n_bins = counts.shape
    given = tile_numba.Histograms(
        counts,
        np.array([0, n_bins], np.int64),
        np.asarray(origin, np.int64)[:, None],
        np.zeros(1, np.bool_),
        np.zeros((n, n_bins), np.uint8),
    )
    out = np.full((n, 2, 4), np.nan)
    tile_numba.start_tile(given, pack([SampleLaw()], n), engine.regression_basis(), out[:, 0])
    some = np.flatnonzero((counts > 0).sum(axis=1) > 2)
    out[some, 1] = _highest_lobe(counts[some].astype(np.float64), np.asarray(origin)[some])
    return out


def _highest_lobe(counts: FloatArray, origin: NDArray[np.integer]) -> FloatArray:
    """Compute (H, g, mu, sigma) from the highest side lobe of the characteristic function."""
    shares = counts / counts.sum(axis=1, keepdims=True)
    bins = np.arange(counts.shape[1])
    mean = shares @ bins
    variance = shares @ bins**2 - mean**2
    size = 8 * counts.shape[1]  # frequencies
    phi, frequency = np.fft.rfft(shares, size), np.fft.rfftfreq(size)
    modulus = np.abs(phi)
    modulus[frequency < _CENTRAL_LOBE / np.sqrt(variance)[:, None]] = 0.0
    modulus[:, 1:][modulus[:, 1:] < modulus[:, :-1]] = 0.0  # still falling
    place = modulus.argmax(axis=1)[:, None]
    gain, height = frequency[place[:, 0]], np.take_along_axis(modulus, place, 1)[:, 0].clip(1e-9, 0.999)
    phase = -np.angle(np.take_along_axis(phi, place, 1)[:, 0]) / (2.0 * np.pi)  # of mu g
    noise2 = -np.log(height) / (2.0 * np.pi**2)
    exposure = np.maximum(variance * gain**2 - noise2, 0.05)
    below = phase + np.round(mean * gain - exposure - phase)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.column_stack([mean * gain - below, gain, origin + below / gain, np.sqrt(noise2) / gain])
