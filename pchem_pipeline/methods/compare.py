"""Run every method on the same pixels and say how far it is from what is known, beside the bound.

Also how the error of the gain grows with the read noise, on simulated pixels. There all methods are given the
same number of frames: one sample has all of them, a dark and a bright sample half each, a series (dark, half
and full exposure) a third each.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.plain import plain
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.methods.base import Method, PixelSamples, Sample, methods
from pchem_pipeline.methods.photon_transfer import gain_variance
from pchem_pipeline.methods.settings import MethodsSettings
from pchem_pipeline.model.arithmetic.statistics import robust_sd
from pchem_pipeline.model.errors.expected_information import (
    expected_information,
    inverse_information,
    shared_information,
)
from pchem_pipeline.model.law.mass import draw_histograms

#: What is compared: (H, g, read noise) relative, the bias in electrons.
COMPARED = ("quanta_exposure", "conversion_gain", "bias", "read_noise_e")
#: Errors of a parameter over the pixels, JSON data.
Errors = dict[str, float | None]
#: Exposures of the samples in units of H, by what a method needs; frames are shared evenly.
SHARES: dict[str, tuple[float, ...]] = {
    "one sample": (1.0,),
    "a dark and a bright sample": (1.0, 0.0),
    "a series of samples": (1.0, 0.0, 0.5),
}


class MethodResult(NamedTuple):
    """What one method made of the pixels.

    Attributes:
        facts: JSON data: ``name``, ``title``, ``source`` and ``remark`` of the method, how many ``samples``
            it was given, and why it was not run (``missing``, empty if it was); then ``n_pixels``,
            ``n_answered`` with a gain, ``reasons`` why others have none or a doubtful one, processor time
            ``seconds_per_pixel``, and by name of :data:`COMPARED` the ``medians`` of the estimates, in e-,
            e-/DN, DN and e-, and the ``errors`` of :func:`summarise_errors`, where something is known.
        estimates: (H, g, mu, sigma), shape (n, 4); None if it was not run.
    """

    facts: dict[str, Any]
    estimates: FloatArray | None = None


def compare(
    pixels: PixelSamples,
    reference: FloatArray | None,
    settings: MethodsSettings,
    *,
    skip_errors: Sequence[str] = (),
    only: Sequence[str] | None = None,
) -> list[MethodResult]:
    """Run the methods, or some by name, on the samples of the same pixels, the characterised one first.

    The reference is (H, g, mu, sigma) that is held for true, shape (n, 4), NaN where nothing is known;
    ``skip_errors`` are methods whose errors mean nothing, since it is theirs.
    """
    return [
        _run(method, pixels, None if name in skip_errors else reference, settings)
        for name, method in methods().items()
        if only is None or name in only
    ]


def _run(
    method: Method, pixels: PixelSamples, reference: FloatArray | None, settings: MethodsSettings
) -> MethodResult:
    used = pixels if method.needs != "one sample" else PixelSamples(pixels.samples[:1], pixels.adc_limits)
    n_samples = len(used.samples)
    facts: dict[str, Any] = {each: getattr(method, each) for each in ("name", "title", "source", "remark")}
    facts |= {"samples": n_samples, "missing": method.missing(n_samples), "n_pixels": 0, "n_answered": 0}
    facts |= {"reasons": {}, "seconds_per_pixel": None, "medians": {}, "errors": {}}
    if facts["missing"]:
        return MethodResult(facts)
    # compiled code is loaded before the clock starts
    first = tuple(Sample(sample.counts[:1], sample.origin[:1]) for sample in used.samples)
    method.estimate(PixelSamples(first, used.adc_limits), settings)
    start = time.process_time()
    estimates = method.estimate(used, settings)
    facts["seconds_per_pixel"] = (time.process_time() - start) / max(pixels.n_pixels, 1)
    found = estimates.parameters
    facts["n_pixels"], facts["n_answered"] = pixels.n_pixels, int(np.isfinite(found[:, 1]).sum())
    facts["reasons"], facts["medians"] = dict(estimates.reasons), _medians(found)
    if reference is not None:
        errors, bounds = errors_of(found, reference), pixel_bounds(used.samples, reference).T
        facts["errors"] = {
            name: summarise_errors(values, bound)
            for (name, values), bound in zip(errors.items(), bounds, strict=True)
        }
    return MethodResult(facts, found)


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

    Both are (H, g, mu, sigma), shape (n, 4); the reference is held for true.
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


def summarise_errors(errors: FloatArray, bounds: FloatArray) -> Errors:
    """Return what the errors of one parameter come to; relative, or in e- for the bias.

    Errors and Cramer-Rao bounds are of each pixel. Of ``n`` pixels with an error: the mean ``bias`` with
    ``bias_stderr``, ``rmse``, ``median``, ``robust_sd``, and ``bound``, the rms of the bounds.
    """
    known = np.isfinite(errors)
    values, bound = errors[known], bounds[known]
    n, bound = int(values.size), bound[np.isfinite(bound)]
    if n == 0:
        return {"n": 0} | dict.fromkeys(("bias", "bias_stderr", "rmse", "median", "robust_sd", "bound"))
    return {
        "n": n,
        "bias": float(values.mean()),
        "bias_stderr": float(values.std(ddof=1) / np.sqrt(n)) if n > 1 else None,
        "rmse": float(np.sqrt(np.mean(values**2))),
        "median": float(np.median(values)),
        "robust_sd": robust_sd(values),
        "bound": float(np.sqrt(np.mean(bound**2))) if bound.size else None,
    }


def pixel_bounds(samples: Sequence[Sample], reference: FloatArray) -> FloatArray:
    """Return the Cramer-Rao bound of each pixel for :data:`COMPARED`, in the units of the errors, (n, 4).

    The exposure of the first sample is that of the reference, (H, g, mu, sigma), shape (n, 4); those of the
    others follow from their means. A sample whose mean lies within five standard errors of the bias is taken
    for bias frames, of which H = 0 is known. NaN where nothing is known or the samples do not tell.
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
    rows = [bounds(tuple(map(float, h)), float(s), float(g), tuple(map(float, n))) for h, s, g, n in pixels]
    return np.array(rows).reshape(-1, 4)


@functools.lru_cache(maxsize=1 << 16)
def bounds(exposures: tuple[float, ...], noise: float, gain: float, frames: tuple[float, ...]) -> FloatArray:
    """Return the bound of (H of the first sample, g, mu, s_e), relative, the bias in e-."""
    known = np.isfinite([*exposures, noise]).all() and min(exposures[0], noise) > 0 and min(exposures) >= 0
    if not known:
        return np.full(4, np.nan)
    first = expected_information(exposures[0], noise, gain) * frames[0]
    for exposure, n in zip(exposures[1:], frames[1:], strict=True):
        first[1:, 1:] += shared_information(exposure, noise, gain) * n
    covariance = inverse_information(first)
    both = covariance[1, 1] + 2 * covariance[1, 3] + covariance[3, 3]
    relative = covariance[0, 0] / exposures[0] ** 2
    return np.asarray(np.sqrt([relative, covariance[1, 1], covariance[2, 2], both]))


@dataclass(frozen=True)
class StudyPoint:
    """Where and with what to simulate."""

    read_noise_e: float  # s_e, e-, quantisation included
    quanta_exposure: float  # H of the bright sample, e-
    conversion_gain: float  # g, e-/DN
    n_frames: int  # frames of a pixel, all samples together
    n_pixels: int  # pixels to simulate
    seed: int  # of the random numbers


def study_point(point: StudyPoint, settings: MethodsSettings) -> dict[str, Any]:
    """Return errors of all methods at one read noise, and the bounds there, as plain data.

    Methods that give one gain to the whole sensor are left out: they average over pixels.
    """
    exposure, gain, n = point.quanta_exposure, point.conversion_gain, point.n_frames
    found: dict[str, dict[str, Any]] = {}
    for number, (needs, shares) in enumerate(SHARES.items()):
        names = [name for name, m in methods().items() if m.needs == needs and not m.sensor_wide]
        rng = np.random.default_rng([point.seed, number, round(1e6 * point.read_noise_e)])
        frames = max(n // len(shares), 4)
        bias = 100.0 + rng.random(point.n_pixels)  # pixels differ in where a DN begins
        noise = max(point.read_noise_e, gain * np.sqrt(QUANTISATION_VARIANCE))
        drawn = [draw_histograms(rng, share * exposure, gain, bias, noise, frames) for share in shares]
        pixels = PixelSamples(tuple(Sample(one.counts, one.origin) for one in drawn))
        results = compare(pixels, drawn[0].truth, settings, only=names)
        found |= {result.facts["name"]: result.facts for result in results}
    # the smallest relative errors of g, and that of photon transfer
    one = bounds((exposure,), point.read_noise_e, gain, (n,))[1]
    both = bounds((exposure, 0.0), point.read_noise_e, gain, (n / 2, n / 2))[1]
    transfer = np.sqrt(gain_variance(exposure, 0.0, point.read_noise_e, n / 2, n / 2))
    least = {"one sample": one, "a dark and a bright sample": both, "photon_transfer": transfer}
    return {
        "read_noise_e": point.read_noise_e,
        "bounds": {name: plain(value) for name, value in least.items()},
        "methods": {name: found[name] for name in methods() if name in found},
    }
