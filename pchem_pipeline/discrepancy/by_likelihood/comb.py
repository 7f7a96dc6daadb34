"""Codes by their position (x - bias) * gain: which to compare, and where data and model disagree.

Where no known effect brings the model to the data, something unknown is in them, and likely in one place: a
peak that was cut by a trigger, samples between the peaks. A fit to all codes is biased by it. So the
comparison is repeated on fewer codes (a side band), and what is named must be found in all of these views.
What is left is located at the peaks or between.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.discrepancy.verdict import Place
from pchem_pipeline.model.fit.guard import Interval, electrons_of, inside

_RESOLVED = 0.3  # e-: read noise above which there are no valleys
_HALF_PEAK = 0.25  # e-: half width of what counts as a peak
_CELL = 0.125  # e-
_MOST_SHARE = 0.3  # of the samples that may be set aside
_LEAST_SHARE = 1e-3
_MOST_RESIDUALS = 6
_SIGNIFICANT = 0.005


def doubtful_peaks(counts: NDArray[np.integer], electrons: FloatArray) -> list[Interval]:
    """Return peaks of few samples: each alone, and with all above it; codes are at ``electrons``, (n, B)."""
    peaks: list[Interval] = [(None, 0.5)]
    for k in range(1, _last(electrons) + 1):
        peaks += [(k - 0.5, k + 0.5), (k - 0.5, None)]
    return [each for each in peaks if _LEAST_SHARE < _share(counts, (each,), electrons) < _MOST_SHARE]


def valleys(counts: NDArray[np.integer], electrons: FloatArray, sigma_e: float) -> tuple[Interval, ...]:
    """Return the codes between the peaks; none where peaks are not resolved or little would be left."""
    if sigma_e > _RESOLVED:
        return ()
    found = tuple((k + _HALF_PEAK, k + 1.0 - _HALF_PEAK) for k in range(-1, _last(electrons) + 1))
    return found if _share(counts, found, electrons) < _MOST_SHARE else ()


def _share(counts: NDArray[np.integer], intervals: Sequence[Interval], electrons: FloatArray) -> float:
    """Return the share of the samples in intervals."""
    return float(counts[inside(intervals, electrons)].sum() / counts.sum())


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
    seen: FloatArray,
    expected: FloatArray,
    origin: IntArray,
    parameters: FloatArray,
    peaks: Sequence[Interval] = (),
) -> list[Place]:
    """Return where on the comb are too many or too few samples, the most significant first.

    The codes of all pixels are sorted into cells by their place on the comb; each p-value counts all cells.
    Peaks that were set aside come first, and their codes are in no other cell. Samples are (n, B) from the DN
    ``origin`` on, (n,); parameters are (H, g, mu, sigma), (n, 4).
    """
    electrons = electrons_of(origin, seen.shape[1], parameters[:, 1], parameters[:, 2])
    gain, bias = float(np.median(parameters[:, 1])), float(np.median(parameters[:, 2]))
    width = max(_CELL, gain)
    index = np.floor(electrons / width).astype(np.int64)
    ends = [
        (-0.5 if low is None else low, (low or 0.0) + 1.0 if high is None else high) for low, high in peaks
    ]
    masks = [inside([peak], electrons) for peak in peaks]
    left = ~inside(peaks, electrons)
    for cell in np.unique(index[left & (expected + seen > 0.0)]):
        ends.append((cell * width, (cell + 1) * width))
        masks.append(left & (index == cell))
    o, e = (np.array([values[mask].sum() for mask in masks]) for values in (seen, expected))
    deviance = special.kl_div(o, np.maximum(e, 1e-9))
    z = np.sign(o - e) * np.sqrt(2.0 * deviance)
    p = np.minimum(2.0 * special.ndtr(-np.abs(z)) * len(masks), 1.0)
    order = [*range(len(peaks)), *(len(peaks) + np.argsort(-deviance[len(peaks) :]))]
    found = []
    for i in [i for i in order if p[i] < _SIGNIFICANT or i < len(peaks)][:_MOST_RESIDUALS]:
        dn = int(np.ceil(bias + ends[i][0] / gain)), int(np.floor(bias + ends[i][1] / gain))
        words = (
            f"{'more' if z[i] > 0 else 'fewer'} samples than expected {place_words(*ends[i])} "
            f"(DN {dn[0]} to {dn[1]}: {o[i]:.3g} seen, {e[i]:.3g} expected)"
        )
        share = float(deviance[i] / deviance.sum())
        numbers = {"p": float(p[i]), "seen": float(o[i]), "expected": float(e[i]), "share_of_gap": share}
        found.append(Place.of("code.smooth", float(z[i]), sentence=words, dn=dn, **numbers))
    return found
