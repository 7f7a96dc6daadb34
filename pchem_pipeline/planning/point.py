"""A pixel under one exposure, as planning sees it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.base.units import QUANTISATION_VARIANCE


@dataclass(frozen=True)
class Point:
    """What is known of the pixel.

    Attributes:
        quanta_exposure: H, e-.
        read_noise_e: s_e, e-, quantisation included.
        conversion_gain: g, e-/DN; matters for rounding and for units of DN only.

    Raises:
        ConfigError: a number is out of range, or the read noise is below that of rounding.
    """

    quanta_exposure: float
    read_noise_e: float
    conversion_gain: float

    def __post_init__(self) -> None:
        ranges = {
            "--exposure": (self.quanta_exposure, 1e-6, 1e4, "e-"),
            "--read-noise": (self.read_noise_e, 1e-3, 100.0, "e-"),
            "--gain": (self.conversion_gain, 1e-6, 1e2, "e-/DN"),
        }
        for option, (value, low, high, unit) in ranges.items():
            if not low <= value <= high:
                raise ConfigError(f"{option} {value:g}: give a number from {low:g} to {high:g} {unit}")
        rounding = self.conversion_gain * np.sqrt(QUANTISATION_VARIANCE)
        if self.read_noise_e < rounding:
            raise ConfigError(
                f"--read-noise {self.read_noise_e:g}: below the rounding noise of {rounding:.3g} e- at "
                f"{self.conversion_gain:g} e-/DN, which the read noise includes"
            )
