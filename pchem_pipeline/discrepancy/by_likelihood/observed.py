"""The examined histograms, split into train, test and final samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.errors import InputError
from pchem_pipeline.discrepancy.by_likelihood.sets import SetComparison
from pchem_pipeline.discrepancy.by_simulation.sensor.population import REACH
from pchem_pipeline.discrepancy.observe.observe import UNTRUSTWORTHY, observe_histograms
from pchem_pipeline.discrepancy.verdict import Examined
from pchem_pipeline.effects.framework.evidence import Evidence, PixelMaps
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.shared import Samples

_FEWEST_SAMPLES = 300  # of a pixel
_MOST_PIXELS = 256  # looked at; more add nothing about what all have in common
_LARGEST_TOTAL = 10**9 - 1  # samples of a pixel that can be split at random


@dataclass(frozen=True)
class SampleHistograms:
    """Histograms of n pixels in one sample (exposure).

    Attributes:
        counts: one histogram per pixel, shape (n, B).
        origin: DN of bin 0, shape (n,).
        bias: frames without electrons, H = 0.
        integration_time: s; if all samples have one, and exposures lie on a line over it, spurious charge is
            distinguished from dark current.
    """

    counts: NDArray[np.integer]
    origin: NDArray[np.integer]
    bias: bool = False
    integration_time: float | None = None


@dataclass(frozen=True)
class ObservedHistograms:
    """The histograms of a search, split and observed.

    Arrays have a row for each sample of each pixel, those of a pixel one after the other.
    """

    parts: tuple[IntArray, ...]  # train, test and final samples of the chosen rows, shape (r, B) each
    origin: IntArray  # DN of bin 0, shape (r,)
    start: FloatArray  # H, g, mu, sigma of the plain fit of the train part, shape (r, 4)
    chosen: NDArray[np.intp]  # which rows of all they are, shape (r,)
    layout: Samples  # of the samples of a pixel
    n_pixels: int  # of all
    evidence: Evidence  # of the train part of all rows with electrons

    @classmethod
    def of(cls, samples: Sequence[SampleHistograms], rng: np.random.Generator) -> ObservedHistograms:
        """Split the samples at random, fit the train part, and choose the rows to look at.

        Raises:
            InputError: the samples are too few, or not of the same pixels, or none has a usable fit.
        """
        _check(samples)
        layout = Samples(tuple(sample.bias for sample in samples))
        counts, origin = _rows(samples)
        parts = _split(counts, 3, rng)
        together = None
        if layout.n > 1:
            together = _fitted_together(parts[0], origin, layout)
            parts, origin = _widened(parts, origin, together)
        evidence = _observe(parts[0], origin, layout, together)
        start = evidence.maps.columns if together is None else together
        chosen = _choose(start, counts.sum(axis=1), layout.n)
        some = tuple(part[chosen] for part in parts)
        n_pixels = samples[0].counts.shape[0]
        return cls(some, origin[chosen], start[chosen], chosen, layout, n_pixels, evidence)

    @property
    def joint(self) -> bool:
        """Whether there are several samples of a pixel."""
        return self.layout.n > 1

    def examined(self) -> Examined:
        """Return what is looked at."""
        sizes = [int(part.sum()) for part in self.parts]
        return Examined(
            histograms=self.chosen.size,
            frames=int(sum(part.sum(axis=1).max() for part in self.parts)),
            rows=(0, 1),
            columns=(0, self.n_pixels),
            train=sizes[0],
            test=sizes[1],
            final=sizes[2],
        )

    def statistics(self, counts: IntArray, bare: SetComparison) -> Mapping[str, float]:
        """Return the statistics of histograms of the rows, fitted with the PCD alone, as ``bare`` does."""
        parameters = replace(bare, train=counts).plain.fit.parameters if self.joint else None
        found = _observe(counts, self.origin, self.layout, parameters)
        bare.effort.simulate(0, found.evaluated)
        return found.z

    def drawn(
        self, log_masses: FloatArray, bare: SetComparison, count: int, rng: np.random.Generator
    ) -> list[Mapping[str, float]]:
        """Return the statistics of histograms drawn from masses of the codes, (r, B), refit included."""
        mass = np.exp(log_masses)
        mass /= mass.sum(axis=1, keepdims=True)
        total = self.parts[0].sum(axis=1)
        bare.effort.replicates += count
        return [self.statistics(rng.multinomial(total, mass), bare) for _ in range(count)]

    def maps(self, parameters: FloatArray) -> PixelMaps:
        """Return parameters of the rows, (r, 4), as maps, NaN elsewhere, shape (1, n) or (n, J)."""
        columns = np.full((4, self.n_pixels * self.layout.n), np.nan)
        columns[:, self.chosen] = parameters.T
        shape = (self.n_pixels, self.layout.n) if self.joint else (1, self.n_pixels)
        maps = columns.reshape(4, *shape)
        return PixelMaps.known(maps, np.isfinite(maps[0]))


def _split(counts: NDArray[np.integer], parts: int, rng: np.random.Generator) -> tuple[IntArray, ...]:
    """Split the samples of histograms (n, B) into equal parts at random, without replacement."""
    left = counts.astype(np.int64)
    found = []
    for remaining in range(parts, 1, -1):
        totals = (left.sum(axis=1) // remaining).tolist()
        drawn = [rng.multivariate_hypergeometric(row, n) for row, n in zip(left, totals, strict=True)]
        found.append(np.stack(drawn).astype(np.int64))
        left = left - found[-1]
    return (*found, left)


def _check(samples: Sequence[SampleHistograms]) -> None:
    if len({sample.counts.shape[0] for sample in samples}) != 1 or all(sample.bias for sample in samples):
        raise InputError("the exposures have different numbers of pixels, or no electrons; give one exposure")
    for sample in samples:
        most = int(sample.counts.sum(axis=1).max()) if sample.counts.size else 0
        if most < 3 * _FEWEST_SAMPLES:
            raise InputError(
                f"the largest histogram has {most} samples; {3 * _FEWEST_SAMPLES} needed: take more frames"
            )
        if most > _LARGEST_TOTAL:
            raise InputError(f"a histogram has {most} samples; at most {_LARGEST_TOTAL} can be split")


def _fitted_together(counts: IntArray, origin: IntArray, layout: Samples) -> FloatArray:
    """Fit the PCD to all samples of each pixel; return (H, g, mu, sigma) of the rows, NaN if unusable."""
    j = layout.n
    by_sample = [counts[k::j].astype(np.uint32) for k in range(j)]
    fit = fit_histograms(by_sample, [origin[k::j] for k in range(j)], dark=layout.dark)
    usable = (fit.fit_status & UNTRUSTWORTHY) == 0
    shared = np.stack([fit.conversion_gain, fit.bias, fit.read_noise_dn], axis=1)
    shared = np.repeat(shared[:, None], j, axis=1)
    rows = np.concatenate([fit.quanta_exposure[:, :, None], shared], axis=2)
    return np.asarray(np.where(usable[:, None, None], rows, np.nan).reshape(-1, 4))


def _observe(counts: IntArray, origin: IntArray, layout: Samples, parameters: FloatArray | None) -> Evidence:
    """Observe the rows with electrons; the others say nothing about how electrons come and are read."""
    illuminated = layout.illuminated(origin.size)
    known = None if parameters is None else parameters[illuminated]
    return observe_histograms(counts[illuminated].astype(np.uint32), origin[illuminated], parameters=known)


def _rows(samples: Sequence[SampleHistograms]) -> tuple[IntArray, IntArray]:
    """Return histograms (n J, B) and DN of bin 0, (n J,): the samples of a pixel one after the other."""
    n, j = samples[0].counts.shape[0], len(samples)
    counts = np.zeros((n, j, max(sample.counts.shape[1] for sample in samples)), np.int64)
    for k, sample in enumerate(samples):
        counts[:, k, : sample.counts.shape[1]] = sample.counts
    origin = np.stack([np.asarray(sample.origin, np.int64) for sample in samples], axis=1)
    return counts.reshape(n * j, -1), origin.ravel()


def _widened(
    parts: Sequence[IntArray], origin: IntArray, parameters: FloatArray
) -> tuple[tuple[IntArray, ...], IntArray]:
    """Return the histograms with all codes that the law reaches, so that replicates have tails, too."""
    h, g, mu, sigma = parameters.T
    last = origin + parts[0].shape[1] - 1
    low = np.nanmax(origin - (mu - REACH * sigma))
    high = np.nanmax(mu + (h + REACH * (np.sqrt(h) + 1.0)) / g + REACH * sigma - last)
    left, right = (max(int(np.ceil(more)), 0) for more in (low, high))
    return tuple(np.pad(part, ((0, 0), (left, right))) for part in parts), origin - left


def _choose(parameters: FloatArray, total: NDArray[np.integer], n_samples: int) -> NDArray[np.intp]:
    """Return rows to look at: of usable pixels with samples enough, spread over the exposures."""
    good = np.isfinite(parameters).all(axis=1) & (total >= 3 * _FEWEST_SAMPLES)
    usable = np.flatnonzero(good.reshape(-1, n_samples).all(axis=1))
    if not usable.size:
        raise InputError("no histogram with enough samples has a usable fit; see fit_status")
    exposure = parameters[:, 0].reshape(-1, n_samples).sum(axis=1)
    order = usable[np.argsort(exposure[usable], kind="stable")]
    places = np.unique(np.linspace(0, order.size - 1, min(order.size, _MOST_PIXELS)).astype(np.intp))
    pixels = np.sort(order[places])
    return np.asarray((pixels[:, None] * n_samples + np.arange(n_samples)).ravel(), np.intp)
