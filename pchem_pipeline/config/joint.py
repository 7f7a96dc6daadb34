"""The YAML of a joint fit: the runs of the same sensor at several exposures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import Field, ValidationError, field_validator, model_validator

from pchem_pipeline.base.errors import ConfigError, quoted
from pchem_pipeline.base.settings import Section
from pchem_pipeline.compute.settings import ComputeSettings
from pchem_pipeline.config.load import complaints, yaml_content
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.model.ensemble.settings import MapsSettings
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.report.settings import ReportSettings

__all__ = [
    "JointConfig",
    "JointSettings",
    "SampleSettings",
    "as_run",
    "dump_joint",
    "load_joint",
    "make_joint",
]


class SampleSettings(Section):
    """One exposure: an ordinary run of the same pixels."""

    run: str = Field(min_length=1, description="config.yaml or store of the run, relative to this file")
    kind: Literal["exposed", "bias"] = Field(
        default="exposed",
        description="bias: frames without any electrons, H = 0; they pin the bias and the read noise",
    )
    integration_time: float | None = Field(
        default=None, ge=0, description="s; null: what the run says. 0 is allowed: no time to integrate"
    )
    light_level: float | None = Field(
        default=None, ge=0, description="exposure in any unit, for joint.against: light_level"
    )


class JointSettings(Section):
    """What concerns the joint fit as a whole."""

    store: str = Field(default="joint.zarr", min_length=1, description="folder of its store (zarr)")
    title: str = Field(default="", description="title of the report; empty: the name of the store")
    tile: Literal[8, 16, 32, 64, 128, 256] = Field(default=64, description="side of a tile, pixels")
    against: Literal["integration_time", "light_level", "none"] = Field(
        default="integration_time",
        description="what the exposures are drawn against. integration_time: the slope of H is the dark "
        "current and its offset the spurious charge. none: no line",
    )
    allowed_failed_pixels: float = Field(
        default=0.1,
        ge=0,
        le=1,
        description="fraction of pixels without a value above which the exit code is 3",
    )

    @field_validator("store")
    @classmethod
    def _is_a_folder(cls, value: str) -> str:
        if "://" in value:
            raise ValueError("is a URL; a joint fit has its store on a disk, copy it when it is finished")
        return value


class JointConfig(Section):
    """The configuration of a joint fit.

    Raises:
        pydantic.ValidationError: a key is unknown, a value is out of range, or no sample holds electrons.
    """

    samples: tuple[SampleSettings, ...] = Field(
        min_length=1, max_length=64, description="the exposures, in increasing order"
    )
    joint: JointSettings = Field(default_factory=JointSettings, description="the joint fit as a whole")
    fit: FitSettings = Field(default_factory=FitSettings, description="PCH-EM")
    maps: MapsSettings = Field(default_factory=MapsSettings, description="parameter maps")
    report: ReportSettings = Field(default_factory=ReportSettings, description="report.html and figures")
    compute: ComputeSettings = Field(default_factory=ComputeSettings, description="who does the work")

    @field_validator("joint", "fit", "maps", "report", "compute", mode="before")
    @classmethod
    def _empty_section(cls, value: object) -> object:
        """Take a section of which every line is a comment as a section of defaults."""
        return {} if value is None else value

    @model_validator(mode="after")
    def _has_electrons(self) -> JointConfig:
        if all(sample.kind == "bias" for sample in self.samples):
            raise ValueError("samples: every sample is a bias; list at least one that holds electrons")
        return self


def load_joint(path: Path) -> JointConfig:
    """Return the joint fit that a YAML file describes.

    Raises:
        ConfigError: the file is missing, is not YAML, or a setting is wrong.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(
            f"{path}: no such file; write one with: pchem joint RUN RUN ... --store "
            f"{quoted(path.with_suffix('.zarr'))}"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from error
    content = yaml_content(text, str(path))
    if "samples" not in content:
        raise ConfigError(f"{path}: has no samples; a joint fit lists the runs of each exposure there")
    return make_joint(content, str(path))


def make_joint(content: Mapping[str, Any], name: str) -> JointConfig:
    """Return the joint fit with these settings; ``name`` is used in messages.

    Raises:
        ConfigError: a setting is wrong.
    """
    try:
        return JointConfig.model_validate(content)
    except ValidationError as error:
        raise ConfigError(f"{name}: {complaints(error, JointConfig)}") from error


def dump_joint(config: JointConfig) -> str:
    """Return the YAML text of a joint fit, every setting spelled out."""
    content = config.model_dump(mode="json", by_alias=True)
    return yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


def as_run(config: JointConfig) -> RunConfig:
    """Return the configuration that the stages of a joint fit see: its runs are its input."""
    joint = config.joint
    run = {name: getattr(joint, name) for name in ("store", "title", "tile", "allowed_failed_pixels")}
    return RunConfig.model_validate(
        {
            "run": run,
            "input": {"files": [sample.run for sample in config.samples]},
            **{name: getattr(config, name) for name in ("fit", "maps", "report", "compute")},
        }
    )
