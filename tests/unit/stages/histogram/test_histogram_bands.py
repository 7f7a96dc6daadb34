"""Bands cover the sensor, cut no tile and no group of rows, and keep to the memory allowed."""

from hypothesis import given
from hypothesis import strategies as st

from pchem_pipeline.model.histogram.summaries import ROW_GROUP
from pchem_pipeline.stages.bands import plan_bands
from pchem_pipeline.stages.histogram.arrays import row_frames
from pchem_pipeline.store.tiles import tile_grid


@given(
    ny=st.integers(1, 1200),
    tile=st.sampled_from([8, 16, 32, 64, 128, 256]),
    most=st.integers(0, 1500),
    workers=st.integers(1, 9),
    together=st.sampled_from([1, 7, 64, 100, 128, 1200]),
    data=st.data(),
)
def test_bands_are_sound(ny, tile, most, workers, together, data):
    tiles = tile_grid((ny, 20), tile)
    pending = data.draw(st.sets(st.sampled_from([t.key for t in tiles])))
    bands = plan_bands(tiles, pending, most, workers, together)
    assert [bands[0].y0, *(b.y1 for b in bands)] == [*(b.y0 for b in bands), ny]
    assert [key for band in bands for key in band.keys] == [t.key for t in tiles]
    step = max(tile, ROW_GROUP)
    for band in bands:
        assert band.y0 < band.y1
        assert band.y0 % tile == 0
        assert band.y0 % ROW_GROUP == 0
        assert band.y1 - band.y0 <= max(most, min(ny, step))
        for t in tiles:
            assert (band.y0 <= t.y0 < t.y1 <= band.y1) == (t.key in band.keys)


def test_memory_and_workers_decide_the_height():
    tiles = tile_grid((512, 512), 64)
    everything = {tile.key for tile in tiles}
    assert len(plan_bands(tiles, everything, 10_000, 1)) == 1
    assert len(plan_bands(tiles, everything, 10_000, 2)) == 2
    assert len(plan_bands(tiles, everything, 130, 2)) == 4
    assert len(plan_bands(tiles, everything, 1, 2)) == 8


def test_only_pending_rows_are_joined():
    tiles = tile_grid((512, 128), 64)
    bands = plan_bands(tiles, {"2.0", "3.1", "4.0"}, 10_000, 1)
    assert [(band.y0, band.y1) for band in bands if "2.0" in band.keys] == [(128, 320)]
    assert len(bands) == 6


def test_rows_that_are_decoded_together_stay_together():
    tiles = tile_grid((512, 128), 64)
    everything = {tile.key for tile in tiles}
    assert len(plan_bands(tiles, everything, 10_000, 8, rows_per_read=128)) == 4
    assert len(plan_bands(tiles, everything, 10_000, 8, rows_per_read=512)) == 1
    # odd strips: each worker keeps its band, at the price of a few strips decoded twice
    assert len(plan_bands(tiles, everything, 10_000, 4, rows_per_read=27)) == 4
    assert len(plan_bands(tiles, everything, 10_000, 2, rows_per_read=500)) == 1
    # unless memory forbids
    assert len(plan_bands(tiles, everything, 64, 8, rows_per_read=512)) == 8


def test_row_sums_of_tall_sensors_are_read_in_smaller_pieces():
    assert row_frames(512) == 4096
    assert row_frames(10_000) * 10_000 * 16 < 2**28
    assert row_frames(200_000) > 0
