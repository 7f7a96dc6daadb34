"""Rare samples: how rare each is, and that one disturbance is one event."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.small_stacks import small_stack
from scipy import stats

from pchem_pipeline.discrepancy.observe.observe import observe
from pchem_pipeline.discrepancy.observe.rare import expected_beyond, rare_samples, single_samples
from pchem_pipeline.effects.framework.evidence import MOST_HITS, PixelMaps


def observed(frames):
    return observe(frames, np.arange(1000, 1000 + len(frames)), n_run=2000, block_frames=20)


@pytest.mark.parametrize("exposure", [0.4, 3.0, 80.0])
def test_a_sample_is_as_rare_as_the_law_of_its_pixel_makes_it(exposure):
    one = np.ones((1, 2))
    maps = PixelMaps.known((exposure * one, one / 11.0, 100.0 * one, 3.0 * one), one > 0)
    width, k = np.sqrt(9.0 - 1.0 / 12.0), np.arange(400)
    level = 100.0 + 11.0 * k
    for above, codes in ((False, (88, 95)), (True, (160, 1400))):
        hits = np.array([[7, 0, 1, code] for code in codes])
        wanted = [
            500 * (stats.poisson.pmf(k, exposure) * stats.norm.cdf(
                (level - code + 0.5 if above else code + 0.5 - level) / width
            )).sum()
            for code in codes
        ]  # fmt: skip
        assert expected_beyond(hits, maps, 500, above=above) == pytest.approx(wanted, rel=1e-6)


def test_a_disturbed_row_and_an_odd_pixel_are_one_event_each():
    row = [[5, 3, x, 60] for x in range(8)]
    pixel = [[t, 6, 2, 60] for t in range(10, 30)]
    alone = [[40, 1, 1, 60]]
    kept = single_samples(np.array([*row, *pixel, *alone]))
    assert len(kept) == 3
    assert len({int(t) for t in kept[:, 0]}) == len({(int(y), int(x)) for y, x in kept[:, 1:3]}) == 3
    assert single_samples(np.empty((0, 4), np.int64)).shape == (0, 4)


def test_samples_far_below_are_listed_and_are_the_rarer_ones():
    frames = small_stack((10, 10), 400, 3)
    frames[30, 2, 2], frames[60, 4, 4] = 72, 74
    evidence = observed(frames)
    assert evidence.time is not None
    low = evidence.time.low_hits
    assert {(1030, 2, 2, 72), (1060, 4, 4, 74)} <= {tuple(map(int, hit)) for hit in low}
    assert len(low) == evidence.tail_low.sum()
    beyond, rarer, *_ = rare_samples(evidence)
    assert beyond.expected.max() <= 1e-2
    assert rarer.expected.sum() <= 1.0
    assert rarer.seen[2, 2]
    assert rarer.seen[4, 4]
    assert rarer.seen.sum() <= beyond.seen.sum()


def test_a_tail_of_which_not_all_samples_are_listed_says_nothing_of_places():
    evidence = observed(small_stack((10, 10), 400, 3))
    assert evidence.time is not None
    assert len(list(rare_samples(evidence))) == 4
    many = np.zeros((MOST_HITS, 4), np.int64)
    assert len(list(rare_samples(replace(evidence, time=replace(evidence.time, low_hits=many))))) == 2
    assert list(rare_samples(replace(evidence, tail_expected=None))) == []
