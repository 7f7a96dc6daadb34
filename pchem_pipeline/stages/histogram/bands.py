"""How the histogram stage cuts a sensor into bands of rows, and how it keeps arrays along time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pchem_pipeline.model.histogram.count import counts_dtype
from pchem_pipeline.model.histogram.settings import HistogramSettings
from pchem_pipeline.model.histogram.summaries import ROW_GROUP
from pchem_pipeline.store.tiles import Tile

__all__ = [
    "CHUNK_BLOCKS",
    "COLUMN_FRAMES",
    "Band",
    "bytes_per_row",
    "plan_bands",
    "row_frames",
    "rows_together",
]

#: frames, or blocks, in a chunk of the arrays along time
COLUMN_FRAMES = 1024
_ROW_FRAMES = 4096
CHUNK_BLOCKS = 8
#: a chunk of row sums of all rows is read at once in the end: fewer frames on tall sensors
_ROWS_AT_ONCE = 2048


@dataclass(frozen=True)
class Band:
    """Rows ``y0:y1`` of the sensor, over its full width.

    Attributes:
        y0: first row, at the border of a group of rows and of a tile.
        y1: end of the rows.
        keys: names of the tiles in it.
    """

    y0: int
    y1: int
    keys: tuple[str, ...]

    @property
    def key(self) -> str:
        """What messages call it."""
        return f"rows {self.y0}-{self.y1 - 1}"


def bytes_per_row(columns: int, n_frames: int, itemsize: int, bins: int, settings: HistogramSettings) -> int:
    """Return the memory that a worker needs for each row of its band."""
    block = 2 * min(settings.window_frames, n_frames) * itemsize
    pixel = block + bins * counts_dtype(n_frames).itemsize + 21 + 2 * itemsize
    row = 0
    if settings.summaries:
        # sums, covariances and their temporaries; then what waits for its chunk along time to be whole
        pixel += 170 + 2 * 2 * CHUNK_BLOCKS * 8
        pixel += math.ceil(2 * min(COLUMN_FRAMES, n_frames) * 4 / ROW_GROUP)
        row = 2 * 2 * min(_ROW_FRAMES, n_frames) * 8
    return columns * pixel + row


def plan_bands(
    tiles: Sequence[Tile], pending: set[str], most_rows: int, workers: int, rows_per_read: int = 1
) -> list[Band]:
    """Cut the sensor into bands: as high as allowed where there is work, and one for each worker at least.

    Args:
        tiles: all tiles.
        pending: keys of the tiles that are to be done.
        most_rows: rows that fit into the memory of a worker; less than one step is taken as one.
        workers: number of workers.
        rows_per_read: rows that come at no more cost than one; bands keep to multiples where they can.

    Returns:
        Bands that cover the sensor; no tile and no group of rows is cut.
    """
    ny = tiles[-1].y1
    step = max(tiles[0].y1, ROW_GROUP)
    aligned = rows_together(step, rows_per_read, ny, workers)
    if min(aligned, ny) <= most_rows:
        step = aligned
    keys: dict[int, list[str]] = {}
    for tile in tiles:
        keys.setdefault(tile.y0 // step, []).append(tile.key)
    busy = [not pending.isdisjoint(names) for names in keys.values()]
    largest = max(1, min(most_rows // step, math.ceil(sum(busy) / workers)))
    bands: list[Band] = []
    first = 0
    while first < len(busy):
        end = first + 1
        while busy[first] and end < len(busy) and busy[end] and end - first < largest:
            end += 1
        names = tuple(name for number in range(first, end) for name in keys[number])
        bands.append(Band(first * step, min(end * step, ny), names))
        first = end
    return bands


def rows_together(step: int, rows_per_read: int, ny: int, workers: int) -> int:
    """Return the multiple of ``step`` by which bands should grow so that little is decoded twice.

    Args:
        step: rows that must not be cut.
        rows_per_read: rows that come at no more cost than one.
        ny: rows of the sensor.
        workers: number of workers, which should all get a band.

    Returns:
        Rows; no read is shared by two bands where each worker still gets one, else few are.
    """
    rows = min(rows_per_read, ny)
    exact = math.lcm(step, rows)
    return exact if exact * workers <= ny else step * math.ceil(rows / step)


def row_frames(ny: int) -> int:
    """Return the frames in a chunk of row sums."""
    return max(_ROW_FRAMES // 16, _ROW_FRAMES // -(-ny // _ROWS_AT_ONCE))
