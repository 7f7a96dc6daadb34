"""Scan statistics: places and frames that stand out, of values and of events; probabilities count all."""

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from pchem_pipeline.discrepancy.families import log_binomial_tails
from pchem_pipeline.discrepancy.scan import (
    affected_share,
    scan_event_frames,
    scan_event_map,
    scan_map,
    scan_series,
    sharpest_range,
)
from pchem_pipeline.effects.framework.region import Region, When

Mask = np.ndarray[Any, np.dtype[np.bool_]]
SHAPE, SQUARE, FRAMES = (48, 64), (32, 32), 1500
EVERY = np.ones(SQUARE, np.bool_)


def mask_of(shape: tuple[int, int] = SHAPE, **region: Any) -> Mask:
    return Region.model_validate(region).mask(shape)


@pytest.mark.parametrize(
    ("mask", "shift", "least"),
    [
        (mask_of(columns=[40, 56]), 0.7, 0.9),
        (mask_of(rows=[17, 18]), -1.5, 1.0),
        (mask_of(rows=[0, 24], columns=[32, 64]), -0.8, 0.9),
        (mask_of(taps={"every": 8, "which": 5}), 1.0, 1.0),
        (mask_of(columns=[12, 64]), 0.7, 0.9),
        (np.hypot(np.arange(48)[:, None] - 20, np.arange(64) - 44) <= 7, -1.5, 0.8),
    ],
)
def test_a_place_is_found_where_it_is(mask: Mask, shift: float, least: float) -> None:
    rng = np.random.default_rng(int(mask.sum()))
    values = rng.standard_normal(SHAPE) + shift * mask
    first, *others = scan_map(values, np.ones(SHAPE, bool))
    assert others == []
    assert first.region.overlap(Region.of_mask(mask), SHAPE) >= least
    assert first.log_p < -20
    assert first.only_there
    assert np.sign(first.z) == np.sign(shift)
    # five standard errors of the mean inside
    assert abs(first.inside - shift) < 5.0 / np.sqrt(mask.sum()) + 0.1 * abs(shift)


def test_two_places_are_found_one_after_the_other() -> None:
    rng = np.random.default_rng(2)
    both = mask_of(columns=[8, 16]), mask_of(columns=[40, 56])
    values = rng.standard_normal(SHAPE) + 1.5 * both[0] + 1.0 * both[1]
    found = scan_map(values, np.ones(SHAPE, bool))
    overlaps = [max(each.region.overlap(Region.of_mask(m), SHAPE) for each in found) for m in both]
    assert min(overlaps) > 0.8


def test_single_pixels_are_listed_and_pixels_that_do_not_count_are_not() -> None:
    values = np.random.default_rng(3).standard_normal(SHAPE)
    values[3, 4] = values[30, 50] = 9.0
    values[40, 2] = 50.0
    usable = np.ones(SHAPE, bool)
    usable[40, 2] = False
    [found] = scan_map(values, usable)
    assert found.family == "pixels"
    assert np.argwhere(found.region.mask(SHAPE)).tolist() == [[3, 4], [30, 50]]
    assert found.share == 1.0


def test_chance_and_what_is_everywhere_alike_have_no_place() -> None:
    """At 5 %, of 60 maps 3 are allowed; five standard errors above that is 11."""
    rng = np.random.default_rng(4)
    shapes = [(16, 16), (24, 90), (64, 20), (50, 50)]
    maps = [rng.standard_normal(shapes[i % 4]) + 0.5 * (i % 3) for i in range(60)]
    found = sum(bool(scan_map(m, np.ones(m.shape, bool), significance=0.05)) for m in maps)
    assert found <= 11


def test_pairs_with_the_next_column_reach_one_further() -> None:
    rng = np.random.default_rng(5)
    values = rng.standard_normal(SHAPE) + 2.0 * mask_of(columns=[40, 63])
    values[:, -1] = np.nan
    [found] = scan_map(values, np.ones(SHAPE, bool), next_along=1)
    assert found.region.numbers() == {"columns": [[40, 64]]}


def test_the_share_that_is_affected_is_a_lower_bound_for_any_place() -> None:
    rng = np.random.default_rng(6)
    z = rng.standard_normal(4000) + 6.0 * (np.arange(4000) < 300)
    inside = np.arange(4000) < 400
    assert 0.6 < affected_share(z, inside) <= 0.75
    # chosen after looking, without any effect: more than none in 5 of 100 at most, 16 with five errors
    noise = rng.standard_normal((100, 2000))
    best = [affected_share(row, row >= np.partition(row, -50)[-50]) for row in noise]
    assert sum(share > 0 for share in best) <= 16


@pytest.mark.parametrize(
    ("chosen", "family"), [(slice(200, 400), "range"), (slice(3, None, 10), "period"), ([7, 99], "frames")]
)
def test_frames_are_found(chosen: Any, family: str) -> None:
    values = np.random.default_rng(7).standard_normal(1500)
    values[chosen] += 8.0 if family == "frames" else 1.0
    [found] = scan_series(values, np.arange(100, 1600))
    assert found.family == family
    seen, wanted = found.when.frames(np.arange(100, 1600)), np.zeros(1500, bool)
    wanted[chosen] = True
    assert (seen & wanted).sum() / (seen | wanted).sum() > 0.9


@pytest.mark.parametrize(("moved", "factor"), [(0.0, 3.0), (1.5, 1.0)])
def test_the_ends_of_a_range_are_those_of_its_scatter_or_mean(moved: float, factor: float) -> None:
    rng = np.random.default_rng(9)
    off = []
    for _ in range(20):
        series = rng.standard_normal((3, 1500))
        series[:2, 400:560] = moved + factor * rng.standard_normal((2, 160))
        series[:, 1000] += 50.0  # one frame decides nothing
        ends = np.array(sharpest_range(series, 450, 700, 64))
        off.append(np.abs(ends - (400, 560)))
    # a frame tells 0.9 nats in two series; the end is off by a few
    assert np.mean(off) < 4.0
    assert np.max(off) < 25
    # by chance a range gains half a nat for each of nine parameters and a few by its choice: nothing is told
    for _ in range(20):
        assert sharpest_range(rng.standard_normal((3, 300)), 100, 180, 64) == (100, 180)


def test_a_series_too_short_for_two_stretches_is_looked_at_all_the_same() -> None:
    rng = np.random.default_rng(1)
    for n in (40, 90, 150):
        values = rng.standard_normal(n)
        values[10:20] += 6.0
        for stretch in scan_series(values, np.arange(n), significance=0.5, most=4, shortest=n // 2 + 1):
            assert stretch.when.frames(np.arange(n)).any()


def test_a_series_that_scatters_more_for_a_while_has_no_mean_that_is_off() -> None:
    rng = np.random.default_rng(8)
    for _ in range(20):
        values = rng.standard_normal(1500)
        values[300:400] *= 3.0
        assert [each for each in scan_series(values, np.arange(1500)) if each.family == "range"] == []


@pytest.mark.parametrize("shape", [(1, 320), (320, 1), (2, 160), (1, 100)])
def test_channels_side_by_side_are_a_sensor_of_one_row(shape: tuple[int, int]) -> None:
    """No band of rows divides them; a band of columns does."""
    rng = np.random.default_rng(7)
    values = rng.standard_normal(shape)
    assert scan_map(values, np.ones(shape, bool)) == []
    long = values.reshape(-1)
    long[20:40] += 2.0
    [found] = scan_map(values, np.ones(shape, bool), single=False)
    assert found.log_p < math.log(1e-3)
    assert found.region.mask(shape).sum() <= 30


def test_ranges_of_frames_come_by_chance_as_often_as_told() -> None:
    numbers, rng = np.arange(600), np.random.default_rng(999)
    drawn = rng.standard_normal((100, 600))
    seen = [scan_series(each, numbers, significance=0.1, most=1, shortest=64) for each in drawn]
    # binomial: three standard deviations around 0.1 of 100
    assert 1 <= sum(map(bool, seen)) <= 19
    shifted = rng.standard_normal(600) + 0.75 * ((numbers >= 200) & (numbers < 264))
    [one] = scan_series(shifted, numbers, significance=1e-3, shortest=64)
    assert one.z < 7.5  # a count of all ranges would ask for 6.5 and more
    assert one.when.range[0][0] == pytest.approx(200, abs=25)


@pytest.mark.parametrize(
    "place",
    [
        mask_of(SQUARE, columns=[12, 15]),
        mask_of(SQUARE, rows=[4, 8]),
        mask_of(SQUARE, taps={"every": 8, "which": 5}),
        mask_of(SQUARE, rows=[10, 20], columns=[16, 26]),
    ],
)
def test_events_of_a_place_are_found_there(place: Mask) -> None:
    """Sixteen or so in a tenth of the pixels, and a dozen by chance anywhere."""
    rng = np.random.default_rng(int(place.sum()))
    seen = rng.random(SQUARE) < 0.01 + 0.2 * place
    [found] = scan_event_map(seen, np.full(SQUARE, 0.01), EVERY)
    assert found.region.overlap(Region.of_mask(place), SQUARE) > 0.6
    assert found.only_there
    # a rate between those of a binomial number five deviations off
    assert abs(found.inside - 0.2) < 5.0 * np.sqrt(0.2 * 0.8 / place.sum()) + 0.04


def test_events_have_no_place_by_chance_and_follow_the_share_of_each_pixel() -> None:
    """Of 80 maps at 5 %, four are allowed; five standard errors above that is 13."""
    share = np.where(mask_of(SQUARE, columns=[0, 16]), 0.1, 0.005)
    rng = np.random.default_rng(1)
    drawn = [rng.random(SQUARE) < share for _ in range(80)]
    assert sum(bool(scan_event_map(seen, share, EVERY, significance=0.05)) for seen in drawn) <= 13
    # taken for alike, the pixels of either half are a place
    assert sum(bool(scan_event_map(seen, np.ones(SQUARE), EVERY)) for seen in drawn[:10]) == 10


def test_a_binomial_tail_is_that_of_the_law() -> None:
    for k, n, share in ((3, 8, 0.09), (16, 16, 0.1), (1, 40, 0.5)):
        assert log_binomial_tails(k, n, share) == pytest.approx(stats.binom.logsf(k - 1, n, share), rel=1e-9)


def test_a_range_of_frames_with_events_is_found() -> None:
    rng, numbers = np.random.default_rng(2), np.arange(100, 100 + FRAMES)
    wanted = (numbers >= 700) & (numbers < 860)
    for _ in range(20):
        happened = rng.random(FRAMES) < np.where(wanted, 0.154, 0.004)
        found = scan_event_frames(np.flatnonzero(happened), numbers, expected=6.0, shortest=64)
        inside = found.when.frames(numbers)
        # of 24 events the outermost lie seven frames from the ends on average
        assert (inside & wanted).sum() > 0.6 * (inside | wanted).sum()
        assert found.only_there


def test_of_very_many_events_some_tell_the_range() -> None:
    rng = np.random.default_rng(4)
    happened = rng.random(50_000) < np.where((np.arange(50_000) // 5000) == 3, 0.4, 0.1)
    found = scan_event_frames(np.flatnonzero(happened), np.arange(50_000), shortest=64)
    assert found.when.overlap(When(range=((15_000, 20_000),)), 50_000) > 0.8


def test_events_have_no_range_by_chance() -> None:
    """Of 300 series at 5 %, 15 are allowed; five standard errors above that is 34."""
    rng = np.random.default_rng(3)
    drawn = [np.sort(rng.choice(FRAMES, n, replace=False)) for n in rng.integers(3, 60, 300)]
    found = [scan_event_frames(each, np.arange(FRAMES), significance=0.05, shortest=64) for each in drawn]
    assert sum(each is not None for each in found) <= 34
    assert scan_event_frames(np.array([5, 6]), np.arange(FRAMES), significance=1.0) is None
