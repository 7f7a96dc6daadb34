"""Frames of a sensor without any effect, in plain numpy: ``round(mu + (K + s_e Z) / g)`` and nothing else.

It shares no code with the package. The parameters scatter over the pixels as those of real sensors do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class PlainCamera:
    """What a sensor is like; the spreads are of its pixels.

    Attributes:
        read_noise_e: median analog read noise, e-.
        exposure: median H, e-.
        step: median DN per electron.
        shape: rows and columns.
        n_frames: of the run.
        spread: relative spreads of H, DN per electron and read noise, and the spread of the bias, DN.
    """

    read_noise_e: float
    exposure: float
    step: float
    shape: tuple[int, int]
    n_frames: int
    spread: tuple[float, float, float, float] = (0.25, 0.015, 0.06, 3.0)

    def maps(self, rng: np.random.Generator) -> tuple[NDArray[np.float64], ...]:
        """Return H (e-), DN per electron, bias (DN) and read noise (e-) of the pixels, (y, x) each."""
        of_h, of_step, of_noise, of_bias = self.spread
        exposure = self.exposure * np.exp(of_h * rng.standard_normal(self.shape))
        step = self.step * np.exp(of_step * rng.standard_normal(self.shape))
        noise = self.read_noise_e * np.exp(of_noise * rng.standard_normal(self.shape))
        level = 60.0 + 10.0 * self.read_noise_e * self.step
        return exposure, step, level + of_bias * rng.standard_normal(self.shape), noise

    def frames(self, seed: int) -> NDArray[np.uint16]:
        """Return the frames (frame, y, x), DN."""
        rng = np.random.default_rng(seed)
        exposure, step, bias, noise = self.maps(rng)
        out = np.empty((self.n_frames, *self.shape), np.uint16)
        for t in range(self.n_frames):
            electrons = rng.poisson(exposure) + noise * rng.standard_normal(self.shape)
            out[t] = np.maximum(np.rint(bias + step * electrons), 0.0)
        return out


def drawn_camera(rng: np.random.Generator, most_samples: float = np.inf) -> PlainCamera:
    """Draw s_e 0.15 to 0.8, H 0.05 to 20, 3 to 30 DN per electron, 300 to 20,000 frames, 16 to 256 rows.

    Args:
        rng: of the draw.
        most_samples: frames x pixels; larger draws get fewer pixels, then fewer frames.
    """

    def between(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    frames = round(between(300, 20_000))
    rows, columns = (round(between(16, 256)) for _ in range(2))
    shrink = min(1.0, float(np.sqrt(most_samples / (frames * rows * columns))))
    rows, columns = max(16, int(rows * shrink)), max(16, int(columns * shrink))
    frames = int(min(frames, max(300, most_samples / (rows * columns))))
    spread = (between(0.05, 0.5), between(0.003, 0.03), between(0.02, 0.15), between(0.5, 8.0))
    return PlainCamera(
        between(0.15, 0.8), between(0.05, 20.0), between(3.0, 30.0), (rows, columns), frames, spread
    )
