"""Offsets that pixels of a frame, a row, a column or a wave share, all or those of a part of the sensor.

Which a model names, and what they were in some frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import PchEmError
from pchem_pipeline.model.law.parameters import FloatArray
from pchem_pipeline.use.calibration import Calibration

if TYPE_CHECKING:
    from pchem_pipeline.effects.framework.effect import Effect
    from pchem_pipeline.effects.framework.shared_offset import SharedOffset

_AXES = ("frame", "row", "column")
_LEAST_SCENE = 0.02  # e-


@dataclass(frozen=True)
class CommonModes:
    """The offsets that a model names, by parts of the sensor (all of it, a readout tap, ...) that share them.

    Attributes:
        removed: tags of the effects that are taken from the frames.
        parts: pixels of each part, shape (part, y, x); parts may overlap.
        variances: of offsets of the frames, rows and columns of each part, DN^2, shape (part, 3); 0: none.
        left: tags of effects on many pixels alike that are not the same in other frames.
        waves: periodic patterns ``c cos(2 pi (f_y y + f_x x)) + s sin(...)`` with their own c and s in each
            frame: f_y, f_x, the variance of c and of s (DN^2), and the number of the part, shape (wave, 4).
    """

    removed: tuple[str, ...] = ()
    parts: NDArray[np.bool_] = field(default_factory=lambda: np.zeros((0, 0, 0), np.bool_))
    variances: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    left: tuple[str, ...] = ()
    waves: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))

    @classmethod
    def of_model(cls, effects: Sequence[Effect], shape: tuple[int, int]) -> CommonModes:
        """Return those of the effects of a model of a sensor of (rows, columns)."""
        found = [(effect, shared) for effect in effects if (shared := effect.shared_offset()) is not None]
        for effect, shared in found:
            _check(effect, shared)
        # other frames are taken at other times; of a tag that is there several times, all or none
        left = {
            effect.tag: None for effect, shared in found if shared.variance is None or effect.when is not None
        }
        parts: dict[bytes, NDArray[np.bool_]] = {}
        variances: dict[bytes, FloatArray] = {}
        waves = []
        for effect, shared in found:
            if effect.tag in left or shared.variance is None:
                continue
            mask = np.ones(shape, np.bool_) if effect.region is None else effect.region.mask(shape)
            key = mask.tobytes()
            parts[key] = mask
            own = variances.setdefault(key, np.zeros(3))
            if shared.of != "wave":
                own[_AXES.index(shared.of)] += shared.variance
            elif shared.variance > 0.0:
                place = float(list(parts).index(key))
                waves.append([shared.cycles_per_row, shared.cycles_per_column, shared.variance, place])
        removed = dict.fromkeys(effect.tag for effect, _ in found if effect.tag not in left)
        return cls(
            tuple(removed),
            np.array(list(parts.values()), np.bool_).reshape(-1, *shape),
            np.array(list(variances.values())).reshape(-1, 3),
            tuple(left),
            np.array(waves).reshape(-1, 4),
        )

    def turns(self, shape: tuple[int, int]) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return ``exp(2 pi i f y)`` of rows and columns, whose product is a wave: (wave, y), (wave, x)."""
        turn = 2j * np.pi
        rows, columns = (turn * self.waves[:, axis, None] * np.arange(shape[axis]) for axis in (0, 1))
        return np.exp(rows), np.exp(columns)


def _check(effect: Effect, shared: SharedOffset) -> None:
    """Refuse what an effect of another package may say.

    Raises:
        PchEmError: its offset is of nothing that is known, or its variance is none.
    """
    known = shared.of in (*_AXES, "wave")
    if not known or (shared.variance is not None and not 0.0 <= shared.variance < np.inf):
        raise PchEmError(f"effect {effect.tag!r}: shared_offset() returned {shared}, which is no offset")


@dataclass(frozen=True)
class Offsets:
    """What was found in some frames, for each part of the sensor.

    Attributes:
        rows: offset of each row, that of the frame included, DN, shape (frame, part, y).
        columns: offset of each column, DN, shape (frame, part, x).
        waves: c and s of each wave, DN, shape (frame, wave, 2).
        left: variance of a sample's offset that stays unknown, DN^2, shape (frame, part).
    """

    rows: NDArray[np.floating[Any]]
    columns: NDArray[np.floating[Any]]
    waves: NDArray[np.floating[Any]] = field(default_factory=lambda: np.zeros((0, 0, 2)))
    left: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def of_samples(self, modes: CommonModes, rows: slice = slice(None)) -> NDArray[np.float32]:
        """Return the offset of each sample of some rows, DN, shape (frame, y, x)."""
        parts = modes.parts[:, rows]
        out = np.zeros((len(self.rows), *parts.shape[1:]), np.float32)
        for part, mask in enumerate(parts):
            out += mask * (self.rows[:, part, rows, None] + self.columns[:, part, None, :]).astype(np.float32)
        down, along = modes.turns(modes.parts.shape[1:])
        for wave, part in enumerate(modes.waves[:, 3].astype(int)):
            pattern = parts[part] * down[wave, rows, None] * along[wave]
            own = self.waves[:, wave, :, None, None].astype(np.float32)
            out += own[:, 0] * pattern.real.astype(np.float32)
            out += own[:, 1] * pattern.imag.astype(np.float32)
        return out


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
    """Return the most probable offsets of the frames, rows, columns and waves.

    The posterior mode of normal offsets under the mixture of all pixels of the line (best linear prediction
    where the electron numbers are known): each pixel says of the offset what its electron number leaves open.

    Args:
        frames: DN, whole frames, shape (frame, y, x).
        scene: exposure to expect, see `scene_of`.
        calibration: of the pixels, under a law without these offsets.
        modes: which offsets there are.
    """
    from pchem_pipeline.use import common_modes_numba  # loads compiled loops

    n, ny, nx = frames.shape
    m = len(modes.parts)
    out = common_modes_numba.Offsets(
        np.empty((n, m, ny)), np.empty((n, m, nx)), np.empty((n, len(modes.waves), 2)), np.empty((n, m))
    )
    down, along = (np.stack([each.real, each.imag], axis=1) for each in modes.turns((ny, nx)))
    waves = common_modes_numba.Waves(
        down, along, modes.waves[:, 2].copy(), modes.waves[:, 3].astype(np.int64)
    )
    sigma = np.sqrt(calibration.noise_variance_dn2)
    known = np.where(np.isfinite(sigma), scene, np.nan)
    common_modes_numba.find_offsets(
        frames,
        common_modes_numba.Pixels(
            np.ascontiguousarray(known), calibration.conversion_gain, calibration.bias, sigma
        ),
        common_modes_numba.Modes(modes.parts, modes.variances, waves),
        out,
    )
    return Offsets(*out)
