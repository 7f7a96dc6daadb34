"""YAML section ``discrepancy``: settings of the search for missing effects."""

from __future__ import annotations

from pydantic import Field

from pchem_pipeline.base.settings import Section


class DiscrepancySettings(Section):
    """Comparison of the frames with stacks simulated from the fitted model, and identification of effects."""

    replicates: int = Field(
        default=40,
        ge=20,
        le=2000,
        description="simulated and refitted stacks for the null distribution, each a third of the run",
    )
    extended_replicates: int = Field(
        default=16, ge=12, le=2000, description="the same for each model with added effects"
    )
    block_frames: int | None = Field(
        default=None,
        ge=8,
        description="frames per block; blocks go in turn to train, test and final; null: a sixtieth of "
        "the run, from 20 to 100",
    )
    max_samples: int = Field(
        default=1 << 25,
        ge=1 << 14,
        description="largest number of frames x pixels compared with simulations; of a larger stack, blocks "
        "of frames spread over the run, and the most deviating window (else the centre)",
    )
    clear_samples: int = Field(
        default=1 << 22,
        ge=1 << 14,
        description="smaller limit that is used if so many samples (or two or four times as many) disagree "
        "by 15 sigma with a model without effects: faster, but strengths are less precise; what is named is "
        "tested in max_samples; set it to max_samples to search in all",
    )
    max_pixels: int = Field(
        default=1 << 13,
        ge=256,
        description="largest number of pixels compared with simulations; each is refitted in every stack",
    )
    significance: float = Field(
        default=0.005,
        gt=0,
        le=0.1,
        description="p-value, corrected for the number of statistics, below which data and model disagree",
    )
    certainty: float = Field(
        default=0.98,
        gt=0.5,
        lt=1,
        description="posterior probability among the candidates from which an effect is named",
    )
    model_error: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="allowed relative error of the predicted shift of the statistics by a candidate, no unit",
    )
    max_rounds: int = Field(
        default=3, ge=1, le=10, description="largest number of times that the best set of effects is extended"
    )
    effort: float | None = Field(
        default=1.0,
        gt=0,
        description="factor on the search budget, which is counted work, the same on any machine: 1 is six "
        "times the work of the null distribution, at least some 170 CPU seconds; null: no limit",
    )
    candidates: tuple[str, ...] | None = Field(
        default=None, description="effects (tags) to consider; null: all, plug-ins included"
    )
    exclude: tuple[str, ...] = Field(default=(), description="effects (tags) to leave out")
    add: bool = Field(
        default=True, description="make a new version of the model with the named effects, in store and YAML"
    )
    seed: int = Field(default=1, ge=0, lt=2**63, description="seed of the simulated stacks")
