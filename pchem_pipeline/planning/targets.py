"""A pixel, how well a parameter of it shall be known, and the frames of one sample that this takes."""

from __future__ import annotations

import difflib
import functools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.base.variables import CHARGE_RATES
from pchem_pipeline.model.errors.expected_information import expected_information, inverse_information

#: Parameters that can be planned for, with the units in which a precision can be given.
TARGET_NAMES: dict[str, tuple[str, ...]] = {
    "quanta_exposure": ("%", "e-"),
    "charge_rate": ("%",),
    "dark_current": ("%",),
    "conversion_gain": ("%", "e-/DN"),
    "bias": ("e-", "DN"),
    "read_noise_dn": ("%", "DN"),
    "read_noise_e": ("%", "e-"),
}
_EXAMPLE = {"%": "1%", "e-": "0.02e-", "DN": "0.2DN", "e-/DN": "0.001e-/DN"}


@dataclass(frozen=True)
class Point:
    """A pixel under one exposure.

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


@dataclass(frozen=True)
class Target:
    """A precision: one standard deviation of a parameter of one pixel, see :data:`TARGET_NAMES`."""

    name: str
    value: float
    unit: str

    def __str__(self) -> str:
        """Return e.g. ``conversion_gain to 1 %``."""
        return f"{self.name} to {self.value:g} {self.unit}"

    @property
    def shared(self) -> bool:
        """Whether all samples of a pixel share the parameter."""
        return self.name not in ("quanta_exposure", *CHARGE_RATES)

    def gradient(self, point: Point) -> FloatArray:
        """Return the derivative by the coordinates of the information, (4,): relative, of the bias in e-."""
        if not self.shared:
            return np.array([1.0 / point.quanta_exposure, 0.0, 0.0, 0.0])
        places = {"conversion_gain": [1], "bias": [2], "read_noise_dn": [3], "read_noise_e": [1, 3]}
        return np.isin(np.arange(4), places[self.name]).astype(np.float64)

    def wanted(self, point: Point) -> float:
        """Return the wanted standard deviation: relative, of the bias in e-."""
        gain, noise = point.conversion_gain, point.read_noise_e
        scale = {
            ("quanta_exposure", "e-"): 1.0 / point.quanta_exposure,
            ("conversion_gain", "e-/DN"): 1.0 / gain,
            ("bias", "e-"): 1.0,
            ("bias", "DN"): gain,
            ("read_noise_dn", "DN"): gain / noise,
            ("read_noise_e", "e-"): 1.0 / noise,
        }
        return self.value * scale.get((self.name, self.unit), 0.01)


def parse_target(text: str) -> Target:
    """Return the target of ``name=value`` with a unit, such as ``conversion_gain=1%`` or ``bias=0.02e-``.

    Raises:
        ConfigError: the name or the unit is unknown, or the value is not above 0.
    """
    name, _, rest = text.partition("=")
    name = name.strip()
    if name not in TARGET_NAMES:
        close = difflib.get_close_matches(name, TARGET_NAMES, 1)
        hint = f"; did you mean {close[0]}?" if close else f"; choose from {', '.join(TARGET_NAMES)}"
        raise ConfigError(f"--target {text}: {name or 'nothing'} is not a parameter{hint}")
    units = TARGET_NAMES[name]
    example = f"{name}={_EXAMPLE[units[0]]}"
    match = re.fullmatch(r"\s*([0-9.+\-]+(?:[eE][+\-]?[0-9]+)?)\s*(%|e-/DN|e-|DN)\s*", rest)
    try:
        value = float(match[1]) if match else math.nan
    except ValueError:
        value = math.nan
    if match is None or not math.isfinite(value) or match[2] not in units:
        raise ConfigError(f"--target {text}: give a number in {' or '.join(units)}, such as {example}")
    if value <= 0:
        raise ConfigError(f"--target {text}: give a number above 0, such as {example}")
    return Target(name, value, match[2])


@functools.lru_cache(maxsize=8192)
def _bound(point: Point) -> FloatArray:
    """Return the smallest covariance from one frame, rounding included; do not change it."""
    return inverse_information(
        expected_information(point.quanta_exposure, point.read_noise_e, point.conversion_gain)
    )


def frames_needed(target: Target, point: Point) -> float:
    """Return the number of frames with which one sample reaches a target, by the Cramer-Rao bound, or inf."""
    gradient = target.gradient(point)
    variance = float(gradient @ _bound(point) @ gradient)
    if not np.isfinite(variance):
        return float("inf")
    return float(np.ceil(max(variance / target.wanted(point) ** 2, 1.0)))


def precision(point: Point, n_frames: float) -> dict[str, float]:
    """Return the smallest standard deviation of each of `TARGET_NAMES` from so many frames of one sample.

    They are relative, of the bias in e-; NaN if undetermined.
    """
    covariance = _bound(point) / n_frames
    gradients = {name: Target(name, 1.0, units[0]).gradient(point) for name, units in TARGET_NAMES.items()}
    return {name: float(np.sqrt(each @ covariance @ each)) for name, each in gradients.items()}


def best_exposure(targets: Sequence[Target], point: Point, low: float, high: float) -> tuple[float, float]:
    """Return the exposure from ``low`` to ``high`` (e-) with the fewest frames for all targets, and these.

    They are infinite where no exposure reaches the targets; that of the point does not matter.
    """
    from scipy.optimize import minimize_scalar  # takes a fifth of a second, and reports import this

    def needed(log_exposure: float) -> float:
        exposed = replace(point, quanta_exposure=float(np.exp(log_exposure)))
        return max(frames_needed(target, exposed) for target in targets)

    grid = np.log(np.geomspace(low, high, 25))
    values = np.array([needed(x) for x in grid])
    best = int(np.argmin(values))
    if not np.isfinite(values[best]):
        return float("nan"), float("inf")
    ends = grid[max(best - 1, 0)], grid[min(best + 1, grid.size - 1)]
    found = min(grid[best], minimize_scalar(needed, bounds=ends, method="bounded").x, key=needed)
    return float(np.exp(found)), needed(found)
