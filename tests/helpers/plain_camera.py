"""Frames of a sensor without any effect, in plain numpy: ``round(mu + (K + s_e Z) / g)`` and nothing else.

It shares no code with the package. The parameters scatter over the pixels as those of real sensors do, and
may be laid out as there: by taps, columns or quadrants, under a lens, with reference columns or dead pixels.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass
class _Maps:
    """H (e-), DN per electron, bias (DN) and read noise (e-) of the pixels, (y, x) each."""

    exposure: NDArray[np.float64]
    step: NDArray[np.float64]
    bias: NDArray[np.float64]
    noise: NDArray[np.float64]


def _even(maps: _Maps, rng: np.random.Generator) -> None:
    """Leave all as it is."""


def _vignetted(maps: _Maps, rng: np.random.Generator) -> None:
    """Light falls off to the corners, to a twentieth."""
    y, x = (np.linspace(-1.0, 1.0, n) for n in maps.exposure.shape)
    maps.exposure *= np.exp(-1.5 * (y[:, None] ** 2 + x**2))


def _hot(maps: _Maps, rng: np.random.Generator) -> None:
    """One pixel in fifty has up to forty times the exposure."""
    some = rng.random(maps.exposure.shape) < 0.02
    maps.exposure[some] *= rng.uniform(5.0, 40.0, int(some.sum()))


def _columns(maps: _Maps, rng: np.random.Generator) -> None:
    """Each column has a converter of its own."""
    columns = maps.step.shape[1]
    maps.step *= np.exp(0.1 * rng.standard_normal(columns))
    maps.bias += 20.0 * rng.standard_normal(columns)


def _taps(maps: _Maps, rng: np.random.Generator) -> None:
    """The right half has an amplifier of its own."""
    half = np.s_[:, maps.step.shape[1] // 2 :]
    maps.step[half] *= 1.12
    maps.bias[half] += 80.0
    maps.noise[half] *= 1.2


def _quadrants(maps: _Maps, rng: np.random.Generator) -> None:
    """So has each quadrant."""
    rows, columns = (n // 2 for n in maps.step.shape)
    for number, quadrant in enumerate(
        (np.s_[:rows, columns:], np.s_[rows:, :columns], np.s_[rows:, columns:])
    ):
        maps.step[quadrant] *= 1.1 + 0.1 * number
        maps.bias[quadrant] += 40.0 * (1 + number)
        maps.noise[quadrant] *= 1.15 + 0.15 * number


def _noisy_few(maps: _Maps, rng: np.random.Generator) -> None:
    """Read noise has the tail of real sensors: a few pixels have several times that of most."""
    maps.noise *= np.exp(0.15 * np.minimum(np.abs(rng.standard_cauchy(maps.noise.shape)), 13.0))


def _overscan(maps: _Maps, rng: np.random.Generator) -> None:
    """Columns without light, and rows with hardly any."""
    maps.exposure[:, -max(maps.exposure.shape[1] // 10, 2) :] = 0.0
    maps.exposure[:2] = 0.003


def _mosaic(maps: _Maps, rng: np.random.Generator) -> None:
    """A mosaic of colours."""
    maps.exposure[::2, ::2] *= 0.45
    maps.exposure[1::2, 1::2] *= 0.8


def _stars(maps: _Maps, rng: np.random.Generator) -> None:
    """A dozen stars, up to a hundred times as bright as the sky."""
    y, x = np.indices(maps.exposure.shape)
    for _ in range(12):
        row, column = (rng.uniform(0.0, n) for n in maps.exposure.shape)
        peak = np.exp(rng.uniform(np.log(3.0), np.log(100.0)))
        maps.exposure *= 1.0 + peak * np.exp(-((y - row) ** 2 + (x - column) ** 2) / 4.0)


def _dead(maps: _Maps, rng: np.random.Generator) -> None:
    """One pixel in fifty says the same always."""
    some = rng.random(maps.exposure.shape) < 0.02
    maps.exposure[some] = maps.noise[some] = 0.0


#: Ways in which the pixels of a sensor differ by their place.
LAYOUTS = {
    layout.__name__[1:]: layout
    for layout in (
        _even, _vignetted, _hot, _columns, _taps, _quadrants, _noisy_few, _overscan, _mosaic, _stars, _dead
    )
}  # fmt: skip


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
        layout: how the pixels differ by their place, one of `LAYOUTS`.
    """

    read_noise_e: float
    exposure: float
    step: float
    shape: tuple[int, int]
    n_frames: int
    spread: tuple[float, float, float, float] = (0.25, 0.015, 0.06, 3.0)
    layout: str = "even"

    def maps(self, rng: np.random.Generator) -> tuple[NDArray[np.float64], ...]:
        """Return H (e-), DN per electron, bias (DN) and read noise (e-) of the pixels, (y, x) each."""
        of_h, of_step, of_noise, of_bias = self.spread
        exposure = self.exposure * np.exp(of_h * rng.standard_normal(self.shape))
        step = self.step * np.exp(of_step * rng.standard_normal(self.shape))
        noise = self.read_noise_e * np.exp(of_noise * rng.standard_normal(self.shape))
        level = 60.0 + 10.0 * self.read_noise_e * self.step
        maps = _Maps(exposure, step, level + of_bias * rng.standard_normal(self.shape), noise)
        LAYOUTS[self.layout](maps, rng)
        return maps.exposure, maps.step, maps.bias, maps.noise

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

    And a layout.

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
    median = between(0.15, 0.8), between(0.05, 20.0), between(3.0, 30.0)
    return PlainCamera(*median, (rows, columns), frames, spread, str(rng.choice([*LAYOUTS])))
