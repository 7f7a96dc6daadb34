"""A simulated camera with the parameters that a characterisation found."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, CodeArray, FloatArray, IndexArray
from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.errors.expected_information import covariance_from
from pchem_pipeline.simulate.chain import frames_per_block, simulate_block, with_scene
from pchem_pipeline.simulate.settings import SimulateSettings
from pchem_pipeline.simulate.truth import Defect, TruthMaps

_LEAST_GAIN, _LEAST_NOISE_DN, _LEAST_EXPOSURE = 1e-6, 1e-3, 1e-6
#: Side of the blocks of pixels that a larger sensor is made of: correlations of neighbours stay within them.
_BLOCK = 16


@dataclass(frozen=True)
class Twin:
    """A camera as it was measured.

    Attributes:
        truth: maps of its pixels.
        settings: effects, ADC, integration time; the section ``simulate`` of a YAML.
    """

    truth: TruthMaps
    settings: SimulateSettings

    def __repr__(self) -> str:
        rows, columns = self.truth.quanta_exposure.shape
        effects = ", ".join(effect.tag for effect in self.settings.effects) or "none"
        return f"<Twin: {rows} x {columns} pixels; effects: {effects}; frames(scene, n) simulates>"

    def frames(self, scene: float | FloatArray | None = None, n: int = 100, *, seed: int = 1) -> CodeArray:
        """Return n frames of a scene.

        Args:
            scene: exposure, e- per frame: a number, an image (y, x), or a sequence (image, y, x) that is
                repeated; None: what the characterisation saw.
            n: number of frames.
            seed: another one gives other frames of the same camera.

        Returns:
            DN, shape (n, y, x).

        Raises:
            ConfigError: the scene does not fit the sensor, or is no exposure.
        """
        if n < 1:
            raise ConfigError(f"{n} frames: give 1 or more")
        settings = self.settings.model_copy(update={"n_frames": n, "seed": seed})
        truth = self.truth
        if scene is not None:
            truth, settings = with_scene(truth, settings, scene)
        step = frames_per_block(settings, truth.shape[0], 256 << 20)
        blocks = [
            simulate_block(truth, settings, (t, min(t + step, n)), electron_frames=0)[0]
            for t in range(0, n, step)
        ]
        return np.concatenate(blocks)


def twin_maps(maps: tuple[FloatArray, ...], usable: BoolArray, level: NDArray[Any]) -> TruthMaps:
    """Return the maps of a simulated sensor from (H, g, mu, sigma) of a fit, (y, x) each.

    Pixels without a fit, those not ``usable``, have no parameters that could be simulated: they always give
    their usual DN, ``level``.
    """
    exposure, gain, bias, sigma = (np.where(usable, values, 0.0) for values in maps)
    typical = float(np.median(gain[usable])) if usable.any() else 1.0
    gain = np.where(usable, gain, typical)
    analog = gain * np.sqrt(np.maximum(sigma**2 - QUANTISATION_VARIANCE, 0.0))
    return TruthMaps(
        exposure,
        gain,
        np.where(usable, bias, level),
        np.where(usable, analog, 0.0),
        np.where(usable, Defect.NONE, Defect.STUCK).astype(np.uint8),
    )


def redrawn(
    maps: tuple[FloatArray, ...], stderr: FloatArray, correlation: FloatArray, seed: int
) -> tuple[FloatArray, ...]:
    """Return maps that are as likely as those of the fit: drawn within their errors.

    Maps are (H, g, mu, sigma), (y, x) each, with standard errors (4, y, x) and correlations as in
    :func:`~pchem_pipeline.use.calibration.covariance_of`.
    """
    matrix = covariance_from(np.ones((*stderr.shape[1:], 4)), np.nan_to_num(correlation))
    values, vectors = np.linalg.eigh(matrix)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    normal = np.random.default_rng(seed).standard_normal((*stderr.shape[1:], 4))
    moves = np.moveaxis(np.einsum("yxij,yxj->yxi", root, normal), -1, 0) * np.nan_to_num(stderr)
    exposure, gain, bias, sigma = (each + move for each, move in zip(maps, moves, strict=True))
    return (
        np.maximum(exposure, 0.0),
        np.maximum(gain, _LEAST_GAIN),
        bias,
        np.maximum(sigma, np.sqrt(QUANTISATION_VARIANCE)),
    )


def extrapolated(truth: TruthMaps, shape: tuple[int, int], seed: int) -> TruthMaps:
    """Return a sensor of another size with the distributions and correlations of this one.

    Each map is taken apart into patterns of its rows and of its columns, and what is left. Lines of the new
    sensor draw theirs from the old ones; what is left comes in blocks of neighbouring pixels, all maps from
    the same place (block bootstrap: Kuensch 1989, Ann. Statist. 17, 1217), so that the parameters of a pixel
    and its neighbours belong together as they did. Exposure, gain and read noise multiply, the bias adds.
    """
    rng = np.random.default_rng(seed)
    rows, columns = (rng.integers(old, size=new) for old, new in zip(truth.shape, shape, strict=True))
    y, x = _blocks(truth.shape, shape, rng)
    defect = truth.defect[y, x]
    special = truth.defect != Defect.NONE
    made = {}
    for name, floor in (
        ("quanta_exposure", _LEAST_EXPOSURE),
        ("conversion_gain", _LEAST_GAIN),
        ("bias", None),
        ("analog_read_noise_e", _LEAST_NOISE_DN),
    ):
        values = getattr(truth, name)
        level = values if floor is None else np.log(np.maximum(values, floor))
        centre, of_rows, of_columns, rest = _patterns(np.where(special, np.nan, level))
        whole = centre + of_rows[rows][:, None] + of_columns[columns][None] + np.nan_to_num(rest)[y, x]
        found = whole if floor is None else np.exp(whole)
        made[name] = np.where(defect == Defect.NONE, found, values[y, x])
    return replace(truth, **made, defect=defect)


def _patterns(values: FloatArray) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """Return centre, pattern of the rows, of the columns, and the rest, whose variances add to the whole."""
    centre = float(np.nanmean(values))
    of_rows = np.nan_to_num(np.nanmean(values, axis=1) - centre)
    of_columns = np.nan_to_num(np.nanmean(values, axis=0) - centre)
    rest = values - centre - of_rows[:, None] - of_columns[None]
    own = float(np.nanvar(rest))
    # a mean of a line scatters by its pixels, too: that part stays with the rest
    of_rows, of_columns = (
        pattern * np.sqrt(max(0.0, 1.0 - own / length / max(float(pattern.var()), 1e-300)))
        for pattern, length in ((of_rows, values.shape[1]), (of_columns, values.shape[0]))
    )
    return centre, of_rows, of_columns, values - centre - of_rows[:, None] - of_columns[None]


def _blocks(
    old: tuple[int, int], new: tuple[int, int], rng: np.random.Generator
) -> tuple[IndexArray, IndexArray]:
    """Return from which pixel each new one takes what is left of its maps: blocks from random places."""
    y, x = np.empty(new, np.intp), np.empty(new, np.intp)
    height, width = (min(_BLOCK, side) for side in old)
    for top in range(0, new[0], height):
        for left in range(0, new[1], width):
            rows = np.arange(min(height, new[0] - top)) + rng.integers(old[0] - height + 1)
            columns = np.arange(min(width, new[1] - left)) + rng.integers(old[1] - width + 1)
            part = (slice(top, top + rows.size), slice(left, left + columns.size))
            y[part], x[part] = rows[:, None], columns[None]
    return y, x
