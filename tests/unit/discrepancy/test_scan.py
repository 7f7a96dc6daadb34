"""Scan statistics: places and frames that stand out, with probabilities that count all of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from pchem_pipeline.discrepancy.scan import affected_share, scan_map, scan_series, sharpest_range
from pchem_pipeline.effects.framework.region import Region

Mask = np.ndarray[Any, np.dtype[np.bool_]]
SHAPE = (48, 64)


def mask_of(**region: Any) -> Mask:
    return Region.model_validate(region).mask(SHAPE)


def disc() -> Mask:
    y, x = np.ogrid[: SHAPE[0], : SHAPE[1]]
    return np.asarray((y - 20) ** 2 + (x - 44) ** 2 <= 49)


@pytest.mark.parametrize(
    ("mask", "shift", "least"),
    [
        (mask_of(columns=[40, 56]), 0.7, 0.9),
        (mask_of(rows=[17, 18]), 1.5, 1.0),
        (mask_of(rows=[0, 24], columns=[32, 64]), 0.8, 0.9),
        (mask_of(taps={"every": 8, "which": 5}), 1.0, 1.0),
        (mask_of(columns=[12, 64]), 0.7, 0.9),
        (disc(), 1.5, 0.8),
    ],
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_place_is_found_where_it_is(mask: Mask, shift: float, least: float, sign: float) -> None:
    rng = np.random.default_rng(int(mask.sum()))
    values = rng.standard_normal(SHAPE) + sign * shift * mask
    first, *others = scan_map(values, np.ones(SHAPE, bool))
    assert others == []
    assert first.region.overlap(Region.of_mask(mask), SHAPE) >= least
    assert first.log_p < -20
    assert first.only_there
    assert np.sign(first.z) == sign
    # five standard errors of the mean inside
    assert abs(first.inside - sign * shift) < 5.0 / np.sqrt(mask.sum()) + 0.1 * shift


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
    """At 5 %, of 100 maps 5 are allowed; five standard errors above that is 16."""
    rng = np.random.default_rng(4)
    shapes = [(16, 16), (24, 90), (64, 20), (50, 50)]
    maps = [rng.standard_normal(shapes[i % 4]) + 0.5 * (i % 3) for i in range(100)]
    found = sum(bool(scan_map(m, np.ones(m.shape, bool), significance=0.05)) for m in maps)
    assert found <= 16


def test_pairs_with_the_next_column_reach_one_further() -> None:
    rng = np.random.default_rng(5)
    values = rng.standard_normal(SHAPE) + 2.0 * mask_of(columns=[40, 63])
    values[:, -1] = np.nan
    [found] = scan_map(values, np.ones(SHAPE, bool), next_along=1)
    assert found.region.numbers() == {"columns": [[40, 64]]}


def test_the_share_that_is_affected_is_a_lower_bound_for_any_place() -> None:
    rng = np.random.default_rng(6)
    true = np.zeros(4000, bool)
    true[:300] = True
    z = rng.standard_normal(4000) + 6.0 * true
    inside = np.zeros(4000, bool)
    inside[:400] = True
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
