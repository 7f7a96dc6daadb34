"""What something hidden is: hooks along the signal chain, called once per frame, in the order of time."""

import re
from typing import Any, ClassVar

import numpy as np

from hidden.sensor import Sensor


class Hidden:
    """Base of all that can be hidden; every hook leaves things as they are.

    Attributes:
        tag: the name that the workflow should find, of the words of the class.
        s95: strength at level 1 for 64 x 64 pixels and 4000 frames (the strength that is found in 95 % of
            stacks), in the unit of the effect.
        scaling: powers of 64 / rows, 64 / columns and 4000 / frames with which s95 goes.
        most: largest strength that makes sense.
        warmup: frames to run before the first one is kept.
        order: of what has the same hook: what stands later along the chain comes later.
    """

    tag: ClassVar[str] = ""
    s95: ClassVar[float] = 1.0
    scaling: ClassVar[tuple[float, float, float]] = (0.5, 0.5, 0.5)
    most: ClassVar[float] = np.inf
    warmup: ClassVar[int] = 0
    order: ClassVar[int] = 0

    def __init_subclass__(cls, **attributes: Any) -> None:
        """Name the effect, and set what is said of it beside its base."""
        cls.tag = re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()
        for name, value in attributes.items():
            setattr(cls, name, value)

    def __init__(self, rng: np.random.Generator, sensor: Sensor, level: float):
        """Draw the sub-parameters of the effect for a sensor."""
        self.rng = rng
        self.sensor = sensor
        self.level = level
        (ny, nx), nt = sensor.shape, sensor.n_frames
        a, b, c = self.scaling
        size = (64 / ny) ** a * (64 / nx) ** b * (4000 / nt) ** c
        self.strength = float(min(level * self.s95 * size, self.most))
        self.parameters: dict[str, Any] = {}
        #: pixels whose samples the effect changes
        self.affected = np.ones(sensor.shape, bool)
        self.draw()

    def draw(self) -> None:
        """Draw sub-parameters, and write them to ``parameters``."""

    def exposure(self, t: int, h: np.ndarray) -> np.ndarray:
        """Mean number of electrons of frame t, e-."""
        return h

    def electrons(self, t: int, k: np.ndarray) -> np.ndarray:
        """Number of electrons in the wells."""
        return k

    def signal(self, t: int, v: np.ndarray) -> np.ndarray:
        """Signal at the sense node without noise, e-."""
        return v

    def noise(self, t: int, n: np.ndarray, k: np.ndarray) -> np.ndarray:
        """Read noise, e-, of pixels that hold k electrons."""
        return n

    def gain(self, t: int) -> float:
        """Factor of the DN per electron."""
        return 1.0

    def voltage(self, t: int, dn: np.ndarray) -> np.ndarray:
        """Input of the converter, DN, before rounding."""
        return dn

    def convert(self, t: int, dn: np.ndarray, code: np.ndarray) -> np.ndarray:
        """Code of each sample; ``code`` is what an ideal converter gives."""
        return code

    def record(self, t: int, frames: np.ndarray) -> None:
        """Change frame t, and no later one, in the stack."""

    def finish(self, frames: np.ndarray) -> None:
        """Change the whole stack."""

    def some_pixels(self, fraction: float) -> tuple[np.ndarray, np.ndarray]:
        """Choose a fraction of the pixels (at least one); they are the affected ones."""
        n = max(1, round(fraction * self.sensor.n_pixels))
        chosen = self.rng.choice(self.sensor.n_pixels, min(n, self.sensor.n_pixels), replace=False)
        where = np.unravel_index(np.sort(chosen), self.sensor.shape)
        self.affected = np.zeros(self.sensor.shape, bool)
        self.affected[where] = True
        return where

    def pick(self, name: str, *choices: Any, p: tuple[float, ...] | None = None) -> Any:
        """Choose one of several kinds and note it."""
        self.parameters[name] = choices[self.rng.choice(len(choices), p=p)]
        return self.parameters[name]

    def between(self, name: str, low: float, high: float, *, log: bool = False) -> float:
        """Draw a number between two limits and note it."""
        value = self.rng.uniform(low, high) if not log else np.exp(self.rng.uniform(*np.log([low, high])))
        self.parameters[name] = float(value)
        return self.parameters[name]

    def sign(self, negative: float = 0.5) -> int:
        """Draw a sign and note it."""
        self.parameters["sign"] = -1 if self.rng.random() < negative else 1
        return self.parameters["sign"]


class Course:
    """A slow course along the run: 0 in the mean, 1 from its lowest to its highest value."""

    def __init__(self, effect: Hidden):
        """Draw the shape for an effect, which notes it."""
        n = effect.sensor.n_frames
        u = np.arange(n) / max(n - 1, 1)
        shape = effect.pick("shape", "linear", "exponential", "sine")
        if shape == "linear":
            course = u
        elif shape == "exponential":
            course = np.exp(-u / effect.between("time_constant_runs", 0.08, 0.5))
        else:
            turns, phase = effect.between("turns", 0.6, 3.0), effect.between("phase", 0, 2 * np.pi)
            course = np.sin(2 * np.pi * turns * u + phase)
        course = (course - course.mean()) / max(np.ptp(course), 1e-12)
        self.values = effect.sign() * course

    def __call__(self, t: int) -> float:
        """Value at frame t."""
        return float(self.values[max(t, 0)])


def telegraph(rng: np.random.Generator, n: int, tau_low: float, tau_high: float) -> np.ndarray:
    """A two-level Markov course of n frames, 0 or 1, with mean dwell times in frames."""
    course, t = np.zeros(n), 0
    state = int(rng.random() < tau_high / (tau_low + tau_high))
    while t < n:
        dwell = max(1, round(rng.exponential(tau_high if state else tau_low)))
        course[t : t + dwell] = state
        t, state = t + dwell, 1 - state
    return course
