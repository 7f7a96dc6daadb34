"""The YAML section ``report``: what the report shows."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field, field_validator

from pchem_pipeline.base.settings import Section
from pchem_pipeline.base.variables import MEASURED_MAPS
from pchem_pipeline.effects.framework.region import Region

PixelPosition = tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]]


class Criteria(Section):
    """Limits of the report's criteria; null: no limit.

    Flagged pixels (``fit_status``: values open by whole electrons) do not count, but for ``flagged_pixels``.
    """

    read_noise_e: float | None = Field(
        default=0.5, gt=0, description="median read noise, e-; above 0.5 e- electrons cannot be counted"
    )
    failed_pixels: float | None = Field(
        default=0.01, ge=0, le=1, description="share of pixels without a value"
    )
    flagged_pixels: float | None = Field(
        default=0.1, ge=0, le=1, description="share of pixels whose values can be off by whole electrons"
    )
    hot_pixels: float | None = Field(
        default=0.01,
        ge=0,
        le=1,
        description="share of hot pixels: H above its median by more than maps.outlier_sigmas",
    )
    outlying_pixels: float | None = Field(
        default=0.01,
        ge=0,
        le=1,
        description="share of outliers in conversion gain, bias or read noise (the largest)",
    )
    gain_nonuniformity: float | None = Field(
        default=0.15,
        gt=0,
        description="spread of the conversion gain between pixels over its median: robust standard "
        "deviation, corrected for the errors of the pixels",
    )
    medians: dict[str, tuple[float, float]] = Field(
        default_factory=dict,
        description="range of the median of a map, in its unit, such as {bias: [90, 110]}",
    )

    @field_validator("medians")
    @classmethod
    def _of_maps(cls, ranges: dict[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
        for name, (low, high) in ranges.items():
            if name not in MEASURED_MAPS:
                raise ValueError(f"{name} is no map; choose from {', '.join(MEASURED_MAPS)}")
            if not low < high:
                raise ValueError(f"{name}: {low:g} to {high:g} is no range; give the smaller number first")
        return ranges


class ReportSettings(Section):
    """Settings of the stage ``report``."""

    removed: ClassVar[tuple[str, ...]] = ("figure_formats", "dpi", "map_stretch", "histogram_bins")

    pixels: tuple[PixelPosition, ...] = Field(
        default=(),
        max_length=16,
        description="pixels whose fits are drawn, [[y, x], ...]; empty: four pixels at low and high "
        "read noise and low and high quanta exposure",
    )
    criteria: Criteria = Field(default_factory=Criteria, description="limits of the sensor; null: no limit")
    regions: dict[str, Region] = Field(
        default_factory=dict,
        description="parts of the sensor by name, such as {left: columns=0:256, right: columns=256:512}; the "
        "report has the medians of each",
    )
