"""The arrays behind regions and times: maps of pixels, masks of frames, runs and ranges of them.

Apart from :mod:`.region`, since the YAML is read without numpy.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, IntArray
from pchem_pipeline.base.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pchem_pipeline.effects.framework.region import Region, Span, Taps, When


# a set of pixels longer than that is no place that anybody could read; it would not fit a YAML either
_MOST_RUNS = 20_000


def region_mask(region: Region, shape: tuple[int, ...], rows: IntArray | None = None) -> BoolArray:
    """Return which pixels (y, x) of a sensor lie in a region, see :meth:`.region.Region.mask`.

    Raises:
        ConfigError: it reaches beyond the sensor.
    """
    _check(region, shape)
    y = np.arange(shape[0]) if rows is None else np.asarray(rows)
    x = np.arange(shape[1])
    inside = (_within(region.rows, y) & _in_taps(region.taps, "rows", y))[:, None]
    inside = inside & _within(region.columns, x) & _in_taps(region.taps, "columns", x)
    if region.quadrant is not None:
        inside &= ((y < shape[0] // 2) == region.quadrant.startswith("top"))[:, None]
        inside &= (x < shape[1] // 2) == region.quadrant.endswith("left")
    if region.pixels:
        listed = np.zeros(shape, np.bool_)
        for row, first, last in region.pixels:
            listed[row, first:last] = True
        inside &= listed[y]
    return np.asarray(inside)


def _check(region: Region, shape: tuple[int, ...]) -> None:
    """Refuse what lies beyond the sensor."""
    ends = {
        "rows": [last for _, last in region.rows] + [row + 1 for row, _, _ in region.pixels],
        "columns": [last for _, last in region.columns] + [last for _, _, last in region.pixels],
    }
    for (name, beyond), size in zip(ends.items(), shape, strict=True):
        if beyond and max(beyond) > size:
            raise ConfigError(
                f"region: {region.describe()}: the sensor has {size} {name}, counted from 0; correct it"
            )


def _within(spans: Sequence[Span], numbers: IntArray) -> BoolArray:
    """Return which numbers lie in some range; all where there is no range."""
    inside = np.full(numbers.shape, not spans)
    for first, last in spans:
        inside |= (numbers >= first) & (numbers < last)
    return inside


def _in_taps(taps: Taps | None, along: str, numbers: IntArray) -> BoolArray:
    """Return which of these rows or columns belong to taps; all where those group the others."""
    if taps is None or taps.along != along:
        return np.ones(numbers.shape, np.bool_)
    group = (numbers - taps.first) // taps.width
    return np.isin(group if taps.every is None else group % taps.every, taps.which)


def frames_of(when: When, numbers: IntArray) -> BoolArray:
    """Return which of these frames are meant, shape of ``numbers``; those before the run never are."""
    inside = _within(when.range, numbers) & (numbers >= 0)
    if when.every is not None:
        inside &= (numbers - when.phase) % when.every < when.length
    if when.single:
        inside &= np.isin(numbers, when.single)
    return inside


def overlap(one: BoolArray, other: BoolArray) -> float:
    """Return the elements of both sets over those of either (Jaccard's index), 0 to 1; of empty ones 0."""
    either = int((one | other).sum())
    return float((one & other).sum() / either) if either else 0.0


def simplest_region(mask: BoolArray) -> dict[str, Any]:
    """Return the fields of the region of a map of pixels, see :meth:`.region.Region.of_mask`.

    Raises:
        ConfigError: it holds no pixel, or too many runs.
    """
    rows, columns = np.asarray(mask.any(axis=1)), np.asarray(mask.any(axis=0))
    if not rows.any():
        raise ConfigError("a region without a pixel; leave it out")
    if not np.array_equal(mask, rows[:, None] & columns):
        try:
            return {"pixels": runs_of(mask)}
        except ValueError as error:
            raise ConfigError(str(error)) from error
    # all rows, or all columns, go without saying, but not both
    found = {"rows": () if rows.all() and not columns.all() else _spans_of(rows)}
    return found | ({} if columns.all() else {"columns": _spans_of(columns)})


def runs_of(mask: BoolArray) -> tuple[tuple[int, int, int], ...]:
    """Return the runs of pixels of a map: row, first column, behind the last; ValueError: too many."""
    edges = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    (row, first), last = np.nonzero(edges == 1), np.nonzero(edges == -1)[1]
    if row.size > _MOST_RUNS:
        raise ValueError(f"the mask has {row.size} runs of pixels, more than {_MOST_RUNS}; simplify it")
    return tuple(zip(row.tolist(), first.tolist(), last.tolist(), strict=True))


def _spans_of(lines: BoolArray) -> tuple[Span, ...]:
    """Return the ranges of lines that are True."""
    edges = np.flatnonzero(np.diff(np.pad(lines, 1).astype(np.int8)))
    return tuple((int(first), int(last)) for first, last in edges.reshape(-1, 2))


def mask_file(path: Path) -> BoolArray:
    """Return the map (y, x) in a file of numpy; ValueError: there is none, or it holds no truth values."""
    try:
        with path.open("rb") as file:
            content = np.load(file, allow_pickle=False)
            if isinstance(content, np.lib.npyio.NpzFile):
                if len(content.files) != 1:
                    raise ValueError(f"it holds {len(content.files)} arrays; save one")
                content = content[content.files[0]]
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(f"mask {path}: cannot be read ({error}); save a bool array (y, x)") from None
    if content.ndim != 2 or content.dtype != np.bool_:
        raise ValueError(f"mask {path}: {content.dtype}{content.shape}; save a bool array (y, x)")
    return np.asarray(content)
