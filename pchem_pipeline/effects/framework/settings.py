"""YAML section ``model``: what the model of the data holds beyond the PCD."""

from __future__ import annotations

from pydantic import Field

from pchem_pipeline.base.settings import Section
from pchem_pipeline.effects.framework.registry import EffectList


class ModelSettings(Section):
    """The model with which the pixels are fitted."""

    effects: EffectList = Field(
        default=(),
        description="effects beyond the PCD with which pixels are fitted and ensembles predicted; "
        "pchem discrepancy writes those that it names to RUN.effects.yaml, which counts instead of this "
        "section; a simulated camera has its own list, simulate.effects",
    )
    set_aside_e: tuple[tuple[float | None, float | None], ...] = Field(
        default=(),
        description="codes that the fit leaves out, since the model does not describe them: intervals of "
        "(x - bias) * gain of the plain fit, e-; null: no limit ([[null, 0.5]]: without the 0-electron peak)",
    )
