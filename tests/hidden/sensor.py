"""A random sensor: the maps of the four parameters and what its converter can hold."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Sensor:
    """Maps (y, x) of one sensor.

    Attributes:
        exposure: H, e-.
        step: DN per electron.
        bias: DN.
        noise: analog read noise, e-.
        bits: of the converter.
        n_frames: of the run.
    """

    exposure: np.ndarray
    step: np.ndarray
    bias: np.ndarray
    noise: np.ndarray
    bits: int
    n_frames: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.exposure.shape

    @property
    def n_pixels(self) -> int:
        """Number of pixels."""
        return self.exposure.size

    @property
    def code_range(self) -> tuple[float, float]:
        """DN between which nearly all samples lie."""
        low = np.median(self.bias) - 3 * np.median(self.noise * self.step)
        reach = np.median(self.exposure) + 2 * np.sqrt(np.median(self.exposure))
        return float(low), float(np.median(self.bias) + reach * np.median(self.step))


def _smooth(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """A tilted bowl of mean 0 and standard deviation about 1 (vignetting, temperature)."""
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij")
    cy, cx, tilt, angle = rng.uniform(-0.5, 0.5), rng.uniform(-0.5, 0.5), rng.normal(), rng.uniform(0, 6.3)
    field = (x - cx) ** 2 + (y - cy) ** 2 + 0.4 * tilt * (x * np.cos(angle) + y * np.sin(angle))
    return (field - field.mean()) / max(field.std(), 1e-9)


def draw_sensor(rng: np.random.Generator, shape: tuple[int, int], n_frames: int) -> Sensor:
    """Draw H within 0.3..5 e-, 8..20 DN per electron, s_e within 0.2..0.45 e-, bias about 100 DN."""
    level = np.exp(rng.uniform(np.log(0.7), np.log(3.2)))
    log_h = rng.uniform(0.1, 0.45) * rng.standard_normal(shape)
    log_h += rng.uniform(0.0, 0.25) * _smooth(rng, shape)
    exposure = np.clip(level * np.exp(log_h), 0.3, 5.0)
    step = rng.uniform(8.6, 19.0) * (1 + rng.uniform(0.005, 0.03) * rng.standard_normal(shape))
    noise = rng.uniform(0.22, 0.40) * np.exp(rng.uniform(0.03, 0.12) * rng.standard_normal(shape))
    bias = rng.uniform(85, 120) + rng.uniform(1, 6) * rng.standard_normal(shape)
    bias += rng.uniform(0, 3) * rng.standard_normal((1, shape[1]))
    return Sensor(
        exposure,
        np.clip(step, 8.0, 20.0),
        np.clip(bias, 70.0, 140.0),
        np.clip(noise, 0.2, 0.45),
        int(rng.choice([12, 14])),
        n_frames,
    )
