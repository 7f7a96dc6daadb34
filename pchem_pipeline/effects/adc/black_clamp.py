"""Black-level clamp: the offset of every frame follows the mean of some of its pixels.

Cameras hold their black level by subtracting, frame by frame, what dark reference pixels or the frame itself
show (EMCCD baseline clamp, black-level clamp of CMOS sensors). The mean of few pixels has noise, and where
they collect charge it has their shot noise too: all pixels of the frame then move against them together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field, field_validator

from pchem_pipeline.effects.estimators.clamps import best_clamp
from pchem_pipeline.effects.framework.context import ALL_ROWS
from pchem_pipeline.effects.framework.effect import Count, Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.framework.region import Span
from pchem_pipeline.effects.types import AnyArray, EffectContext, Evidence, PixelMaps, SampleLaw


@register_effect
class BlackClamp(Effect):
    """A part of what the clamp's pixels deviate in a frame, in the mean, is taken from all of its pixels.

    Signature: frame means of the readout residual scatter, against the charge of the clamp's pixels: where
    those got more, the frame is lower. Noise of frames is as common to the pixels, but follows no charge.
    """

    tag: Literal["black_clamp"] = Field(default="black_clamp", description="name of the effect")
    plane = Plane.ADC
    title = "frame-dependent black-level clamp"
    source = "Andor iXon manual (baseline clamp); Janesick 2001 (optically black pixels)"
    signature = (
        "frame.covariance",
        "frame.readout.variance",
        "frame.charge.variance",
        "space.x.rk",
    )
    strength = "follow"
    reach_rows = ALL_ROWS  # the clamp may be anywhere
    may_be_at_bound = ("follow",)
    separate: ClassVar[Mapping[str, str]] = {
        "frame_noise": "clamp switched off: frame noise stays and is independent of charge",
        "exposure_flicker": "clamp switched off, or covered pixels: flicker is proportional to the light",
        "interpixel_capacitance": "distant pixels: a clamp couples the whole frame, capacitance neighbours",
    }
    follow: Ratio = Field(
        ge=0, le=1, description="share of the clamp's deviation that is subtracted, no unit; 1: all of it"
    )
    rows: Span | None = Field(default=None, description="rows of the clamp: first and last + 1; null: all")
    columns: Span | None = Field(
        default=None, description="columns of the clamp: first and last + 1; null: all"
    )
    pixels: Count | None = Field(
        default=None, ge=1, description="number of these pixels, for the read noise it adds; null: none"
    )

    #: clamps that take off a tenth of the mean of the frame, and of eight columns and rows
    typical_values = ({"follow": 0.1}, {"follow": 0.1, "columns": (0, 8)}, {"follow": 0.1, "rows": (0, 8)})

    @field_validator("rows", "columns")
    @classmethod
    def _some(cls, span: Span | None) -> Span | None:
        if span is not None and not 0 <= span[0] < span[1]:
            raise ValueError(f"black_clamp: {list(span)} holds no line; give [first, last + 1]")
        return span

    def to_window(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with what lies of its clamp in these rows and columns; without any it does nothing."""
        spans = [
            (max(first, low) - low, min(last, high) - low)
            for (first, last), (low, high) in zip(self._spans(shape), (rows, columns), strict=True)
        ]
        if any(first >= last for first, last in spans):
            return self.model_copy(update={"follow": 0.0, "rows": None, "columns": None})
        return self.model_copy(update={"rows": spans[0], "columns": spans[1]})

    def to_sensor(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with its rows and columns counted on the sensor."""
        size = (rows[1] - rows[0], columns[1] - columns[0])
        moved = [
            (first + low, last + low)
            for (first, last), (low, _) in zip(self._spans(size), (rows, columns), strict=True)
        ]
        kept = [None if span == (0, n) else span for span, n in zip(moved, shape, strict=True)]
        return self.model_copy(update={"rows": kept[0], "columns": kept[1]})

    def _spans(self, shape: tuple[int, int]) -> tuple[Span, Span]:
        return self.rows or (0, shape[0]), self.columns or (0, shape[1])

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal at the ADC (frame, y, x), DN, less what the clamp sees; draws nothing."""
        truth = context.truth
        usual = truth["bias"] + truth["quanta_exposure"] / truth["conversion_gain"]
        place = tuple(slice(*span) for span in self._spans(context.shape))
        if not usual[place].size:  # a sensor without these rows or columns
            return values.copy()
        deviation = (values[:, *place] - usual[place]).mean(axis=(1, 2), keepdims=True)
        return np.asarray(values - self.follow * deviation)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the rows, columns or the whole frame whose content the frames' offsets follow best."""
        found = best_clamp(evidence)
        if found is None:
            return ()
        return (cls(follow=found.follow, rows=found.rows, columns=found.columns, pixels=found.pixels),)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with the variance of the clamp's mean, its pixels taken to be like these."""
        if self.pixels is None:
            return model
        variance = maps.read_noise_dn**2 + maps.quanta_exposure / maps.conversion_gain**2
        mean = float(np.nanmean(variance)) if np.isfinite(variance).any() else 0.0
        return model.with_variance(dn2=self.follow**2 * mean / self.pixels)
