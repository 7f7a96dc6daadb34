import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.store.tiles import MAX_BINS, Tile, roi_tiles, tile_grid, tile_shape


@given(ny=st.integers(1, 200), nx=st.integers(1, 200), size=st.sampled_from([8, 16, 64]))
def test_tiles_cover_every_pixel_once(ny, nx, size):
    seen = np.zeros((ny, nx), int)
    for tile in tile_grid((ny, nx), size):
        seen[tile.y0 : tile.y1, tile.x0 : tile.x1] += 1
    assert (seen == 1).all()


def test_tiles_grow_with_the_sensor():
    sensors = [(16, 16), (512, 512), (1024, 1024), (2304, 4096), (1, 14_400)]
    columns = [64, 64, 256, 2048, 2048]
    assert [tile_shape("auto", sensor) for sensor in sensors] == [(64, each) for each in columns]
    assert {tile_shape(16, sensor) for sensor in sensors} == {(16, 16)}


@given(ny=st.integers(1, 20_000), nx=st.integers(1, 20_000))
def test_no_sensor_has_many_tiles_unless_a_row_of_them_would_not_fit_into_memory(ny, nx):
    rows, columns = tile_shape("auto", (ny, nx))
    assert 1 <= len(tile_grid((ny, nx), "auto")) <= 80 or (columns >= nx and 2 * rows * nx > 2**20)
    assert rows == 64 or rows * nx <= 2**20
    assert rows % 64 == columns % 64 == 0


@given(*map(st.integers, (0, 0, 1, 1, 1), (3, 3, 150, 200, 99_999)))
def test_parts_of_a_tile_cover_it_once_and_have_few_bins(y0, x0, ny, nx, bins):
    tile = Tile(0, 0, y0, y0 + ny, x0, x0 + nx)
    seen = np.zeros((y0 + ny, x0 + nx), int)
    for part in tile.parts(bins):
        assert seen[tile.within(part)].shape == np.empty(tile.shape)[part].shape
        seen[tile.within(part)] += 1
        assert np.empty(tile.shape)[part].size * bins <= MAX_BINS
    assert (seen[tile.region] == 1).all()


def test_tiles_are_named_like_their_chunks_and_a_roi_chooses_those_that_it_touches():
    tile = tile_grid((100, 130), 64)[-1]
    assert (tile.key, tile.shape) == ("1.2", (36, 2))
    assert tile.region == (slice(64, 100), slice(128, 130))
    grid = tile_grid((256, 256), 64)
    assert [t.key for t in roi_tiles((63, 65, 128, 129), grid)] == ["0.2", "1.2"]

    for roi in ((10, 10, 0, 5), (300, 310, 0, 5), (-1, 5, 0, 5), (5, 2, 0, 5)):
        with pytest.raises(ConfigError, match="is outside"):
            roi_tiles(roi, grid)
