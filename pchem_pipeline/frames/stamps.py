"""Frames that are missing or repeated, by the numbers that the camera gave to them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from pchem_pipeline.frames.reader import FrameReader

_LISTED = 4


def stamp_notes(readers: Sequence[FrameReader], frame_range: tuple[int, int | None] | None) -> list[str]:
    """Return a remark on missing and repeated frames; empty where there are none, or no stamps.

    From one file to the next nothing is judged: cameras count each recording anew. Nor are stamps that mostly
    do not rise evenly, which are no counts.

    Args:
        readers: of the files, in their order.
        frame_range: first frame and end of those that are used; None: all.
    """
    first, end = frame_range or (0, None)
    total = sum(reader.shape[0] for reader in readers)
    end = total if end is None else min(end, total)
    missing, start = 0, 0
    after: list[int] = []
    repeated: list[int] = []
    back: list[int] = []
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
        f"by the camera's count of frames {' and '.join(found)}; values of single pixels hold; for what "
        f"changes in time a part without gaps is input.frame_range: [{a}, {b}] (--frames {a}:{b})"
    ]


def _are(number: int) -> str:
    return "is" if number == 1 else "are"


def _places(numbers: Sequence[int]) -> str:
    """Return the first frames of a list, in words."""
    listed = ", ".join(map(str, numbers[:_LISTED]))
    more = f" and {len(numbers) - _LISTED} more" if len(numbers) > _LISTED else ""
    return f"frame{'s' * (len(numbers) > 1)} {listed}{more}"
