"""What an effect knows of the block of frames that it acts on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray, IntArray

Dim = Literal["frame", "y", "x"]
#: What the random numbers depend on that samples, or all samples of a row, column or frame, have.
DIMS: Mapping[str, tuple[Dim, ...]] = {
    "sample": ("frame", "y", "x"),
    "row": ("frame", "y"),
    "column": ("frame", "x"),
    "frame": ("frame",),
}

#: As many rows as any sensor has: the halo of an effect that reaches across all of it.
ALL_ROWS = 1 << 20


class RandomSource(Protocol):
    """Random numbers of one effect, keyed on position: the same at every tiling.

    ``dims`` names the dimensions along which the numbers differ; along the others there is one number for
    all. ``("frame", "y")`` gives each row of each frame its own number, shape (n_frames, n_rows, 1), whatever
    block or band is being simulated, ``()`` one number for the whole run. ``draw`` tells independent sets
    apart.
    """

    def uniform(self, dims: tuple[Dim, ...], draw: int = 0) -> FloatArray:
        """Return uniform numbers in (0, 1), with length 1 along the dimensions not in ``dims``."""
        ...

    def normal(self, dims: tuple[Dim, ...], draw: int = 0) -> FloatArray:
        """Return standard normal numbers, with length 1 along the dimensions not in ``dims``."""
        ...

    def poisson(self, mean: FloatArray, draw: int = 0) -> IntArray:
        """Return Poisson numbers of the given mean (frame, y, x), one per sample."""
        ...

    def generator(
        self, *, frame: int | None = None, y: int | None = None, x: int | None = None, draw: int = 0
    ) -> np.random.Generator:
        """Return a generator of its own for a frame, row, pixel or sample (whole run if none is given).

        For numbers of which it is not known beforehand how many are needed: tracks in a frame,
        dwell times of a trap. Costs some 20 microseconds, so not for every sample.
        """
        ...


@dataclass(frozen=True)
class EffectContext:
    """A block of frames and a band of rows, seen from an effect.

    All arrays broadcast against (frame, y, x) and are read-only.

    Attributes:
        frames: frame numbers of the block. The run is ``0 .. n_frames - 1``; negative numbers
            are frames before the run, simulated only for effects that ask for ``history``.
        n_frames: number of frames of the whole run.
        rows: sensor rows of the band, ``halo`` rows included; columns are always complete.
        shape: rows and columns of the whole sensor, px.
        integration_time: s.
        bit_depth: bits of the ADC.
        truth: maps of the band (y, x): ``quanta_exposure`` (e-), ``conversion_gain`` (e-/DN),
            ``bias`` (DN), ``analog_read_noise_e`` (e-).
        random: this effect's own random numbers.
        exposure: H_t behind the EXPOSURE plane, e-; ``None`` before that.
        charge: electron number K behind the CHARGE plane, e-; ``None`` before that.
        read_noise: the read noise R that was added, e-; ``None`` before ANALOG.
    """

    frames: IntArray
    n_frames: int
    rows: IntArray
    shape: tuple[int, int]
    integration_time: float
    bit_depth: int
    truth: Mapping[str, FloatArray]
    random: RandomSource
    exposure: NDArray[Any] | None = None
    charge: NDArray[Any] | None = None
    read_noise: NDArray[Any] | None = None
