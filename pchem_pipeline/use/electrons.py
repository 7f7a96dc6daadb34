"""Frames in electrons by the two-point correction, and the two parts of their standard error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import CodeArray, Float32Array, FloatArray
from pchem_pipeline.use.calibration import Calibration


def electrons(
    frames: CodeArray,
    calibration: Calibration,
    offsets: Float32Array | None = None,
    room: Float32Array | None = None,
) -> Float32Array:
    """Return ``g (x - mu)``, e-, of frames (frame, y, x), DN; NaN for pixels without a calibration.

    Offsets that frames, rows and columns share, DN, of the shape of the frames (none: None, or an empty
    array), are taken off. ``room``, for as many frames or more, is where the result is to lie.
    """
    gain = np.where(calibration.usable, calibration.conversion_gain, np.nan).astype(np.float32)
    bias = calibration.bias.astype(np.float32)
    out = np.empty(frames.shape, np.float32) if room is None else room[: len(frames)]
    # frame by frame: what is written is still in the cache when it is scaled
    for t, (frame, own) in enumerate(zip(frames, out, strict=True)):
        np.subtract(frame, bias, out=own, dtype=np.float32)
        if offsets is not None and offsets.size:
            own -= offsets[t]
        own *= gain
    return out


def add_up(frames: CodeArray, offsets: Float32Array, sums: FloatArray) -> None:
    """Add x to the sums of pixels, where there are offsets b also x^2, x - b and its square; see its range.

    ``sums``, shape (6, y, x), are x, x^2, x - b, its square (they stay where there are no offsets), and the
    smallest and largest x. Frames and offsets (or an empty array) are in DN, shape (frame, y, x).
    """
    sums[0] += frames.sum(axis=0, dtype=np.uint64)
    np.minimum(sums[4], frames.min(axis=0), out=sums[4])
    np.maximum(sums[5], frames.max(axis=0), out=sums[5])
    if not offsets.size:
        return
    for frame, offset in zip(frames, offsets, strict=True):
        value = frame.astype(np.float64)
        sums[1] += value * value
        value -= offset
        sums[2] += value
        sums[3] += value * value


def whole_parts(frames: CodeArray, offsets: Float32Array, parts: int, lift: int) -> NDArray[np.uint32]:
    """Return ``x - b`` in whole parts of a DN, ``lift`` DN higher so that none is negative.

    Of frames and their offsets b, DN, (frame, y, x), with so many ``parts`` in a DN.
    """
    out = np.empty(frames.shape, np.uint32)
    for frame, offset, own in zip(frames, offsets, out, strict=True):
        value = (frame.astype(np.float64) + lift - offset) * parts + 0.5
        own[:] = np.maximum(value, 0.0)
    return out


def read_stderr(calibration: Calibration) -> FloatArray:
    """Return the standard error of a sample at its own electron number, e-, shape (y, x).

    Read noise, rounding, and the variance of the model's effects; new in every frame.
    """
    noise = calibration.conversion_gain * np.sqrt(calibration.noise_variance_dn2)
    return np.where(calibration.usable, noise, np.nan)


def calibration_variance(calibration: Calibration) -> FloatArray:
    """Return (c0, c1, c2), (3, y, x), of the variance ``c0 + c1 E + c2 E^2`` that the calibration gives.

    ``E = g (x - mu)``, e-, moves by ``(E / g) dg - g dmu``, in all frames alike; NaN without a calibration.
    """
    gain, covariance = calibration.conversion_gain, calibration.whole_covariance
    of_gain, common, of_bias = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    return np.where(calibration.usable, [gain**2 * of_bias, -2.0 * common, of_gain / gain**2], np.nan)


def with_its_errors(calibration: Calibration, signal: FloatArray) -> Calibration:
    """Return a calibration whose law holds what is not known of g and mu, at a signal.

    Electron numbers are then given all calibrations that are possible, not given that this one is right; a
    bias that is an electron off is not in it. The signal is in e-, shape (y, x).
    """
    variance = stderr_at(calibration_variance(replace(calibration, rivals=None)), signal) ** 2
    variance /= calibration.conversion_gain**2
    law = calibration.law.with_variance(dn2=np.nan_to_num(variance).ravel())
    return replace(calibration, law=law)


def stderr_at(variance: FloatArray, signal: FloatArray) -> FloatArray:
    """Return the standard error from the calibration at a signal, e-, shape (y, x) or (frame, y, x)."""
    whole = variance[0] + variance[1] * signal + variance[2] * signal**2
    return np.asarray(np.sqrt(np.maximum(whole, 0.0)))
