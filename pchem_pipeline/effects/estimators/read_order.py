"""1/f noise in the order of reading: its spectrum, and what row means and neighbours show of it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pchem_pipeline.effects.estimators.common_modes import mean_variance, responsivity
from pchem_pipeline.effects.estimators.regression import multiple_of
from pchem_pipeline.effects.types import Evidence, FloatArray, TimeSeries
from pchem_pipeline.model.arithmetic.significance import CLEAR

_TAPS = (1, 2, 4, 8)
_LAGS = 8  # rows
_LEAST_BESIDE = 0.005  # of what such rows show, that it must show beside them
_LEAST_SHAPE = 6.0  # chi2 by which it must beat rows whose pixels move together, each row by itself


RECORD = 4  #: frames in a record of noise, of which one is used: what is cut from a longer one has no period


def pink_amplitudes(n: int) -> FloatArray:
    """Return factors of the spectrum that make white noise of a record 1/f, of variance 1.

    Args:
        n: samples of a frame; there is nothing slower than one cycle in so many.

    Returns:
        (RECORD n // 2 + 1,), real.
    """
    cycles = np.arange(RECORD * n // 2 + 1)
    amplitudes = np.where(cycles >= min(RECORD, cycles[-1]), np.maximum(cycles, 1) ** -0.5, 0.0)
    weight = np.where((cycles == 0) | (2 * cycles == RECORD * n), 1.0, 2.0)
    return np.asarray(amplitudes / np.sqrt((weight * amplitudes**2).sum() / (RECORD * n)))


def pink_noise_of(evidence: Evidence) -> list[tuple[float, int]]:
    """Return standard deviation, DN, and number of taps of 1/f noise; empty if rows do not show it.

    Least squares of its variance to the covariances of row means, and to the correlations of neighbours along
    both axes, for each number of taps: in place of rows that move each by itself, or beside them. Neighbours
    that are coupled besides look like another number of taps: the likeliest beside such a coupling is second.
    """
    time, rows, columns = evidence.time, *evidence.maps.usable.shape
    if time is None or rows < 8 or columns < 8:
        return []
    seen, error = _seen(evidence, time)
    shapes = {
        taps: _shown(evidence, rows, columns, taps)
        for taps in _TAPS
        if columns % taps == 0 and columns // taps > 1
    }
    in_rows = slice(0, _LAGS + 1)
    whole = {
        taps: _fitted(seen, shape, error)
        for taps, shape in shapes.items()
        # coupled neighbours are alike, too, but not whole rows
        if _fitted(seen[in_rows], shape[in_rows], error[in_rows])[0] > CLEAR**2
    }
    # rows that move each by itself: their variance, and that of neighbours within them
    alone = np.where(np.isin(np.arange(seen.size), (0, _LAGS + 1)), 1.0, 0.0)
    alone[_LAGS + 1] = float(np.nanmean(evidence.readout_std**-2.0))
    alone[in_rows] -= 1.0 / rows  # the frame's mean is taken from each
    by_rows = _fitted(seen, alone, error)[0]
    if whole and max(whole.values())[0] >= max(CLEAR**2, by_rows + _LEAST_SHAPE):
        coupled = np.where(np.arange(seen.size) > _LAGS, 1.0, 0.0)
        beside = {taps: _fitted_beside(seen, coupled, shapes[taps], error) for taps in whole}
        likely = dict(map(_best, (whole, beside)))
        return [(float(np.sqrt(variance)), taps) for taps, variance in likely.items()]
    # both at once, by whole rows: coupled neighbours are alike, too
    by_rows = _fitted(seen[in_rows], alone[in_rows], error[in_rows])[0]
    both = {
        taps: _fitted_beside(seen[in_rows], alone[in_rows], shape[in_rows], error[in_rows])
        for taps, shape in shapes.items()
    }
    taps, variance = _best(both)
    seen_beside = both[taps][0] - by_rows > CLEAR**2 + _LEAST_BESIDE * by_rows
    return [(float(np.sqrt(variance)), taps)] if seen_beside else []


def _best(fits: Mapping[int, tuple[float, float]]) -> tuple[int, float]:
    """Return the number of taps that lowers chi2 the most, and the variance with it."""
    taps = max(fits, key=lambda each: fits[each][0])
    return taps, fits[taps][1]


def _fitted_beside(
    seen: FloatArray, other: FloatArray, shape: FloatArray, error: FloatArray
) -> tuple[float, float]:
    """Return by how much multiples of two shapes, none negative, lower chi2, and the second multiple."""
    from scipy import optimize  # not for every command that knows of effects

    wanted = seen / error
    factors, left = optimize.nnls(np.stack([other, shape], axis=1) / error[:, None], wanted)
    return float(wanted @ wanted) - float(left) ** 2, float(factors[1])


def _fitted(seen: FloatArray, shape: FloatArray, error: FloatArray) -> tuple[float, float]:
    """Return by how much a multiple of a shape lowers chi2 (0 if it is negative), and the multiple."""
    factor = multiple_of(shape, seen, error**-2.0)
    return (factor.sigmas**2 if factor.value > 0 else 0.0), factor.value


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
    n = RECORD * rows * width
    covariance = np.asarray(np.fft.irfft(pink_amplitudes(rows * width) ** 2, n), np.float64)
    # of a row's mean with that of one so many rows below: lags of the samples with a triangle of weights
    near = np.arange(1 - width, width)
    weight = (width - np.abs(near)) / width**2
    of_rows = covariance[(np.arange(rows)[:, None] * width + near) % n] @ weight / taps
    line = np.arange(rows)
    every = of_rows[np.abs(line - line[:, None])]
    common = every.mean()
    # the frame's mean is taken from each
    every = every - every.mean(axis=0) - every.mean(axis=1)[:, None] + common
    shown = np.zeros(_LAGS + 3)
    shown[: _LAGS + 1] = [np.diagonal(every, lag).mean() for lag in range(_LAGS + 1)]
    relative = float(np.nanmean(evidence.readout_std**-2.0))
    shown[_LAGS + 1] = (covariance[1] * (columns - taps) / (columns - 1) - common) * relative
    shown[_LAGS + 2] = (covariance[width] - common) * relative
    return np.asarray(shown * responsivity(evidence) ** 2)
