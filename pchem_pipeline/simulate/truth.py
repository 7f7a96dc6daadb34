"""The parameter maps of a simulated sensor."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.base.units import QUANTISATION_VARIANCE

if TYPE_CHECKING:
    from numpy.typing import NDArray

_LARGEST_EXPOSURE = 1e7  # that can be simulated, e-


class Defect(IntEnum):
    """What is special about a simulated pixel."""

    NONE = 0
    HOT = 1
    DEAD = 2
    STUCK = 3


@dataclass(frozen=True)
class TruthMaps:
    """True parameters of the pixels, all (y, x).

    Attributes:
        quanta_exposure: H, e-.
        conversion_gain: g, e-/DN.
        bias: mu, DN.
        analog_read_noise_e: sigma_R, e-, without quantisation.
        defect: uint8, see :class:`Defect`.

    Raises:
        ConfigError: if a value is not finite, or impossible (H < 0, g <= 0, sigma_R < 0).
    """

    quanta_exposure: FloatArray
    conversion_gain: FloatArray
    bias: FloatArray
    analog_read_noise_e: FloatArray
    defect: NDArray[np.uint8]

    def __post_init__(self) -> None:
        """Refuse parameters out of range: the compiled chain does not check them."""
        allowed = {
            "quanta_exposure": (0.0, _LARGEST_EXPOSURE),
            "conversion_gain": (np.nextafter(0.0, 1.0), np.inf),
            "bias": (-np.inf, np.inf),
            "analog_read_noise_e": (0.0, np.inf),
        }
        for name, (low, high) in allowed.items():
            values = getattr(self, name)
            if values.shape != self.bias.shape:
                raise ConfigError(
                    f"truth: {name} has shape {values.shape}, bias {self.bias.shape}; make them equal"
                )
            bad = ~(np.isfinite(values) & (values >= low) & (values <= high))
            if bad.any():
                y, x = np.argwhere(bad)[0]
                raise ConfigError(
                    f"truth: {name} is impossible in {bad.sum()} pixels (first: {values[y, x]} at y={y}, "
                    f"x={x}); give possible, finite values"
                )

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns, px."""
        rows, columns = self.bias.shape
        return rows, columns

    @property
    def read_noise_dn(self) -> FloatArray:
        """Read noise with quantisation, DN: sigma = (sigma_R^2 / g^2 + 1/12)^(1/2)."""
        return np.sqrt((self.analog_read_noise_e / self.conversion_gain) ** 2 + QUANTISATION_VARIANCE)

    @property
    def read_noise_e(self) -> FloatArray:
        """Read noise with quantisation, e-: sigma_e- = g sigma."""
        return self.conversion_gain * self.read_noise_dn

    def band(self, start: int, stop: int) -> TruthMaps:
        """Return the maps of rows ``start .. stop - 1``."""
        return replace(self, **{f.name: getattr(self, f.name)[start:stop] for f in fields(self)})

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return every map by its name in the group ``truth`` of a store."""
        names = (*(f.name for f in fields(self)), "read_noise_dn", "read_noise_e")
        return {name: getattr(self, name) for name in names}
