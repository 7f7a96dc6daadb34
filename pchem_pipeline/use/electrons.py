"""Frames in electrons by the two-point correction, and the two parts of their standard error."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.law.parameters import FloatArray
from pchem_pipeline.use import electrons_numba
from pchem_pipeline.use.calibration import Calibration

__all__ = ["calibration_variance", "electrons", "read_stderr", "stderr_at", "with_its_errors"]


def electrons(
    frames: NDArray[np.unsignedinteger[Any]],
    calibration: Calibration,
    offsets: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Return ``g (x - mu)``, less the offsets that frames, rows and columns share.

    Args:
        frames: DN, shape (frame, y, x).
        calibration: of these pixels.
        offsets: of each sample, DN, shape of the frames; none: None, or an empty array.

    Returns:
        e-, shape (frame, y, x); NaN for pixels without a calibration.
    """
    gain = np.where(calibration.usable, calibration.conversion_gain, np.nan).astype(np.float32)
    bias = calibration.bias.astype(np.float32)
    out = np.empty(frames.shape, np.float32)
    given = np.zeros((0, 0, 0), np.float32) if offsets is None else offsets
    electrons_numba.subtract_and_scale(frames, gain, bias, given, out)
    return out


def read_stderr(calibration: Calibration) -> FloatArray:
    """Return the standard error of a sample at its own electron number, e-, shape (y, x).

    Read noise, rounding, and the variance of the model's effects; new in every frame.
    """
    noise = calibration.conversion_gain * np.sqrt(calibration.noise_variance_dn2)
    return np.where(calibration.usable, noise, np.nan)


def calibration_variance(calibration: Calibration) -> FloatArray:
    """Return (c0, c1, c2) of the variance ``c0 + c1 E + c2 E^2`` that the calibration gives to E electrons.

    ``E = g (x - mu)`` moves by ``(E / g) dg - g dmu``. The error is common to all frames.

    Returns:
        e-^2, e- and 1, shape (3, y, x); NaN for pixels without a calibration.
    """
    return _variance(calibration, calibration.whole_covariance)


def _variance(calibration: Calibration, covariance: FloatArray) -> FloatArray:
    gain = calibration.conversion_gain
    found = np.stack(
        [
            gain**2 * covariance[..., 1, 1],
            -2.0 * covariance[..., 0, 1],
            covariance[..., 0, 0] / gain**2,
        ]
    )
    return np.where(calibration.usable, found, np.nan)


def with_its_errors(calibration: Calibration, signal: FloatArray) -> Calibration:
    """Return a calibration whose law holds what is not known of g and mu, at a signal.

    Electron numbers are then given all calibrations that are possible, not given that this one is right; a
    bias that is an electron off is not in it.

    Args:
        calibration: of these pixels.
        signal: e-, shape (y, x).
    """
    variance = stderr_at(_variance(calibration, calibration.covariance), signal) ** 2
    variance /= calibration.conversion_gain**2
    law = calibration.law.with_variance(dn2=np.nan_to_num(variance).ravel())
    return replace(calibration, law=law)


def stderr_at(variance: FloatArray, signal: FloatArray) -> FloatArray:
    """Return the standard error from the calibration at a signal.

    Args:
        variance: of `calibration_variance`, shape (3, y, x).
        signal: e-, shape (y, x) or (frame, y, x).
    """
    whole = variance[0] + variance[1] * signal + variance[2] * signal**2
    return np.asarray(np.sqrt(np.maximum(whole, 0.0)))
