"""Distributions of a pixel parameter over the sensor and patterns on top, as they are written in the YAML.

Only the settings live here; ``maps.py`` turns them into numbers.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from pchem_pipeline.base.settings import Section


class PatternBase(Section):
    """What every pattern has."""

    relative: bool = Field(default=False, description="multiply by 1 + pattern instead of adding it")

    @model_serializer(mode="wrap")
    def _kind_first(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        data = handler(self)
        relative = data.pop("relative")
        return {**data, "relative": relative}


class ColumnPattern(PatternBase):
    """One normal random offset per column, as left by column amplifiers."""

    kind: Literal["column"] = Field(default="column", description="shape of the pattern")
    amplitude: float = Field(gt=0, description="standard deviation over columns; no unit if relative")


class RowPattern(PatternBase):
    """One normal random offset per row, as left by row drivers."""

    kind: Literal["row"] = Field(default="row", description="shape of the pattern")
    amplitude: float = Field(gt=0, description="standard deviation over rows; no unit if relative")


class GradientPattern(PatternBase):
    """A plane through the centre of the sensor, for example amplifier glow or heat from one side."""

    kind: Literal["gradient"] = Field(default="gradient", description="shape of the pattern")
    amplitude: float = Field(description="difference from edge to edge; no unit if relative")
    angle: float = Field(default=0.0, description="direction of the rise, degrees from +x towards +y")


class RadialPattern(PatternBase):
    """A paraboloid, zero in the centre, for example vignetting."""

    kind: Literal["radial"] = Field(default="radial", description="shape of the pattern")
    amplitude: float = Field(description="value in the corners; no unit if relative")


Pattern = Annotated[ColumnPattern | RowPattern | GradientPattern | RadialPattern, Field(discriminator="kind")]


class DistributionBase(Section):
    """What every distribution has: bounds and spatial patterns.

    The distribution is truncated to ``minimum .. maximum`` (the shape inside is kept);
    patterns are applied after that and the sum is cut at the bounds.
    """

    minimum: float | None = Field(default=None, description="smallest allowed value; null: no limit")
    maximum: float | None = Field(default=None, description="largest allowed value; null: no limit")
    patterns: tuple[Pattern, ...] = Field(default=(), description="column, row, gradient, radial")

    @model_serializer(mode="wrap")
    def _kind_first(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Write the kind and its numbers first, then the bounds and patterns that there are."""
        data = handler(self)
        common = {name: data.pop(name) for name in DistributionBase.model_fields}
        return {
            "kind": data.pop("kind"),
            **data,
            **{name: v for name, v in common.items() if v not in (None, [], ())},
        }

    @model_validator(mode="after")
    def _bounds_in_order(self) -> Self:
        if self.minimum is not None and self.maximum is not None and not self.minimum < self.maximum:
            raise ValueError(f"minimum {self.minimum} is not below maximum {self.maximum}; swap them")
        return self


class Constant(DistributionBase):
    """The same value in every pixel."""

    kind: Literal["constant"] = Field(default="constant", description="shape of the distribution")
    value: float = Field(description="value of every pixel, unit of the parameter")


class Normal(DistributionBase):
    """Normal distribution."""

    kind: Literal["normal"] = Field(default="normal", description="shape of the distribution")
    mean: float = Field(description="mean before truncation, unit of the parameter")
    std: float = Field(gt=0, description="standard deviation before truncation, unit of the parameter")


class LogNormal(DistributionBase):
    """Log-normal distribution: skewed to the right, never negative."""

    kind: Literal["lognormal"] = Field(default="lognormal", description="shape of the distribution")
    median: float = Field(gt=0, description="median before truncation, unit of the parameter")
    log_std: float = Field(gt=0, description="standard deviation of the natural logarithm, no unit")


class Gamma(DistributionBase):
    """Gamma distribution by its mean and standard deviation."""

    kind: Literal["gamma"] = Field(default="gamma", description="shape of the distribution")
    mean: float = Field(gt=0, description="mean before truncation, unit of the parameter")
    std: float = Field(gt=0, description="standard deviation before truncation, unit of the parameter")


class _Between(DistributionBase):
    """What has a lower and an upper end."""

    low: float = Field(description="lower end, unit of the parameter")
    high: float = Field(description="upper end, unit of the parameter")

    @model_validator(mode="after")
    def _ends_in_order(self) -> Self:
        if not self.low < self.high:
            raise ValueError(f"low {self.low} is not below high {self.high}; swap them or use kind: constant")
        return self


class Uniform(_Between):
    """Uniform distribution."""

    kind: Literal["uniform"] = Field(default="uniform", description="shape of the distribution")


class LogUniform(_Between):
    """Uniform distribution of the logarithm: equal numbers of pixels per decade."""

    kind: Literal["loguniform"] = Field(default="loguniform", description="shape of the distribution")
    low: float = Field(gt=0, description="lower end, unit of the parameter")
    high: float = Field(gt=0, description="upper end, unit of the parameter")


Distribution = Annotated[
    Constant | Normal | LogNormal | Gamma | Uniform | LogUniform, Field(discriminator="kind")
]
