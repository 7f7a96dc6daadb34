"""Numbers that a camera gives to its frames: which are missing, and which pixels hold them, not samples.

Cameras can write the number of a frame, its time and more into its first pixels: PCO two decimal digits a
pixel (BCD) into 16, and a text of 8 x 271 pixels beside them (manuals of pco.edge and pco.ultraviolet), FLIR
up to ten numbers of 4 bytes. What they have in common is a byte that counts the frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray
from pchem_pipeline.base.errors import InputError
from pchem_pipeline.base.wording import first_few
from pchem_pipeline.frames.reader import FrameReader

if TYPE_CHECKING:
    from pchem_pipeline.frames.sequence import FrameSequence

#: bytes of a frame that may hold a stamp; rows and columns of a text beside it
_STAMP_BYTES, _TEXT = 40, (8, 271)
#: frames that must be counted: few that tell most stacks, and all that are looked at
_FRAMES = (5, 16)


def stamp_notes(readers: Sequence[FrameReader], frame_range: tuple[int, int | None] | None) -> list[str]:
    """Return a remark on missing and repeated frames; empty where there are none, or no stamps.

    From one file to the next nothing is judged: cameras count each recording anew. Nor are stamps that mostly
    do not rise evenly, which are no counts.
    """
    first, end = frame_range or (0, None)
    total = sum(reader.shape[0] for reader in readers)
    end = total if end is None else min(end, total)
    missing, start = 0, 0
    after, repeated, back = list[int](), list[int](), list[int]()
    for reader in readers:
        a, b = max(first, start), min(end, start + reader.shape[0])
        if reader.frame_stamps is not None and b - a > 1:
            steps = np.diff(reader.frame_stamps[a - start : b - start])
            usual = int(np.quantile(steps, 0.5, method="lower"))
            if usual > 0 and 2 * np.count_nonzero(steps == usual) > steps.size:
                missing += int((steps // usual - 1)[steps > usual].sum())
                after += (a + np.flatnonzero(steps > usual)).tolist()
                repeated += (a + 1 + np.flatnonzero(steps == 0)).tolist()
                back += (a + np.flatnonzero((steps < usual) & (steps != 0))).tolist()
        start += reader.shape[0]
    found = []
    if after:
        found.append(f"{missing} {_are(missing)} missing (after {_places(after)})")
    if repeated:
        found.append(f"{len(repeated)} {_are(len(repeated))} repeated ({_places(repeated)})")
    if back:
        found.append(f"the numbers go back (after {_places(back)})")
    if not found:
        return []
    edges = sorted({first, end, *(t + 1 for t in after + back), *repeated})
    a, b = max(pairwise(edges), key=lambda part: part[1] - part[0])
    return [
        f"the camera's count of frames: {' and '.join(found)}; values of pixels are right, what is found in "
        f"time can be off; the longest part without gaps: input.frame_range: [{a}, {b}] (--frames {a}:{b})"
    ]


def _are(number: int) -> str:
    return "is" if number == 1 else "are"


def _places(numbers: Sequence[int]) -> str:
    """Return the first frames of a list, in words."""
    return f"frame{'s' * (len(numbers) > 1)} {first_few(numbers)}"


def stamped_pixels(frames: FrameSequence) -> BoolArray | None:
    """Return the pixels (y, x) of the files' frames that hold a stamp; None where the frames have none."""
    size = frames.dtype.itemsize
    if frames.shape[0] < _FRAMES[-1] or frames.whole_shape[1] * size < _STAMP_BYTES:
        return None
    width = _STAMP_BYTES // size
    try:
        if not all(_counts_frames(frames.top_rows(n, 1)[:, 0, :width]) for n in _FRAMES):
            return None
        beside = frames.top_rows(1, _TEXT[0])[0, :, width : _TEXT[1]]
    except InputError:
        return None  # reading the frames will say so
    stamped = np.zeros(frames.whole_shape, np.bool_)
    stamped[0, :width] = True
    if np.unique(beside).size == 2:  # black and white
        stamped[: _TEXT[0], : _TEXT[1]] = True
    return stamped


def _counts_frames(pixels: NDArray[Any]) -> bool:
    """Return whether a byte of the pixels (frame, x) rises by one per frame, in binary or in BCD."""
    used = int(np.bitwise_or.reduce(pixels, axis=None))
    shift = max((used & -used).bit_length() - 1, 0)  # left-justified
    values = np.ascontiguousarray(pixels >> shift).view(np.uint8)
    digits = np.stack([values >> 4, values & 15]).astype(np.int64)
    binary = np.diff(values, axis=0) == 1
    steps = np.diff(10 * digits[0] + digits[1], axis=0)
    decimal = (steps % 100 == 1) & (digits[:, 1:].max(axis=0) < 10)
    counting = (binary.all(axis=0) | decimal.all(axis=0)).reshape(pixels.shape[1], -1).any(axis=1)
    return bool(0 < 2 * counting.sum() < counting.size)  # where more rise, it is the light
