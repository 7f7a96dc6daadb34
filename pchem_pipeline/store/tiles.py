"""Tiles: the units of work, each one chunk of every output map."""

from __future__ import annotations

import re
from dataclasses import dataclass

from pchem_pipeline.base.errors import ConfigError

__all__ = ["Tile", "parse_tiles", "roi_tiles", "tile_grid"]


@dataclass(frozen=True, order=True)
class Tile:
    """A rectangle of pixels, rows ``y0:y1`` and columns ``x0:x1``, at grid position ``(iy, ix)``."""

    iy: int
    ix: int
    y0: int
    y1: int
    x0: int
    x1: int

    @property
    def key(self) -> str:
        """Name of the tile, ``iy.ix``, as in the chunk names of the store."""
        return f"{self.iy}.{self.ix}"

    @property
    def keys(self) -> tuple[str, ...]:
        """The marker names that this unit of work sets: its own."""
        return (self.key,)

    @property
    def region(self) -> tuple[slice, slice]:
        """Index of the tile's pixels in a ``(y, x)`` map."""
        return slice(self.y0, self.y1), slice(self.x0, self.x1)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the tile."""
        return self.y1 - self.y0, self.x1 - self.x0


def tile_grid(shape: tuple[int, int], size: int) -> list[Tile]:
    """Return the tiles of a sensor of ``shape`` (y, x), row by row; edge tiles may be smaller."""
    ny, nx = shape
    return [
        Tile(y0 // size, x0 // size, y0, min(y0 + size, ny), x0, min(x0 + size, nx))
        for y0 in range(0, ny, size)
        for x0 in range(0, nx, size)
    ]


_PART = re.compile(r"^(\d+)(?::(\d+))?\.(\d+)(?::(\d+))?$")


def parse_tiles(text: str, grid: list[Tile]) -> list[Tile]:
    """Select tiles by name: ``"0.3,2.1"`` or ranges ``"0:2.0:4"`` (rows 0 and 1, columns 0 to 3).

    Raises:
        ConfigError: the text is no list of tiles, or names tiles that the sensor does not have.
    """
    wanted: set[tuple[int, int]] = set()
    for part in text.replace(" ", "").split(","):
        match = _PART.match(part)
        if match is None:
            raise ConfigError(f"--tiles: {part!r} is not a tile; write iy.ix, such as 0.3, or ranges 0:2.0:4")
        y0, x0 = int(match[1]), int(match[3])
        y1, x1 = int(match[2] or y0 + 1), int(match[4] or x0 + 1)
        # one beyond the last tile is enough to be told that it does not exist
        rows, columns = range(y0, min(y1, grid[-1].iy + 2)), range(x0, min(x1, grid[-1].ix + 2))
        wanted |= {(iy, ix) for iy in rows for ix in columns}
    known = {(tile.iy, tile.ix): tile for tile in grid}
    missing = sorted(wanted - known.keys())
    if missing or not wanted:
        last = grid[-1]
        name = f"{missing[0][0]}.{missing[0][1]}" if missing else text
        raise ConfigError(f"--tiles: there is no tile {name}; this sensor has 0.0 to {last.iy}.{last.ix}")
    return [known[key] for key in sorted(wanted)]


def roi_tiles(roi: tuple[int, int, int, int], grid: list[Tile]) -> list[Tile]:
    """Return the tiles that touch the region of interest ``(y0, y1, x0, x1)``.

    Raises:
        ConfigError: the region is empty or outside the sensor.
    """
    y0, y1, x0, x1 = roi
    tiles = [t for t in grid if t.y0 < y1 and y0 < t.y1 and t.x0 < x1 and x0 < t.x1]
    if not tiles or y0 >= y1 or x0 >= x1 or y0 < 0 or x0 < 0:
        last = grid[-1]
        raise ConfigError(
            f"--roi {y0}:{y1},{x0}:{x1} selects nothing of a sensor of {last.y1} x {last.x1} pixels "
            f"(y x x); choose within 0:{last.y1},0:{last.x1}"
        )
    return tiles
