"""Every pixel and every frame of a run is looked at for places that stand out."""

import tracemalloc

import numpy as np
import pytest
from helpers.discrepancy_material import verdict_of
from helpers.quick_stacks import stack, sums_of
from helpers.small_stacks import Stack

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.discrepancy.observe.observe import fitted_maps
from pchem_pipeline.discrepancy.scan_pairs import pairs_bytes
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.model.histogram.count import histogram_frames
from pchem_pipeline.stages.discrepancy import survey as module
from pchem_pipeline.stages.discrepancy.survey import places_of_bands, places_of_sums
from pchem_pipeline.stages.discrepancy.window import PAIRS, SHAPES, SUMS, Survey

SHAPE, FRAMES = (40, 32), 600


class Store:
    """Histograms and fit of a stack, as the stages leave them."""

    def __init__(self, values):
        histograms = histogram_frames(values)
        maps, _ = fitted_maps(values, np.zeros(values.shape[1:], bool))
        names = ("counts", "origin", "under", "over", "minimum", "maximum")
        self.arrays = {f"histogram/{name}": getattr(histograms, name) for name in names}
        for name in ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn"):
            self.arrays[f"fit/{name}"] = getattr(maps, name)
        self.arrays["fit/fit_status"] = np.where(maps.usable, 0, 1 << 10).astype(np.uint16)

    def array(self, name):
        return self.arrays[name]

    def read(self, name, region=...):
        return self.arrays[name][region]


def camera(seed, add=None):
    rng = np.random.default_rng(seed)
    size = (FRAMES, *SHAPE)
    step = rng.normal(11.0, 0.8, SHAPE)
    noise = 3.0 * rng.standard_normal(size)
    x = 100.0 + rng.normal(0, 4, SHAPE) + step * rng.poisson(1.5, size) + noise
    return np.rint(np.clip(x if add is None else x + add(rng), 0, 4095)).astype(np.uint16)


@pytest.fixture(scope="module")
def tap():
    def add(rng):
        offsets = np.zeros((FRAMES, *SHAPE))
        offsets[:, :, 20:28] = rng.normal(0.0, 1.0, (FRAMES, SHAPE[0], 1))
        return offsets

    values = camera(1, add)
    return Stack(values), Store(values)


@pytest.mark.parametrize("codes", [1 << 26, 1 << 10])
def test_a_tap_stands_out_of_all_pairs_in_one_band_of_rows_or_in_several(tap, codes, monkeypatch):
    source, store = tap
    monkeypatch.setattr(module, "_MOST_CODES", codes)
    source.read[:] = 0
    places, shares = places_of_bands(store, source)
    assert shares == {PAIRS: 1.0, SHAPES: 1.0}
    assert source.read.min() >= 1  # every row of every frame
    found = places["pairs.row.readout"]
    assert found.p < 1e-6
    columns = Region(columns=((20, 28),))
    mask = found.region.mask(SHAPE)
    assert not mask[:, :20].any()
    assert codes == 1 << 10 or found.region.overlap(columns, SHAPE) == 1.0
    assert mask.sum() >= 8 * 8


def test_frames_are_spread_over_the_run_where_not_all_can_be_looked_at_and_it_is_said(tap, monkeypatch):
    source, store = tap
    monkeypatch.setattr(module, "_MOST_SAMPLES", 400 * SHAPE[0] * SHAPE[1])
    places, shares = places_of_bands(store, source, plain=False)
    assert 0.5 < shares[PAIRS] < 0.7
    assert SHAPES not in shares
    assert set(places) == {"pairs.row.readout"}


def test_bands_are_as_high_as_the_memory_allows_and_keep_to_it(tap):
    source, store = tap
    places_of_bands(store, source)  # compiled
    for memory in (pairs_bytes(SHAPE) + (6 << 20), pairs_bytes(SHAPE) + (40 << 20)):
        source.read[:] = 0
        tracemalloc.start()
        places, _ = places_of_bands(store, source, memory=memory)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < memory
        assert source.read.min() >= 1
        assert places["pairs.row.readout"].region.mask(SHAPE)[:, 20:28].any()


def test_too_little_memory_for_the_lowest_band_is_told_in_one_line(tap):
    source, store = tap
    for memory in (-1 << 20, 1 << 16, pairs_bytes((8, SHAPE[1]))):
        with pytest.raises(ConfigError, match=r"needs \d+ MiB more for 8 rows .*--max-memory"):
            places_of_bands(store, source, memory=memory)


def test_nothing_stands_out_of_nothing_nor_does_what_all_pixels_share():
    def add(rng):
        return rng.normal(0.0, 1.0, (FRAMES, SHAPE[0], 1))

    for values in (camera(2), camera(3, add)):
        assert places_of_bands(Store(values), Stack(values))[0] == {}


def test_peaks_of_another_shape_stand_out_of_the_histograms():
    y, x = np.ogrid[: SHAPE[0], : SHAPE[1]]
    blob = (y - 12) ** 2 + (x - 20) ** 2 < 64
    rng = np.random.default_rng(5)
    # in the blob some frames have thrice the read noise: heavy tails, which no width of a Gaussian has
    values = camera(
        4, lambda _: blob * 9.0 * rng.standard_normal((FRAMES, *SHAPE)) * (rng.random((FRAMES, *SHAPE)) < 0.1)
    )
    places, _ = places_of_bands(Store(values), Stack(values))
    best = min(places.values(), key=lambda place: place.p)
    assert best.region.overlap(Region.of_mask(np.broadcast_to(blob, SHAPE)), SHAPE) > 0.6


def test_the_sums_of_all_frames_tell_the_place():
    rng = np.random.default_rng(1)

    def tap(dn):
        dn[:, :, 40:] += 2.5 * rng.standard_normal(dn.shape[:2])[:, :, None]
        return dn

    sums = sums_of(stack(rng, (600, 32, 48), tap))
    found = places_of_sums(sums, (32, 48))
    assert found["next_x"].region.numbers() == {"columns": [[40, 48]]}
    assert found["next_x"].p < 1e-20
    assert places_of_sums(sums, (16, 48)) is None  # of another region of the sensor
    assert places_of_sums(sums_of(stack(rng, (600, 32, 48))), (32, 48)) == {}
    assert places_of_sums(None, (32, 48)) is None


def test_the_verdict_says_what_was_looked_at_over_the_whole_sensor():
    verdict = verdict_of("named")
    told = Survey({}, {SUMS: 1.0, PAIRS: 0.4}).told(verdict, 0.1).examined
    assert (told.share, told.surveyed, told.surveyed_by) == (0.1, 0.1, {SUMS: 1.0, PAIRS: 0.4})
    told = Survey({}, {SUMS: 1.0, SHAPES: 1.0, PAIRS: 0.4}).told(verdict, 0.1).examined
    assert told.surveyed == 0.4
    assert Survey().told(verdict, 1.0).examined.surveyed == 1.0
