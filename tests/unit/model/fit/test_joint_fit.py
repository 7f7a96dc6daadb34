"""The joint fit against dense algebra, finite differences, plain numpy EM, iminuit and the single fit."""

from typing import NamedTuple

import numpy as np
import pytest
from helpers.drawn_pixels import draw
from helpers.em_trace import LIMITS, evaluated
from helpers.reference_pchem import Theta, memberships

from pchem_pipeline.model.errors import algebra_numba
from pchem_pipeline.model.fit import tile_numba
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.climb_numba import em_step
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.model.law import cells_numba
from pchem_pipeline.model.law.inputs import pack
from pchem_pipeline.model.law.likelihood import cells_likelihood, density_likelihood
from pchem_pipeline.model.law.pixel_numba import (
    AT,
    CENTRE,
    DAMPING,
    DERIVATIVES,
    FIRST,
    HELD,
    INFORMATION,
    N_BINS,
    SCORE,
    WEIGHT,
    make_scratch,
)
from pchem_pipeline.model.law.sample_law import SampleLaw

EXACT = FitSettings(likelihood="exact")


class Drawn(NamedTuple):
    """Histograms of J samples, and which of them are dark."""

    counts: list
    origins: list
    dark: list


def draw_series(rng, exposures, noise_e, n_pixels, *, step=10.0, bias=100.3, n_frames=4000):
    """Draw n pixels at each exposure; an exposure of 0 is a sample without electrons."""
    counts, origins = [], []
    for exposure in exposures:
        if exposure > 0:
            drawn = draw(rng, np.full(n_pixels, exposure), step, noise_e, bias, n_frames)
            counts.append(drawn.counts)
            origins.append(drawn.origin)
            continue
        sd = np.sqrt((noise_e * step) ** 2 - 1 / 12)
        codes = np.rint(bias + sd * rng.standard_normal((n_pixels, n_frames))).astype(np.int64)
        low, width = codes.min(), int(np.ptp(codes)) + 1
        counts.append(np.stack([np.bincount(row - low, minlength=width) for row in codes]).astype(np.uint32))
        origins.append(np.full(n_pixels, low))
    return Drawn(counts, origins, [exposure == 0 for exposure in exposures])


class Series:
    """One pixel of a series as the loops take it."""

    def __init__(self, series):
        places = np.concatenate([[0], np.cumsum([c.shape[1] for c in series.counts])]).astype(np.int64)
        counts = np.concatenate([c[:1] for c in series.counts], axis=1).astype(np.uint32)
        origin = np.array([[o[0] for o in series.origins]], np.int64)
        given = tile_numba.Histograms(
            counts, places, origin, np.array(series.dark), np.zeros(counts.shape, np.uint8)
        )
        law = pack([SampleLaw()] * len(series.counts), 1)
        self.pixel = tile_numba.load_pixel(given, 0, tile_numba.make_room(given, law))
        cells_numba.resolve(law, 0, 0.0, self.pixel)
        self.scratch = make_scratch(len(series.counts), int(np.diff(places).max()), True)
        self.at = self.scratch.evaluations[AT]
        self.dark = np.array(series.dark)

    def theta(self, exposures, step, bias, v):
        log = [np.log(h) if h > 0 else -60.0 for h in exposures]
        return np.array([*log, step, bias - self.pixel.centre, v, 0.0])

    def codes(self, j):
        """Values from the bias's own zero, and counts, of a sample."""
        facts = self.pixel.facts[j]
        n = int(facts[N_BINS])
        first = self.pixel.centre + facts[CENTRE] + facts[FIRST]
        return first + np.arange(n), self.pixel.bins[j, WEIGHT, :n]

    def __call__(self, theta, exact):
        likelihood = cells_likelihood() if exact else density_likelihood()
        return evaluated(self.pixel, theta, DERIVATIVES, likelihood, self.scratch)

    def dense(self):
        """Score and information of all but the weight of satellites as one vector and matrix."""
        n = self.dark.size
        score, matrix = np.zeros(n + 3), np.zeros((n + 3, n + 3))
        for j in range(n):
            where = [j, n, n + 1, n + 2]
            score[where] += self.at[j, SCORE, :4]
            lower = np.tril(self.at[j, INFORMATION : INFORMATION + 4, :4])
            matrix[np.ix_(where, where)] += lower + np.tril(lower, -1).T
        return score, matrix


@pytest.fixture
def pixel():
    return Series(draw_series(np.random.default_rng(5), [0.7, 3.0, 0.0], 0.35, 1, n_frames=600))


@pytest.mark.parametrize("exact", [False, True])
def test_score_and_information_are_the_derivatives(pixel, exact):
    theta = pixel.theta([0.8, 2.7, 0.0], 9.7, 100.9, np.log(13.0))
    free = [0, 1, 3, 4, 5]
    pixel(theta, exact)
    score, information = pixel.dense()
    for i in free:
        h = 1e-4 * max(1.0, abs(theta[i]))
        ends = []
        for sign in (1, -1):
            moved = theta.copy()
            moved[i] += sign * h
            value = pixel(moved, exact)
            ends.append((value, pixel.dense()[0]))
        assert score[i] == pytest.approx((ends[0][0] - ends[1][0]) / (2 * h), rel=1e-5, abs=1e-3)
        slope = -(ends[0][1] - ends[1][1]) / (2 * h)
        np.testing.assert_allclose(
            information[i, free], slope[free], rtol=1e-4, atol=1e-3 * np.abs(slope).max()
        )


@pytest.mark.parametrize("exact", [False, True])
def test_the_arrow_is_solved_and_inverted_as_a_whole(pixel, exact):
    theta = pixel.theta([0.8, 2.7, 0.0], 9.7, 100.9, np.log(13.0))
    pixel(theta, exact)
    held = pixel.scratch.flags[HELD]
    held[:] = [False, False, True, False, False, False, True]
    step = np.empty(7)
    squared = algebra_numba.solve_arrow(pixel.at, 0.0, pixel.scratch, step)
    score, matrix = pixel.dense()
    free = [0, 1, 3, 4, 5]
    wanted = np.linalg.solve(matrix[np.ix_(free, free)], score[free])
    np.testing.assert_allclose(step[free], wanted, rtol=1e-8)
    assert squared == pytest.approx(wanted @ score[free], rel=1e-8)
    assert step[2] == step[6] == 0
    pixel.at[:, SCORE] = 0.0
    covariance = np.empty((7, 7))
    assert algebra_numba.invert_arrow(pixel.at, theta, held, covariance)
    scale = np.array([np.exp(-theta[0]), np.exp(-theta[1]), 1, 1, 1])
    own = matrix[np.ix_(free, free)] * scale[:, None] * scale
    np.testing.assert_allclose(covariance[np.ix_(free, free)], np.linalg.inv(own), rtol=1e-7)
    assert (covariance[[2, 6]] == 0).all()
    pixel.at[:, INFORMATION:DAMPING] = 1.0  # singular
    assert np.isnan(algebra_numba.solve_arrow(pixel.at, 0.0, pixel.scratch, step))
    assert not algebra_numba.invert_arrow(pixel.at, theta, held, covariance)


def test_an_em_step_is_that_of_the_paper_with_all_samples(pixel):
    theta = pixel.theta([0.8, 2.7, 0.0], 9.7, 100.9, np.log(13.0))
    pixel(theta, False)
    out = np.empty(7)
    limits = LIMITS._replace(bound=-20.0)
    assert em_step(pixel.pixel, theta, pixel.at, limits, out)
    a, b, c, x1, x2, n, mean_k = [], [], [], [], [], [], []
    for j, exposure in enumerate((0.8, 2.7, 0.0)):
        codes, weights = pixel.codes(j)
        x = np.repeat(codes, weights.astype(int))
        k = np.zeros((x.size, 1))
        gamma = np.ones((x.size, 1))
        if exposure > 0:
            gamma = memberships(x, Theta(exposure, 1 / 9.7, 100.9, np.sqrt(13.0)))
            k = np.arange(gamma.shape[1])[None, :]
        k1, k2 = (gamma * k).sum(axis=1), (gamma * k**2).sum(axis=1)
        mean_k.append(k1.mean())
        for total, value in zip(
            (a, b, c, x1, x2, n), (k1, k2, x * k1, x, x**2, np.ones(x.size)), strict=True
        ):
            total.append(value.sum())
    a, b, c, x1, x2 = (sum(total) / sum(n) for total in (a, b, c, x1, x2))
    step = (c - x1 * a) / (b - a**2)
    bias = x1 - a * step
    variance = x2 - x1**2 - (b - a**2) * step**2
    np.testing.assert_allclose(np.exp(out[:2]), mean_k[:2], rtol=1e-9)
    np.testing.assert_allclose(out[3:6], [step, bias - pixel.pixel.centre, np.log(variance)], rtol=1e-8)


@pytest.mark.parametrize("settings", [FitSettings(), EXACT])
def test_one_sample_is_the_single_fit(settings):
    drawn = draw(np.random.default_rng(3), [0.5, 2.0, 6.0], 10.0, 0.3)
    single = fit_histograms(drawn.counts, drawn.origin)
    joint = fit_histograms([drawn.counts], [drawn.origin], settings=settings)
    errors = np.sqrt(np.diagonal(single.covariance, axis1=1, axis2=2))
    close = 1e-4 if settings.likelihood == "density" else 0.05
    for i, name in enumerate(("quanta_exposure", "conversion_gain", "bias", "read_noise_dn")):
        mine = np.ravel(getattr(joint, name))
        assert (np.abs(mine - getattr(single, name)) < close * errors[:, i]).all()
    np.testing.assert_allclose(
        np.diagonal(joint.covariance, axis1=1, axis2=2), errors**2, rtol=1e-3 if close < 1e-3 else 0.05
    )
    assert (joint.fit_status == single.fit_status).all()


def test_a_pixel_does_not_depend_on_the_others():
    series = draw_series(np.random.default_rng(4), [0.6, 2.5], 0.5, 4)
    together = fit_histograms(series.counts, series.origins)
    alone = fit_histograms([c[2:3] for c in series.counts], [o[2:3] for o in series.origins])
    assert together.conversion_gain[2] == alone.conversion_gain[0]
    np.testing.assert_array_equal(together.covariance[2], alone.covariance[0])


def test_words_say_why_a_pixel_has_no_value():
    series = draw_series(np.random.default_rng(6), [0.6, 2.5, 0.0], 0.3, 3)
    series.counts[1][0] = 0
    for j in (0, 1):
        series.counts[j][1] = 0
        series.counts[j][1, 5] = 4000
    found = fit_histograms(
        series.counts, series.origins, dark=series.dark, adc_limits=(0, 150), under=np.array([0, 0, 3])
    )
    assert found.fit_status[0] & FitStatus.NO_DATA
    assert found.fit_status[1] & FitStatus.TOO_FEW_BINS
    assert np.isnan(found.conversion_gain[:2]).all()
    assert found.fit_status[2] & FitStatus.ADC_LIMIT
    assert found.fit_status[2] & FitStatus.OUTSIDE_WINDOW
    assert np.isfinite(found.conversion_gain[2])


def test_samples_without_any_electrons_do_not_give_a_gain():
    series = draw_series(np.random.default_rng(6), [0.0, 0.0], 0.3, 3)
    found = fit_histograms(series.counts, series.origins, dark=[False, True])
    assert np.isnan(found.conversion_gain).all()
    lacking = FitStatus.GAIN_NOT_IDENTIFIED | FitStatus.EXPOSURE_AT_BOUND | FitStatus.NOT_CONVERGED
    assert ((found.fit_status & int(lacking)) != 0).all()


def test_what_does_not_fit_together_is_refused():
    series = draw_series(np.random.default_rng(6), [0.6, 2.5], 0.3, 3)
    with pytest.raises(ValueError, match="no sample has electrons"):
        fit_histograms(series.counts, series.origins, dark=[True, True])
    with pytest.raises(ValueError, match="one entry per sample"):
        fit_histograms(series.counts, series.origins[:1])
    with pytest.raises(ValueError, match=r"different numbers of pixels: \[2, 3\]"):
        fit_histograms([series.counts[0], series.counts[1][:2]], series.origins)


def test_a_few_glitches_do_not_move_the_estimates():
    series = draw_series(np.random.default_rng(12), [0.6, 3.0, 0.0], 0.4, 6)
    clean = fit_histograms(series.counts, series.origins, dark=series.dark)
    assert (clean.outlier_share == 0).all()
    counts = [np.pad(sample, ((0, 0), (0, 3000))) for sample in series.counts]
    for j, place in ((0, 2500), (1, 900), (2, 1700)):
        counts[j][:, place] += 2
    errors = np.sqrt(np.diagonal(clean.covariance, axis1=1, axis2=2))[:, [0, 1, 3, 4, 5]]
    shifts = {}
    for guard in (1e-3, 0.0):
        found = fit_histograms(
            counts, series.origins, dark=series.dark, settings=FitSettings(tail_guard=guard)
        )
        mine, others = (
            np.column_stack([f.quanta_exposure[:, :2], f.conversion_gain, f.bias, f.read_noise_dn])
            for f in (found, clean)
        )
        shifts[guard] = np.abs(mine - others) / errors
        if guard:
            np.testing.assert_allclose(found.outlier_share, 6 / (3 * 4000 + 6), rtol=1e-9)
    assert shifts[1e-3].max() < 0.1
    assert not (shifts[0.0].max(axis=1) < 2.0).any()
