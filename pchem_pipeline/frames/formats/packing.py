"""Packed samples of 10 or 12 bits: the ``p`` formats of GenICam, and those called ``Packed`` of GigE Vision.

GenICam (Pixel Format Naming Convention 2.1) writes one stream of bits, the lowest bit of a sample first. GigE
Vision writes two samples in three bytes: the high bits of each in its own, the low ones in the middle.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class _Place(NamedTuple):
    """Place of a sample in its group: byte, first bit and number of its low bits, byte of the others."""

    low: int
    shift: int
    n_low: int
    high: int


class Packing(NamedTuple):
    """How samples of so many bits are packed in groups of whole bytes, and their places in a group."""

    bits: int
    n_bytes: int
    places: tuple[_Place, ...]

    def span(self, first: int, end: int) -> tuple[int, int, int]:
        """Return first byte and end of the groups of samples first..end, and the samples before these."""
        n = len(self.places)
        return first // n * self.n_bytes, -(-end // n) * self.n_bytes, first % n

    def unpacked(self, data: NDArray[np.uint8]) -> NDArray[Any]:
        """Return the samples (n,) of bytes that are whole groups."""
        groups = data.reshape(-1, self.n_bytes)
        samples = np.empty((len(groups), len(self.places)), np.uint16)
        for sample, (low, shift, n_low, high) in zip(samples.T, self.places, strict=True):
            np.left_shift(groups[:, high], n_low, out=sample, dtype=np.uint16)
            sample &= (1 << self.bits) - 1
            sample |= (groups[:, low] >> shift) & ((1 << n_low) - 1)
        return samples.ravel()


def _stream(bits: int, n_samples: int) -> Packing:
    """Return the packing of a stream of bits, in which each sample ends in the byte after its first."""
    starts = [divmod(bits * number, 8) for number in range(n_samples)]
    places = tuple(_Place(byte, shift, 8 - shift, byte + 1) for byte, shift in starts)
    return Packing(bits, bits * n_samples // 8, places)


def _pairs(bits: int) -> Packing:
    """Return the packing of two samples in three bytes."""
    return Packing(bits, 3, (_Place(1, 0, bits - 8, 0), _Place(1, 4, bits - 8, 2)))


#: by the name that the standards have for it
PACKINGS = {
    "Mono10p": _stream(10, 4),
    "Mono12p": _stream(12, 2),
    "Mono10Packed": _pairs(10),
    "Mono12Packed": _pairs(12),
}
