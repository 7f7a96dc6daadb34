"""Noise that the pixels of a frame, row or column share: one random offset for all, new in every frame.

A reference, ramp or supply that is sampled once for many pixels shifts them all: ``x += n_t`` with
``n_t ~ N(0, s^2)``, in DN since the disturbance sits behind the pixels' gains. A pixel's own histogram only
broadens: its read noise becomes ``(sigma^2 + s^2)^(1/2)`` DN. Offsets that do not change from frame to frame
are part of the bias map and not this effect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.estimators.common_modes import (
    line_excess,
    mean_variance,
    responsivity,
    successive,
)
from pchem_pipeline.effects.families.offsets import OffsetEffect
from pchem_pipeline.effects.framework.context import DIMS
from pchem_pipeline.effects.framework.effect import Dn, SharedOffset, register_effect
from pchem_pipeline.effects.types import EffectContext, Evidence, FloatArray, TimeSeries
from pchem_pipeline.model.arithmetic.significance import POSSIBLE


class SharedNoise(OffsetEffect):
    """Base of noise that the pixels of a frame, row or column share: an offset that is new in every frame.

    The strength is its standard deviation.

    Attributes:
        shared_by: what has one offset.
    """

    power = 2.0
    shared_by: ClassVar[Literal["frame", "row", "column"]]

    def offsets(self, context: EffectContext) -> FloatArray:
        """Return one offset for each frame, or for each row or column of a frame, DN."""
        return np.asarray(getattr(self, self.strength) * context.random.normal(DIMS[self.shared_by]))

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the excess variance of the means of rows (columns) within their frames (moment estimate)."""
        if evidence.time is None:
            return ()
        rows = cls.shared_by == "row"
        means = evidence.time.row_readout if rows else evidence.time.column_readout
        excess, error = line_excess(means, mean_variance(evidence, axis=1 if rows else 0))
        if excess < POSSIBLE * error:
            return ()
        return (cls.model_validate({cls.strength: excess**0.5 / responsivity(evidence)}),)

    def shared_offset(self) -> SharedOffset:
        """Return its offset."""
        return SharedOffset(self.shared_by, getattr(self, self.strength) ** 2)


@register_effect
class RowNoise(SharedNoise):
    """Random offset per row and frame: noise of a ramp, reference or supply while a row is read.

    A common design rule keeps it below a tenth of the read noise, because the eye finds stripes long before
    the pixel statistics do.

    Signature: the variance of the row means of the readout residual exceeds that of ``n_x`` independent
    pixels by ``row_noise_dn^2``; neighbours along x are correlated.
    """

    tag: Literal["row_noise"] = Field(default="row_noise", description="name of the effect")
    title = "row noise (row temporal noise)"
    source = "Gow et al. 2007, IEEE Trans. Electron Devices 54, 1321"
    signature = ("space.row.readout.variance", "space.x.rr")
    strength = "row_noise_dn"
    shared_by = "row"
    separate: ClassVar[Mapping[str, str]] = {
        "read_order_noise": "distant pixels of a row: 1/f noise correlates them less than neighbours",
        "periodic_pickup": "spectrum of the row means within a frame: pickup is a line, row noise is flat",
        "interpixel_capacitance": "distant pixels of a row: row noise correlates them like neighbours",
        "frame_noise": "row means within a frame: frame noise is common to all",
    }
    row_noise_dn: Dn = Field(ge=0, le=1e6, description="standard deviation of the rows' offsets, DN")

    #: at 0.35 DN
    typical_values = ({"row_noise_dn": 0.35},)


@register_effect
class ColumnNoise(SharedNoise):
    """Random offset per column and frame: what a column's reference or sampling capacitor picks up once.

    For sensors with one amplifier and ADC per column.

    Signature: the variance of the column means of the readout residual exceeds that of ``n_y`` independent
    pixels by ``column_noise_dn^2``; neighbours along y are correlated.
    """

    tag: Literal["column_noise"] = Field(default="column_noise", description="name of the effect")
    title = "column noise (column temporal noise)"
    source = "Gow et al. 2007, IEEE Trans. Electron Devices 54, 1321"
    signature = ("space.column.readout.variance", "space.y.rr")
    strength = "column_noise_dn"
    shared_by = "column"
    separate: ClassVar[Mapping[str, str]] = {
        "interpixel_capacitance": "distant pixels of a column: column noise correlates them like neighbours",
        "frame_noise": "column means within a frame: frame noise is common to all",
        "row_noise": "row and column means within a frame: only column means scatter",
    }
    column_noise_dn: Dn = Field(ge=0, le=1e6, description="standard deviation of the columns' offsets, DN")

    #: at 0.32 DN
    typical_values = ({"column_noise_dn": 0.32},)


@register_effect
class FrameNoise(SharedNoise):
    """Random offset per frame: noise of a reference that is sampled once per frame.

    It is what remains of pedestal noise after a correction by rows, and why overscan or optically black
    pixels are subtracted frame by frame (Janesick 2001, Scientific Charge-Coupled Devices; Rauscher 2015,
    PASP 127, 1144 draws such pedestals).

    Signature: frame means of the readout residual scatter more than ``n`` independent pixels do, by
    ``frame_noise_dn^2``, white from frame to frame; those of the charge do not.
    """

    tag: Literal["frame_noise"] = Field(default="frame_noise", description="name of the effect")
    title = "frame noise (frame-to-frame offset noise)"
    source = "Janesick 2001, Scientific Charge-Coupled Devices; Rauscher 2015, PASP 127, 1144"
    signature = (
        "frame.readout.variance",
        "frame.readout.largest",
        "space.x.rr",
        "space.y.rr",
    )
    strength = "frame_noise_dn"
    shared_by = "frame"
    separate: ClassVar[Mapping[str, str]] = {
        "black_clamp": "clamp switched off: frame noise stays, offsets of the clamp vanish",
        "exposure_flicker": "frames without light, or at short exposure: flicker vanishes",
        "periodic_pickup": "spectrum of the frame means of a longer run: pickup is a line, noise is flat",
        "bias_drift": "a longer run: a drift grows with time, noise does not",
    }
    frame_noise_dn: Dn = Field(ge=0, le=1e6, description="standard deviation of the frames' offsets, DN")

    #: at 0.12 DN
    typical_values = ({"frame_noise_dn": 0.12},)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the excess variance of successive frames, so that a slow drift does not count.

        Half the mean squared difference of successive frame means, even and odd frames centred apart, less
        what the noise of pixels, rows and columns gives.
        """
        if evidence.time is None:
            return ()
        expected = _expected(evidence, evidence.time)
        steps = _steps(evidence.time)
        if steps.size < 8 or not expected > 0:
            return ()
        excess = float((steps**2).mean() / 2.0 - expected)
        # successive differences share a frame: their squares are correlated by 1/4
        error = expected * np.sqrt(3.0 / steps.size)
        if excess < POSSIBLE * error:
            return ()
        return (cls(frame_noise_dn=float(np.sqrt(excess)) / responsivity(evidence)),)


def _expected(evidence: Evidence, time: TimeSeries) -> float:
    """Return the variance, DN^2, that pixels, rows and columns by themselves give to frame means."""
    expected = float(mean_variance(evidence))
    for means, axis in ((time.row_readout, 1), (time.column_readout, 0)):
        excess, error = line_excess(means, mean_variance(evidence, axis))
        if excess > POSSIBLE * error:
            expected += excess / means.shape[1]
    return expected


def _steps(time: TimeSeries) -> FloatArray:
    """Return differences of the frame means of successive frames, DN, without even-odd contrast."""
    means = time.frame_readout.astype(np.float64).copy()
    for parity in (0, 1):
        chosen = time.frames % 2 == parity
        if chosen.any():
            means[chosen] -= means[chosen].mean()
    return np.asarray(np.diff(means)[successive(time.frames)], np.float64)
