"""Disagreements are located: on frames from plain numpy, by the maps and series of their evidence."""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.plain_camera import PlainCamera
from helpers.quick_stacks import added, stack

from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.observe.observe import observe
from pchem_pipeline.discrepancy.verdict import Place
from pchem_pipeline.discrepancy.where import (
    _codes,
    _frames,
    _pixels,
    frame_series,
    map_of,
    pixel_maps,
    suspected_frames,
    suspected_regions,
    unfitted_place,
)
from pchem_pipeline.effects.framework.evidence import Evidence
from pchem_pipeline.effects.framework.region import Region

SHAPE = (500, 40, 64)  # a third of 1,500 frames
PIXELS = SHAPE[1:]
Array = np.ndarray[Any, Any]


NOISE = np.random.default_rng(5).standard_normal


@functools.cache
def seen(moved: Callable[[Array], Array] = lambda dn: dn) -> Evidence:
    frames = stack(np.random.default_rng(1), SHAPE, moved)
    return observe(frames, np.arange(SHAPE[0]), n_run=SHAPE[0], block_frames=50)


def blob() -> Array:
    y, x = np.ogrid[: PIXELS[0], : PIXELS[1]]
    return np.asarray((y - 20) ** 2 + (x - 44) ** 2 <= 64)


@pytest.mark.parametrize(
    ("part", "values", "name"),
    [
        (np.s_[:, :, 48:], 1.2 * NOISE((500, 40, 1)), "x.rr"),
        (np.s_[:, :20, 32:], NOISE((500, 1, 32)), "y.rr"),
        (np.s_[:, 17], 1.5 * NOISE((500, 1)), "x.rr"),
        (np.s_[:, blob()], 1.5 * np.linspace(-0.5, 0.5, 500)[:, None], "trend.readout"),
    ],
)
def test_the_place_overlaps_the_truth_by_80_per_cent(part: Any, values: Array, name: str) -> None:
    inside = np.zeros(SHAPE, np.bool_)
    inside[part] = True
    region = Region.of_mask(inside[0])
    found = suspected_regions(seen(added(part, values)))
    best = min(found, key=lambda each: found[each][0].log_p)
    assert best == name
    first = found[name][0]
    assert first.region.overlap(region, PIXELS) >= 0.8
    assert first.only_there
    assert first.log_p < -30


def test_row_noise_of_some_frames_is_told_by_its_frames() -> None:
    found = suspected_frames(seen(added(np.s_[200:260], 1.2 * NOISE((60, 40, 1)))))
    assert found["row.readout"][0].when.numbers() == {"range": [[200, 260]]}


def test_frames_that_are_noisier_in_every_sample_by_itself_are_told() -> None:
    found = suspected_frames(seen(added(np.s_[200:280], 0.8 * NOISE((80, *PIXELS)))))
    [[first, last]] = found["frame.noise"][0].when.numbers()["range"]
    assert abs(first - 200) + abs(last - 280) <= 8


def test_an_electron_in_a_dark_row_makes_no_frame_stand_out() -> None:
    n = 8000
    frames = PlainCamera(0.4, 5.0, 8.2, (16, 16), n, layout="overscan").frames(1)
    evidence = observe(frames, np.arange(n), n_run=n, block_frames=100)
    assert evidence.maps.usable[:2].any()
    for line in ("row", "column"):
        values = frame_series(evidence)[f"{line}.charge"]
        # the largest of so many normal numbers is beyond 5.5 once in 3,000
        assert np.abs(values).max() < 5.5
        assert abs(values.std() - 1.0) < 0.1


def test_clean_frames_have_no_place_and_no_time_and_their_maps_and_series_are_standard_normal() -> None:
    evidence = seen()
    assert suspected_regions(evidence) == suspected_frames(evidence) == {}
    maps, series = pixel_maps(evidence), frame_series(evidence)
    assert len(maps) == 8 + 2 + 3 + 4 + 6
    for name, values in (maps | series).items():
        z = values[np.isfinite(values)]
        assert abs(z.mean()) < 5.0 / np.sqrt(z.size) + 0.05, name
        assert 0.8 < z.std() < 1.2, name
    # every statistic is asked of one of them, or of none
    assert {map_of(name) for name in STATISTICS} - {""} <= set(maps)
    assert {known.series for known in STATISTICS.values()} - {""} <= set(series)
    assert (map_of("space.x.rk@rows=0:4"), map_of("code.rough")) == ("x.rk", "")
    assert STATISTICS["space.row.readout.lag1"].series == "row.readout"


def test_pixels_whose_levels_wander_are_listed_and_no_others() -> None:
    def moved(dn: Array) -> Array:
        levels = 3.0 * np.random.default_rng(3).standard_normal((10, 2))
        dn[:, [30, 36], [60, 7]] += np.repeat(levels, 50, axis=0)
        return dn

    evidence = seen(moved)
    names = ("time.block.charge.cnt", "time.block.readout.cnt")
    assert {p for name in names for p in _pixels(name, evidence, pixel_maps(evidence))} == {(30, 60), (36, 7)}


def test_an_outlying_code_is_one_code_and_no_frame() -> None:
    evidence = seen()
    code = replace(evidence.code, observed=evidence.code.observed.copy())
    code.observed[20:24] += [400.0, 900.0, 800.0, 400.0]
    evidence = replace(evidence, code=code)
    assert _codes("code.largest", evidence) == (code.first + 21, code.first + 21)
    low, high = _codes("code.smooth", evidence) or (0, 0)
    assert low < high
    assert _frames("code.largest", evidence) == ()
    assert len(_frames("frame.charge.largest", evidence)) == 1


def test_a_place_counts_from_the_corner_of_the_sensor() -> None:
    inside = Place.of("space.x.rr", 9.0, region={"columns": [[2, 6]]}, when={"range": [[3, 9]]})
    moved = inside.shifted((100, 200), (10, 30), (40, 60))
    assert moved.region == {"rows": [[10, 30]], "columns": [[42, 46]]}
    assert inside.shifted((20, 20), (0, 20), (0, 20)) == inside
    assert moved.spot() == "mainly in rows 10 to 29, columns 42 to 45, frames 3 to 8"


def test_pixels_without_a_fit_have_a_place_where_they_come_together_and_else_none() -> None:
    rng = np.random.default_rng(5)
    alarms = [unfitted_place(rng.random((32, 32)) > 0.02) for _ in range(100)]
    assert sum(each is not None for each in alarms) <= 2  # 0.1 are meant
    usable = rng.random((32, 32)) > 0.005
    usable[:, 6:9] &= rng.random((32, 3)) > 0.25
    place = unfitted_place(usable)
    assert place.region.overlap(Region(columns=((6, 9),)), usable.shape) > 0.6
    assert unfitted_place(np.ones((32, 32), np.bool_)) is None
