"""Glow: light or charge at one place of the sensor, in bursts or growing along the run.

Output amplifiers, and circuits beside the array, emit near-infrared light that the pixels around them collect
(amplifier glow of CCDs, circuit glow of CMOS and infrared sensors); a light leak does the same. What is
constant is part of the pixels' exposure and in their maps; what bursts now and then, or grows while the
electronics warm up, is not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pchem_pipeline.effects.estimators.charge_sums import block_charge, exposure_nodes
from pchem_pipeline.effects.estimators.common_modes import run_position
from pchem_pipeline.effects.estimators.fading_images import FadingCells
from pchem_pipeline.effects.estimators.spots import Spot, best_bursts, best_spot
from pchem_pipeline.effects.framework.added_exposure import AddedExposure
from pchem_pipeline.effects.framework.effect import (
    FEWEST_SHOWN,
    Effect,
    Electrons,
    Plane,
    Ratio,
    register_effect,
)
from pchem_pipeline.effects.framework.region import Span
from pchem_pipeline.effects.framework.spot import Falloff, spot_image, spot_to_sensor, spot_to_window
from pchem_pipeline.effects.types import AnyArray, EffectContext, Evidence, FloatArray, IntArray, PixelMaps

_GRID = 16  # cells along either side of the map of what grows
_STRAIGHT = 50.0  # runs: a time constant so long is a straight line
_LEAST_GROWTH = 20.0  # chi2 that the best of some 1,000 spots must explain


@register_effect
class Glow(Effect):
    """A spot of additional exposure that is there in a share of the frames, or grows along the run.

    Signature: means of the electron number of the rows and columns around one place rise, in single frames or
    along the run, not in proportion to H; nothing in the readout residual.
    """

    tag: Literal["glow"] = Field(default="glow", description="name of the effect")
    plane = Plane.EXPOSURE
    title = "local glow or light leak"
    source = "Janesick 2001, Scientific Charge-Coupled Devices (amplifier luminescence)"
    signature = (
        "space.row.charge.lag1",
        "space.column.charge.lag1",
        "space.row.charge.variance",
        "space.column.charge.variance",
        "frame.charge.quadrants",
        "space.x.kk",
        "time.block.charge.chi",
    )
    strength = "peak_e"
    may_be_at_bound = ("centre_y", "centre_x")
    separate: ClassVar[Mapping[str, str]] = {
        "exposure_flicker": "a map of the bright frames: flicker is proportional to H, a glow local",
        "exposure_drift": "a map of the change along the run: a drift is proportional to H, a glow local",
        "persistence": "a run after a longer time in the dark: persistence is gone, a glow grows again",
        "cosmic_rays": "longer runs: a glow is always at the same place",
        "optical_crosstalk": "dark frames without the source of the glow: crosstalk remains",
    }
    peak_e: Electrons = Field(
        ge=0, le=1e6, description="largest additional exposure of the brightest pixel, e-"
    )
    burst_share: Ratio | None = Field(
        default=None, gt=0, le=1, description="share of the frames with a burst; null: it grows along the run"
    )
    centre_y: Ratio = Field(
        default=0.0, ge=0, le=1, description="row of the centre over the number of rows, no unit"
    )
    centre_x: Ratio = Field(
        default=0.0, ge=0, le=1, description="column of the centre over the number of columns, no unit"
    )
    radius: Ratio = Field(
        default=0.2, gt=0, description="radius of the spot over the longer side of the sensor, no unit"
    )
    falloff: Falloff = Field(
        default="exponential",
        description="exponential: to 1/e within the radius; gaussian: of that standard deviation",
    )

    #: a corner that bursts in one frame of fifty, by 1 e-, and one that grows by 0.3 e-
    typical_values = ({"peak_e": 1.0, "burst_share": 0.02}, {"peak_e": 0.3})

    def to_window(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with its centre counted from these rows and columns, and the size that it has there."""
        return self.model_copy(update=spot_to_window(vars(self), self.falloff, rows, columns, shape))

    def to_sensor(self, rows: Span, columns: Span, shape: tuple[int, int]) -> Self:
        """Return it with its centre counted on the sensor."""
        return self.model_copy(update=spot_to_sensor(vars(self), rows, columns, shape))

    def pattern(self, rows: IntArray, shape: tuple[int, ...]) -> FloatArray:
        """Return the spot in some rows relative to its brightest pixel, shape (rows, columns)."""
        centre = (self.centre_y, self.centre_x)
        return spot_image(rows, np.arange(shape[1]), shape, centre, self.radius, self.falloff)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the exposure with the glow (frame, y, x), e-."""
        if self.burst_share is None:
            size = run_position(context.frames, context.n_frames)
        else:
            size = (context.random.uniform(("frame",))[:, 0, 0] < self.burst_share).astype(np.float64)
        result: AnyArray = values.copy()
        bright = size > 0
        pattern = self.peak_e * self.pattern(context.rows, context.shape)
        result[bright] += size[bright, None, None] * pattern
        return result

    def added_exposure(
        self, frames: NDArray[np.unsignedinteger], numbers: IntArray, maps: PixelMaps
    ) -> AddedExposure | None:
        """Return the glow's levels: with and without a burst, or three of its growth."""
        if self.peak_e == 0:
            return None
        if self.burst_share is None:
            # a straight line from 0 to 1 has the mean 1/2
            weights, factors = exposure_nodes((np.arange(400) + 0.5) / 200.0)
            sizes = 0.5 * factors
        else:
            weights, sizes = np.array([1.0 - self.burst_share, self.burst_share]), np.array([0.0, 1.0])
        image = self.peak_e * self.pattern(np.arange(maps.usable.shape[0]), maps.usable.shape)
        return AddedExposure(
            sizes[:, None, None] * image,
            np.broadcast_to(weights[:, None, None], (sizes.size, *image.shape)),
        )

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return a spot that bursts, from rows and columns, and one that grows, from block means."""
        bursts = best_bursts(evidence)
        found = [] if bursts is None else [cls._of(bursts.spot, burst_share=bursts.share)]
        growing = _growing(evidence)
        return [*found, *([] if growing is None else [cls._of(growing)])]

    @classmethod
    def _of(cls, spot: Spot, burst_share: float | None = None) -> Self:
        return cls.model_validate(
            {"peak_e": spot.peak, "falloff": spot.falloff, "burst_share": burst_share, **spot.place}
        )

    def representative(self, frames: IntArray) -> tuple[Self, float]:
        """Return rare bursts more often than they are, and how much rarer they are."""
        return self._shown_at_least("burst_share", FEWEST_SHOWN / max(frames.size, 1), 1.0)


def _growing(evidence: Evidence) -> Spot | None:
    """Return the spot whose exposure rises along a straight line over the run."""
    blocks = block_charge(evidence)
    if blocks is None or evidence.time is None:
        return None
    exposure = evidence.maps.quanta_exposure
    cells = FadingCells.of(blocks, exposure, _STRAIGHT * evidence.time.n_run, _GRID)
    rise = 1.0 / _STRAIGHT
    falloffs: tuple[Falloff, ...] = ("gaussian", "exponential")
    spot = best_spot(-rise * cells.amplitude, rise * cells.noise, cells.exposure, exposure.shape, falloffs)
    return spot if spot is not None and spot.worth > _LEAST_GROWTH else None
