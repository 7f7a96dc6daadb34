"""Tiles: the units of work, each one chunk of every output map."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from pchem_pipeline.base.errors import ConfigError

#: The setting: a side, rows and columns, or chosen by the sensor.
TileSize = int | tuple[int, int] | Literal["auto"]

#: The side of the smallest tile that is chosen, and the pixels that it has at least on a sensor of few rows.
_SIDE, _FEW_PIXELS = 64, 2048
#: Bins of histograms that are worked on at once: a fit takes some ten bytes for each.
MAX_BINS = 1 << 23
#: Tiles beyond which they grow: each is some 50 files.
_MANY = 80
#: Pixels of rows over the full width, which are read and counted at once, up to which tiles grow in rows.
_MOST_TOGETHER = 1 << 20


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
    def region(self) -> tuple[slice, slice]:
        """Index of the tile's pixels in a ``(y, x)`` map."""
        return slice(self.y0, self.y1), slice(self.x0, self.x1)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the tile."""
        return self.y1 - self.y0, self.x1 - self.x0

    def within(self, part: tuple[slice, slice]) -> tuple[slice, slice]:
        """Return where a piece of the tile lies on the sensor."""
        y, x = part
        return slice(self.y0 + y.start, self.y0 + y.stop), slice(self.x0 + x.start, self.x0 + x.stop)

    def parts(self, bins: int = 1) -> Iterator[tuple[slice, slice]]:
        """Yield indices of pieces of at most 64 x 64 pixels and `MAX_BINS` bins, ``bins`` for each pixel."""
        ny, nx = self.shape
        for y in equal_rows(ny, min(_SIDE, max(1, MAX_BINS // (_SIDE * bins)))):
            for x in equal_rows(nx, _SIDE):
                yield slice(*y), slice(*x)


def tile_shape(size: TileSize, sensor: tuple[int, int]) -> tuple[int, int]:
    """Return rows and columns of the tiles of a sensor of some shape (y, x).

    With ``auto`` they are 64 x 64, and wider, then higher, on larger sensors: a tile is an amount of work and
    some 50 files, and neither should be small a thousand times; but a row of tiles has to fit into memory.
    """
    if size != "auto":
        return size if isinstance(size, tuple) else (size, size)
    ny, nx = sensor
    rows = columns = _SIDE
    while columns < nx and min(rows, ny) * columns < _FEW_PIXELS:
        columns *= 2
    while -(-ny // rows) * -(-nx // columns) > _MANY:
        if columns < nx:
            columns *= 2
        elif 2 * rows * nx <= _MOST_TOGETHER:
            rows *= 2
        else:
            break
    return rows, columns


def tile_grid(shape: tuple[int, int], size: TileSize) -> list[Tile]:
    """Return the tiles of a sensor of ``shape`` (y, x), row by row; edge tiles may be smaller."""
    height, width = tile_shape(size, shape)
    rows, columns = equal_rows(shape[0], height), equal_rows(shape[1], width)
    return [Tile(iy, ix, *y, *x) for iy, y in enumerate(rows) for ix, x in enumerate(columns)]


def equal_rows(ny: int, height: int) -> list[tuple[int, int]]:
    """Return first row (or column, or frame) and end of bands of ``ny`` of them; the last may be lower."""
    return [(y, min(y + height, ny)) for y in range(0, ny, height)]


def roi_tiles(roi: tuple[int, int, int, int], grid: list[Tile]) -> list[Tile]:
    """Return the tiles that touch the region of interest ``(y0, y1, x0, x1)``.

    Raises:
        ConfigError: the region is empty, or reaches beyond the sensor.
    """
    y0, y1, x0, x1 = roi
    tiles = [t for t in grid if t.y0 < y1 and y0 < t.y1 and t.x0 < x1 and x0 < t.x1]
    last = grid[-1]
    outside = not tiles or y0 >= y1 or x0 >= x1 or y0 < 0 or x0 < 0
    if outside or y1 > last.y1 or x1 > last.x1:
        raise ConfigError(
            f"--roi {y0}:{y1},{x0}:{x1} {'is outside' if outside else 'exceeds'} the sensor of {last.y1} x "
            f"{last.x1} pixels (y x x); choose within 0:{last.y1},0:{last.x1}"
        )
    return tiles
