"""Loops of the peak and valley method: smooth, find the peaks, look into the valley between two."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import kernel

#: Most peaks of a histogram that are used.
MOST_PEAKS = 64


@kernel
def smooth(counts: NDArray[np.integer], width: float, out: NDArray[np.float64]) -> None:
    """Fill ``out`` with the histogram convolved with a Gaussian of standard deviation ``width`` bins."""
    reach = max(1, int(np.ceil(4 * width)))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    kernel /= kernel.sum()
    out[:] = 0.0
    for i in range(counts.size):
        if counts[i] > 0:
            for j in range(max(0, i - reach), min(counts.size, i + reach + 1)):
                out[j] += counts[i] * kernel[j - i + reach]


@kernel
def summit(values: NDArray[np.float64], around: float, reach: float) -> tuple[float, float]:
    """Return place and height of the largest local maximum near a place; height 0 where there is none.

    Refined by a parabola through three logarithms.
    """
    first, last = max(1, int(np.ceil(around - reach))), min(values.size - 2, int(around + reach))
    best, height = -1, 0.0
    for i in range(first, last + 1):
        if values[i] > height and values[i] >= values[i - 1] and values[i] > values[i + 1]:
            best, height = i, values[i]
    if best < 0 or values[best - 1] <= 0 or values[best + 1] <= 0:
        return 0.0, 0.0
    left, middle, right = np.log(values[best - 1]), np.log(values[best]), np.log(values[best + 1])
    bend = left - 2 * middle + right
    shift = 0.5 * (left - right) / bend if bend < 0 else 0.0
    return best + shift, np.exp(middle - 0.25 * (left - right) * shift)


@kernel
def walk(
    values: NDArray[np.float64],
    noise: float,
    spacing: float,
    places: NDArray[np.float64],
    heights: NDArray[np.float64],
) -> int:
    """Walk from the highest peak to both sides as long as there are peaks; return how many were found.

    A peak counts where it stands above the valley before it by three times the scatter of the smoothed
    counts, ``sqrt(noise * count)``. Places and heights are in rising order of the places.
    """
    top = int(np.argmax(values))
    place, height = summit(values, top, 1.0)
    if height <= 0:
        return 0
    found_places, found_heights = np.empty(MOST_PEAKS), np.empty(MOST_PEAKS)
    found_places[0], found_heights[0] = place, height
    found = 1
    for side in (-1.0, 1.0):
        here = found_places[0]
        while found < MOST_PEAKS:
            place, height = summit(values, here + side * spacing, 0.35 * spacing)
            if height <= 0:
                break
            low = max(0, int(min(here, place)))
            high = min(values.size - 1, int(max(here, place)) + 1)
            valley = values[low : high + 1].min()
            if height - valley <= 3 * np.sqrt(noise * (height + valley)):
                break
            found_places[found], found_heights[found] = place, height
            found += 1
            here = place
    order = np.argsort(found_places[:found])
    for i in range(found):
        places[i], heights[i] = found_places[order[i]], found_heights[order[i]]
    return found


@kernel
def peaks_pixel(counts: NDArray[np.integer], spacing: float, width: float, out: NDArray[np.float64]) -> None:
    """Estimate one pixel; see :func:`peaks_tile`."""
    values = np.empty(counts.size)
    smooth(counts, width, values)
    places, heights = np.empty(MOST_PEAKS), np.empty(MOST_PEAKS)
    # averaging over the kernel lowers the variance of a count by this factor
    noise = 1.0 / (2.0 * np.sqrt(np.pi) * width)
    found = walk(values, noise, spacing, places, heights)
    out[0] = found
    if found < 2:
        return
    total = mean_k = mean_x = 0.0
    for k in range(found):
        total += heights[k]
        mean_k += heights[k] * k
        mean_x += heights[k] * places[k]
    mean_k, mean_x = mean_k / total, mean_x / total
    upper = lower = 0.0
    for k in range(found):
        upper += heights[k] * (k - mean_k) * (places[k] - mean_x)
        lower += heights[k] * (k - mean_k) ** 2
    step = upper / lower
    highest = int(np.argmax(heights[:found]))
    pair = min(highest, found - 2)
    out[1] = step
    out[2] = mean_x - step * mean_k
    out[3] = (pair + 1) * heights[pair + 1] / heights[pair]
    # half-way between two peaks, where their tails add up to 2 exp(-1 / 8 s^2) of their mean height
    half = 0.5 * (places[pair] + places[pair + 1])
    cell = int(half)
    valley = values[cell] + (half - cell) * (values[cell + 1] - values[cell])
    out[4] = valley / (0.5 * (heights[pair] + heights[pair + 1]))


@kernel
def peaks_tile(
    counts: NDArray[np.integer],
    spacing: NDArray[np.float64],
    width: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Find the peaks of every pixel.

    Args:
        counts: histograms, shape (n, B).
        spacing: first guess of the distance of two peaks, bins, shape (n,); NaN or 0 to leave a pixel out.
        width: standard deviation of the smoothing, bins, shape (n,).
        out: shape (n, 5), filled with NaN before: number of peaks, their distance and the place of the first
            (bins), quanta exposure, and the height of the valley over that of the peaks beside it.
    """
    for pixel in range(counts.shape[0]):
        if spacing[pixel] > 0 and width[pixel] > 0:
            peaks_pixel(counts[pixel], spacing[pixel], width[pixel], out[pixel])
