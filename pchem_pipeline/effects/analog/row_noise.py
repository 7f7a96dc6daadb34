"""Row noise: one random offset for each row of each frame, common to its pixels.

Noise of a ramp, reference or supply while a row is read shifts the whole row: ``x += n_row,t`` with
``n_row,t ~ N(0, s^2)``, new in every frame. A common design rule keeps it below a tenth of the read noise,
because the eye finds stripes long before the pixel statistics do.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field

from pchem_pipeline.effects.families.offsets import SharedNoise
from pchem_pipeline.effects.framework.effect import Dn, register_effect


@register_effect
class RowNoise(SharedNoise):
    """Random offset per row and frame, in DN since the disturbance sits behind the pixels' gains.

    Signature: the variance of the row means of the readout residual exceeds that of ``n_x`` independent
    pixels by ``row_noise_dn^2``; neighbours along x are correlated. A pixel's own histogram only
    broadens: its read noise becomes ``(sigma^2 + row_noise_dn^2)^(1/2)`` DN.
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
