"""Bands of tiles: what the stages that read frames again do at once.

Camera files give whole rows cheaply and single tiles dearly, so the tiles to be done are taken by rows of
them. A tile that is done, or that is not to be done, is in no band and stays a unit of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

from pchem_pipeline.run.stage import StageContext
from pchem_pipeline.stages.histogram.bands import Band, rows_together
from pchem_pipeline.store.tiles import Tile

__all__ = ["tile_bands"]


def tile_bands(
    context: StageContext, needs: str, most_rows: int, rows_per_read: int = 1
) -> list[Band | Tile]:
    """Return the units of a stage that reads frames by bands.

    Args:
        context: of the stage.
        needs: the stage whose tiles must be there; others are left as single tiles, which then fail.
        most_rows: rows that a worker can hold; one row of tiles is the least.
        rows_per_read: rows that come at no more cost than one.

    Returns:
        Bands of the tiles to be done, and all the other tiles.
    """
    tiles = context.tiles()
    ready = context.tiles_done(needs)
    todo = {tile.key for tile in context.pending(tiles)} & ready
    step = tiles[0].y1
    ny, workers = tiles[-1].y1, context.executor.workers
    together = rows_together(step, rows_per_read, ny, workers)
    # one worker that decodes once is faster than all of them that decode the same many times
    if min(together, ny) <= most_rows and (together * workers <= ny or together > step * workers):
        step = together
    groups: dict[int, list[Tile]] = {}
    for tile in tiles:
        if tile.key in todo:
            groups.setdefault(tile.y0 // step, []).append(tile)
    bands: list[Band | Tile] = [_band(group) for group in groups.values()]
    return bands + [tile for tile in tiles if tile.key not in todo]


def _band(tiles: Sequence[Tile]) -> Band:
    y0, y1 = min(tile.y0 for tile in tiles), max(tile.y1 for tile in tiles)
    return Band(y0, y1, tuple(tile.key for tile in tiles))
