"""Offsets that pixels of a frame, a row, a column, a wave or a readout share, of the sensor or a part of it.

Which a model names, and what they were in some frames.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, CodeArray, Float32Array, FloatArray
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
        readouts: noise of spectrum 1/f along the samples of each tap: its variance (DN^2), the number of taps
            and of the part, shape (readout, 3).
        in_noise: variance of these offsets that the read noise of the run includes, DN^2.
    """

    removed: tuple[str, ...] = ()
    parts: BoolArray = field(default_factory=lambda: np.zeros((0, 0, 0), np.bool_))
    variances: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    left: tuple[str, ...] = ()
    waves: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    in_noise: float = 0.0
    readouts: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def stored(self) -> dict[str, str]:
        """Names of the arrays of offsets that are not all 0, each with its field of :class:`Offsets`."""
        lines = {"rows": self.variances[:, :2], "columns": self.variances[:, 2]}
        some = {**lines, "waves": self.waves, "readout": self.readouts}
        return {f"{name.removesuffix('s')}_offset": name for name, each in some.items() if each.any()}

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
        waves, readouts = [], []
        for effect, shared in found:
            if effect.tag in left or shared.variance is None:
                continue
            mask = np.ones(shape, np.bool_) if effect.region is None else effect.region.mask(shape)
            _, variances = parts.setdefault(mask.tobytes(), (mask, np.zeros(3)))
            place = float(list(parts).index(mask.tobytes()))
            if shared.of in _AXES:
                variances[_AXES.index(shared.of)] += shared.variance
            elif shared.variance > 0.0 and shared.of == "wave":
                waves.append([shared.cycles_per_row, shared.cycles_per_column, shared.variance, place])
            elif shared.variance > 0.0:
                readouts.append([shared.variance, float(min(shared.taps, shape[1])), place])
        return cls(
            tuple(removed),
            np.array([mask for mask, _ in parts.values()], np.bool_).reshape(-1, *shape),
            np.array([variances for _, variances in parts.values()]).reshape(-1, 3),
            tuple(left),
            np.array(waves).reshape(-1, 4),
            readouts=np.array(readouts).reshape(-1, 3),
        )

    @classmethod
    def of_overscan(cls, overscan: Overscan, frames: Iterable[FloatArray]) -> CommonModes:
        """Return those of whole frames and rows, as large as in frames; see `Overscan.variances_in`."""
        variances = np.array([[*overscan.variances_in(frames), 0.0]])
        parts = np.ones((1, *overscan.bias.shape), np.bool_)
        return cls(("frame_noise", "row_noise"), parts, variances, in_noise=overscan.shared_variance)


def _check(effect: Effect, shared: SharedOffset) -> None:
    """Refuse what an effect of another package may say: an unknown kind, or an impossible variance."""
    known = shared.of in (*_AXES, "wave", "readout") and shared.taps > 0
    if not known or (shared.variance is not None and not 0.0 <= shared.variance < np.inf):
        raise PchEmError(f"effect {effect.tag!r}: shared_offset() returned {shared}, which is not an offset")


@dataclass(frozen=True)
class Offsets:
    """What was found in some frames, for each part of the sensor.

    Attributes:
        rows: offset of each row, that of the frame included, DN, shape (frame, part, y).
        columns: offset of each column, DN, shape (frame, part, x).
        waves: c and s of each wave, DN, shape (frame, wave, 2).
        readout: noise along the readouts, DN, shape (frame, y, x); empty without any.
        left: variance of a sample's offset that stays unknown, DN^2, shape (frame, part).
    """

    rows: NDArray[np.floating[Any]]
    columns: NDArray[np.floating[Any]]
    waves: NDArray[np.floating[Any]] = field(default_factory=lambda: np.zeros((0, 0, 2)))
    readout: NDArray[np.floating[Any]] = field(default_factory=lambda: np.zeros((0, 0, 0)))
    left: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def of_samples(self, modes: CommonModes, rows: slice = slice(None)) -> Float32Array:
        """Return the offset of each sample of some rows, DN, shape (frame, y, x)."""
        design, n = _Design(modes), len(self.rows)
        waves = self.waves if len(self.waves) else np.zeros((n, 0, 2))
        readout = self.readout[:, rows] if self.readout.size else np.zeros(n)
        lines = (design.of_lines(self.rows[t], self.columns[t], waves[t], rows) for t in range(n))
        frames = [offset + own for offset, own in zip(lines, readout, strict=True)]
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

    Of each part there is one of the frame, one of each row, one of each column; of each wave two; of each
    readout one of each sample of its taps.
    """

    modes: CommonModes

    @cached_property
    def waves(self) -> list[tuple[int, FloatArray, FloatArray]]:
        """Part of each wave, and its cosine and sine down the rows, (y, 2), and along the columns, (x, 2)."""
        found, places = [], [np.arange(n) for n in self.modes.parts.shape[1:]]
        for *cycles, _, part in self.modes.waves:
            y, x = (np.exp(2j * np.pi * f * place) for f, place in zip(cycles, places, strict=True))
            down, along = (np.stack([turn.real, turn.imag], axis=1) for turn in (y, x))
            found.append((int(part), down, along))
        return found

    @cached_property
    def readouts(self) -> list[_Readout]:
        """Each readout."""
        parts = self.modes.parts
        return [
            _Readout(parts[int(part)], int(taps), variance) for variance, taps, part in self.modes.readouts
        ]

    @cached_property
    def _scales(self) -> FloatArray:
        """Standard deviation of each number of lines and waves, DN."""
        _, ny, nx = self.modes.parts.shape
        variances = np.repeat(self.modes.variances, (1, ny, nx), axis=1).ravel()
        return np.asarray(np.sqrt(np.concatenate([variances, np.repeat(self.modes.waves[:, 2], 2)])))

    def unpacked(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return offsets of rows with that of their frame, columns, waves (c and s) and readouts, DN."""
        n_parts, ny, nx = self.modes.parts.shape
        values, n = self._scales * z[: self._scales.size], n_parts * (1 + ny + nx)
        lines = values[:n].reshape(n_parts, -1)
        pairs = zip(self.readouts, self._of_readouts(z), strict=True)
        readout = sum(
            (each.offsets(own) for each, own in pairs), start=np.zeros((ny if self.readouts else 0, nx))
        )
        return lines[:, :1] + lines[:, 1 : 1 + ny], lines[:, 1 + ny :], values[n:].reshape(-1, 2), readout

    def _of_readouts(self, z: FloatArray) -> list[FloatArray]:
        """Return the numbers of each readout."""
        ends = self._scales.size + np.cumsum([0, *(each.size for each in self.readouts)])
        return [z[begin:end] for begin, end in itertools.pairwise(ends)]

    def offsets(self, z: FloatArray) -> FloatArray:
        """Return the offset of each sample of a frame, DN, shape (y, x)."""
        rows, columns, waves, readout = self.unpacked(z)
        return self.of_lines(rows, columns, waves) + (readout if readout.size else 0.0)

    def of_lines(
        self,
        rows: NDArray[np.floating[Any]],
        columns: NDArray[np.floating[Any]],
        waves: NDArray[np.floating[Any]],
        some: slice = slice(None),
    ) -> FloatArray:
        """Return what rows, columns and waves add to the samples of some rows of a frame, DN, (y, x)."""
        parts = self.modes.parts[:, some]
        found = np.zeros(parts.shape[1:])
        for mask, row, column in zip(parts, rows, columns, strict=True):
            found += mask * (row[some, None] + column)
        for (part, down, along), (c, s) in zip(self.waves, waves, strict=True):
            found += parts[part] * (down[some] @ np.array([[c, s], [s, -c]]) @ along.T)
        return found

    def sums(self, values: FloatArray) -> FloatArray:
        """Return the transpose of :meth:`offsets`, of values (y, x)."""
        parts = []
        for mask in self.modes.parts:
            some = mask * values
            rows = some.sum(axis=1)
            parts += [rows.sum(keepdims=True), rows, some.sum(axis=0)]
        for part, down, along in self.waves:
            (cc, cs), (sc, ss) = down.T @ (self.modes.parts[part] * values) @ along
            parts.append(np.array([cc - ss, sc + cs]))
        lines = np.concatenate([np.zeros(0), *parts]) * self._scales
        return np.concatenate([lines, *(each.sums(values) for each in self.readouts)])

    def top(self, form: FloatArray, near: FloatArray) -> FloatArray:
        """Return z of largest ``sum(form[0] o - form[1] o^2 / 2) - z^2 / 2``, by conjugate gradients."""
        from scipy.sparse.linalg import LinearOperator, cg

        size = near.size

        def near_inverse(z: FloatArray) -> FloatArray:
            pairs = zip(self.readouts, self._of_readouts(z), strict=True)
            return np.concatenate(
                [z[: self._scales.size], *(r.near_inverse(own, form[1]) for r, own in pairs)]
            )

        curvature, inverse = (
            LinearOperator((size, size), each, dtype=float)
            for each in (lambda z: z + self.sums(form[1] * self.offsets(z)), near_inverse)
        )
        return np.asarray(
            cg(curvature, self.sums(form[0]), x0=near, rtol=1e-6, M=inverse if self.readouts else None)[0]
        )

    def left(self, weight: FloatArray) -> FloatArray:
        """Return the variance of a sample's offset that stays unknown, on the median line, DN^2, (part,)."""
        parts, waves = self.modes.parts, self.modes.waves[:, 3].astype(np.int64)
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
        readouts = [each.left(weight) for each in self.readouts]
        of_readouts = np.bincount(self.modes.readouts[:, 2].astype(np.int64), readouts, len(parts))
        return np.asarray(sum(each) + np.bincount(waves, of_waves, len(parts)) + of_readouts)


@dataclass(frozen=True)
class _Readout:
    """Noise of spectrum 1/f along the samples of each tap as a linear function of standard normal numbers."""

    inside: BoolArray  # pixels of its part, (y, x)
    taps: int
    variance: float  # DN^2

    @property
    def width(self) -> int:
        """Columns of a tap."""
        return -(-int(self.inside.shape[1]) // self.taps)

    @property
    def size(self) -> int:
        """Numbers: one for each sample of its taps."""
        return self.taps * int(self.inside.shape[0]) * self.width

    @cached_property
    def amplitudes(self) -> FloatArray:
        """Factors at each frequency that make the noise of a tap from white noise, DN."""
        from pchem_pipeline.effects.operators.offsets import pink_amplitudes

        return np.asarray(pink_amplitudes(self.size // self.taps) * np.sqrt(self.variance))

    def _filtered(self, values: FloatArray, factors: FloatArray) -> FloatArray:
        """Return values, any shape, multiplied by factors at each frequency, shape (tap, sample)."""
        from scipy import fft  # loaded where it is needed only

        along = values.reshape(self.taps, -1)
        return np.asarray(fft.irfft(factors * fft.rfft(along), along.shape[1]))

    def offsets(self, z: FloatArray) -> FloatArray:
        """Return the noise of each pixel, DN, shape (y, x)."""
        ny, nx = self.inside.shape
        blocks = self._filtered(z, self.amplitudes).reshape(self.taps, ny, self.width)
        return np.asarray(blocks.transpose(1, 0, 2).reshape(ny, -1)[:, :nx] * self.inside)

    def sums(self, values: FloatArray) -> FloatArray:
        """Return the transpose of :meth:`offsets`, of values (y, x)."""
        ny, nx = self.inside.shape
        padded = np.pad(self.inside * values, ((0, 0), (0, self.taps * self.width - nx)))
        blocks = padded.reshape(ny, self.taps, self.width).transpose(1, 0, 2)
        return self._filtered(blocks, self.amplitudes).ravel()

    def near_inverse(self, z: FloatArray, weight: FloatArray) -> FloatArray:
        """Return the inverse of the curvature, as if all samples had the mean of the weights (y, x)."""
        return self._filtered(z, 1.0 / (1.0 + self.amplitudes**2 * (self.inside * weight).mean())).ravel()

    def left(self, weight: FloatArray) -> float:
        """Return the variance of the noise that stays unknown (Wiener 1949), DN^2, for weights (y, x).

        The mean of ``S / (1 + S w)`` over all frequencies, S the variance at each. Of weights that differ
        between samples the harmonic mean is taken for w: little of the noise is common to many of them.
        """
        known = weight[self.inside & (weight > 0.0)]
        share = known.size / max(int(self.inside.sum()), 1)
        each = share / (1.0 / known).mean() if known.size else 0.0
        variance = self.amplitudes**2
        # the first term of the inverse transform is the mean
        return float(np.fft.irfft(variance / (1.0 + variance * each), self.size // self.taps)[0])


def estimate_offsets(frames: CodeArray, reference: Reference, modes: CommonModes) -> Offsets:
    """Return the most probable offsets of whole frames (frame, y, x), DN: of rows, columns, waves, readouts.

    The posterior mode of normal offsets under the mixture of all pixels of the line (best linear prediction
    where the electron numbers are known): each pixel says of the offset what its electron number leaves open.
    """
    from pchem_pipeline.model.law.pcd import pcd_posterior  # loads compiled loops

    design, step, bias, sigma = _Design(modes), reference.step, reference.bias, reference.sigma
    known = np.ascontiguousarray(np.where(np.isfinite(sigma), reference.scene, np.nan))
    expansions = 4 if (known > 0.0).any() else 0  # without electrons the means tell all
    found = []
    for frame in frames:
        # means tell offsets beyond half an electron apart, electron numbers the rest
        weight = np.nan_to_num(1.0 / (known * step**2 + sigma**2))
        form = np.stack([weight * np.nan_to_num(frame - bias - known * step), weight])
        z = design.top(form, np.zeros_like(design.sums(weight)))
        for _ in range(expansions):  # in the offsets
            offset = design.offsets(z)
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
