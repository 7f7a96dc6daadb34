"""What ``pchem apply`` writes when all frames are done: maps, coordinates and quality."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.base.wording import count
from pchem_pipeline.commands.apply.settings import Job
from pchem_pipeline.model.fit.status import MEANINGS
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.use.calibration import PEAKS_OVERLAP_E, Calibration
from pchem_pipeline.use.electrons import calibration_variance, read_stderr, stderr_at

#: Bits of ``applied/quality``: those of ``fit_status``, and from the 17th on its own.
FLAGS: dict[str, tuple[int, str]] = {
    **{str(bit.name).lower(): (int(bit), text) for bit, text in MEANINGS.items()},
    "at_adc_limit": (1 << 16, "samples at a limit of the ADC in these frames"),
    "peaks_overlap": (
        1 << 17,
        f"read noise above {PEAKS_OVERLAP_E} e-: the most probable electron number is often wrong; use "
        "expected_number",
    ),
    "outside_histogram": (1 << 18, "outlying samples excluded from the exposure"),
    "below_bias": (
        1 << 19,
        "mean of these frames more than 5 standard errors below the bias: the bias has changed",
    ),
}


def finish_maps(output: RunStore, job: Job, calibration: Calibration, reporter: Reporter) -> None:
    """Write maps, quality and coordinates; they are small, and written whole."""
    n, ny, nx = job.source.shape
    for name, length in (("frame", n), ("y", ny), ("x", nx)):
        output.write_array(f"applied/{name}", np.arange(length, dtype=np.int64))
    sums = _sums(output) if job.converts else None
    if (extra := job.offset_variance) is not None:  # what stays unknown of the offsets
        calibration = replace(calibration, law=calibration.law.with_variance(dn2=extra.ravel()))
    if sums is not None and job.removed:
        _write_noise(output, calibration, sums, n, job, reporter)
        sums[0] = sums[2]  # the offsets may have a mean: a bias that moved
    raised = {"peaks_overlap": calibration.conversion_gain * calibration.read_noise_dn > PEAKS_OVERLAP_E}
    if "electrons" in job.kinds:
        assert sums is not None
        noise = read_stderr(calibration)
        if job.traps:
            left = output.read("applied_parts/jump_noise")
            trapped = np.isfinite(left)
            before, after = (float(np.median(each[trapped])) for each in (noise, left))
            reporter.info(
                f"apply: noise of pixels with a trap, median: {before:.3f} e- with telegraph jumps, "
                f"{after:.3f} e- without"
            )
            noise = np.where(trapped, left, noise)
        _write_errors(output, calibration, noise, sums, n)
    if sums is not None:
        raised |= _flags_of_sums(calibration, sums, n, job.limits)
    if job.counts:
        ends = output.read("applied_parts/range")
        raised["outside_histogram"] = (ends[1] - ends[0]) >= job.bins
    _write_quality(output, calibration, raised)
    bad = int((~calibration.usable).sum())
    reporter.info(
        f"apply: {count(n, 'frame')} of {ny} x {nx} pixels"
        + (f"; {count(bad, 'pixel')} without a calibration: NaN (see quality)" if bad else "")
    )


def _sums(output: RunStore) -> FloatArray:
    """Return the sums over all frames, segment by segment in their order."""
    number = output.array("applied_parts/sums").shape[0]
    places = ((slice(i, i + 1), *[slice(None)] * 3) for i in range(number))
    parts = (output.read("applied_parts/sums", place)[0] for place in places)
    total: FloatArray = next(parts)
    for part in parts:
        total[:4] += part[:4]
        total[4] = np.minimum(total[4], part[4])
        total[5] = np.maximum(total[5], part[5])
    return total


def _write_errors(
    output: RunStore, calibration: Calibration, noise: FloatArray, sums: FloatArray, n: int
) -> None:
    """Write the two parts of the standard error of electrons, and the mean signal."""
    signal = np.where(
        calibration.usable, calibration.conversion_gain * (sums[0] / n - calibration.bias), np.nan
    )
    variance = calibration_variance(calibration)
    output.write_array("applied/mean_signal", signal)
    output.write_array("applied/electrons_stderr_read", noise.astype(np.float32))
    output.write_array("applied/calibration_variance", variance, {"power_of_signal": [0, 1, 2]})
    output.write_array("applied/electrons_stderr_calibration", stderr_at(variance, signal).astype(np.float32))


def _write_noise(
    output: RunStore, calibration: Calibration, sums: FloatArray, n: int, job: Job, reporter: Reporter
) -> None:
    """Write what the pixels scatter by with the offsets and without, and say what that gains."""
    gain = np.where(calibration.usable, calibration.conversion_gain, np.nan)
    variances = [gain**2 * _variance(sums[i : i + 2], n) for i in (0, 2)]
    for name, variance in zip(("noise_before", "noise_after"), variances, strict=True):
        output.write_array(f"applied/{name}", np.sqrt(np.maximum(variance, 0.0)))
    # what is not of the electrons' own number, whose variance is its mean
    signal = gain * (sums[2] / n - calibration.bias)
    expected = np.maximum(signal, 0.0) + (gain * calibration.read_noise_dn) ** 2
    before, after = (_noise_words(each - signal, expected) for each in variances)
    reporter.info(
        f"apply: subtracted {', '.join(job.removed)}: noise without shot noise {before} before, {after} after"
    )
    before, after = (
        _row_words(_variance(rows, n), _variance(sums[i : i + 2], n), calibration.usable)
        for i, rows in zip((0, 2), job.row_sums, strict=True)
    )
    reporter.info(f"apply: row noise, that of frames included, {before} before, {after} after")


def _variance(sums: FloatArray, n: int) -> FloatArray:
    """Return the variance of n values from their sum and the sum of their squares, shape (2, ...)."""
    mean, square = sums / n
    return np.asarray((square - mean**2) * n / max(n - 1, 1))


def _row_words(means: FloatArray, pixels: FloatArray, usable: BoolArray) -> str:
    """Return the noise that a row shares, DN, from variances of its mean (y,) and of samples (y, x), DN^2."""
    number = usable.sum(axis=1)
    several = number > 1
    own = np.where(usable, pixels, 0.0).sum(axis=1)[several] / number[several] ** 2
    # the pixels' noise has the shared part, too
    shared = (means[several] - own) / (1.0 - 1.0 / number[several])
    if not shared.size:
        return "not known"
    error = float(shared.std() / np.sqrt(shared.size))
    root = float(np.sqrt(max(shared.mean(), 0.0)))
    return f"{root:.3f} ± {error / (2.0 * max(root, error**0.5, 1e-9)):.3f} DN"


def _noise_words(excess: FloatArray, expected: FloatArray) -> str:
    """Return the root of the mean excess of variances over shot noise, e-, weighted by expected variances."""
    known = np.isfinite(excess)
    weight = expected[known] ** -2.0
    mean = float(np.average(excess[known], weights=weight))
    if not mean > 0.0:
        return "not known (the samples scatter less than their mean allows: frames of another sensor?)"
    error = float(np.sqrt(np.sum((weight * (excess[known] - mean)) ** 2)) / weight.sum())
    return f"{np.sqrt(mean):.3f} ± {error / (2.0 * np.sqrt(mean)):.3f} e-"


def _flags_of_sums(
    calibration: Calibration, sums: FloatArray, n: int, limits: tuple[int, int] | None
) -> dict[str, Any]:
    mean = sums[0] / n
    error = np.sqrt(calibration.noise_variance_dn2 / n + calibration.covariance[..., 1, 1])
    with np.errstate(invalid="ignore"):
        found = {"below_bias": mean - calibration.bias < -5.0 * error}
    if limits is not None:
        found["at_adc_limit"] = (sums[4] <= limits[0]) | (sums[5] >= limits[1])
    return found


def _write_quality(output: RunStore, calibration: Calibration, raised: Mapping[str, BoolArray]) -> None:
    """Write why pixels have no value, or deserve caution, with attributes by the CF conventions."""
    quality = calibration.fit_status.astype(np.uint32)
    for name, where in raised.items():
        quality |= np.where(where, np.uint32(FLAGS[name][0]), np.uint32(0))
    words = {
        "flag_masks": [mask for mask, _ in FLAGS.values()],
        "flag_meanings": " ".join(FLAGS),
        "sentences": {name: text for name, (_, text) in FLAGS.items()},
    }
    output.write_array("applied/quality", quality, words)
