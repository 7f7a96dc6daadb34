"""Column noise: one random offset for each column of each frame, common to its pixels.

With one amplifier and ADC per column, what a column's reference or sampling capacitor picks up once per frame
shifts the whole column: ``x += n_column,t`` with ``n_column,t ~ N(0, s^2)``, new in every frame. Offsets that
do not change from frame to frame are part of the bias map and not this effect.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field

from pchem_pipeline.effects.families.offsets import SharedNoise
from pchem_pipeline.effects.framework.effect import Dn, register_effect


@register_effect
class ColumnNoise(SharedNoise):
    """Random offset per column and frame, in DN since the disturbance sits behind the pixels' gains.

    Signature: the variance of the column means of the readout residual exceeds that of ``n_y`` independent
    pixels by ``column_noise_dn^2``; neighbours along y are correlated. A pixel's own histogram only
    broadens: its read noise becomes ``(sigma^2 + column_noise_dn^2)^(1/2)`` DN.
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
