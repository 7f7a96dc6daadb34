"""Estimates sit at the right maximum, and gaps are those to the neighbours."""

import numpy as np
import pytest
from helpers.drawn_pixels import draw
from helpers.em_trace import em_trace

from pchem_pipeline.methods.plain_em import starting_points
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.law.pcd import log_pcd


def wrong(result, truth):
    """Bias off by more than half an electron, gain by a quarter, or no answer."""
    _, gain, bias, _ = result.columns.T
    return ~((np.abs(bias - truth[:, 2]) * truth[:, 1] < 0.5) & (np.abs(gain / truth[:, 1] - 1) < 0.25))


def drawn_in_range(seed, n, exposure, noise, **k):
    rng = np.random.default_rng(seed)
    h = np.exp(rng.uniform(*np.log(exposure), n))
    return draw(rng, h, rng.uniform(8, 14, n), rng.uniform(*noise, n), rng.uniform(95, 105, n), **k)


def test_the_right_maximum_is_found_or_flagged():
    pixels = drawn_in_range(32, 4000, (0.1, 10), (0.15, 0.35))
    result = fit_histograms(pixels.counts, pixels.origin)
    assert not np.any(wrong(result, pixels.truth) & (result.fit_status == 0))
    assert np.mean(result.fit_status == 0) > 0.999
    # outside of the range a wrong answer may be had, but not without a word
    for exposure, noise in (((15, 60), (0.2, 0.4)), ((2, 10), (0.5, 0.7))):
        pixels = drawn_in_range(33, 300, exposure, noise)
        result = fit_histograms(pixels.counts, pixels.origin)
        bad = wrong(result, pixels.truth)
        assert bad.sum() > 5  # so hard that some are wrong
        assert np.count_nonzero(bad & (result.fit_status == 0)) <= 1


def test_with_few_frames_no_answer_is_less_likely_than_the_truth():
    """A global maximum never is; maxima at wrong gains are, where the side lobe sinks into the noise."""
    pixels = drawn_in_range(64, 1500, (1.5, 5), (0.36, 0.42), n_frames=1000)
    result = fit_histograms(pixels.counts, pixels.origin)
    x = pixels.origin[:, None] + np.arange(pixels.counts.shape[1])
    at_truth = (pixels.counts * log_pcd(x, *pixels.truth.T[:, :, None])).sum(axis=1)
    gain = result.log_likelihood - at_truth
    unflagged = result.fit_status == 0
    assert unflagged.mean() > 0.3
    # with the first starting point alone it happens to 8 of these pixels
    assert np.count_nonzero(gain[unflagged] < -1e-9) <= 1


def test_a_gap_below_thirty_is_that_to_the_polished_neighbour():
    pixels = draw(np.random.default_rng(35), 12.0, 11.0, 0.33)
    result = fit_histograms(pixels.counts, pixels.origin)
    best = result.columns[0]
    a = 1 / best[1]
    starts = [(best[0] + d, best[1], best[2] - d * a, best[3]) for d in (-1, 1)]
    paths = [em_trace(pixels.counts[0], int(pixels.origin[0]), start, 6000) for start in starts]
    assert 0 < result.likelihood_gap[0] < 30
    heights = [path.log_likelihood[-1] for path in paths]
    assert result.log_likelihood[0] - max(heights) == pytest.approx(result.likelihood_gap[0], abs=1e-3)


@pytest.mark.parametrize("case", [(1.0, 0.2), (2.8, 0.35), (4.0, 0.22), (5.6, 0.3)])
def test_a_large_expected_gap_is_that_to_the_polished_neighbour_but_for_some(case):
    pixels = draw(np.random.default_rng(38), case[0], 11.0, case[1])
    result = fit_histograms(pixels.counts, pixels.origin)
    h, g, mu, sigma = result.columns[0]
    origin, heights = int(pixels.origin[0]), []
    for d in (-1, 1):
        if h + d > 0.1:
            path = em_trace(pixels.counts[0], origin, (h + d, g, mu - d / g, sigma), 3000)
            if abs(path.parameters[-1, 2] - mu) > 0.3 / g:
                heights.append(path.log_likelihood[-1])
    gap = result.log_likelihood[0] - max(heights)
    assert result.n_iterations[0] < 8  # the neighbours were not visited
    assert gap > 80
    assert result.likelihood_gap[0] == pytest.approx(gap, rel=0.4)


@pytest.mark.parametrize(("exposure", "methods"), [((0.15, 0.6), 1), ((1.5, 8), 2)])
def test_starting_points_are_near_where_they_should_be(exposure, methods):
    """By the regression, and of more electrons by the side lobe too."""
    pixels = drawn_in_range(42, 200, exposure, (0.2, 0.35))
    gain = starting_points(pixels.counts, pixels.origin)[:, :methods, 1]
    assert (np.median(np.abs(gain / pixels.truth[:, 1:2] - 1), axis=0) < 0.15).all()
