"""Run every method on the same pixels and say how far it is from what is known, beside the bound."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.methods.base import Estimates, Method, PixelSamples, Sample, methods
from pchem_pipeline.methods.settings import MethodsSettings
from pchem_pipeline.model.errors.expected_information import (
    expected_information,
    inverse_information,
    shared_information,
)

#: What is compared: (H, g, read noise) relative, the bias in electrons.
COMPARED = ("quanta_exposure", "conversion_gain", "bias", "read_noise_e")


@dataclass(frozen=True)
class ErrorSummary:
    """Errors of one parameter over the pixels with an answer; relative, or in e- for the bias.

    Attributes:
        n: pixels with an answer and a reference.
        bias: mean error.
        bias_stderr: its standard error.
        rmse: root mean square error.
        median: median error.
        robust_sd: 1.4826 times the median absolute deviation.
        bound: root mean square of the Cramer-Rao bounds of these pixels, from the samples that the
            method was given.
    """

    n: int
    bias: float | None
    bias_stderr: float | None
    rmse: float | None
    median: float | None
    robust_sd: float | None
    bound: float | None


@dataclass(frozen=True)
class MethodResult:
    """What one method made of the pixels.

    Attributes:
        name, title, source, remark: of the method.
        samples: how many samples it was given.
        missing: why it was not run; empty if it was.
        n_pixels: pixels that it was given.
        n_answered: pixels with a gain.
        reasons: why others have none, or a doubtful one.
        seconds_per_pixel: processor time.
        medians: of the estimates (H, g, mu, s_e) over the pixels, by name of :data:`COMPARED`, in e-, e-/DN,
            DN and e-; None where no pixel has one.
        errors: by parameter of :data:`COMPARED`; empty where nothing is known.
        estimates: (H, g, mu, sigma), shape (n, 4); None if it was not run.
    """

    name: str
    title: str
    source: str
    remark: str
    samples: int
    missing: str
    n_pixels: int = 0
    n_answered: int = 0
    reasons: Mapping[str, int] | None = None
    seconds_per_pixel: float | None = None
    medians: Mapping[str, float | None] | None = None
    errors: Mapping[str, ErrorSummary] | None = None
    estimates: FloatArray | None = None

    def as_json(self) -> dict[str, Any]:
        """Return everything but the estimates as plain data."""
        found = {name: getattr(self, name) for name in self.__dataclass_fields__ if name != "estimates"}
        found["reasons"] = dict(self.reasons or {})
        found["medians"] = dict(self.medians or {})
        found["errors"] = {name: asdict(summary) for name, summary in (self.errors or {}).items()}
        return found


def compare(
    pixels: PixelSamples,
    reference: FloatArray | None,
    settings: MethodsSettings,
    *,
    skip_errors: Sequence[str] = (),
    only: Sequence[str] | None = None,
) -> list[MethodResult]:
    """Run the methods on the same pixels.

    Args:
        pixels: the pixels' samples, the characterised one first.
        reference: (H, g, mu, sigma) that is held for true, shape (n, 4), NaN where nothing is known; or None.
        settings: of the iterative methods.
        skip_errors: methods whose errors mean nothing, since the reference is theirs.
        only: names of methods to run; all by default.
    """
    found = []
    for name, method in methods().items():
        if only is None or name in only:
            known = None if name in skip_errors else reference
            found.append(_run(name, method, pixels, known, settings))
    return found


def _run(
    name: str, method: Method, pixels: PixelSamples, reference: FloatArray | None, settings: MethodsSettings
) -> MethodResult:
    head = (name, method.title, method.source, method.remark)
    used = pixels if method.needs != "one sample" else PixelSamples(pixels.samples[:1], pixels.adc_limits)
    n_samples = len(used.samples)
    lacking = method.missing(n_samples)
    if lacking:
        return MethodResult(*head, n_samples, lacking)
    # compiled code is loaded before the clock starts
    first = tuple(Sample(sample.counts[:1], sample.origin[:1]) for sample in used.samples)
    method.estimate(PixelSamples(first, used.adc_limits), settings)
    start = time.process_time()
    estimates: Estimates = method.estimate(used, settings)
    seconds = (time.process_time() - start) / max(pixels.n_pixels, 1)
    errors = None
    if reference is not None:
        bounds = pixel_bounds(used.samples, reference)
        errors = {
            parameter: summarise_errors(values, bounds[:, column])
            for column, (parameter, values) in enumerate(errors_of(estimates.parameters, reference).items())
        }
    return MethodResult(
        *head,
        n_samples,
        "",
        pixels.n_pixels,
        int(np.count_nonzero(np.isfinite(estimates.parameters[:, 1]))),
        estimates.reasons,
        seconds,
        _medians(estimates.parameters),
        errors,
        estimates.parameters,
    )


def _medians(parameters: FloatArray) -> dict[str, float | None]:
    """Return the median of each estimate over the pixels that have it."""
    columns = (*parameters[:, :3].T, parameters[:, 1] * parameters[:, 3])
    known = [values[np.isfinite(values)] for values in columns]
    return {
        name: float(np.median(values)) if values.size else None
        for name, values in zip(COMPARED, known, strict=True)
    }


def errors_of(parameters: FloatArray, reference: FloatArray) -> dict[str, FloatArray]:
    """Return the errors of each pixel by parameter of :data:`COMPARED`; relative, that of the bias in e-.

    Args:
        parameters: (H, g, mu, sigma) estimated, shape (n, 4).
        reference: the same, held for true.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        noise = parameters[:, 1] * parameters[:, 3]
        true_noise = reference[:, 1] * reference[:, 3]
        return {
            "quanta_exposure": parameters[:, 0] / reference[:, 0] - 1,
            "conversion_gain": parameters[:, 1] / reference[:, 1] - 1,
            "bias": (parameters[:, 2] - reference[:, 2]) * reference[:, 1],
            "read_noise_e": noise / true_noise - 1,
        }


def summarise_errors(errors: FloatArray, bounds: FloatArray) -> ErrorSummary:
    """Return the summary of the errors of one parameter; NaN are pixels without an answer or a reference."""
    known = np.isfinite(errors)
    values, bound = errors[known], bounds[known]
    if values.size == 0:
        return ErrorSummary(0, None, None, None, None, None, None)
    mean, median = float(values.mean()), float(np.median(values))
    scatter = float(values.std(ddof=1) / np.sqrt(values.size)) if values.size > 1 else None
    finite = bound[np.isfinite(bound)]
    return ErrorSummary(
        int(values.size),
        mean,
        scatter,
        float(np.sqrt(np.mean(values**2))),
        median,
        float(1.4826 * np.median(np.abs(values - median))),
        float(np.sqrt(np.mean(finite**2))) if finite.size else None,
    )


def pixel_bounds(samples: Sequence[Sample], reference: FloatArray) -> FloatArray:
    """Return the Cramer-Rao bound of each pixel for :data:`COMPARED`, in the units of the errors.

    The exposure of the first sample is that of the reference; those of others follow from their means. A
    sample whose mean lies within five standard errors of the bias is taken for bias frames, of which H = 0 is
    known.

    Args:
        samples: used together, the characterised one first.
        reference: (H, g, mu, sigma), shape (n, 4).

    Returns:
        Standard deviations, shape (n, 4); NaN where nothing is known or the samples do not tell.
    """
    exposures, frames = [reference[:, 0]], [samples[0].counts.sum(axis=1)]
    for sample in samples[1:]:
        moments = sample.moments()
        exposure = reference[:, 1] * (moments.mean - reference[:, 2])
        scatter = reference[:, 1] * np.sqrt(moments.variance / moments.n_frames)
        with np.errstate(invalid="ignore"):
            exposures.append(np.where(np.abs(exposure) < 5 * scatter, 0.0, exposure))
        frames.append(moments.n_frames)
    noise = reference[:, 1] * reference[:, 3]
    pixels = zip(np.stack(exposures, 1), noise, reference[:, 1], np.stack(frames, 1), strict=True)
    rows = [_bound(tuple(map(float, h)), float(s), float(g), tuple(map(float, n))) for h, s, g, n in pixels]
    return np.array(rows).reshape(-1, 4)


@functools.lru_cache(maxsize=1 << 16)
def _bound(exposures: tuple[float, ...], noise: float, gain: float, frames: tuple[float, ...]) -> FloatArray:
    """Return the bound of (H of the first sample, g, mu, s_e), relative, the bias in e-."""
    if not (
        np.isfinite([*exposures, noise]).all() and exposures[0] > 0 and noise > 0 and min(exposures) >= 0
    ):
        return np.full(4, np.nan)
    first = expected_information(exposures[0], noise, gain) * frames[0]
    for exposure, n in zip(exposures[1:], frames[1:], strict=True):
        first[1:, 1:] += shared_information(exposure, noise, gain) * n
    covariance = inverse_information(first)
    both = covariance[1, 1] + 2 * covariance[1, 3] + covariance[3, 3]
    relative = covariance[0, 0] / exposures[0] ** 2
    return np.asarray(np.sqrt([relative, covariance[1, 1], covariance[2, 2], both]))
