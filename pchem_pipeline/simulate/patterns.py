"""Spatial patterns of a pixel parameter, as they are written in the YAML."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer

from pchem_pipeline.base.settings import Section


class PatternBase(Section):
    """What every pattern has."""

    relative: bool = Field(
        default=False, description="true: multiply the parameter by 1 + pattern; false: add the pattern to it"
    )

    @model_serializer(mode="wrap")
    def _kind_first(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        data = handler(self)
        relative = data.pop("relative")
        return {**data, "relative": relative}


class ColumnPattern(PatternBase):
    """One normal random offset per column, as left by column amplifiers."""

    kind: Literal["column"] = Field(default="column", description="shape of the pattern")
    amplitude: float = Field(
        gt=0, description="standard deviation over columns, the parameter's unit (none if relative)"
    )


class RowPattern(PatternBase):
    """One normal random offset per row, as left by row drivers."""

    kind: Literal["row"] = Field(default="row", description="shape of the pattern")
    amplitude: float = Field(
        gt=0, description="standard deviation over rows, the parameter's unit (none if relative)"
    )


class GradientPattern(PatternBase):
    """A plane through the centre of the sensor, for example amplifier glow or heat from one side."""

    kind: Literal["gradient"] = Field(default="gradient", description="shape of the pattern")
    amplitude: float = Field(
        description="difference from edge to edge, the parameter's unit (none if relative)"
    )
    angle: float = Field(default=0.0, description="direction of the rise, degrees from +x towards +y")


class RadialPattern(PatternBase):
    """A paraboloid, zero in the centre, for example vignetting."""

    kind: Literal["radial"] = Field(default="radial", description="shape of the pattern")
    amplitude: float = Field(description="value in the corners, the parameter's unit (none if relative)")


Pattern = Annotated[
    ColumnPattern | RowPattern | GradientPattern | RadialPattern,
    Field(discriminator="kind"),
]
