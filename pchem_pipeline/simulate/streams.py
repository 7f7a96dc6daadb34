"""Random numbers keyed on (root seed, purpose, frame, y, x): the same at every tiling and backend.

Philox4x32-10 (Salmon et al. 2011) as a function from position to bits: the key is a hash of the seed and
of what the numbers are for, the counter is the position. numpy has the same generator, but a keyed number
costs 35 us there, since each key takes a generator of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from hashlib import blake2b
from typing import TYPE_CHECKING

import numpy as np

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.simulate.streams_numba import fill_uniform, normal_from_uniform, poisson_from_uniform

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pchem_pipeline.effects.framework.context import Dim

Key = tuple[np.uint64, np.uint64]

# counter word of a dimension along which the numbers do not differ
_COLLAPSED = np.array([0xFFFFFFFF], dtype=np.uint64)
_DIMS: tuple[Dim, ...] = ("frame", "y", "x")


def make_key(seed: int, purpose: str) -> Key:
    """Return the Philox key (two 32-bit words) of a purpose under a root seed."""
    digest = blake2b(f"{seed}/{purpose}".encode(), digest_size=8).digest()
    return np.uint64(int.from_bytes(digest[:4], "little")), np.uint64(int.from_bytes(digest[4:], "little"))


def to_words(coordinates: IntArray) -> NDArray[np.uint64]:
    """Return coordinates as 32-bit counter words; negative ones wrap around."""
    return (coordinates & 0xFFFFFFFF).astype(np.uint64)


def uniform_pair(
    key: Key, frames: NDArray[np.uint64], ys: NDArray[np.uint64], xs: NDArray[np.uint64], draw: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Return the two independent uniforms in (0, 1) of every (frame, y, x), each of 52 bits."""
    shape = (frames.size, ys.size, xs.size)
    first, second = np.empty(shape), np.empty(shape)
    fill_uniform(frames, ys, xs, np.uint64(draw), *key, first, second)
    return first, second


def normal_quantile(p: FloatArray) -> FloatArray:
    """Return standard normal quantiles (Wichura 1988, AS 241, relative error about 1e-16)."""
    out = np.empty(p.size)
    normal_from_uniform(np.ascontiguousarray(p).reshape(-1), out)
    return out.reshape(p.shape)


def poisson_quantile(u: FloatArray, mean: FloatArray) -> IntArray:
    """Return the smallest k with P(K <= k) >= u, K ~ Poisson(mean); ``mean`` broadcasts against ``u``."""
    out = np.empty(u.size, np.int64)
    means = np.ascontiguousarray(np.broadcast_to(mean, u.shape)).reshape(-1)
    poisson_from_uniform(np.ascontiguousarray(u).reshape(-1), means, out)
    return out.reshape(u.shape)


@dataclass(frozen=True)
class KeyedStreams:
    """The random numbers of one purpose for a block of frames and a band of rows: a ``RandomSource``."""

    seed: int  # root seed of the run
    purpose: str  # what the numbers are for; other purposes get independent numbers
    frames: IntArray  # frame numbers of the block
    rows: IntArray  # sensor rows of the band
    columns: IntArray  # sensor columns, all of them

    def uniform(self, dims: tuple[Dim, ...], draw: int = 0) -> FloatArray:
        """Return uniform numbers in (0, 1), with length 1 along the dimensions not in ``dims``."""
        unknown = set(dims) - set(_DIMS)
        if unknown:
            raise ValueError(f"unknown dimension {sorted(unknown)}; use some of {list(_DIMS)}")
        # the dims are part of the key: one number per row is not the row's number per pixel
        name = ",".join(dim for dim in _DIMS if dim in dims)
        frames, ys, xs = (
            to_words(axis) if dim in dims else _COLLAPSED
            for dim, axis in zip(_DIMS, (self.frames, self.rows, self.columns), strict=True)
        )
        return uniform_pair(make_key(self.seed, f"{self.purpose}/{name}"), frames, ys, xs, draw)[0]

    def normal(self, dims: tuple[Dim, ...], draw: int = 0) -> FloatArray:
        """Return standard normal numbers, with length 1 along the dimensions not in ``dims``."""
        other = replace(self, purpose=f"{self.purpose}/normal")
        return normal_quantile(other.uniform(dims, draw))

    def poisson(self, mean: FloatArray, draw: int = 0) -> IntArray:
        """Return Poisson numbers of the given mean (frame, y, x), one per sample."""
        other = replace(self, purpose=f"{self.purpose}/poisson")
        return poisson_quantile(other.uniform(_DIMS, draw), mean)

    def generator(
        self, *, frame: int | None = None, y: int | None = None, x: int | None = None, draw: int = 0
    ) -> np.random.Generator:
        """Return a generator of its own for a frame, row, pixel or sample (whole run if none is given)."""
        name = f"{self.seed}/{self.purpose}/generator/{frame}/{y}/{x}/{draw}"
        key = int.from_bytes(blake2b(name.encode(), digest_size=16).digest(), "little")
        return np.random.Generator(np.random.Philox(key=key))
