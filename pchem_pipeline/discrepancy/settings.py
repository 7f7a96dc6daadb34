"""YAML section ``discrepancy``: how to look for what the model is missing."""

from __future__ import annotations

from pydantic import Field

from pchem_pipeline.base.settings import Section


class DiscrepancySettings(Section):
    """Comparison of the frames with replicates simulated from the fitted model, and naming of effects."""

    replicates: int = Field(
        default=40,
        ge=20,
        le=2000,
        description="simulated and refitted stacks behind the null distribution, a third of the run each",
    )
    extended_replicates: int = Field(
        default=16, ge=12, le=2000, description="the same for each model that effects were added to"
    )
    block_frames: int | None = Field(
        default=None,
        ge=8,
        description="frames in a block; blocks go in turn to train, test and final. null: a sixtieth of "
        "the run, within 20 to 100",
    )
    max_samples: int = Field(
        default=1 << 25,
        ge=1 << 14,
        description="frames x pixels compared with simulations; of a larger stack, a window where it stands "
        "out most, else its middle, and blocks of frames spread over the run",
    )
    clear_samples: int = Field(
        default=1 << 22,
        ge=1 << 14,
        description="the same where so few, or twice as many, or four times, already disagree by 15 standard "
        "deviations with a model without effects: more would take longer, and tell weaker effects beside it; "
        "the value of max_samples: all",
    )
    max_pixels: int = Field(
        default=1 << 13,
        ge=256,
        description="pixels compared with simulations, at most: each is fitted anew in every simulated stack",
    )
    significance: float = Field(
        default=0.005,
        gt=0,
        le=0.1,
        description="a disagreement counts when one as large comes by chance, anywhere among the "
        "statistics, with a smaller probability",
    )
    certainty: float = Field(
        default=0.98,
        gt=0.5,
        lt=1,
        description="probability among the candidates from which on an effect is named alone",
    )
    model_error: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="relative error allowed to the fingerprint of a candidate (its details are never "
        "quite those of the sensor), no unit",
    )
    max_rounds: int = Field(
        default=3, ge=1, le=10, description="rounds of naming and adding; each round may add several effects"
    )
    effort: float | None = Field(
        default=1.0,
        gt=0,
        description="limit of the search, in counted work, so that the same search ends at the same place "
        "on any machine: 1 is six times the work of the null distribution, or some 170 CPU seconds; "
        "null: none",
    )
    candidates: tuple[str, ...] | None = Field(
        default=None, description="effects (tags) to consider; null: all that are known, plug-ins included"
    )
    exclude: tuple[str, ...] = Field(default=(), description="effects (tags) to leave out")
    add: bool = Field(
        default=True,
        description="make a new version of the model with the named effects, also in the run's YAML",
    )
    seed: int = Field(default=1, ge=0, lt=2**63, description="root of the replicates' random numbers")
