"""Spots of light: what they look like, found in maps and in rows and columns, and images that fade."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy import ndimage, special

from pchem_pipeline.effects.estimators.charge_sums import BlockCharge, against_usual_gain
from pchem_pipeline.effects.framework.region import Span
from pchem_pipeline.effects.types import Evidence, FloatArray, IntArray
from pchem_pipeline.model.arithmetic.significance import BEYOND_DOUBT

Falloff = Literal["gaussian", "exponential"]


def spot_image(
    rows: IntArray | FloatArray,
    columns: IntArray | FloatArray,
    shape: tuple[int, ...],
    centre: tuple[float, float],
    radius: float,
    falloff: Falloff = "gaussian",
) -> FloatArray:
    """Return the brightness of a spot relative to the sensor's brightest pixel, shape (rows, columns).

    The pixels are those of some rows and columns of a sensor of this shape. The centre is relative to the
    numbers of rows and columns, the radius to the longer side: the standard deviation of a Gaussian, or the
    distance in which an exponential falls to 1/e.
    """
    side = max(shape)
    dy = ((rows + 0.5) / shape[0] - centre[0]) * shape[0] / side
    dx = ((columns + 0.5) / shape[1] - centre[1]) * shape[1] / side
    # the pixel nearest to the centre, which may lie between pixels or on the border
    nearest = [
        (min(max(int(c * n), 0), n - 1) + 0.5 - c * n) / side for c, n in zip(centre, shape, strict=True)
    ]
    away, least = (dy[:, None] ** 2 + dx**2) / radius**2, (nearest[0] ** 2 + nearest[1] ** 2) / radius**2
    if falloff == "gaussian":
        return np.asarray(np.exp(0.5 * (least - away)))
    return np.asarray(np.exp(np.sqrt(least) - np.sqrt(away)))


def spot_to_window(
    spot: dict[str, Any], falloff: Falloff, rows: Span, columns: Span, shape: tuple[int, int]
) -> dict[str, float]:
    """Return a spot as it is on some rows and columns that are taken for a sensor of their own.

    By its fields ``centre_y``, ``centre_x``, ``radius`` and ``peak_e``; ranges as in `to_window`.
    """
    centre, size = (spot["centre_y"], spot["centre_x"]), (rows[1] - rows[0], columns[1] - columns[0])
    # the brightest of these pixels is the one nearest to the centre
    nearest = [
        np.array([min(max(int(c * n), low), high - 1)])
        for c, n, (low, high) in zip(centre, shape, (rows, columns), strict=True)
    ]
    left = spot_image(nearest[0], nearest[1], shape, centre, spot["radius"], falloff)
    y, x = ((c * n - low) / m for c, n, (low, _), m in zip(centre, shape, (rows, columns), size, strict=True))
    radius = spot["radius"] * max(shape) / max(size)
    return {"centre_y": y, "centre_x": x, "radius": radius, "peak_e": spot["peak_e"] * float(left[0, 0])}


def spot_to_sensor(
    spot: dict[str, Any], rows: Span, columns: Span, shape: tuple[int, int]
) -> dict[str, float]:
    """Return on the sensor a spot that lies on some of its rows and columns; see `spot_to_window`."""
    centre, size = (spot["centre_y"], spot["centre_x"]), (rows[1] - rows[0], columns[1] - columns[0])
    y, x = ((c * m + low) / n for c, n, (low, _), m in zip(centre, shape, (rows, columns), size, strict=True))
    return {"centre_y": y, "centre_x": x, "radius": spot["radius"] * max(size) / max(shape)}


_RADII = (0.04, 0.06, 0.09, 0.13, 0.19, 0.28, 0.4, 0.6)
_CENTRES = 17  # along either side
_LEAST_SEEN = 0.05  # of a spot's peak, in a cell as well known as the best one
_CELLS = 32  # groups of lines along either side
_FEWEST_BURSTS = 3.0  # a single one may be a particle's
_MOST = 0.6  # share of the frames beyond which a burst is the rule


@dataclass(frozen=True)
class Spot:
    """A spot, its largest value, and by how much it lowers chi2."""

    peak: float
    centre: tuple[float, float]
    radius: float
    worth: float
    falloff: Falloff = "gaussian"

    @property
    def place(self) -> dict[str, float]:
        """Centre and radius as the fields of an effect."""
        return {"centre_y": self.centre[0], "centre_x": self.centre[1], "radius": self.radius}


def best_spot(
    amplitude: FloatArray,
    noise: FloatArray,
    background: FloatArray,
    shape: tuple[int, ...],
    falloffs: tuple[Falloff, ...] = ("gaussian",),
) -> Spot | None:
    """Return the spot that fits amplitudes in the cells of a grid best; None if none is positive.

    Standard errors ``noise`` are infinite without pixels; any part of the ``background`` may be beside it.
    """
    y, x = ((np.arange(n) + 0.5) * size / n - 0.5 for n, size in zip(amplitude.shape, shape, strict=True))
    inverse = noise**-2.0
    power = float(np.sum(inverse * background**2))

    def beside(values: FloatArray) -> FloatArray:
        part = np.sum(inverse * background * values, axis=(-2, -1), keepdims=True) / power
        return np.asarray(values - background * part)

    def seen(spots: FloatArray) -> FloatArray:
        return beside(spots).reshape(len(spots), -1)

    target = beside(amplitude).reshape(-1)
    return _fitted((y, x), shape, falloffs, seen, target, inverse.reshape(-1))


def _fitted(
    places: tuple[FloatArray, FloatArray],
    shape: tuple[int, ...],
    falloffs: tuple[Falloff, ...],
    seen: Callable[[FloatArray], FloatArray],
    target: FloatArray,
    inverse: FloatArray,
) -> Spot | None:
    """Return the spot that lowers chi2 the most, of a grid and then around it; None if none is positive.

    Spots (n, rows, columns) are ``seen``, (n, m), in the data ``target``, (m,), of variances 1 / ``inverse``.
    """
    from scipy.optimize import minimize

    def fits(centres: list[tuple[float, float]], radius: float, falloff: Falloff) -> FloatArray:
        """Return by how much each spot lowers chi2, and its peak, (2, n)."""
        shown = seen(np.stack([spot_image(*places, shape, centre, radius, falloff) for centre in centres]))
        overlap, size = (inverse * shown * target).sum(axis=1), (inverse * shown**2).sum(axis=1)
        # between the cells, where no pixel can be used, or all but like what may be beside it: any peak fits
        there = (overlap > 0) & (size > _LEAST_SEEN**2 * inverse.max())
        size = np.maximum(size, 1e-300)
        return np.stack([np.where(there, overlap**2 / size, 0.0), overlap / size])

    grid = list(itertools.product(np.linspace(0, 1, _CENTRES).tolist(), repeat=2))
    forms = list(itertools.product(falloffs, _RADII))
    gains = np.stack([fits(grid, radius, falloff)[0] for falloff, radius in forms])
    if not gains.max() > 0.0:
        return None
    form, place = np.unravel_index(gains.argmax(), gains.shape)
    (falloff, radius), centre = forms[form], grid[place]

    def loss(values: FloatArray) -> float:
        return -float(fits([(float(values[0]), float(values[1]))], float(np.exp(values[2])), falloff)[0, 0])

    step = 1.0 / (_CENTRES - 1)
    limits = [(max(c - step, 0.0), min(c + step, 1.0)) for c in centre]
    limits.append((np.log(radius / 1.5), np.log(radius * 1.5)))
    polished = minimize(loss, [*centre, np.log(radius)], method="Nelder-Mead", bounds=limits).x
    centre, radius = (float(polished[0]), float(polished[1])), float(np.exp(polished[2]))
    gain, peak = fits([centre], radius, falloff)[:, 0]
    return Spot(float(peak), centre, radius, float(gain), falloff)


@dataclass(frozen=True)
class _Lines:
    """Charge of groups of rows and of columns along the run."""

    charge: FloatArray  # sums of k - H of the row groups, then of the column groups, e-, (n, r + c)
    y: FloatArray  # mean row of each group, (r,), and column, (c,)
    x: FloatArray
    response: FloatArray  # sum over the pixels of a cell of dE[k] by an electron of light, (r, c)
    variance: FloatArray  # sum of Var(k), e-^2, which is also what a flicker of all pixels adds, (r, c)

    def lines(self, cells: FloatArray) -> FloatArray:
        """Return the sums over rows and columns of what is in the cells, (..., r + c)."""
        return np.concatenate([cells.sum(axis=-1), cells.sum(axis=-2)], axis=-1)


def best_bursts(evidence: Evidence) -> tuple[Spot, float] | None:
    """Return the spot whose light comes in some frames only, and their share; None if none stands out.

    A spot's light in a frame shows in its rows and columns. For each spot of a family the frames' light,
    less what all pixels have in proportion to H, has moments; those of the spot whose light is the least
    like a normal number tell how often it is there, and how bright, and then in which frames.
    """
    lines = _lines(evidence)
    if lines is None:
        return None
    shape = evidence.maps.usable.shape
    heights = lines.charge @ _weights(lines, shape).T
    more, skewed = (heights**2).mean(axis=0) - 1.0, (heights**3).mean(axis=0)
    sharp = np.maximum(skewed / 15.0**0.5, more / 2.0**0.5) * len(heights) ** 0.5
    best = int(sharp.argmax())
    if sharp[best] < BEYOND_DOUBT or not more[best] > 0.0:
        return None
    # moments of two values h apart, the upper one of a share p: p (1 - p) h^2, and (1 - 2 p) h times that
    skew = float(skewed[best] / more[best] ** 1.5)
    share = 0.5 - 0.5 * skew / (4.0 + skew**2) ** 0.5
    height = float((more[best] / (share * (1.0 - share))) ** 0.5)
    odds = np.log(share / (1.0 - share)) + height * (heights[:, best] + (share - 0.5) * height)
    burst = special.expit(odds)
    if share > _MOST or burst.sum() < _FEWEST_BURSTS:
        return None
    # rows and columns of the bursts, less those of other frames
    mean = burst @ lines.charge / burst.sum() - (1.0 - burst) @ lines.charge / (1.0 - burst).sum()
    inverse = 1.0 / np.maximum(lines.lines(lines.variance), 1e-12)

    def seen(spots: FloatArray) -> FloatArray:
        return lines.lines(spots * lines.response)

    spot = _fitted((lines.y, lines.x), shape, ("gaussian", "exponential"), seen, mean, inverse)
    return None if spot is None else (spot, share)


def _lines(evidence: Evidence) -> _Lines | None:
    time, maps = evidence.time, evidence.maps
    if time is None:
        return None
    good = maps.usable & (evidence.charge_std > 0) & (maps.quanta_exposure > 0)
    if good.sum() < 16 or min(good.shape) < 2:
        return None
    variance = np.where(good, evidence.charge_std, 0.0) ** 2
    gain = against_usual_gain(maps)
    response = np.where(good, gain * variance / np.where(good, maps.quanta_exposure, 1.0), 0.0)
    groups = [np.arange(n) * min(n, _CELLS) // n for n in good.shape]
    first = [np.flatnonzero(np.diff(group, prepend=-1)) for group in groups]

    def cells(values: FloatArray) -> FloatArray:
        return np.asarray(np.add.reduceat(np.add.reduceat(values, first[0], axis=0), first[1], axis=1))

    charge = []
    for series, axis in ((time.row_charge, 1), (time.column_charge, 0)):
        sums = np.nan_to_num(series) * maps.usable.sum(axis=axis)
        sums = np.add.reduceat(sums.astype(np.float64), first[1 - axis], axis=1)
        # what changes slowly is no burst
        means = np.add.reduceat(sums, np.searchsorted(time.frames, time.block_start), axis=0)
        means /= time.block_length[:, None]
        charge.append(sums - np.repeat(means, time.block_length, axis=0))
    y, x = (np.bincount(g, np.arange(g.size)) / np.bincount(g) for g in groups)
    return _Lines(np.concatenate(charge, axis=1), y, x, cells(response), cells(variance))


def _weights(lines: _Lines, shape: tuple[int, ...]) -> FloatArray:
    """Return weights of the lines for each spot's light in a frame, of unit variance, (spots, r + c)."""
    grid, found = np.linspace(0.0, 1.0, 9).tolist(), []
    for radius, y, x in itertools.product(_RADII[1::2], grid, grid):
        spot = spot_image(lines.y, lines.x, shape, (y, x), radius)
        cells = spot.mean(axis=1, keepdims=True) + spot.mean(axis=0)
        # neither a flicker of all pixels, which adds Var(k) to each, nor a constant is a spot
        cells = cells - (cells * lines.variance).sum() / lines.variance.sum()
        scale = np.sqrt((cells**2 * lines.variance).sum())
        row = cells.mean(axis=1) - 0.5 * cells.mean()
        found.append(np.append(row, cells.mean(axis=0) - 0.5 * cells.mean()) / scale)
    return np.array(found)


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
    """Amplitudes of a falling exponential in the cells of a grid over the sensor."""

    decay: float  # time constant, frames
    amplitude: FloatArray  # e-, less what goes with H, shape (rows, columns); 0 in cells without pixels
    noise: FloatArray  # standard errors, e-; infinite in cells without pixels
    exposure: FloatArray  # mean H, e-
    score: float  # chi-square of all cells against 0, as a standard normal number
    cell: IntArray  # which of them each pixel of the blocks is in, flat, shape (n,)

    @classmethod
    def of(cls, blocks: BlockCharge, exposure: FloatArray, decay: float, grid: int) -> FadingCells:
        """Return least squares amplitudes at a time constant, on at most ``grid`` rows and columns."""
        shape = _exponential(blocks, decay)
        weight = blocks.length * shape
        found = weight @ blocks.deviation / (weight @ shape)
        stderr = np.sqrt(blocks.variance / (weight @ shape))
        rows, columns = (min(grid, 2 ** int(np.log2(n))) for n in exposure.shape)
        cell = (blocks.y * rows // exposure.shape[0]) * columns + blocks.x * columns // exposure.shape[1]
        n = rows * columns

        inverse = stderr**-2
        held = np.bincount(cell, inverse, n)

        def mean_of(values: FloatArray) -> FloatArray:
            return np.bincount(cell, values * inverse, n) / np.maximum(held, 1e-300)

        # from the middle of each cell: from 0 on a bright image would be cut at so many steps
        amplitude = np.nan_to_num(ndimage.median(found, cell, np.arange(n)))
        for _ in range(_CUT_ROUNDS):
            # single pixels that jump are another effect
            middle = amplitude[cell]
            amplitude = mean_of(np.clip(found, middle - _CUT * stderr, middle + _CUT * stderr))
        noise = np.where(held > 0, np.maximum(held, 1e-300) ** -0.5, np.inf)
        freedom = max(int((held > 0).sum()) - 1, 1)
        score = (float(np.sum((amplitude / noise) ** 2)) - freedom) / np.sqrt(2.0 * freedom)
        bright = mean_of(exposure[blocks.y, blocks.x])
        size = (rows, columns)
        return cls(decay, amplitude.reshape(size), noise.reshape(size), bright.reshape(size), score, cell)

    def image(self) -> FloatArray:
        """Return the amplitudes above the background without their noise, >= 0.

        A group of two by two cells keeps its differences where they stand out, and has its mean otherwise; so
        on with the means, up to the whole sensor (Donoho and Johnstone 1994, with Haar's wavelets by groups).
        """
        held = np.isfinite(self.noise) & (self.exposure > 0)
        # with that part of H added which makes their median 0
        background = float(np.median(self.amplitude[held] / self.exposure[held]))
        above = np.where(held, self.amplitude - background * self.exposure, 0.0)
        weight = np.where(np.isfinite(self.noise), self.noise, np.inf) ** -2.0
        image = np.maximum(_denoised(above, weight), 0.0)
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
    """How the cells fade."""

    decay: float  # time constant, frames
    slow_decay: float | None  # of a second, slower part, frames
    slow_share: float  # of the slower part in the first frame
    scale: float  # the first frame's amplitude over that of the cells


def fading_of(blocks: BlockCharge, cells: FadingCells, n_run: int) -> Fading:
    """Return the time constants of all pixels together, a second one if that explains more by 3 sigma."""
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
