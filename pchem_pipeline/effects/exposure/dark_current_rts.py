"""Dark current that blinks: metastable defects switch a pixel's dark current between two levels.

Random telegraph signals of the dark current are found in few pixels of new sensors and in many irradiated
ones, with jumps that are exponentially distributed over the pixels (Hopkins and Hopkinson 1993; Goiffon et
al. 2009; Virmontois et al. 2013). The state is a Markov chain with exponential dwell times.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pchem_pipeline.effects.framework.added_exposure import AddedExposure
from pchem_pipeline.effects.framework.effect import Effect, Electrons, Frames, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import (
    AnyArray,
    EffectContext,
    FloatArray,
    IntArray,
    PixelMaps,
)

# share of the pixels beyond which what seems to blink is something else
_FEW_PIXELS = 0.3


@register_effect
class DarkCurrentRts(Effect):
    """Two levels of the exposure, H and H + step, in a fraction of the pixels.

    Signature: block means of the electron number wander in few pixels, strongly, and successive electron
    numbers are alike there; nothing in the readout residual, nothing in the other pixels.
    """

    tag: Literal["dark_current_rts"] = Field(default="dark_current_rts", description="name of the effect")
    plane = Plane.EXPOSURE
    title = "random telegraph signal of the dark current"
    source = (
        "Hopkins and Hopkinson 1993, IEEE Trans. Nucl. Sci. 40, 1567; Goiffon et al. 2009, ibid. 56, 2132"
    )
    signature = (
        "time.block.charge.cnt",
        "time.lag1.charge.cnt",
        "time.block.charge.chi",
        "shape.C2.cnt",
    )
    strength = "fraction"
    resample_pixels = True
    separate: ClassVar[Mapping[str, str]] = {
        "rts_noise": "several exposure times: jumps of the dark current grow with it",
        "flicker_noise": "dark current jumps in the electron numbers, 1/f noise in the readout residuals",
        "persistence": "a longer run: persistence fades once in regions, single pixels blink repeatedly",
        "overdispersed_counts": "slower and longer runs: blinking is correlated in time",
    }
    fraction: Ratio = Field(ge=0, le=1, description="fraction of the pixels that blink, no unit")
    step_e: Electrons = Field(
        default=1.0,
        ge=0,
        le=1e6,
        description="additional exposure of the upper level, mean over these pixels, e-",
    )
    steps: Literal["equal", "exponential"] = Field(
        default="equal", description="equal: step_e in each of these pixels; exponential: distributed so"
    )
    dwell_low_frames: Frames = Field(
        default=200.0, ge=0.5, description="mean time in the lower level, frames"
    )
    dwell_high_frames: Frames = Field(
        default=200.0, ge=0.5, description="mean time in the upper level, frames"
    )

    #: in 1.1 % of the pixels, slow and fast, and with steps that differ
    typical_values = (
        {"fraction": 0.011},
        {"fraction": 0.011, "dwell_low_frames": 20.0, "dwell_high_frames": 20.0},
        {"fraction": 0.011, "steps": "exponential"},
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the blinking exposure (frame, y, x), e-; touches the pixels that blink only."""
        result = values.copy()
        u = context.random.uniform(("y", "x"))[0]
        blinks = u < self.fraction
        for row in np.flatnonzero(blinks.any(axis=1)):
            # pixels that blink at a small fraction come first, so that they keep their numbers at a larger
            # one
            columns = np.flatnonzero(blinks[row])
            columns = columns[np.argsort(u[row, columns])]
            random = context.random.generator(y=int(context.rows[row]))
            for column in columns:
                result[:, row, column] += self._added(context, random)
        return result

    def _added(self, context: EffectContext, random: np.random.Generator) -> FloatArray:
        """Return the additional exposure of one pixel in each frame of the block, e-."""
        low, high = self.dwell_low_frames, self.dwell_high_frames
        step = self.step_e * (random.exponential() if self.steps == "exponential" else 1.0)
        starts_high = random.random() < high / (low + high)
        # an even number of dwell times, well above what the run holds; the same whatever the block
        pairs = int(
            2.0 + context.n_frames / (low + high) * 1.5 + 6.0 * (context.n_frames / (low + high)) ** 0.5
        )
        dwell = random.exponential(size=(pairs, 2)) * ((high, low) if starts_high else (low, high))
        changes = np.cumsum(dwell.reshape(-1))
        # frames before the run are as the first one
        passed = np.searchsorted(changes, np.maximum(context.frames, 0), side="right")
        added: FloatArray = step * ((passed % 2 == 0) == starts_high)
        return added

    def added_exposure(
        self, frames: NDArray[np.unsignedinteger], numbers: IntArray, maps: PixelMaps
    ) -> AddedExposure | None:
        """Return the levels above the lowest one, and the time spent there, of the pixels seen to blink.

        Each is fitted by itself, whatever the mean step of all: with up to two defects and their own steps.
        """
        from pchem_pipeline.model.law.telegraph import Telegraph, find_telegraph

        if self.fraction == 0 or self.step_e == 0:
            return None
        found: dict[tuple[int, int], Telegraph] = {}
        good = maps.usable
        columns = maps.maps
        for y in np.flatnonzero(good.any(axis=1)):
            row = np.ascontiguousarray(frames[:, y].T)
            for x in np.flatnonzero(good[y]):
                telegraph = find_telegraph(row[x], numbers, np.array([values[y, x] for values in columns]))
                if telegraph is not None:
                    found[int(y), int(x)] = telegraph
        # where most of them seem to blink, it is something else
        if not 0 < len(found) <= _FEW_PIXELS * good.size:
            return None
        levels = max(telegraph.added.size for telegraph in found.values())
        exposure, weight = np.zeros((levels, *good.shape)), np.zeros((levels, *good.shape))
        weight[0] = 1.0
        for place, telegraph in found.items():
            own = (slice(telegraph.added.size), *place)
            exposure[own], weight[own] = telegraph.added, telegraph.weight
        return AddedExposure(exposure, weight)

    def details(self) -> tuple[str, ...]:
        """Return the step and both dwell times: second moments tell only what they come to together."""
        return ("step_e", "dwell_low_frames", "dwell_high_frames") if self.step_e > 0.0 else ()
