"""Scans of rare events: places and frames where they come together more than chance lets them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from pchem_pipeline.discrepancy.scan_events import log_binomial_tail, scan_event_frames, scan_event_map
from pchem_pipeline.effects.framework.region import Region, When

SHAPE, FRAMES = (32, 32), 1500
EVERY = np.ones(SHAPE, np.bool_)


def mask_of(**region):
    return Region.model_validate(region).mask(SHAPE)


@pytest.mark.parametrize(
    "place",
    [
        mask_of(columns=[12, 15]),
        mask_of(rows=[4, 8]),
        mask_of(taps={"every": 8, "which": 5}),
        mask_of(rows=[10, 20], columns=[16, 26]),
    ],
)
def test_events_of_a_place_are_found_there(place):
    """Sixteen or so in a tenth of the pixels, and a dozen by chance anywhere."""
    rng = np.random.default_rng(int(place.sum()))
    seen = rng.random(SHAPE) < 0.01 + 0.2 * place
    found = scan_event_map(seen, np.full(SHAPE, 0.01), EVERY)
    assert len(found) == 1
    assert found[0].region.overlap(Region.of_mask(place), SHAPE) > 0.6
    assert found[0].only_there
    # a rate between those of a binomial number five deviations off
    assert abs(found[0].inside - 0.2) < 5.0 * np.sqrt(0.2 * 0.8 / place.sum()) + 0.04


def test_chance_has_no_place_and_follows_the_share_of_each_pixel():
    """Of 200 maps at 5 %, ten are allowed; five standard errors above that is 26."""
    share = np.where(mask_of(columns=[0, 16]), 0.1, 0.005)
    rng = np.random.default_rng(1)
    drawn = [rng.random(SHAPE) < share for _ in range(200)]
    assert sum(bool(scan_event_map(seen, share, EVERY, significance=0.05)) for seen in drawn) <= 26
    # taken for alike, the pixels of either half are a place
    assert sum(bool(scan_event_map(seen, np.ones(SHAPE), EVERY)) for seen in drawn[:20]) == 20


def test_a_binomial_tail_is_that_of_the_law():
    for k, n, share in ((3, 8, 0.09), (16, 16, 0.1), (1, 40, 0.5)):
        assert log_binomial_tail(k, n, share) == pytest.approx(stats.binom.logsf(k - 1, n, share), rel=1e-9)


def test_a_range_of_frames_with_events_is_found():
    rng = np.random.default_rng(2)
    for _ in range(20):
        happened = rng.random(FRAMES) < 0.004
        happened[600:760] |= rng.random(160) < 0.15
        numbers = np.arange(100, 100 + FRAMES)
        found = scan_event_frames(np.flatnonzero(happened), numbers, expected=6.0, shortest=64)
        assert found is not None
        inside = found.when.frames(numbers)
        wanted = np.zeros(FRAMES, np.bool_)
        wanted[600:760] = True
        # of 24 events the outermost lie seven frames from the ends on average
        assert (inside & wanted).sum() > 0.6 * (inside | wanted).sum()
        assert found.only_there


def test_of_very_many_events_some_tell_the_range():
    rng = np.random.default_rng(4)
    happened = rng.random(50_000) < np.where((np.arange(50_000) // 5000) == 3, 0.4, 0.1)
    found = scan_event_frames(np.flatnonzero(happened), np.arange(50_000), shortest=64)
    assert found is not None
    assert found.when.overlap(When(range=((15_000, 20_000),)), 50_000) > 0.8


def test_chance_has_no_range():
    """Of 300 series at 5 %, 15 are allowed; five standard errors above that is 34."""
    rng = np.random.default_rng(3)
    drawn = [np.sort(rng.choice(FRAMES, n, replace=False)) for n in rng.integers(3, 60, 300)]
    found = [scan_event_frames(each, np.arange(FRAMES), significance=0.05, shortest=64) for each in drawn]
    assert sum(each is not None for each in found) <= 34
    assert scan_event_frames(np.array([5, 6]), np.arange(FRAMES), significance=1.0) is None
