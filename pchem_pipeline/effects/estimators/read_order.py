"""1/f noise in the order of reading: its spectrum, and what row means and neighbours show of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from pchem_pipeline.effects.estimators.common_modes import mean_variance, responsivity

if TYPE_CHECKING:
    from pchem_pipeline.effects.framework.evidence import Evidence, TimeSeries

FloatArray = np.ndarray[Any, np.dtype[np.float64]]

_TAPS = (1, 2, 4, 8)
_LAGS = 8  # rows
_LEAST = 3.0  # standard errors
_LEAST_SHAPE = 6.0  # chi2 by which it must beat rows whose pixels move together, each row by itself


def pink_amplitudes(n: int) -> FloatArray:
    """Return factors of the spectrum (n // 2 + 1,) that make white noise of n samples 1/f, of variance 1.

    No part is constant: the lowest frequency is one cycle in n samples.
    """
    frequency = np.arange(n // 2 + 1)
    amplitudes = np.where(frequency > 0, np.maximum(frequency, 1) ** -0.5, 0.0)
    weight = np.where((frequency == 0) | (2 * frequency == n), 1.0, 2.0)
    return np.asarray(amplitudes / np.sqrt((weight * amplitudes**2).sum() / n))


def pink_noise_of(evidence: Evidence) -> list[tuple[float, int]]:
    """Return standard deviation, DN, and number of taps of 1/f noise; empty if rows do not show it.

    Least squares of its variance to the covariances of row means, and to the correlations of neighbours along
    both axes, for each number of taps.
    """
    time, rows, columns = evidence.time, *evidence.maps.usable.shape
    if time is None or rows < 8 or columns < 8:
        return []
    seen, error = _seen(evidence, time)
    fits = []
    for taps in (taps for taps in _TAPS if columns % taps == 0 and columns // taps > 1):
        shape = _shown(evidence, rows, columns, taps)
        gain, variance = _fitted(seen, shape, error)
        # coupled neighbours are alike, too, but not whole rows
        rows_too = _fitted(seen[: _LAGS + 1], shape[: _LAGS + 1], error[: _LAGS + 1])[0]
        fits.append((gain if rows_too > _LEAST**2 else 0.0, variance, taps))
    gain, variance, taps = max(fits)
    # rows that move each by itself: their variance, and that of neighbours within them
    alone = np.where(np.isin(np.arange(seen.size), (0, _LAGS + 1)), 1.0, 0.0)
    alone[_LAGS + 1] = float(np.nanmean(evidence.readout_std**-2.0))
    if gain < max(_LEAST**2, _fitted(seen, alone, error)[0] + _LEAST_SHAPE):
        return []
    return [(float(np.sqrt(variance)), taps)]


def _fitted(seen: FloatArray, shape: FloatArray, error: FloatArray) -> tuple[float, float]:
    """Return by how much a multiple of a shape lowers chi2 (0 if it is negative), and the multiple."""
    information = float(((shape / error) ** 2).sum())
    factor = float((shape * seen / error**2).sum()) / information if information > 0 else 0.0
    return (factor**2 * information if factor > 0 else 0.0), factor


def _seen(evidence: Evidence, time: TimeSeries) -> tuple[FloatArray, FloatArray]:
    """Return covariances of row means at lags 0 to 8, DN^2, correlations along x and y, and their errors."""
    means = time.row_readout.astype(np.float64)
    good = np.asarray(np.isfinite(means).all(axis=0), np.bool_)
    means = np.where(good, means, 0.0)
    means = means - means.mean(axis=0)
    inside: FloatArray = np.where(good, 1.0, 0.0)
    means = means - inside * means.sum(axis=1, keepdims=True) / good.sum()
    noise = np.nan_to_num(mean_variance(evidence, axis=1)) * inside
    seen, error = np.zeros(_LAGS + 3), np.full(_LAGS + 3, np.inf)
    level = float(noise.sum() / good.sum())
    for lag in range(_LAGS + 1):
        end = good.size - lag
        pairs = float((inside[:end] * inside[lag:]).sum())
        if pairs:
            # the frame's mean was taken from each row
            own = level * ((lag == 0) - 1.0 / good.sum())
            seen[lag] = (means[:, :end] * means[:, lag:]).mean(axis=0).sum() / pairs - own
            error[lag] = level * np.sqrt((2.0 if lag == 0 else 1.0) / pairs / len(means))
    for place, axis in enumerate("xy", _LAGS + 1):
        number = time.neighbour_pairs.get(f"{axis}.rr", 0)
        if number:
            seen[place], error[place] = time.neighbours[f"{axis}.rr"], number**-0.5
    return seen, error


def _shown(evidence: Evidence, rows: int, columns: int, taps: int) -> FloatArray:
    """Return what noise of variance 1 DN^2 would show of these."""
    width = columns // taps
    n = rows * width
    covariance = np.asarray(np.fft.irfft(pink_amplitudes(n) ** 2, n), np.float64)
    response = responsivity(evidence) ** 2
    apart = np.arange(width) - np.arange(width)[:, None]
    shown = np.zeros(_LAGS + 3)
    for lag in range(_LAGS + 1):
        shown[lag] = covariance[(lag * width + apart) % n].mean() / taps
    relative = float(np.nanmean(evidence.readout_std**-2.0))
    shown[_LAGS + 1] = covariance[1] * relative * (columns - taps) / (columns - 1)
    shown[_LAGS + 2] = covariance[width] * relative
    return shown * response
