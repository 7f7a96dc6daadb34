"""Effects outside the library, for the demonstration: whatever gets a name there is named wrongly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Frames = NDArray[np.unsignedinteger[Any]]


@dataclass(frozen=True)
class Unlisted:
    """An effect that acts on the digital numbers of a camera's frames.

    Attributes:
        tag: its name; no effect of the library has it.
        words: what it does.
        change: of frames (frame, y, x), in DN, given the number of the first one and random numbers that are
            keyed on it.
    """

    tag: str
    words: str
    change: Callable[[NDArray[np.int64], int, np.random.Generator], NDArray[np.int64]]

    def applied(self, frames: Frames, first: int, seed: int) -> Frames:
        """Return frames of the camera, the number of the first one being ``first``, with the effect."""
        rng = np.random.default_rng([seed, 0xDEC0, first])
        changed = self.change(frames.astype(np.int64), first, rng)
        return np.clip(changed, 0, np.iinfo(frames.dtype).max).astype(frames.dtype)


def _averaged(dn: NDArray[np.int64], first: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Replace samples by the mean with the frame before, in a twentieth of the frames."""
    chosen = np.flatnonzero(rng.random(dn.shape[0]) < 0.05)
    chosen = chosen[chosen > 0]
    dn[chosen] = (dn[chosen] + dn[chosen - 1] + 1) // 2
    return dn


def _late(dn: NDArray[np.int64], first: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Read rows one column late, three in a hundred."""
    late = rng.random(dn.shape[:2]) < 0.03
    return np.asarray(np.where(late[:, :, None], np.roll(dn, 1, axis=2), dn))


def _ghost(dn: NDArray[np.int64], first: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Add to each sample a hundredth and a half of what the mirrored column deviates from its mean."""
    mirrored = dn[:, :, ::-1] - np.median(dn, axis=0)[:, ::-1]
    # rounded at random, so that the ghost has no steps of its own
    return np.asarray(dn + np.floor(0.015 * mirrored + rng.random(dn.shape)).astype(np.int64))


def _sparks(dn: NDArray[np.int64], first: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Light a corner in one frame of fifty."""
    y, x = np.indices(dn.shape[1:])
    glow = np.exp(-np.hypot(y, x) / (max(dn.shape[1:]) / 5))
    bursts = np.flatnonzero(rng.random(dn.shape[0]) < 0.02)
    # in DN of a typical electron: half of one at the corner
    step = 8
    dn[bursts] += step * rng.poisson(0.5 * glow, (bursts.size, *glow.shape))
    return dn


#: The effects, by their names.
UNLISTED = {
    each.tag: each
    for each in (
        Unlisted("averaged_frames", "some frames are the mean with the frame before", _averaged),
        Unlisted("late_rows", "some rows are read one column late", _late),
        Unlisted("mirror_ghost", "each sample holds a hundredth of the one in the mirrored column", _ghost),
        Unlisted("corner_sparks", "a corner lights up in one frame of fifty", _sparks),
    )
}
