"""YAML section ``model``: what the model of the data holds beyond the PCD."""

from __future__ import annotations

from pydantic import Field

from pchem_pipeline.base.settings import Section
from pchem_pipeline.effects.framework.registry import EffectList


class ModelSettings(Section):
    """The model with which the pixels are fitted."""

    effects: EffectList = Field(
        default=(),
        description="effects added to the PCD in fit and ensemble; pchem discrepancy writes the effects "
        "found to RUN.effects.yaml, which overrides this section; a simulated camera has simulate.effects",
    )
    set_aside_e: tuple[tuple[float | None, float | None], ...] = Field(
        default=(),
        description="codes that the fit leaves out, since the model does not describe them: intervals of "
        "(x - bias) * gain of the plain fit, e-; null: no limit ([[null, 0.5]]: without the 0-electron peak)",
    )
