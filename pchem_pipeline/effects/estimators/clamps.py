"""Which lines of a frame its offset follows, and how much: the part of a black-level clamp that can be seen.

With s the mean deviation of the clamp's pixels in a frame before the clamp, and f the part that is taken off,
all samples move by ``-f s``: the same pixels show ``(1 - f) s`` afterwards, and the mean readout residual of
the frame is its own less ``alpha f s`` (alpha: :mod:`pchem_pipeline.effects.estimators.common_modes`).
Both are normal with variances that the pixels' fits give, so f and the lines have a likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pchem_pipeline.effects.estimators.common_modes import mean_variance, responsivity
from pchem_pipeline.effects.types import Evidence, FloatArray, IntArray

_PARTS = np.concatenate([[0.0], np.geomspace(2e-3, 1.0, 300)])
_LEAST_GAIN = 9.0  # of the log-likelihood, against a noise of frames: some 500 overlapping ranges are tried
_PRICE_OF_PLACE = 4.0  # nats that the choice of two ends brings by chance
_MOST_LINES = 64  # groups of lines whose ranges are tried


@dataclass(frozen=True)
class Clamp:
    """Part that is taken off, and the lines whose mean it is of (None: all), with the number of pixels."""

    follow: float
    rows: tuple[int, int] | None
    columns: tuple[int, int] | None
    pixels: int


@dataclass(frozen=True)
class _Moments:
    """Second moments of the content of ranges of lines with the frames' mean residual, DN^2, (n,) each.

    Attributes:
        content, cross: variance of the content, and its covariance with the mean residual.
        own, shared: what the pixels by themselves give to these two.
        pixels: of the range.
        spans: first line and end, (n, 2).
    """

    content: FloatArray
    cross: FloatArray
    own: FloatArray
    shared: FloatArray
    pixels: FloatArray
    spans: IntArray


def best_clamp(evidence: Evidence) -> Clamp | None:
    """Return the clamp that explains the frames' offsets best; None if a noise of frames does as well."""
    if evidence.time is None or evidence.maps.usable.sum() < 2:
        return None
    means = evidence.time.frame_readout.astype(np.float64)
    means = means - means.mean()
    residual = float((means**2).mean())
    noise, alpha, n = float(mean_variance(evidence)), responsivity(evidence), means.size
    best, gain = None, _LEAST_GAIN
    for axis in (1, 0):
        found = _moments(evidence, axis, means)
        gains, follow = _profile(found, residual, noise, alpha, n)
        # a part of the frame only where it explains more than the frame
        gains[found.pixels == found.pixels.max()] += _PRICE_OF_PLACE
        place = int(gains.argmax())
        if gains[place] > gain:
            span = (int(found.spans[place, 0]), int(found.spans[place, 1]))
            rows, columns = (span, None) if axis == 1 else (None, span)
            where = (None, None) if found.pixels[place] == found.pixels.max() else (rows, columns)
            best, gain = Clamp(float(follow[place]), *where, int(found.pixels[place])), float(gains[place])
    return best


def _moments(evidence: Evidence, axis: int, means: FloatArray) -> _Moments:
    """Return the moments of ranges of rows (axis 1) or columns (axis 0)."""
    time, maps = evidence.time, evidence.maps
    assert time is not None
    charge, readout = (
        (time.row_charge, time.row_readout) if axis == 1 else (time.column_charge, time.column_readout)
    )
    usable = maps.usable & np.isfinite(evidence.readout_std)
    count = usable.sum(axis=axis).astype(np.float64)
    gain = np.where(usable, maps.conversion_gain, 0.0).sum(axis=axis) / np.maximum(count, 1.0)
    # sums over the pixels of a line: deviations of the codes, their variance, their covariance with r
    content = np.nan_to_num((readout + charge / np.where(gain > 0, gain, 1.0)) * count).astype(np.float64)
    content -= content.mean(axis=0)
    variance = maps.read_noise_dn**2 + maps.quanta_exposure / maps.conversion_gain**2
    own = np.where(usable, variance, 0.0).sum(axis=axis)
    shared = np.where(usable, maps.read_noise_dn**2, 0.0).sum(axis=axis)
    group = np.arange(count.size) // -(-count.size // _MOST_LINES)
    first = np.append(np.flatnonzero(np.diff(group, prepend=-1)), count.size)
    content = np.add.reduceat(content, first[:-1], axis=1)
    products = content.T @ content / len(means)
    corner = np.pad(products.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    a, b = np.triu_indices(first.size, 1)
    total = corner[b, b] - corner[a, b] - corner[b, a] + corner[a, a]

    def summed(values: FloatArray) -> FloatArray:
        sums = np.append(0.0, np.cumsum(values))
        return np.asarray(sums[first[b]] - sums[first[a]])

    pixels = summed(count)
    cross = np.append(0.0, np.cumsum(content.T @ means / len(means)))
    kept = pixels > 0
    n = np.where(kept, pixels, 1.0)
    return _Moments(
        content=(total / n**2)[kept],
        cross=((cross[b] - cross[a]) / n)[kept],
        own=(summed(own) / n**2)[kept],
        shared=(summed(shared) / n / usable.sum())[kept],
        pixels=pixels[kept],
        spans=np.stack([first[a], first[b]], axis=1)[kept],
    )


def _profile(
    found: _Moments, residual: float, noise: float, alpha: float, n: int
) -> tuple[FloatArray, FloatArray]:
    """Return for each range by how much a clamp beats a noise of frames, in nats, and its part f.

    Args:
        found: of n frames.
        residual: variance of the frames' mean residual, DN^2.
        noise: of it what the pixels give.
        alpha: response of a residual to an offset.
        n: frames.
    """
    # a noise of frames may be there either way: as much as there is beyond the clamp
    logs = np.empty((_PARTS.size, found.content.size))
    for i, part in enumerate(_PARTS):
        own = (1.0 - part) ** 2 * found.own
        cross = (1.0 - part) * (found.shared - alpha * part * found.own)
        mean = noise - 2.0 * alpha * part * found.shared + (alpha * part) ** 2 * found.own
        more = np.maximum(residual - mean, 0.0)
        logs[i] = _density(found, residual, own + more / alpha**2, cross + more / alpha, mean + more, n)
    best = logs.argmax(axis=0)
    # whatever else moves all pixels of a frame: variances only grow, and no covariance is negative
    content, mean = np.maximum(found.content - found.own, 0.0), max(residual - noise, 0.0)
    cross = np.clip(found.cross - found.shared, 0.0, np.sqrt(content * mean))
    other = _density(found, residual, found.own + content, found.shared + cross, noise + mean, n)
    return np.asarray(logs.max(axis=0) - np.maximum(other, logs[0])), _PARTS[best]


def _density(
    found: _Moments, residual: float, own: FloatArray, cross: FloatArray, mean: FloatArray | float, n: int
) -> FloatArray:
    """Return the log-likelihood of the moments of n frames under a normal law, without its constant.

    Args:
        found: moments.
        residual: variance of the frames' mean residual, DN^2.
        own: variance of the content under the law.
        cross: its covariance with the mean residual.
        mean: variance of the mean residual.
        n: frames.
    """
    own = np.maximum(own, 1e-6 * found.own)
    slope = cross / own
    rest = np.maximum(mean - cross * slope, 1e-12)
    left = residual - 2.0 * slope * found.cross + slope**2 * found.content
    return np.asarray(-0.5 * n * (np.log(own) + found.content / own + np.log(rest) + left / rest))
