"""The whole YAML of a run; each section lives beside the code that it configures."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, ValidationError, ValidationInfo, field_validator, model_validator

from pchem_pipeline.base.settings import Place, Section
from pchem_pipeline.compute.settings import ComputeSettings
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.effects.framework.settings import ModelSettings
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.methods.settings import MethodsSettings
from pchem_pipeline.model.checks.settings import CompareSettings
from pchem_pipeline.model.ensemble.settings import EnsembleSettings, MapsSettings
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.histogram.settings import HistogramSettings
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.simulate.settings import SimulateSettings


class RunSettings(Section):
    """What concerns the run as a whole."""

    store: Place = Field(
        default="run.zarr",
        min_length=1,
        description="store of the run (zarr): a folder, or a URL of an object storage: s3://bucket/run.zarr",
    )
    title: str = Field(default="", description="title of the report; empty: the name of the store")
    tile: Literal["auto", 8, 16, 32, 64, 128, 256] = Field(
        default="auto",
        description="side of a tile (unit of work and storage), pixels; auto: 64, larger on sensors of more "
        "than 80 such tiles",
    )
    allowed_failed_pixels: float = Field(
        default=0.1, ge=0, le=1, description="exit code 3 above this fraction of pixels without a value"
    )


class RunConfig(Section):
    """The configuration of a run."""

    run: RunSettings = Field(default_factory=RunSettings, description="the run as a whole")
    simulate: SimulateSettings | None = Field(
        default=None, description="simulated camera; remove this section to use your own files"
    )
    input: InputSettings = Field(default_factory=InputSettings, description="camera files")
    histogram: HistogramSettings = Field(default_factory=HistogramSettings, description="histograms")
    model: ModelSettings = Field(default_factory=ModelSettings, description="effects added to the PCD")
    fit: FitSettings = Field(default_factory=FitSettings, description="fit of the pixels (PCH-EM)")
    maps: MapsSettings = Field(default_factory=MapsSettings, description="parameter maps")
    ensemble: EnsembleSettings = Field(default_factory=EnsembleSettings, description="ensemble distributions")
    discrepancy: DiscrepancySettings = Field(
        default_factory=DiscrepancySettings, description="search for effects missing from the model"
    )
    methods: MethodsSettings = Field(
        default_factory=MethodsSettings, description="comparison with other methods (pchem methods)"
    )
    compare: CompareSettings = Field(
        default_factory=CompareSettings,
        description="limits of pchem compare with this run as reference; null: not judged, none at all: any "
        "significant change counts",
    )
    report: ReportSettings = Field(default_factory=ReportSettings, description="report.html")
    compute: ComputeSettings = Field(default_factory=ComputeSettings, description="backend, workers, memory")

    @field_validator("*", mode="before")
    @classmethod
    def _empty_section(cls, value: object, info: ValidationInfo) -> object:
        """Take a section of which every line is a comment as a section of defaults."""
        return {} if value is None and info.field_name != "simulate" else value

    @model_validator(mode="before")
    @classmethod
    def _read_what_is_simulated(cls, data: Any, info: ValidationInfo) -> Any:
        """Set the input to the simulated camera's files, where no files are named."""
        if not isinstance(data, dict) or data.get("simulate") is None:
            return data
        given = data.get("input") or {}
        if not isinstance(given, dict) or given.get("files") or given.get("samples"):
            return data
        try:
            simulated = SimulateSettings.model_validate(data["simulate"], context=info.context)
        except ValidationError:
            return data  # said once more, with its place in the tree, by the field itself
        files = [str(simulated.output)]
        known = {
            "format": simulated.format,
            "integration_time": simulated.integration_time,
            "bit_depth": simulated.bit_depth,
            "kind": "unknown" if simulated.parameters.dark_current is None else "dark",
        }
        return {**data, "input": {**known, **given, "files": files}}

    @model_validator(mode="after")
    def _has_input(self) -> RunConfig:
        if self.simulate is None and not (self.input.files or self.input.samples):
            raise ValueError("input.files: no input; give camera files, or add a section simulate")
        return self
