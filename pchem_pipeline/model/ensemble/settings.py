"""Settings of the parameter maps and of the ensemble prediction."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field, field_validator

from pchem_pipeline.base.settings import Section


class MapsSettings(Section):
    """How the maps are summarised, and which pixels are called misfits; no setting changes a parameter."""

    outlier_sigmas: float = Field(
        default=6.0,
        gt=0,
        description="outliers: beyond this many robust standard deviations (1.4826 MAD) from the median",
    )
    false_discovery_rate: float = Field(
        default=0.05,
        gt=0,
        lt=1,
        description="false-discovery rate of misfits, pixels whose histograms disagree with the model "
        "(Benjamini and Hochberg)",
    )
    worst_pixels: int = Field(
        default=6, ge=0, le=16, description="number of worst-fitting pixels that are listed and drawn"
    )
    removed: ClassVar[tuple[str, ...]] = ("percentiles",)


class EnsembleSettings(Section):
    """The ensemble histogram and its three predictions."""

    frames: int | Literal["all"] = Field(
        default=250,
        description="number of frames in the ensemble histogram, or all; at most all frames of the run",
    )
    first_frame: int = Field(default=0, ge=0, description="first of the frames in the ensemble histogram")
    parameter_bins: int = Field(
        default=64,
        ge=2,
        le=200,
        description="bins of each parameter in the 4-D, 2-D and 1-D histograms of the parameter maps",
    )
    nuced_bin_width: float | None = Field(
        default=None,
        ge=1e-3,
        description="bin width of the NUCed histogram, e-; null: median conversion gain (same number of DN "
        "in each bin)",
    )
    removed: ClassVar[tuple[str, ...]] = (
        "parameter_range",
        "cell_representative",
        "nuced_bin_steps",
        "rmse_coverage",
    )

    @field_validator("frames")
    @classmethod
    def _at_least_one(cls, value: int | str) -> int | str:
        if isinstance(value, int) and value < 1:
            raise ValueError("give at least one frame, or all")
        return value
