"""Settings of the comparison of methods (YAML section ``methods``)."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from pchem_pipeline.base.settings import Section

_ReadNoise = Annotated[float, Field(ge=0.05, le=3)]


class MethodsSettings(Section):
    """How the other characterisation methods are compared with PCH-EM."""

    pixels: int = Field(
        default=1000, ge=1, le=100_000, description="number of pixels for each method, evenly spread"
    )
    with_runs: tuple[str, ...] = Field(
        default=(),
        description="stores of other runs of the same pixels at other exposures (preferably dark frames), "
        "for methods that need several samples; paths relative to the YAML",
    )
    study_pixels: int = Field(
        default=200,
        ge=0,
        le=100_000,
        description="simulated pixels per read noise of the figure; 0: no simulation",
    )
    study_read_noise: tuple[_ReadNoise, ...] = Field(
        default=(0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.6, 0.7, 0.85, 1.0),
        min_length=1,
        description="e-: read noises of the simulated pixels; exposure, gain and frames as in the run",
    )
    seed: int = Field(default=1, ge=0, lt=2**63, description="random seed of the simulation")
    em_iterations: int = Field(
        default=1000, ge=1, le=1_000_000, description="largest number of steps of the paper's plain EM"
    )
    em_tolerance: float = Field(
        default=1e-6, gt=0, le=0.1, description="relative change of the parameters at which plain EM stops"
    )
