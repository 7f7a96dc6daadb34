"""The forward chain: exposure -> charge -> analog -> ADC -> readout.

Hendrickson et al., eq. PCD_RV_definition: ``X = round((K + R) / g + mu)``, ``K ~ Poisson(H)``,
``R ~ N(0, sigma_R^2)``. Rounding is to the nearest whole DN (halves to even), and what the ADC cannot express
ends at 0 or at 2**bit_depth - 1: that cut always happens, with or without effects.

A scene is what the sensor looks at: an exposure of all pixels, an image, or a sequence of images. The numbers
go plane by plane; an effect of no strength changes nothing, not even the last bit, and one with a
region nothing elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.base.errors import ConfigError, PchEmError, error_words
from pchem_pipeline.effects.framework.context import EffectContext
from pchem_pipeline.effects.framework.effect import Effect, Plane
from pchem_pipeline.simulate.streams import (
    KeyedStreams,
    make_key,
    normal_quantile,
    poisson_quantile,
    to_words,
    uniform_pair,
)
from pchem_pipeline.simulate.streams_numba import SampleKeys, draw_rows
from pchem_pipeline.simulate.truth import Defect, TruthMaps

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pchem_pipeline.simulate.settings import SimulateSettings

_BYTES_PER_SAMPLE = 8  # of a block: digital and electron numbers
_SAMPLES_AT_ONCE = 1 << 19
_FRAMES_AT_ONCE = 8
# as long as so many histories are the frames for which one is simulated
_REPEATED = 8
_MAPS = ("quanta_exposure", "conversion_gain", "bias", "analog_read_noise_e")


def dn_dtype(bit_depth: int) -> np.dtype[Any]:
    """Return the smallest unsigned type (8, 16 or 32 bits) that holds the ADC's range."""
    return np.dtype(np.uint8 if bit_depth <= 8 else np.uint16 if bit_depth <= 16 else np.uint32)


def frames_per_block(settings: SimulateSettings, n_rows: int, budget: int) -> int:
    """Return how many frames of a band of rows can be simulated at once within a budget of bytes."""
    return max(1, budget // (_BYTES_PER_SAMPLE * n_rows * settings.shape[1]))


def simulate_block(
    truth: TruthMaps,
    settings: SimulateSettings,
    frames: tuple[int, int],
    rows: tuple[int, int] | None = None,
    *,
    electron_frames: int | None = None,
) -> tuple[NDArray[Any], NDArray[np.uint32]]:
    """Simulate a block of frames of a band of rows; the same at every division into blocks and bands.

    Args:
        truth: maps of the whole sensor.
        settings: the section ``simulate``.
        frames: first frame and the frame after the last.
        rows: first row and the row after the last; ``None`` for all.
        electron_frames: first frames whose electron number is wanted; ``None`` for all.

    Returns:
        Digital numbers (frame, y, x), DN, unsigned; true electron numbers (frame, y, x), e-.

    Raises:
        ConfigError: if the truth is not of the sensor's shape.
        PchEmError: if an effect fails or returns something impossible; names it.
    """
    if truth.shape != settings.shape:
        raise ConfigError(
            f"truth has shape {truth.shape}, simulate.shape is {settings.shape}; make them equal"
        )
    rows = rows or (0, settings.shape[0])
    halo = sum(effect.halo() for effect in settings.effects)
    history = sum(effect.history() for effect in settings.effects)
    size = (frames[1] - frames[0], rows[1] - rows[0], settings.shape[1])
    dn, electrons = np.empty(size, dn_dtype(settings.bit_depth)), np.empty(size, np.uint32)
    # few rows at once: planes stay in the cache, and what a pixel has of its own serves many frames
    at_once = _SAMPLES_AT_ONCE // ((_REPEATED + 1) * max(history, _FRAMES_AT_ONCE) * settings.shape[1])
    n_rows = max(at_once, _REPEATED // 2 * halo, 1)
    for begin in range(rows[0], rows[1], n_rows):
        end = min(begin + n_rows, rows[1])
        first, last = max(0, begin - halo), min(settings.shape[0], end + halo)
        band = truth.band(first, last)
        inside = slice(begin - rows[0], end - rows[0])
        keep = (slice(history, None), slice(begin - first, end - first))
        # planes that stay in the cache are three times as fast; history must not be repeated too often
        step = max(1, _SAMPLES_AT_ONCE // (band.shape[0] * band.shape[1]), _REPEATED * history)
        for start in range(frames[0], frames[1], step):
            numbers = np.arange(start - history, min(start + step, frames[1]))
            part = slice(start - frames[0], start - frames[0] + step), inside
            dn_part, charge = _Block(settings, band, numbers, np.arange(first, last)).run()
            dn[part], electrons[part] = dn_part[keep], charge[keep]
    return dn, electrons[:electron_frames]


@dataclass(frozen=True)
class _Block:
    """A block with its halo and history, on its way through the planes."""

    settings: SimulateSettings
    truth: TruthMaps
    frames: IntArray
    rows: IntArray

    def run(self) -> tuple[NDArray[Any], IntArray]:
        """Return digital numbers and electron numbers of the block."""
        settings, truth = self.settings, self.truth
        context = EffectContext(
            frames=_frozen(self.frames),
            n_frames=settings.n_frames,
            rows=_frozen(self.rows),
            shape=settings.shape,
            integration_time=settings.integration_time,
            bit_depth=settings.bit_depth,
            truth={name: _frozen(getattr(truth, name)) for name in _MAPS},
            random=self._streams("effect"),
        )
        exposure, charge, noise = self._samples(context)
        context = replace(context, exposure=_frozen(exposure))
        charge = self._apply(Plane.CHARGE, charge, context)
        context = replace(context, charge=_frozen(charge), read_noise=_frozen(noise))
        analog = self._apply(Plane.ANALOG, charge + noise, context)
        at_adc = self._apply(Plane.ADC, analog / truth.conversion_gain + truth.bias, context)
        top = 2**settings.bit_depth - 1
        dn = np.clip(np.rint(at_adc), 0, top).astype(dn_dtype(settings.bit_depth))
        dn = self._apply(Plane.READOUT, dn, context)
        if dn.size and int(dn.max()) > top:
            raise PchEmError(
                f"an effect on the readout returned {dn.max()} DN, above the ADC's {top}; correct it"
            )
        return dn, charge

    def _samples(self, context: EffectContext) -> tuple[FloatArray, IntArray, FloatArray]:
        """Return exposure, electron number and read noise (frame, y, x), e-."""
        read_noise, columns = self.truth.analog_read_noise_e, np.arange(self.settings.shape[1])
        words = to_words(self.frames), to_words(self.rows), to_words(columns)
        key = make_key(self.settings.seed, "sample")
        shape = tuple(axis.size for axis in words)
        exposure = np.broadcast_to(self.truth.quanta_exposure, shape)
        if _of_plane(self.settings.effects, Plane.EXPOSURE):
            u, v = uniform_pair(key, *words)
            exposure = self._apply(Plane.EXPOSURE, np.array(exposure), context)
            return exposure, poisson_quantile(u, exposure), read_noise * normal_quantile(v)
        # the same numbers, sooner: each pixel's table of electron numbers serves all frames
        charge, noise = np.empty(shape, np.int64), np.empty(shape)
        draw_rows(self.truth.quanta_exposure, read_noise, SampleKeys(*words, key), charge, noise)
        return exposure, charge, noise

    def _streams(self, purpose: str) -> KeyedStreams:
        columns = np.arange(self.settings.shape[1])
        return KeyedStreams(self.settings.seed, purpose, self.frames, self.rows, columns)

    def _apply(self, plane: Plane, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        for position, effect in _of_plane(self.settings.effects, plane):
            inside = _inside(effect, context)
            if not inside.any():
                continue
            random = self._streams(f"effect/{effect.tag}/{position}")
            changed = _checked(effect, plane, values, replace(context, random=random))
            values = changed if inside.all() else np.where(inside, changed, values)
        return values


def _of_plane(effects: Sequence[Effect], plane: Plane) -> list[tuple[int, Effect]]:
    """Return the effects of a plane, each with how many of its tag come before it in the whole list."""
    tags = [effect.tag for effect in effects]
    return [(tags[:i].count(effect.tag), effect) for i, effect in enumerate(effects) if effect.plane is plane]


def _inside(effect: Effect, context: EffectContext) -> BoolArray:
    """Return the samples on which an effect acts, an array that broadcasts against (frame, y, x)."""
    inside = np.ones((1, 1, 1), np.bool_)
    if effect.when is not None:
        inside = effect.when.frames(context.frames)[:, None, None]
    if effect.region is not None:
        inside = inside & effect.region.mask(context.shape, context.rows)
    return inside


def _checked(effect: Effect, plane: Plane, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
    name = f"effect {effect.tag!r} ({type(effect).__module__})"
    try:
        result: Any = effect.apply(_frozen(values), context)
    except Exception as error:
        raise PchEmError(f"{name} failed: {error_words(error)}; correct it or leave it out") from error
    if not isinstance(result, np.ndarray) or result.shape != values.shape or result.dtype != values.dtype:
        got = f"{result.dtype}{result.shape}" if isinstance(result, np.ndarray) else type(result).__name__
        raise PchEmError(f"{name} returned {got} instead of {values.dtype}{values.shape}; correct it")
    if result.dtype.kind == "f" and not np.isfinite(result).all():
        raise PchEmError(f"{name} returned NaN or infinity; correct its parameters")
    if plane in (Plane.EXPOSURE, Plane.CHARGE) and result.size and result.min() < 0:
        raise PchEmError(f"{name} returned a negative number of electrons; correct its parameters")
    return result


def _frozen(values: NDArray[Any]) -> NDArray[Any]:
    view = values.view()
    view.flags.writeable = False
    return view


class _Sequence(Effect):
    """Frame n sees image n; after the last one the sequence begins anew. For pixels that see anything."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True)

    tag: Literal["scene"] = "scene"
    plane: ClassVar[Plane] = Plane.EXPOSURE
    images: FloatArray

    def apply(self, values: NDArray[Any], context: EffectContext) -> NDArray[Any]:
        """Return the exposure (frame, y, x), e-."""
        seen = self.images[context.frames % len(self.images)][:, context.rows]
        return np.where(context.truth["quanta_exposure"] > 0.0, seen, 0.0)


def with_scene(
    truth: TruthMaps, settings: SimulateSettings, scene: float | FloatArray
) -> tuple[TruthMaps, SimulateSettings]:
    """Return the sensor and its settings when it looks at a scene.

    A number, an image (y, x), or a sequence (image, y, x), e- per frame: all of the exposure, the dark one
    included. Dead and stuck pixels see nothing.

    Raises:
        ConfigError: its shape is not the sensor's, or a value is impossible.
    """
    values = np.asarray(scene, np.float64)
    if values.ndim not in (0, 2, 3) or (values.ndim and values.shape[-2:] != truth.shape):
        raise ConfigError(
            f"scene of shape {values.shape}, but the sensor has {truth.shape}; give a number, an image of "
            "that shape, or a sequence of such images"
        )
    if not (np.isfinite(values) & (values >= 0.0)).all():
        raise ConfigError("scene: negative exposure; give 0 or more e- in each pixel")
    sees = (truth.defect != Defect.DEAD) & (truth.defect != Defect.STUCK)
    if values.ndim < 3:
        return replace(truth, quanta_exposure=np.where(sees, values, 0.0)), settings
    mean = np.maximum(values.mean(axis=0), np.finfo(np.float64).tiny)
    effects = (_Sequence(images=values), *settings.effects)
    return (
        replace(truth, quanta_exposure=np.where(sees, mean, 0.0)),
        settings.model_copy(update={"effects": effects}),
    )
