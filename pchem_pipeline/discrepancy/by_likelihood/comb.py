"""Codes by their position (x - bias) * gain: which to compare, and where data and model disagree.

Where no known effect brings the model to the data, something unknown is in them, and likely in one place: a
peak that was cut by a trigger, samples between the peaks. A fit to all codes bends every parameter towards
it. So the comparison is repeated on fewer codes (a side band, as where a background is fitted next to a
bump), and what is named must be found in all of these views. What is left is located at the peaks or between.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.discrepancy.by_likelihood.sets import SetComparison
from pchem_pipeline.discrepancy.verdict import Place
from pchem_pipeline.model.fit.excluding_codes import Interval, electrons_of, inside

FloatArray = NDArray[np.float64]

_RESOLVED = 0.3  # e-: read noise above which there are no valleys
_HALF_PEAK = 0.25  # e-: half width of what counts as a peak
_MOST_SHARE = 0.3  # of the samples that may be set aside
_LEAST_SHARE = 1e-3
_WIDEST_RESIDUAL = 1.0  # e-
_MOST_RESIDUALS = 6
_SIGNIFICANT = 0.005


def places_of(origin: NDArray[np.int64], width: int, parameters: FloatArray) -> FloatArray:
    """Return ``(x - mu) g`` of every code, e-, shape (n, B), of pixels with (H, g, mu, sigma)."""
    return electrons_of(origin, width, parameters[:, 1], parameters[:, 2])


def doubtful_peaks(sets: SetComparison, electrons: FloatArray) -> list[Interval]:
    """Return peaks of few samples: each alone, and each with all above it.

    Args:
        sets: with all codes.
        electrons: place of every code, e-, shape (n, B).
    """
    peaks: list[Interval] = [(None, 0.5)]
    for k in range(1, _last(electrons) + 1):
        peaks += [(k - 0.5, k + 0.5), (k - 0.5, None)]
    return [each for each in peaks if _LEAST_SHARE < _share(sets, (each,), electrons) < _MOST_SHARE]


def valleys(sets: SetComparison, electrons: FloatArray, sigma_e: float) -> tuple[Interval, ...]:
    """Return the codes between the peaks; none where peaks are not resolved or little would be left."""
    if sigma_e > _RESOLVED:
        return ()
    found = tuple((k + _HALF_PEAK, k + 1.0 - _HALF_PEAK) for k in range(-1, _last(electrons) + 1))
    return found if _share(sets, found, electrons) < _MOST_SHARE else ()


def _share(sets: SetComparison, intervals: Sequence[Interval], electrons: FloatArray) -> float:
    """Return the share of the samples in intervals."""
    return float(sets.train[inside(intervals, electrons)].sum()) / float(sets.train.sum())


def _last(electrons: FloatArray) -> int:
    """Return the electron number of the last code of most pixels."""
    return max(int(np.median(electrons[:, -1])), 1)


def place_words(low: float, high: float) -> str:
    """Describe an interval of (x - bias) * gain, e-."""
    centre = 0.5 * (low + high)
    k = round(centre)
    if centre < -_HALF_PEAK:
        return "below the 0-electron peak"
    if high - low > 1.0:
        return f"from the {max(round(low), 0)}- to the {round(high)}-electron peak"
    if abs(centre - k) < _HALF_PEAK:
        return f"at the {k}-electron peak"
    below = int(np.floor(centre))
    return f"between the {below}- and the {below + 1}-electron peak"


def find_residuals(
    observed: FloatArray, expected: FloatArray, electrons: FloatArray, parameters: FloatArray
) -> list[Place]:
    """Scan for windows of codes that hold too many or too few samples, the most significant first.

    As in a bump hunt (Choudalakis 2011), windows of every place and width are tried, and each p-value counts
    the trials. The codes of pixels are lined up by their place on the comb.

    Args:
        observed: samples, shape (n, B); 0 in codes that are not compared.
        expected: the same under the model.
        electrons: place of every code, e-, shape (n, B).
        parameters: (H, g, mu, sigma) of the pixels, shape (n, 4).
    """
    gain, bias = float(np.median(parameters[:, 1])), float(np.median(parameters[:, 2]))
    index = np.floor((electrons + 0.5 * gain) / gain).astype(np.int64)
    first = int(index.min())
    seen, wanted = (
        np.bincount((index - first).ravel(), values.ravel()).astype(np.float64)
        for values in (observed, expected)
    )
    sums = [np.concatenate([[0.0], np.cumsum(values)]) for values in (seen, wanted)]
    widest = max(int(_WIDEST_RESIDUAL / gain), 1)
    windows: list[tuple[float, int, int]] = []
    for width in range(1, min(widest, seen.size) + 1):
        o, e = (total[width:] - total[:-width] for total in sums)
        roots = _signed_root(o, np.maximum(e, 1e-9))
        windows += [(float(roots[i]), int(i), width) for i in np.argsort(-np.abs(roots))[:40]]
    windows.sort(key=lambda item: -abs(item[0]))
    taken = np.zeros(seen.size, np.bool_)
    found: list[Place] = []
    whole = max(float(_contribution(seen, wanted).sum()), 1e-12)
    for z, start, width in windows:
        place = slice(start, start + width)
        p = float(min(1.0, 2.0 * special.ndtr(-abs(z)) * widest * seen.size))
        if p > _SIGNIFICANT or len(found) == _MOST_RESIDUALS:
            break
        if taken[place].any():
            continue
        taken[place] = True
        low, high = (first + start - 0.5) * gain, (first + start + width - 0.5) * gain
        dn = int(np.ceil(bias + low / gain)), int(np.floor(bias + high / gain))
        share = float(_contribution(seen[place], wanted[place]).sum()) / whole
        found.append(
            _residual(low, high, dn, float(seen[place].sum()), float(wanted[place].sum()), z, p, share)
        )
    return found


def set_aside_residual(
    low: float | None, high: float | None, seen: float, expected: float, parameters: FloatArray, share: float
) -> Place:
    """Return what a peak that was set aside holds, against what the model that fits the rest expects in it.

    Args:
        low: lower limit, e-; None: no limit.
        high: upper limit, e-; None: no limit.
        seen: samples that it holds.
        expected: samples that the model expects.
        parameters: (H, g, mu, sigma) of the pixels, shape (n, 4).
        share: of the remaining gap.
    """
    gain, bias = float(np.median(parameters[:, 1])), float(np.median(parameters[:, 2]))
    ends = (-0.5 if low is None else low, (low or 0.0) + 1.0 if high is None else high)
    dn = tuple(int(np.round(bias + end / gain)) for end in ends)
    z = float(_signed_root(np.array([seen]), np.array([max(expected, 1e-9)]))[0])
    return _residual(ends[0], ends[1], (dn[0], dn[1]), seen, expected, z, 0.0, share)


def _residual(
    low: float,
    high: float,
    dn: tuple[int, int],
    seen: float,
    expected: float,
    z: float,
    p: float,
    share: float,
) -> Place:
    more = "more" if z > 0 else "fewer"
    words = (
        f"{more} samples than expected {place_words(low, high)} (DN {dn[0]} to {dn[1]}: "
        f"{seen:.3g} seen, {expected:.3g} expected)"
    )
    return Place.of(
        "code.smooth", z=z, sentence=words, p=p, dn=dn, seen=seen, expected=expected, share_of_gap=share
    )


def _contribution(seen: FloatArray, expected: FloatArray) -> FloatArray:
    """Return what codes contribute to the gap, nats: ``o log(o / e) - o + e``."""
    return np.asarray(special.kl_div(seen, np.maximum(expected, 1e-9)))


def _signed_root(seen: FloatArray, expected: FloatArray) -> FloatArray:
    """Return the signed root of the Poisson deviance, about N(0, 1) by chance."""
    return np.asarray(np.sign(seen - expected) * np.sqrt(2.0 * special.kl_div(seen, expected)))
