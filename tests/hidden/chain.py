"""The forward chain: sensor and electrons, one frame after the other."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hidden import effects_decoys, effects_light, effects_noise, effects_other, effects_readout
from hidden.base import Hidden
from hidden.sensor import Sensor, draw_sensor


def _all_of(module) -> dict[str, type[Hidden]]:
    classes = [v for v in vars(module).values() if isinstance(v, type) and issubclass(v, Hidden)]
    return {c.tag: c for c in classes if c.tag}


LIBRARY = _all_of(effects_light) | _all_of(effects_noise) | _all_of(effects_readout)
UNTESTABLE = ("charge_lag", "charge_diffusion", "spurious_charge")
#: of effects of the library, with the name that they are to be given
VARIANTS = {"herring_bone": "periodic_pickup"}
OUTSIDE = tuple(tag for tag in _all_of(effects_other) if tag not in {*UNTESTABLE, *VARIANTS})
DECOYS = _all_of(effects_decoys)
ALL = LIBRARY | _all_of(effects_other) | DECOYS


@dataclass(frozen=True)
class Hiding:
    """A stack and all that is known of it.

    Attributes:
        frames: uint16, (frame, y, x).
        sensor: its true maps.
        effects: what is hidden in it.
        seed: of all its random numbers.
    """

    frames: np.ndarray
    sensor: Sensor
    effects: tuple[Hidden, ...]
    seed: int

    def key(self) -> dict[str, Any]:
        """What to seal."""
        names = ("tag", "level", "strength", "parameters")
        effects = [
            {name: getattr(effect, name) for name in names} | {"affected_pixels": int(effect.affected.sum())}
            for effect in self.effects
        ]
        facts = {"n_frames": self.sensor.n_frames, "bits": self.sensor.bits, "effects": effects}
        return {"seed": self.seed, "shape": list(self.sensor.shape), **facts}

    def seal(self, path: Path) -> None:
        """Write the key, and the maps beside it (.npz)."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(self.key(), indent=1))
        affected = {f"affected_{effect.tag}": effect.affected for effect in self.effects}
        np.savez(
            path.with_suffix(".npz"),
            quanta_exposure=self.sensor.exposure,
            conversion_gain=1 / self.sensor.step,
            bias=self.sensor.bias,
            read_noise_e=self.sensor.noise,
            **affected,
        )


def hide(
    tags: tuple[str, ...],
    level: float,
    seed: int,
    shape: tuple[int, int] = (64, 64),
    n_frames: int = 4000,
    take: int = 0,
) -> Hiding:
    """Make a stack with the named effects in it.

    The sensor and the random numbers of the plain chain depend on the seed alone, not on what is hidden;
    another ``take`` is the same sensor with other electrons and other noise.
    """
    unknown = [tag for tag in tags if tag not in ALL]
    if unknown:
        raise SystemExit(f"nothing known as {', '.join(unknown)}; there are {', '.join(sorted(ALL))}")
    streams = np.random.SeedSequence(seed).spawn(3 + 2 * take)
    sensor = draw_sensor(np.random.default_rng(streams[0]), shape, n_frames)
    # each effect has the same numbers whatever it is hidden with
    hidden = (ALL[tag](np.random.default_rng([seed, *tag.encode()]), sensor, level) for tag in tags)
    # lines that are repeated are codes, and not converted again
    effects = tuple(sorted(hidden, key=lambda effect: effect.order))
    light, dark = (np.random.default_rng(stream) for stream in streams[-2:])
    frames = np.zeros((n_frames, *shape), np.uint16)
    for t in range(-max([e.warmup for e in effects], default=0), n_frames):
        code = _one_frame(t, sensor, effects, light, dark)
        if t >= 0:
            frames[t] = code
            for effect in effects:
                effect.record(t, frames)
    for effect in effects:
        effect.finish(frames)
    return Hiding(frames, sensor, effects, seed)


def _one_frame(
    t: int, sensor: Sensor, effects: tuple[Hidden, ...], light: np.random.Generator, dark: np.random.Generator
) -> np.ndarray:
    def through(hook: str, value: np.ndarray, *more: np.ndarray) -> np.ndarray:
        for effect in effects:
            value = getattr(effect, hook)(t, value, *more)
        return value

    k = through("electrons", light.poisson(through("exposure", sensor.exposure)))
    v = through("signal", k.astype(float))
    n = through("noise", sensor.noise * dark.standard_normal(sensor.shape), k)
    step = sensor.step
    for effect in effects:
        step = step * effect.gain(t)
    dn = through("voltage", sensor.bias + step * (v + n))
    most = 2**sensor.bits - 1
    code = np.clip(np.floor(dn + 0.5).astype(np.int64), 0, most)
    for effect in effects:
        code = np.clip(effect.convert(t, dn, code), 0, most)
    return code
