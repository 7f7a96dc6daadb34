"""Offsets that pixels of a frame, a row, a column or a wave share, all or those of a part of the sensor.

Which a model names, and what they were in some frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, Float32Array, FloatArray, IntArray
from pchem_pipeline.base.errors import PchEmError
from pchem_pipeline.use.calibration import Calibration
from pchem_pipeline.use.overscan import Overscan

if TYPE_CHECKING:
    from pchem_pipeline.effects.framework.effect import Effect, SharedOffset

_AXES = ("frame", "row", "column")


@dataclass(frozen=True)
class CommonModes:
    """The offsets that a model names, by parts of the sensor (all of it, a readout tap, ...) that share them.

    Attributes:
        removed: tags of the effects that are taken from the frames.
        parts: pixels of each part, shape (part, y, x); parts may overlap.
        variances: of offsets of the frames, rows and columns of each part, DN^2, shape (part, 3); 0: none.
        left: tags of effects on many pixels alike that are not the same in other frames.
        waves: patterns ``c cos(2 pi (f_y y + f_x x)) + s sin(...)`` with their own c and s in each frame:
            f_y, f_x, the variance of c and of s (DN^2), and the number of the part, shape (wave, 4).
        in_noise: variance of these offsets that the read noise of the run includes, DN^2.
    """

    removed: tuple[str, ...] = ()
    parts: BoolArray = field(default_factory=lambda: np.zeros((0, 0, 0), np.bool_))
    variances: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    left: tuple[str, ...] = ()
    waves: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    in_noise: float = 0.0

    @classmethod
    def of_model(cls, effects: Sequence[Effect], shape: tuple[int, int]) -> CommonModes:
        """Return those of the effects of a model of a sensor of (rows, columns)."""
        found = [(effect, shared) for effect in effects if (shared := effect.shared_offset()) is not None]
        for effect, shared in found:
            _check(effect, shared)
        # other frames are taken at other times; of a tag that is there several times, all or none
        left = dict.fromkeys(
            effect.tag for effect, shared in found if shared.variance is None or effect.when is not None
        )
        removed = dict.fromkeys(effect.tag for effect, _ in found if effect.tag not in left)
        parts: dict[bytes, tuple[BoolArray, FloatArray]] = {}
        waves = []
        for effect, shared in found:
            if effect.tag in left or shared.variance is None:
                continue
            mask = np.ones(shape, np.bool_) if effect.region is None else effect.region.mask(shape)
            _, variances = parts.setdefault(mask.tobytes(), (mask, np.zeros(3)))
            if shared.of != "wave":
                variances[_AXES.index(shared.of)] += shared.variance
            elif shared.variance > 0.0:
                place = float(list(parts).index(mask.tobytes()))
                waves.append([shared.cycles_per_row, shared.cycles_per_column, shared.variance, place])
        return cls(
            tuple(removed),
            np.array([mask for mask, _ in parts.values()], np.bool_).reshape(-1, *shape),
            np.array([variances for _, variances in parts.values()]).reshape(-1, 3),
            tuple(left),
            np.array(waves).reshape(-1, 4),
        )

    @classmethod
    def of_overscan(cls, overscan: Overscan, frames: Iterable[FloatArray]) -> CommonModes:
        """Return those of whole frames and rows, as large as in frames; see `Overscan.variances_in`."""
        variances = np.array([[*overscan.variances_in(frames), 0.0]])
        parts = np.ones((1, *overscan.bias.shape), np.bool_)
        return cls(("frame_noise", "row_noise"), parts, variances, in_noise=overscan.shared_variance)

    def turns(self, shape: tuple[int, int]) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
        """Return ``exp(2 pi i f y)`` of rows and columns, whose product is a wave: (wave, y), (wave, x)."""
        turn = 2j * np.pi
        rows, columns = (turn * self.waves[:, axis, None] * np.arange(shape[axis]) for axis in (0, 1))
        return np.exp(rows), np.exp(columns)


def _check(effect: Effect, shared: SharedOffset) -> None:
    """Refuse what an effect of another package may say: an unknown kind, or an impossible variance."""
    known = shared.of in (*_AXES, "wave")
    if not known or (shared.variance is not None and not 0.0 <= shared.variance < np.inf):
        raise PchEmError(f"effect {effect.tag!r}: shared_offset() returned {shared}, which is not an offset")


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

    def of_samples(self, modes: CommonModes, rows: slice = slice(None)) -> Float32Array:
        """Return the offset of each sample of some rows, DN, shape (frame, y, x)."""
        design, n = _Design.of(modes), len(self.rows)
        waves = self.waves if len(self.waves) else np.zeros((n, 0, 2))
        frames = [design.offsets(self.rows[t], self.columns[t], waves[t], rows) for t in range(n)]
        return np.array(frames, np.float32).reshape(n, *modes.parts[0, rows].shape)


@dataclass(frozen=True)
class Reference:
    """Pixels that tell offsets, shape (y, x) each; NaN where nothing is known.

    Attributes:
        scene: exposure to expect, e-; 0 without electrons.
        step: DN of an electron.
        bias: mu, DN.
        sigma: standard deviation of samples of one electron number, without the offsets, DN.
    """

    scene: FloatArray
    step: FloatArray
    bias: FloatArray
    sigma: FloatArray

    @classmethod
    def of_pixels(cls, calibration: Calibration, scene: FloatArray) -> Reference:
        """Return calibrated pixels; the law of the calibration is without these offsets."""
        sigma = np.sqrt(calibration.noise_variance_dn2)
        return cls(scene, 1.0 / calibration.conversion_gain, calibration.bias, sigma)

    @classmethod
    def of_overscan(cls, overscan: Overscan) -> Reference:
        """Return the overscan."""
        nothing = np.zeros(overscan.bias.shape)
        return cls(nothing, nothing + 1.0, overscan.bias, np.sqrt(overscan.own_variance))


def scene_of(mean: FloatArray, calibration: Calibration) -> FloatArray:
    """Return the exposure, e-, (y, x), to expect from the mean of some frames, DN; NaN: no calibration."""
    signal = (mean - calibration.bias) * calibration.conversion_gain
    return np.where(calibration.usable, np.maximum(signal, 0.02), np.nan)  # e-, at least


@dataclass(frozen=True)
class _Design:
    """Offsets of samples as a linear function of standard normal numbers, z.

    Of each part there is one of the frame, one of each row, one of each column; of each wave two.
    """

    modes: CommonModes
    down: FloatArray  # cosine and sine of each wave down the rows, shape (wave, y, 2)
    along: FloatArray  # along the columns, shape (wave, x, 2)

    @classmethod
    def of(cls, modes: CommonModes) -> _Design:
        turns = modes.turns(modes.parts.shape[1:])
        return cls(modes, *(np.stack([turn.real, turn.imag], axis=2) for turn in turns))

    @property
    def parts_of_waves(self) -> IntArray:
        """Number of the part of each wave."""
        return self.modes.waves[:, 3].astype(np.int64)

    @cached_property
    def _scales(self) -> FloatArray:
        """Standard deviation of each number, DN."""
        _, ny, nx = self.modes.parts.shape
        variances = np.repeat(self.modes.variances, (1, ny, nx), axis=1).ravel()
        return np.asarray(np.sqrt(np.concatenate([variances, np.repeat(self.modes.waves[:, 2], 2)])))

    def unpacked(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the offsets of rows, with that of their frame, and of columns, and c and s of waves, DN."""
        n_parts, ny, nx = self.modes.parts.shape
        values, n = self._scales * z, n_parts * (1 + ny + nx)
        lines = values[:n].reshape(n_parts, -1)
        return lines[:, :1] + lines[:, 1 : 1 + ny], lines[:, 1 + ny :], values[n:].reshape(-1, 2)

    def offsets(
        self,
        rows: NDArray[np.floating[Any]],
        columns: NDArray[np.floating[Any]],
        waves: NDArray[np.floating[Any]],
        some: slice = slice(None),
    ) -> FloatArray:
        """Return the offset of each sample of some rows of a frame, DN, shape (y, x)."""
        parts = self.modes.parts[:, some]
        found = np.zeros(parts.shape[1:])
        for mask, row, column in zip(parts, rows, columns, strict=True):
            found += mask * (row[some, None] + column)
        for part, (c, s), down, along in zip(self.parts_of_waves, waves, self.down, self.along, strict=True):
            found += parts[part] * (down[some] @ np.array([[c, s], [s, -c]]) @ along.T)
        return found

    def sums(self, values: FloatArray) -> FloatArray:
        """Return the transpose of :meth:`offsets`, of values (y, x)."""
        parts = []
        for mask in self.modes.parts:
            some = mask * values
            rows = some.sum(axis=1)
            parts += [rows.sum(keepdims=True), rows, some.sum(axis=0)]
        for part, down, along in zip(self.parts_of_waves, self.down, self.along, strict=True):
            (cc, cs), (sc, ss) = down.T @ (self.modes.parts[part] * values) @ along
            parts.append(np.array([cc - ss, sc + cs]))
        return np.asarray(np.concatenate([np.zeros(0), *parts]) * self._scales)

    def top(self, form: FloatArray, near: FloatArray) -> FloatArray:
        """Return z of largest ``sum(form[0] o - form[1] o^2 / 2) - z^2 / 2``, by conjugate gradients."""
        from scipy.sparse.linalg import LinearOperator, cg

        size = near.size
        curvature = LinearOperator(
            (size, size), lambda z: z + self.sums(form[1] * self.offsets(*self.unpacked(z))), dtype=float
        )
        return np.asarray(cg(curvature, self.sums(form[0]), x0=near, rtol=1e-6)[0])

    def left(self, weight: FloatArray) -> FloatArray:
        """Return the variance of a sample's offset that stays unknown, on the median line, DN^2, (part,)."""
        parts, waves = self.modes.parts, self.parts_of_waves
        of_frame, of_row, of_column = self.modes.variances.T
        known = parts * weight
        # what a row says of itself, and then of its frame
        rows = 1.0 / (1.0 + of_row[:, None] * known.sum(axis=2))
        with np.errstate(divide="ignore"):
            frame = 1.0 / ((known.sum(axis=2) * rows).sum(axis=1) + 1.0 / of_frame)
            columns = 1.0 / (known.sum(axis=1) + 1.0 / of_column[:, None])
            # each coefficient is known by half of the samples' information, and cos^2 + sin^2 = 1
            of_waves = 1.0 / (0.5 * known.sum(axis=(1, 2))[waves] + 1.0 / self.modes.waves[:, 2])
        lines = (frame[:, None] * rows**2 + of_row[:, None] * rows, columns)
        each = [
            np.nanmedian(np.where(parts.any(axis=axis), values, np.nan), axis=1)
            for axis, values in zip((2, 1), lines, strict=True)
        ]
        return np.asarray(sum(each) + np.bincount(waves, of_waves, len(parts)))


def estimate_offsets(
    frames: NDArray[np.unsignedinteger[Any]],
    reference: Reference,
    modes: CommonModes,
) -> Offsets:
    """Return the most probable offsets of whole frames (frame, y, x), DN, their rows, columns and waves.

    The posterior mode of normal offsets under the mixture of all pixels of the line (best linear prediction
    where the electron numbers are known): each pixel says of the offset what its electron number leaves open.
    """
    from pchem_pipeline.model.law.pcd import pcd_posterior  # loads compiled loops

    design, step, bias, sigma = _Design.of(modes), reference.step, reference.bias, reference.sigma
    known = np.ascontiguousarray(np.where(np.isfinite(sigma), reference.scene, np.nan))
    expansions = 4 if (known > 0.0).any() else 0  # without electrons the means tell all
    found = []
    for frame in frames:
        # means tell offsets beyond half an electron apart, electron numbers the rest
        weight = np.nan_to_num(1.0 / (known * step**2 + sigma**2))
        form = np.stack([weight * np.nan_to_num(frame - bias - known * step), weight])
        z = design.top(form, np.zeros_like(design.sums(weight)))
        for _ in range(expansions):  # in the offsets
            offset = design.offsets(*design.unpacked(z))
            given = pcd_posterior(frame - bias - offset, known, 1.0 / step, 0.0, sigma)
            # what is left open of the electron number takes from what a sample tells of its offset
            # but for a twentieth of what one tells whose electron number is known
            open_part = (given.ee - given.e**2) / sigma**2
            information = np.maximum(1.0 - open_part, 0.05) / sigma**2
            score = given.e / sigma**2 + information * offset  # of the offset itself, not of its change
            form = np.nan_to_num(np.stack([score, information]))
            z = design.top(form, z)
        found.append((*design.unpacked(z), design.left(form[1])))
    return Offsets(*(np.stack(each) for each in zip(*found, strict=True)))
