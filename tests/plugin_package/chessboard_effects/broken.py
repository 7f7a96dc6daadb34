"""Effects that break: one when it is asked for a guess, one when it is simulated."""

from typing import ClassVar, Literal

from pydantic import Field

from pchem_pipeline.effects.framework.effect import Effect, Plane


class HastyOffset(Effect):
    """Breaks in its estimator."""

    tag: Literal["hasty_offset"] = "hasty_offset"
    plane: ClassVar[Plane] = Plane.ADC
    signature: ClassVar[tuple[str, ...]] = ("time.lag1.readout.mean",)
    strength: ClassVar[str] = "offset_dn"

    offset_dn: float = Field(default=0.2, description="offset, DN")

    def apply(self, values, context):
        return values + self.offset_dn

    @classmethod
    def estimate(cls, evidence):
        raise ZeroDivisionError("nobody divided the offsets")


class CarelessOffset(HastyOffset):
    """Guesses, and breaks when it is simulated."""

    tag: Literal["careless_offset"] = "careless_offset"

    def apply(self, values, context):
        raise KeyError("offsets were left on the desk")

    @classmethod
    def estimate(cls, evidence):
        return (cls(),)
