"""What a characterisation method is given, what it returns, and which there are.

A method is a subclass of :class:`Method` in a file of this package. Adding one touches no other file.
"""

from __future__ import annotations

import functools
import importlib
import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray, IntegerArray
from pchem_pipeline.methods.settings import MethodsSettings
from pchem_pipeline.model.fit.status import FAILED, MEANINGS
from pchem_pipeline.model.law.pcd import log_pcd

Needs = Literal["one sample", "a dark and a bright sample", "a series of samples"]


class SampleMoments(NamedTuple):
    """k-statistics of n pixels, shape (n,) each; NaN where the sample is too small.

    Attributes:
        n_frames: number of samples.
        mean: DN.
        variance: DN^2.
        third: third cumulant, DN^3.
        fourth: fourth cumulant, DN^4.
    """

    n_frames: FloatArray
    mean: FloatArray
    variance: FloatArray
    third: FloatArray
    fourth: FloatArray


@dataclass(frozen=True)
class Sample:
    """Histograms of n pixels at one exposure.

    Attributes:
        counts: shape (n, B).
        origin: DN of bin 0, shape (n,).
    """

    counts: IntegerArray
    origin: IntArray

    def moments(self) -> SampleMoments:
        """Return the unbiased estimates of the first four cumulants (k-statistics, Fisher 1929).

        Values are centred on the mean first, so that a large bias costs no digits.
        """
        weights = np.asarray(self.counts, np.float64)
        bins = np.arange(weights.shape[1], dtype=np.float64)
        n = weights.sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            centre = weights @ bins / n
            residual = bins - centre[:, None]
            second, third, fourth = (np.einsum("ij,ij->i", weights, residual**power) for power in (2, 3, 4))
            variance = np.where(n > 1, second / (n - 1), np.nan)
            skew = np.where(n > 2, n * third / ((n - 1) * (n - 2)), np.nan)
            top = n * (n + 1) * fourth - 3 * (n - 1) * second**2
            kurtosis = np.where(n > 3, top / ((n - 1) * (n - 2) * (n - 3)), np.nan)
        return SampleMoments(n, np.asarray(self.origin, np.float64) + centre, variance, skew, kurtosis)

    def likeliest(self, candidates: FloatArray) -> FloatArray:
        """Return for every pixel the likeliest (H, g, mu, sigma), shape (n, 4), NaN where there is none.

        The candidates are of shape (n, m, 4); NaN for those that do not count.
        """
        pixel, bins = np.nonzero(self.counts)
        x, weights = self.origin[pixel] + bins, self.counts[pixel, bins]
        heights = np.full(candidates.shape[:2], -np.inf)
        for place, parameters in enumerate(np.moveaxis(candidates, 1, 0)):
            values = weights * log_pcd(x, *parameters[pixel].T)
            heights[:, place] = np.bincount(pixel, values, minlength=self.origin.size)
        heights[~np.isfinite(heights)] = -np.inf
        best = candidates[np.arange(self.origin.size), heights.argmax(axis=1)]
        return np.where(np.isfinite(heights.max(axis=1))[:, None], best, np.nan)


@dataclass(frozen=True)
class PixelSamples:
    """The same pixels under one or several exposures.

    Attributes:
        samples: the first is the one whose quanta exposure is asked for.
        adc_limits: first and last code of the ADC, DN, where known.
    """

    samples: tuple[Sample, ...]
    adc_limits: tuple[int, int] | None = None

    @property
    def n_pixels(self) -> int:
        """Number of pixels."""
        return int(self.samples[0].origin.size)

    def by_brightness(self) -> list[int]:
        """Return the samples' numbers from the darkest to the brightest, by the median pixel."""
        means = (sample.moments().mean for sample in self.samples)
        known = [mean[np.isfinite(mean)] for mean in means]
        level = [float(np.median(mean)) if mean.size else 0.0 for mean in known]
        return [int(number) for number in np.argsort(level, kind="stable")]


@dataclass(frozen=True)
class Estimates:
    """What a method says of n pixels.

    Attributes:
        parameters: (H, g, mu, sigma) in e-, e-/DN, DN and DN, shape (n, 4); NaN where there is no answer, for
            single parameters too.
        reasons: why pixels have no answer, or a doubtful one: words to number of pixels.
    """

    parameters: FloatArray
    reasons: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def where(cls, parameters: FloatArray, reasons: Mapping[str, BoolArray]) -> Estimates:
        """Return estimates with the number of pixels for which each reason holds."""
        counted = {words: int(np.count_nonzero(pixels)) for words, pixels in reasons.items()}
        return cls(parameters, {words: n for words, n in counted.items() if n})

    @classmethod
    def of_fit(cls, parameters: FloatArray, words: NDArray[np.uint16]) -> Estimates:
        """Return the estimates of this package's fit, with the reasons of its status words."""
        failed = words & int(FAILED)
        return cls.where(parameters, {MEANINGS[bit]: (failed & int(bit)) != 0 for bit in FAILED})


def no_estimates(n_pixels: int) -> FloatArray:
    """Return parameters of pixels without an answer, shape (n_pixels, 4)."""
    return np.full((n_pixels, 4), np.nan)


class Method(ABC):
    """A way to estimate the parameters of pixels.

    Attributes:
        name: short name, in tables and files.
        title: what people call it.
        source: whose method it is.
        needs: the samples that it needs.
        remark: what to know before believing it, one sentence.
        order: place in tables.
        sensor_wide: it gives one gain to all pixels, averaged over them.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    source: ClassVar[str]
    needs: ClassVar[Needs]
    remark: ClassVar[str]
    order: ClassVar[int]
    sensor_wide: ClassVar[bool] = False

    @abstractmethod
    def estimate(self, pixels: PixelSamples, settings: MethodsSettings) -> Estimates:
        """Return the estimates of every pixel; no pixel raises."""

    def missing(self, n_samples: int) -> str:
        """Say what the method lacks with so many samples; empty where it can work."""
        least = {"one sample": 1, "a dark and a bright sample": 2, "a series of samples": 3}[self.needs]
        return "" if n_samples >= least else f"needs {self.needs}; this comparison has {n_samples}"


@functools.cache
def methods() -> Mapping[str, Method]:
    """Return every method by name, in the order of tables: the modules of this package are looked at once."""
    for module in pkgutil.iter_modules([str(Path(__file__).parent)], f"{__package__}."):
        importlib.import_module(module.name)
    known = sorted(Method.__subclasses__(), key=lambda method: (method.order, method.name))
    return MappingProxyType({method.name: method() for method in known})
