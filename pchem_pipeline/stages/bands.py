"""How stages that read frames cut the sensor into bands of rows.

Camera files give whole rows cheaply and single tiles dearly: bands of a counted stack, bands of tiles to be
done, and bands that the workers share while a stack streams by.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pchem_pipeline.model.histogram.summaries import ROW_GROUP
from pchem_pipeline.run.stage import StageContext
from pchem_pipeline.store.tiles import Tile, equal_rows

#: bytes of frames, or of histograms, of a band that are worked on at once
BAND_BYTES = 64 << 20
#: frames that are read at a time
FRAMES_AT_ONCE = 64


@dataclass(frozen=True)
class Band:
    """Rows ``y0:y1`` over the full width: whole groups of rows, and the tiles with these keys."""

    y0: int
    y1: int
    keys: tuple[str, ...]

    @property
    def key(self) -> str:
        """What messages call it."""
        return f"rows {self.y0}-{self.y1 - 1}"


def plan_bands(
    tiles: Sequence[Tile], pending: set[str], most_rows: int, workers: int, rows_per_read: int = 1
) -> list[Band]:
    """Cut the sensor into bands: as high as allowed where there is work, and one for each worker at least.

    No tile and no group of rows is cut. ``pending`` are the keys of the tiles that are to be done,
    ``most_rows`` fit into the memory of a worker; less than one step is taken as one. ``rows_per_read`` come
    at no more cost than one; bands keep to multiples where they can.
    """
    ny = tiles[-1].y1
    step = max(tiles[0].y1, ROW_GROUP)
    aligned = _rows_together(step, rows_per_read, ny, workers)
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


def _rows_together(step: int, rows_per_read: int, ny: int, workers: int) -> int:
    """Return the multiple of ``step`` by which bands should grow so that little is decoded twice.

    No read is shared by two bands where each worker still gets one, else few are.
    """
    rows = min(rows_per_read, ny)
    exact = math.lcm(step, rows)
    return exact if exact * workers <= ny else step * math.ceil(rows / step)


def cut_rows(ny: int, step: int, workers: int) -> list[tuple[int, int]]:
    """Return first row and end of bands of multiples of ``step`` rows, a few for each worker."""
    # four for each: enough to keep all busy to the end
    return equal_rows(ny, step * max(1, -(-ny // step) // (4 * workers)))


def tile_bands(context: StageContext, most_rows: int, rows_per_read: int) -> list[Band | Tile]:
    """Return the units of a stage that reads the frames of fitted pixels again by bands.

    They are bands of the tiles to be done, and each tile that is done, or that is not fitted. Arguments as of
    `plan_bands`; one row of tiles is the least.
    """
    tiles = context.tiles()
    todo = {tile.key for tile in context.pending(tiles)} & context.tiles_done("fit")
    step, ny, workers = tiles[0].y1, tiles[-1].y1, context.executor.workers
    together = _rows_together(step, rows_per_read, ny, workers)
    # one worker that decodes once is faster than all of them that decode the same many times
    if min(together, ny) <= most_rows and (together * workers <= ny or together > step * workers):
        step = together
    groups: dict[int, list[Tile]] = {}
    for tile in tiles:
        if tile.key in todo:
            groups.setdefault(tile.y0 // step, []).append(tile)
    bands: list[Band | Tile] = [
        Band(min(t.y0 for t in group), max(t.y1 for t in group), tuple(t.key for t in group))
        for group in groups.values()
    ]
    return bands + [tile for tile in tiles if tile.key not in todo]
