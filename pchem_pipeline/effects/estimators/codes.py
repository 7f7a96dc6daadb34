"""What the counts per code tell of the code edges.

If the lower edge of code c lies at ``c - 1/2 + d_c`` instead of ``c - 1/2``, the code's width is ``1 +
d_{c+1} - d_c`` and its counts grow in proportion (histogram test of ADCs, IEEE Std 1241). The smooth part of
d is taken for bias, gain and noise by the pixels' own fits, so only the rough part is looked at here.
"""

from __future__ import annotations

import numpy as np

from pchem_pipeline.effects.framework.evidence import CodeResiduals
from pchem_pipeline.effects.types import FloatArray, IntArray, PixelMaps

Residuals = tuple["IntArray", "FloatArray", "FloatArray"]

# fewest expected counts at which a relative residual is about normal
_FEWEST = 100.0
# fall of chi2 that one edge must bring, and most edges
_LEAST_GAIN = 18.0
_MOST_SHIFTS = 4


def usable_codes(code: CodeResiduals, *, most: int = 1 << 12) -> Residuals:
    """Return the longest run of codes with counts enough: codes, relative residuals, expected counts.

    Of a run longer than ``most`` the part with the most counts.
    """
    every = code.first + np.arange(code.expected.size)
    # the extreme codes are where a limit piles counts up
    inside = (every > code.minimum) & (every < code.maximum)
    good = np.concatenate([[False], inside & (code.expected >= _FEWEST), [False]])
    edges = np.flatnonzero(np.diff(good.astype(np.int8)))
    starts, ends = edges[::2], edges[1::2]
    if not starts.size:
        return np.zeros(0, np.int64), np.zeros(0), np.zeros(0)
    longest = int((ends - starts).argmax())
    part = slice(int(starts[longest]), int(ends[longest]))
    if part.stop - part.start > most:
        sums = np.cumsum(np.concatenate([[0.0], code.expected[part]]))
        begin = part.start + int((sums[most:] - sums[:-most]).argmax())
        part = slice(begin, begin + most)
    expected = np.asarray(code.expected[part], np.float64)
    codes = code.first + np.arange(part.start, part.stop)
    return codes, (code.observed[part] - expected) / expected, expected


def few_shifts(residuals: FloatArray, expected: FloatArray) -> FloatArray | None:
    """Return shifts of the edges, DN, shape (codes + 1,), if a few of them explain all that is rough.

    One edge after the other, the one that lowers chi2 the most (matching pursuit); None if the residuals ask
    for more than a few, or for none.
    """
    if residuals.size < 2:
        return None  # no edge between two codes
    shifts = np.zeros(residuals.size + 1)
    left = residuals.copy()
    # an edge moved up makes the code below it wider by as much as that above it narrower
    weight = np.concatenate([expected, [0.0]]) + np.concatenate([[0.0], expected])
    inner = slice(1, -1)
    for _ in range(_MOST_SHIFTS):
        pull = np.diff(np.concatenate([[0.0], left * expected, [0.0]]))
        gains = pull**2 / weight
        place = 1 + int(gains[inner].argmax())
        if gains[place] < _LEAST_GAIN:
            break
        shift = -pull[place] / weight[place]
        shifts[place] += shift
        left[place - 1] -= shift
        left[place] += shift
    if not shifts.any() or roughness(left, expected)[1] > 3.0:
        return None
    return shifts


def roughness(residuals: FloatArray, expected: FloatArray) -> tuple[float, float]:
    """Return the variance of independent edge shifts, DN^2, and how many standard errors it is above 0.

    Second differences ``(2 w_c - w_{c-1} - w_{c+1}) / sqrt(6)`` of the widths see nothing smooth; each has
    variance ``10/3`` of that of the edges, besides that of the counts.
    """
    if residuals.size < 8:
        return 0.0, 0.0
    second = (2 * residuals[1:-1] - residuals[:-2] - residuals[2:]) / np.sqrt(6.0)
    noise = (4 / expected[1:-1] + 1 / expected[:-2] + 1 / expected[2:]) / 6.0
    # optimal for weak shifts: weights of the squared inverse of the noise
    weights = noise**-2
    excess = float((weights * (second**2 - noise)).sum() / weights.sum())
    # squares of second differences of white noise: autocorrelations (4/6)^2 and (1/6)^2 at lags 1 and 2
    error = np.sqrt(2.0 * (1 + 2 * (16 + 1) / 36) * float((weights**2 * noise**2).sum())) / weights.sum()
    return max(excess, 0.0) * 0.3, excess / float(error)


def edge_shifts(residuals: FloatArray, expected: FloatArray, variance: float) -> FloatArray:
    """Return the most probable shifts of the edges, DN, shape (codes + 1,), given that of each variance.

    Least squares of the widths with a penalty on the shifts (the posterior mean of independent normal
    shifts): a tridiagonal system. The penalty leaves nothing that varies slowly.
    """
    n = residuals.size
    widths = np.diff(np.eye(n + 1), axis=0)
    weighted = widths * expected[:, None]
    system = widths.T @ weighted + np.eye(n + 1) / max(variance, 1e-12)
    return np.asarray(np.linalg.solve(system, weighted.T @ residuals), np.float64)


def code_range(maps: PixelMaps) -> tuple[int, int]:
    """Return first and last code that the pixels can give, 8 standard deviations included."""
    parts = (maps.bias, maps.quanta_exposure, maps.conversion_gain, maps.read_noise_dn)
    good = np.isfinite(np.stack([np.ravel(p) for p in parts])).all(axis=0)
    if not good.any():
        return 0, 0
    mu, exposure, gain, noise = (np.ravel(p)[good] for p in parts)
    top = mu + (exposure + 8 * np.sqrt(exposure) + 8) / gain + 8 * noise
    return max(0, int(np.floor((mu - 8 * noise).min()))), int(np.ceil(top.max()))
