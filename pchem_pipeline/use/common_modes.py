"""Offsets that pixels of a frame, a row or a column share: which a model names, and what they were."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.law.parameters import FloatArray
from pchem_pipeline.use import common_modes_numba
from pchem_pipeline.use.calibration import Calibration

if TYPE_CHECKING:
    from pchem_pipeline.effects.framework.effect import Effect

__all__ = ["CommonModes", "Offsets", "estimate_offsets", "scene_of"]

FRAME, ROW, COLUMN = range(3)
_LEAST_SCENE = 0.02  # e-
#: Effects that shift many pixels alike.
_OFFSETS = (
    "frame_noise",
    "row_noise",
    "column_noise",
    "bias_drift",
    "bias_jumps",
    "readout_alternation",
    "periodic_pickup",
)


@dataclass(frozen=True)
class CommonModes:
    """Variances of the offsets that a model names, DN^2; 0 where it names none.

    Attributes:
        removed: tags of the effects that are taken from the frames.
        variances: of the offsets of frames, rows and columns.
        left: tags of effects on many pixels alike that no offset of a frame, row or column describes.
    """

    removed: tuple[str, ...] = ()
    variances: tuple[float, float, float] = (0.0, 0.0, 0.0)
    left: tuple[str, ...] = ()

    @classmethod
    def of_model(cls, effects: Sequence[Effect]) -> CommonModes:
        """Return those of the effects of a model."""
        found = [(effect.tag, *_mode(effect)) for effect in effects]
        # of a tag that is there several times, all or none
        left = dict.fromkeys(tag for tag, place, _ in found if place is None)
        variances = [0.0, 0.0, 0.0]
        for tag, place, variance in found:
            if place is not None and tag not in left:
                variances[place] += variance
        removed = dict.fromkeys(tag for tag, _, _ in found if tag not in left)
        modes = tuple(tag for tag in left if tag in _OFFSETS)
        return cls(tuple(removed), (variances[0], variances[1], variances[2]), modes)


def _mode(effect: Effect) -> tuple[int | None, float]:
    """Return which offset an effect is, and its variance, DN^2; None where it is none."""
    if effect.region is not None or effect.when is not None:
        return None, 0.0
    values: dict[str, Any] = effect.model_dump()
    match effect.tag:
        case "frame_noise":
            return FRAME, values["frame_noise_dn"] ** 2
        case "row_noise":
            return ROW, values["row_noise_dn"] ** 2
        case "column_noise":
            return COLUMN, values["column_noise_dn"] ** 2
        case "bias_drift":
            return FRAME, values["drift_dn"] ** 2  # other frames may be at any place of the drift
        case "readout_alternation":
            return FRAME, values["alternation_dn"] ** 2
        case "periodic_pickup":
            along = values["cycles_per_row"] != 0.0, values["cycles_per_column"] != 0.0
            places = {(False, False): FRAME, (True, False): ROW, (False, True): COLUMN}
            return places.get(along), values["amplitude_dn"] ** 2 / 2.0
    return None, 0.0


@dataclass(frozen=True)
class Offsets:
    """What was found in some frames.

    Attributes:
        rows: offset of each row, that of the frame included, DN, shape (frame, y).
        columns: offset of each column, DN, shape (frame, x).
        left: variance of a sample's offset that stays unknown, DN^2, shape (frame,).
    """

    rows: FloatArray
    columns: FloatArray
    left: FloatArray


def scene_of(mean: FloatArray, calibration: Calibration) -> FloatArray:
    """Return the exposure to expect from the mean of some frames, e-, shape (y, x); NaN: no calibration.

    Args:
        mean: DN, shape (y, x).
        calibration: of these pixels.
    """
    signal = (mean - calibration.bias) * calibration.conversion_gain
    return np.where(calibration.usable, np.maximum(signal, _LEAST_SCENE), np.nan)


def estimate_offsets(
    frames: NDArray[np.unsignedinteger[Any]],
    scene: FloatArray,
    calibration: Calibration,
    modes: CommonModes,
) -> Offsets:
    """Return the most probable offsets of the frames, rows and columns.

    The posterior mode of normal offsets under the mixture of all pixels of the line (best linear prediction
    where the electron numbers are known): each pixel says of the offset what its electron number leaves open.

    Args:
        frames: DN, whole frames, shape (frame, y, x).
        scene: exposure to expect, see `scene_of`.
        calibration: of the pixels, under a law without these offsets.
        modes: which offsets there are.
    """
    n, ny, nx = frames.shape
    rows, columns, left = np.empty((n, ny)), np.empty((n, nx)), np.empty(n)
    sigma = np.sqrt(calibration.noise_variance_dn2)
    known = np.where(np.isfinite(sigma), scene, np.nan)
    common_modes_numba.find_offsets(
        frames,
        np.ascontiguousarray(known),
        calibration.conversion_gain,
        calibration.bias,
        sigma,
        np.array(modes.variances),
        rows,
        columns,
        left,
    )
    return Offsets(rows, columns, left)
