"""What fades along the run in parts of a sensor: amplitudes in the cells of a grid, and time constants."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from pchem_pipeline.effects.estimators.charge_sums import BlockCharge
from pchem_pipeline.effects.types import FloatArray, IntArray

# standard deviations up to which a pixel's deviation counts, and times that a mean is taken anew about which
# they are cut: by then it stays
_CUT, _CUT_ROUNDS = 4.0, 4
# a cell must explain this chi-square to tell the time constant, and the differences of four cells that one
_PRICE_OF_CELL = 6.0
_PRICE_OF_DETAIL = 9.0
# of the brightest cell: less than this is dark
_DARK = 0.05


@dataclass(frozen=True)
class FadingCells:
    """Amplitudes of a falling exponential in the cells of a grid over the sensor.

    Attributes:
        decay: time constant, frames.
        amplitude: e-, less what goes with H, shape (rows, columns); 0 in cells without pixels.
        noise: standard errors, e-; infinite in cells without pixels.
        exposure: mean H, e-.
        score: chi-square of all cells against 0, as a standard normal number.
        cell: which of them each pixel of the blocks is in, flat, shape (n,).
    """

    decay: float
    amplitude: FloatArray
    noise: FloatArray
    exposure: FloatArray
    score: float
    cell: IntArray

    @classmethod
    def of(cls, blocks: BlockCharge, exposure: FloatArray, decay: float, grid: int) -> FadingCells:
        """Return the least squares amplitudes at a time constant, on a grid of so many rows and columns.

        Each is a power of two, smaller where the sensor is.
        """
        shape = _exponential(blocks, decay)
        weight = blocks.length * shape
        found = weight @ blocks.deviation / (weight @ shape)
        stderr = np.sqrt(blocks.variance / (weight @ shape))
        rows, columns = (min(grid, 2 ** int(np.log2(n))) for n in exposure.shape)
        cell = (blocks.y * rows // exposure.shape[0]) * columns + blocks.x * columns // exposure.shape[1]
        n = rows * columns

        def mean_of(values: FloatArray, inverse: FloatArray) -> FloatArray:
            return np.bincount(cell, values * inverse, n) / np.maximum(np.bincount(cell, inverse, n), 1e-300)

        inverse = stderr**-2
        # from the middle of each cell: from 0 on a bright image would be cut at so many steps
        amplitude = np.nan_to_num(ndimage.median(found, cell, np.arange(n)))
        for _ in range(_CUT_ROUNDS):
            # single pixels that jump are another effect
            middle = amplitude[cell]
            amplitude = mean_of(np.clip(found, middle - _CUT * stderr, middle + _CUT * stderr), inverse)
        held = np.bincount(cell, inverse, n)
        noise = np.where(held > 0, np.maximum(held, 1e-300) ** -0.5, np.inf)
        freedom = max(int((held > 0).sum()) - 1, 1)
        score = (float(np.sum((amplitude / noise) ** 2)) - freedom) / np.sqrt(2.0 * freedom)
        bright = mean_of(exposure[blocks.y, blocks.x], inverse)
        size = (rows, columns)
        return cls(decay, amplitude.reshape(size), noise.reshape(size), bright.reshape(size), score, cell)

    def above_background(self) -> FloatArray:
        """Return the amplitudes with that part of H added which makes their median 0."""
        held = np.isfinite(self.noise) & (self.exposure > 0)
        background = float(np.median(self.amplitude[held] / self.exposure[held]))
        return np.where(held, self.amplitude - background * self.exposure, 0.0)

    def image(self) -> FloatArray:
        """Return the amplitudes above the background without their noise, >= 0.

        A group of two by two cells keeps its differences where they stand out, and has its mean otherwise; so
        on with the means, up to the whole sensor (Donoho and Johnstone 1994, with Haar's wavelets by groups).
        """
        weight = np.where(np.isfinite(self.noise), self.noise, np.inf) ** -2.0
        image = np.maximum(_denoised(self.above_background(), weight), 0.0)
        return np.where(image > _DARK * image.max(), image, 0.0)


def _denoised(values: FloatArray, weight: FloatArray) -> FloatArray:
    """Return values on a grid of powers of two, of given inverse variances, coarse where they may be."""
    rows, columns = values.shape
    if values.size == 1:
        return values
    size = (max(rows // 2, 1), min(rows, 2), max(columns // 2, 1), min(columns, 2))
    groups, held = values.reshape(size), weight.reshape(size)
    whole = held.sum(axis=(1, 3))
    mean = (held * groups).sum(axis=(1, 3)) / np.maximum(whole, 1e-300)
    details = groups - mean[:, None, :, None]
    stands_out = (held * details**2).sum(axis=(1, 3)) > _PRICE_OF_DETAIL
    kept: FloatArray = _denoised(mean, whole)[:, None, :, None] + np.where(
        stands_out[:, None, :, None], details, 0.0
    )
    return kept.reshape(rows, columns)


def _exponential(blocks: BlockCharge, decay: float) -> FloatArray:
    """Return the block means of ``exp(-t / decay)``, less their mean."""
    mean = decay / blocks.length * np.exp(-blocks.start / decay) * -np.expm1(-blocks.length / decay)
    return mean - np.average(mean, weights=blocks.length)


@dataclass(frozen=True)
class Fading:
    """How the cells fade.

    Attributes:
        decay: time constant, frames.
        slow_decay: of a second, slower part, frames, or None.
        slow_share: share of the slower part in the first frame.
        scale: the first frame's amplitude over that of the cells.
    """

    decay: float
    slow_decay: float | None
    slow_share: float
    scale: float


def fading_of(blocks: BlockCharge, cells: FadingCells, n_run: int) -> Fading:
    """Return the time constants, from the time profile of all pixels with their amplitudes as weights.

    A second one where it explains more by three standard deviations.
    """
    # cells of noise would weigh in with the time constant that they were found with
    significant = (cells.amplitude / cells.noise) ** 2 > _PRICE_OF_CELL
    amplitude = np.where(significant, cells.amplitude, 0.0).reshape(-1)[cells.cell]
    power = max(float(np.sum(amplitude**2 / blocks.variance)), 1e-300)
    profile = blocks.deviation @ (amplitude / blocks.variance) / power
    decays = n_run * np.geomspace(0.01, 3.0, 25)
    shapes = np.stack([_exponential(blocks, decay) for decay in decays])
    weighted = shapes * blocks.length
    products, overlaps = weighted @ shapes.T, weighted @ profile
    single = overlaps**2 / np.diag(products) * (overlaps > 0)
    top = int(np.argmax(single))
    best = float(single[top]) + 9.0 / power
    fading = Fading(float(decays[top]), None, 0.5, float(overlaps[top] / products[top, top]))
    # every pair of clearly different time constants
    for i, j in zip(*np.triu_indices(decays.size, 3), strict=True):
        both = np.array([i, j])
        pair = np.linalg.solve(products[np.ix_(both, both)], overlaps[both])
        explained = float(pair @ overlaps[both])
        if (pair > 0).all() and explained > best:
            best, scale = explained, float(pair.sum())
            fading = Fading(float(decays[i]), float(decays[j]), float(pair[1]) / scale, scale)
    return fading
