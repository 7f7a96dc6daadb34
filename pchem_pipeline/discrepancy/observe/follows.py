"""How readout residuals follow the charge of other samples: by distance, and of whole rows, columns, frames.

Residuals are multiplied with the charge of all samples of the same frame and of the one before, and summed
by distance through Fourier transforms. Of the charge only that part counts which its own sample's residual
does not hold: noise that samples share moves both, and leaves such products alone. Given the histograms,
frames without an effect are in random order, so that the sum of N products of different pixels has mean 0 and
variance N. The largest of all distances counts, by how many there are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from pchem_pipeline.base.arrays import BoolArray, CodeArray, Float32Array, FloatArray, IntArray
from pchem_pipeline.discrepancy.observe import laws as laws_of
from pchem_pipeline.discrepancy.observe.digital import GROUP, MOST_SAMPLES, groups_of
from pchem_pipeline.discrepancy.observe.sums import FrameBlocks, Samples, pixel_statistics
from pchem_pipeline.discrepancy.observe.tables import PixelLaws
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.effects.operators.couple import ALONG, Source

Spectra = NDArray[np.complexfloating]
Axes = tuple[int, ...]  # of (frame, y, x)

SOURCES: tuple[Source, ...] = get_args(Source)
STEPS = 2  # the same frame, and the one before
_FEWEST = 3000  # products of a distance
_RESOLVED = 0.05  # of the variance of the charge, at least, that its residual does not hold


@dataclass(frozen=True)
class Follows:
    """Sums of products of residuals with the charge of other samples, each in its standard deviation.

    Products and their numbers are by frames before, rows and columns from the residual to the charge, the
    distance 0 in the middle, (2, 2 y - 1, 2 x - 1); 0 for a sample with itself. ``wider``: for each of
    `SOURCES`, the standard deviation of their sum over that of independent products.
    """

    products: FloatArray
    pairs: FloatArray
    wider: dict[Source, float]

    def of(self, source: Source) -> tuple[FloatArray, FloatArray]:
        """Return the products and pairs of single samples, or of all of a row, column or frame."""
        axes = ALONG[source]
        if not axes:
            return self.products, self.pairs
        return self.products.sum(axis=axes, keepdims=True), self.pairs.sum(axis=axes, keepdims=True)

    def z(self, source: Source) -> FloatArray:
        """Return the deviations from 0, standard errors; NaN where products are too few."""
        products, pairs = self.of(source)
        known = pairs >= _FEWEST
        return np.where(known, products / np.sqrt(np.where(known, pairs, 1.0)), np.nan) / self.wider[source]


@dataclass(frozen=True)
class FollowingSamples:
    """Frames as residuals and as the charge that these do not hold, each in its standard deviation."""

    samples: Samples  # groups of successive frames
    inside: BoolArray  # pixels whose residuals count, (y, x)
    mixed: Float32Array  # correlation of charge and residual of a sample, (y, x)
    scale: Float32Array  # of what the residual leaves of the charge, 0 where too little, (y, x)
    exposure: Float32Array  # mean of the charge, e-, (y, x)
    spread: Float32Array  # standard deviation of the charge, e-, (y, x)
    mirrored: Axes = ()  # axes of (frame, y, x) along which the charge is counted from the other end

    @classmethod
    def of(
        cls,
        frames: CodeArray,
        edges: IntArray,
        laws: PixelLaws,
        maps: PixelMaps,
        inside: BoolArray | None = None,
        most: int | None = None,
    ) -> FollowingSamples | None:
        """Prepare frames, codes (frame, y, x), in blocks at ``edges``, (b + 1,); None where they are too few.

        Only residuals of pixels ``inside``, (y, x), count, of ``most`` samples, in frames evenly spread.
        """
        first = groups_of(edges, maps.usable.size, frames.size if most is None else most)
        if not first.size:
            return None
        stack = FrameBlocks.of(frames, (first[:, None] + np.arange(GROUP)).ravel(), GROUP)
        samples = replace(Samples.by_laws(stack, laws, maps), most=MOST_SAMPLES)
        inside = samples.usable if inside is None else samples.usable & inside
        pixels = pixel_statistics(laws, maps)
        usable = pixels.usable
        correlation = pixels.cross / np.sqrt(np.where(usable, pixels.variance.prod(axis=0), 1.0))
        left = 1.0 - correlation**2
        resolved = usable & (left > _RESOLVED)
        scale = np.where(resolved, 1.0 / np.sqrt(np.where(resolved, left, 1.0)), 0.0)
        mean = np.where(usable, maps.quanta_exposure, 0.0)
        spread = np.sqrt(np.where(usable, pixels.variance[0], 0.0))
        single = [each.astype(np.float32) for each in (correlation, scale, mean, spread)]
        return cls(samples, inside, single[0], single[1], single[2], single[3])

    @property
    def groups(self) -> int:
        """Number of groups of frames."""
        return self.samples.n_frames // GROUP

    @property
    def told(self) -> BoolArray:
        """Pixels whose charge counts, as they are counted, (y, x)."""
        return self.turned(self.scale > 0.0)

    def turned(self, charge: NDArray[Any]) -> NDArray[Any]:
        """Return what belongs to the charge, (..., y, x), with its mirrored axes from the other end."""
        return np.flip(charge, tuple(axis - 3 for axis in self.mirrored))

    def chunks(self) -> Iterator[tuple[Float32Array, Float32Array]]:
        """Yield residuals and charge of some groups at a time, (frame, y, x), 0 where they do not count."""
        for charge, residual in self.samples.chunks():
            yield residual * self.inside, self.turned((charge - self.mixed * residual) * self.scale)

    def by_distance(self, views: Sequence[Axes] = ((),)) -> list[Follows]:
        """Sum the products of residuals with the charge of others, mirrored along the axes of each view."""
        ny, nx = self.inside.shape
        size = fft.next_fast_len(2 * ny - 1, real=True), fft.next_fast_len(2 * nx - 1, real=True)
        sums = np.zeros((len(views), STEPS, size[0], size[1] // 2 + 1), np.complex128)
        scatter = np.zeros((2, len(SOURCES)))
        for residual, charge in self.chunks():
            scatter += [_scatter(u) for u in (residual, charge)]
            one = fft.rfftn(residual, size, axes=(1, 2)).reshape(-1, GROUP, *sums.shape[2:]).conj()
            for total, axes in zip(sums, views, strict=True):
                two = fft.rfftn(np.flip(charge, axes), size, axes=(1, 2)).reshape(one.shape)
                for step in range(STEPS):
                    total[step] += np.einsum("gtyx,gtyx->yx", one[:, step:], two[:, : GROUP - step])
        ratio = scatter / np.maximum(scatter[:, :1], 1e-300)
        wider = np.sqrt(np.maximum(ratio.prod(axis=0), 1e-300))
        number = (self.groups * (GROUP - np.arange(STEPS))).astype(np.float64)
        found = []
        for axes, total in zip(views, sums, strict=True):
            counted = np.flip(self.scale > 0.0, tuple(axis - 1 for axis in axes))
            to, source = (fft.rfftn(mask.astype(np.float64), size) for mask in (self.inside, counted))
            products = _centred(total, size, (ny, nx))
            pairs = np.rint(_centred((to.conj() * source)[None], size, (ny, nx))) * number[:, None, None]
            if not axes:
                products[0, ny - 1, nx - 1] = pairs[0, ny - 1, nx - 1] = 0.0
            found.append(Follows(products, pairs, dict(zip(SOURCES, wider.tolist(), strict=True))))
        return found

    def by_excess(
        self, place: tuple[int, int, int], columns: tuple[int, int] | None, above: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return ``sum u f`` and ``sum f^2`` of residuals u and of the charge f above some electrons, (n,).

        The place is in frames, rows and columns from the residual to the charge; only residuals of some
        columns (first, end) count; None: all.
        """
        step, (ny, nx) = -place[0], self.inside.shape
        here, there = self._pairs(place)
        some = np.zeros(nx, np.bool_)
        some[slice(*columns) if columns else slice(None)] = True
        products, squares = np.zeros(above.size), np.zeros(above.size)
        for charge, residual in self.samples.chunks():
            u = (residual * (self.inside & some)).reshape(-1, GROUP, ny, nx)[:, step:, *here]
            for number, least in enumerate(above):
                f = np.maximum(self.exposure + self.spread * charge - np.float32(least), 0.0)
                f = (f - f.mean(axis=0)) * (self.scale > 0.0)
                # noise that samples share moves both the charge and the residual of each
                held = (f * residual).sum(axis=0) / np.maximum((residual**2).sum(axis=0), 1.0)
                f = self.turned(f - held * residual).reshape(-1, GROUP, ny, nx)[:, : GROUP - step, *there]
                products[number] += np.einsum("gtyx,gtyx->", u, f, dtype=np.float64)
                squares[number] += np.einsum(
                    "gtyx,gtyx,yx->", f, f, (self.inside & some)[here], dtype=np.float64
                )
        return products, squares

    def _pairs(self, place: tuple[int, int, int]) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
        """Return the rows and columns of residuals with a sample at a place, and those of the samples."""
        here, there = (
            tuple(slice(max(-d, 0), n - max(d, 0)) for d, n in zip(away, self.inside.shape, strict=True))
            for away in (place[1:], (-place[1], -place[2]))
        )
        return here, there

    def by_column(self, place: tuple[int, int, int]) -> tuple[FloatArray, FloatArray]:
        """Return the sums and numbers of products with the sample at a place, by the residual's column.

        The place is in frames, rows and columns from the residual to the charge.
        """
        step, (ny, nx) = -place[0], self.inside.shape
        here, there = self._pairs(place)
        products, pairs = np.zeros(nx), np.zeros(nx)
        for one, two in self.chunks():
            residual = one.reshape(-1, GROUP, ny, nx)[:, step:, *here]
            charge = two.reshape(-1, GROUP, ny, nx)[:, : GROUP - step, *there]
            products[here[1]] += np.einsum("gtyx,gtyx->x", residual, charge)
        both = self.inside[here] & self.told[there]
        pairs[here[1]] = both.sum(axis=0) * self.groups * (GROUP - step)
        return products, pairs


def _scatter(u: Float32Array) -> FloatArray:
    """Return the sums of squares of frames (t, y, x): of samples, row, column and frame sums."""
    rows, columns = u.sum(axis=2, dtype=np.float64), u.sum(axis=1, dtype=np.float64)
    lines = [float((sums**2).sum()) for sums in (rows, columns, rows.sum(axis=1))]
    return np.array([float((u**2).sum(dtype=np.float64)), *lines])


def _centred(spectra: Spectra, size: tuple[int, int], shape: tuple[int, int]) -> FloatArray:
    """Return the sums by distance, that of 0 in the middle, (n, 2 y - 1, 2 x - 1)."""
    found = fft.irfftn(spectra, size, axes=(1, 2))
    rows, columns = (np.arange(1 - n, n) for n in shape)
    return np.asarray(found[:, rows[:, None], columns], np.float64)


def follow_statistics(
    frames: CodeArray, edges: IntArray, laws: PixelLaws, maps: PixelMaps
) -> dict[str, float]:
    """Return the statistics of residuals that follow the charge of other samples, in space and in time.

    Samples next to it in the frame and its own one frame before have statistics of their own.
    """
    prepared = FollowingSamples.of(frames, edges, laws, maps, most=MOST_SAMPLES)
    if prepared is None:
        return {}
    (found,) = prepared.by_distance()
    y, x = (size // 2 for size in found.products.shape[1:])
    of_samples = found.z("sample")
    of_samples[0, y, x - 1 : x + 2] = of_samples[0, y - 1 : y + 2, x] = of_samples[1, y, x] = np.nan
    statistics = {}
    for step, family in enumerate(("space", "time")):
        of_lines = [found.z(source)[step].ravel() for source in SOURCES[1:]]
        for name, values in (("sample", of_samples[step]), ("line", np.concatenate(of_lines))):
            known = values[np.isfinite(values)]
            if known.size:
                statistics[f"{family}.follows.{name}"] = laws_of.largest_normal(known)
    return statistics
