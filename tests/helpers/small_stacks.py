"""Small simulated stacks for the tests of the statistics."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.simulate.chain import simulate_block
from pchem_pipeline.simulate.maps import draw_truth
from pchem_pipeline.simulate.settings import SimulateSettings

PARAMETERS: dict[str, Any] = {
    "quanta_exposure": {"kind": "uniform", "low": 0.5, "high": 3.0},
    "dn_per_electron": {"kind": "normal", "mean": 11.0, "std": 0.8},
    "analog_read_noise_e": {"kind": "normal", "mean": 0.27, "std": 0.02},
    "hot_pixels": {"fraction": 0.0},
}


class Stack:
    """Frames in memory, as a source; counts how often each row of a frame was read."""

    def __init__(self, values: NDArray[Any]) -> None:
        self.values, self.shape, self.dtype, self.rows_per_read = values, values.shape, values.dtype, 1
        self.read = np.zeros(values.shape[:2], int)

    def read_into(self, buffer: NDArray[Any], t0: int, t1: int, y0: int = 0, y1: int | None = None) -> None:
        buffer[...] = self.values[t0:t1, y0:y1]
        self.read[t0:t1, y0:y1] += 1


def small_stack(
    shape: tuple[int, int],
    n_frames: int,
    seed: int,
    effects: Sequence[dict[str, Any]] = (),
    **parameters: Any,
) -> NDArray[np.uint16]:
    """Return frames (n_frames, y, x) of a sensor of its own for each seed."""
    settings = SimulateSettings(
        shape=shape, n_frames=n_frames, seed=seed, parameters=PARAMETERS | parameters, effects=tuple(effects)
    )
    frames, _ = simulate_block(draw_truth(settings), settings, (0, n_frames), electron_frames=0)
    return frames.astype(np.uint16)
