"""Derived maps, quality, robust summaries and the display."""

import numpy as np
import pytest

from pchem_pipeline.model.ensemble.settings import EnsembleSettings
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.status import FAILED, FitStatus
from pchem_pipeline.model.law.mass import draw_histograms
from pchem_pipeline.model.maps.maps import (
    CAUTION,
    GOOD,
    NO_VALUE,
    derived_maps,
    electron_shifts,
    quality_map,
    status_counts,
    summarise,
)
from pchem_pipeline.model.maps.ordered import Ordered, median_of
from pchem_pipeline.model.maps.sample_maps import exposure_line
from pchem_pipeline.stages.maps import maps_tile

PARAMETERS = {
    "quanta_exposure": np.array([[2.0, 1.0]]),
    "conversion_gain": np.array([[0.1, 0.5]]),
    "bias": np.array([[100.0, 90.0]]),
    "read_noise_dn": np.array([[3.0, 0.8]]),
}


def make_covariance():
    root = np.random.default_rng(1).standard_normal((1, 2, 4, 4)) * np.array([0.01, 1e-3, 0.1, 0.02])[:, None]
    return np.asarray(root @ np.swapaxes(root, -1, -2))


def numeric_stderr(function, covariance, at):
    """Delta method with derivatives by central differences."""
    step = 1e-5 * np.diag(at)
    slopes = (function(*(at + step).T) - function(*(at - step).T)) / (2e-5 * at)
    return float(np.sqrt(slopes @ covariance @ slopes))


FUNCTIONS = {
    "read_noise_e": lambda h, g, mu, s: g * s,
    "analog_read_noise_e": lambda h, g, mu, s: g * np.sqrt(s * s - 1 / 12),
    "charge_rate": lambda h, g, mu, s: h / 4.87,
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_derived_maps_and_their_errors(name):
    covariance = make_covariance()
    maps = derived_maps(PARAMETERS, covariance, 4.87)
    for x, at in enumerate(np.concatenate([*PARAMETERS.values()]).T):
        assert maps[name][0, x] == pytest.approx(FUNCTIONS[name](*at), rel=1e-12)
        expected = numeric_stderr(FUNCTIONS[name], covariance[0, x], at)
        assert maps[f"{name}_stderr"][0, x] == pytest.approx(expected, rel=1e-6)


def test_noise_below_rounding_has_no_analog_part():
    below = {**PARAMETERS, "read_noise_dn": np.array([[0.28, np.nan]])}
    maps = derived_maps(below, make_covariance(), None)
    assert np.isnan([maps["analog_read_noise_e"], maps["analog_read_noise_e_stderr"]]).all()
    assert maps["read_noise_e"][0, 0] == pytest.approx(0.028)
    assert "charge_rate" not in maps


@pytest.mark.parametrize(("exposure", "noise", "n_frames"), [(8.0, 0.15, 1000), (80.0, 0.25, 2000)])
def test_the_error_of_h_holds_the_chance_of_being_electrons_off(exposure, noise, n_frames):
    rng = np.random.default_rng(3)
    drawn = draw_histograms(rng, np.full(120, exposure), 0.09, 100 + rng.random(120), noise, n_frames)
    fit = fit_histograms(drawn.counts, drawn.origin)
    stored = {name: getattr(fit, name) for name in (*PARAMETERS, "fit_status", "likelihood_gap")}
    errors = np.sqrt(np.diagonal(fit.covariance, axis1=1, axis2=2))
    stored |= {f"{name}_stderr": errors[:, i] for i, name in enumerate(PARAMETERS)}
    stored["correlation"] = np.zeros((120, 6))
    maps = maps_tile(stored, 2.0, n_frames=n_frames)
    pull = (fit.quanta_exposure - exposure) / maps["quanta_exposure_stderr"]
    # of 120 pulls the root mean square is known to 7 %; by the curvature alone it is 4 and 12
    assert 0.65 < np.sqrt(np.mean(pull**2)) < 1.3
    assert np.sqrt(np.mean(((fit.quanta_exposure - exposure) / errors[:, 0]) ** 2)) > 3
    off = (fit.bias - drawn.truth[:, 2]) / maps["bias_stderr"]
    assert 0.65 < np.sqrt(np.mean(off**2)) < 1.3
    assert maps["charge_rate_stderr"] == pytest.approx(maps["quanta_exposure_stderr"] / 2, rel=0.05)
    np.testing.assert_array_equal(maps["conversion_gain_stderr"], errors[:, 1])
    # the width of the law, which tells the electrons, is not that of a law cut by the window
    stored["fit_status"] |= int(FitStatus.OUTSIDE_WINDOW)
    ambiguous = (stored["fit_status"] & int(FitStatus.BIAS_AMBIGUOUS)) != 0
    cut = maps_tile(stored, 2.0, n_frames=n_frames)
    assert ambiguous.any()
    for name in ("quanta_exposure_stderr", "bias_stderr", "charge_rate_stderr"):
        np.testing.assert_array_equal(np.isnan(cut[name]), ambiguous)


def test_no_chance_of_being_off_where_the_gap_is_large():
    exposure, gap = np.array([2.0, 2.0, np.nan, 0.0, 8.0]), np.array([40.0, 3.0, np.nan, 1.0, 2.0])
    m, probability = electron_shifts(exposure, gap, 1000)
    np.testing.assert_allclose(probability.sum(axis=1), 1.0)
    right = probability[:, m == 0].ravel()
    assert 1.0 - right[0] < 1e-15
    assert right[1] == pytest.approx(1 / (1 + np.exp(-3)), rel=0.01)  # of one rival
    assert right[2:4].tolist() == [1.0, 1.0]
    # a gap of 2 nats: the rival on one side, and on the other one at 1 / s^2 - 2 = 5.8 nats
    others = probability[4] / right[4]
    assert others[m == 1] == pytest.approx(np.exp(-2.0))
    assert others[m == -1] == pytest.approx(np.exp(2.0 - 1000 / 128))


def test_quality_follows_the_status():
    status = np.array([0, int(FitStatus.BIAS_AMBIGUOUS), int(FitStatus.NO_DATA), 0], dtype=np.uint16)
    gain = np.array([0.1, 0.1, np.nan, np.nan])
    np.testing.assert_array_equal(quality_map(status, gain), [GOOD, CAUTION, NO_VALUE, NO_VALUE])
    for bit in FitStatus:
        if bit & FAILED:
            assert quality_map(np.array([int(bit)]), np.array([0.1]))[0] == NO_VALUE


def test_every_reason_is_counted():
    counts = status_counts(np.array([[0, 32, 32 | 512], [1, 0, 0]], dtype=np.uint16))
    seen = {name: number for name, number in counts.items() if number}
    assert seen == {"ok": 3, "bias_ambiguous": 2, "poor_fit": 1, "no_data": 1}
    assert len(counts) == 1 + len(FitStatus)


def test_a_handful_of_hot_pixels_does_not_move_the_summary():
    rng = np.random.default_rng(4)
    values = 0.3 + 0.02 * rng.standard_normal((100, 100))
    clean = summarise(values)
    values.flat[:8] = [*7 * [1e6], np.nan]
    found = summarise(values)
    assert found.median == pytest.approx(clean.median, abs=3 * clean.median_stderr)
    assert found.robust_sd == pytest.approx(clean.robust_sd, rel=0.01)
    assert (found.n_high, found.n_low, found.n_missing, found.n_valid) == (7, 0, 1, 9999)
    assert found.maximum == 1e6
    assert clean.n_high == 0
    assert found.percentiles[99.0] == pytest.approx(clean.percentiles[99.0], rel=0.01)
    nothing, one = summarise(np.full((2, 2), np.nan)), summarise(np.array([3.0]))
    assert (nothing.n_missing, one.n_high, one.median) == (4, 0, 3.0)
    assert np.isnan([nothing.median, one.median_stderr]).all()


def test_median_error_of_a_normal_map():
    values = np.random.default_rng(5).standard_normal(40_000)
    # the distance of two order statistics 200 ranks apart scatters by 1/sqrt(200) of itself
    expected = np.sqrt(np.pi / 2) / 200
    assert summarise(values).median_stderr == pytest.approx(expected, rel=5 / np.sqrt(200))


def test_an_ensemble_needs_a_frame():
    with pytest.raises(ValueError, match="at least one frame"):
        EnsembleSettings(frames=0)


TIMES = np.array([0.5, 1.0, 2.0, 4.0])


def test_equal_independent_errors_are_ordinary_least_squares():
    rng = np.random.default_rng(1)
    exposures = 5.0 + 0.1 * TIMES + 0.01 * rng.standard_normal((3, 4))
    line, _, left = exposure_line(
        exposures, np.tile(1e-4 * np.eye(4), (3, 1, 1)), np.full((3, 4), 1e-4), TIMES
    )
    slope, offset = np.polyfit(TIMES, exposures.T, 1)
    assert line[:, 0] == pytest.approx(slope, rel=0.01)
    assert line[:, 1] == pytest.approx(offset, rel=0.001)
    np.testing.assert_allclose(left["linearity_residual"], exposures - line[:, :1] * TIMES - line[:, 1:])


def test_an_error_that_all_exposures_share_goes_into_the_offset():
    rng = np.random.default_rng(2)
    n, shared = 4000, 0.2
    own = np.sqrt((1.05 + 0.3 * TIMES) / 2000)
    exposures = 1.05 + 0.3 * TIMES + own * rng.standard_normal((n, 4)) + shared * rng.standard_normal((n, 1))
    covariance = np.tile(np.diag(own**2) + shared**2, (n, 1, 1))
    line, spread, left = exposure_line(exposures, covariance, np.tile(own**2, (n, 1)), TIMES)
    pull = (line[:, 0] - 0.3) / np.sqrt(spread[:, 0, 0])
    assert abs(pull.mean()) < 5 / np.sqrt(n)
    assert abs(pull.std() - 1) < 5 / np.sqrt(2 * n)
    # unaware of the shared error, the slope would be weighed wrongly: its error is far below the shared one
    assert np.sqrt(spread[:, 0, 0]).max() < 0.1 * shared < np.sqrt(spread[:, 1, 1]).min()
    assert abs(left["linearity_chi2"].mean() - 2) < 5 * 2 / np.sqrt(n)
    pulls = (left["linearity_residual"] / left["linearity_residual_stderr"]).std(axis=0)
    assert (np.abs(pulls - 1) < 5 / np.sqrt(2 * n)).all()


def test_small_exposures_do_not_claim_too_much_weight():
    # with variances at the estimates, low estimates weigh most and the slope is biased low
    rng = np.random.default_rng(3)
    n, frames = 20_000, 400
    exposures = rng.poisson(0.02 * TIMES * frames, (n, 4)) / frames
    variance = np.maximum(exposures, 1e-4) / frames
    line, *_ = exposure_line(exposures, np.einsum("nj,jk->njk", variance, np.eye(4)), variance, TIMES)
    error = line[:, 0].std() / np.sqrt(n)
    weights = 1 / np.maximum(exposures, 1e-4)
    naive = (weights * exposures / TIMES).sum(axis=1) / weights.sum(axis=1)
    assert abs(naive.mean() - 0.02) > 20 * error
    assert abs(line[:, 0].mean() - 0.02) < 0.1 * line[:, 0].std()


def test_pixels_without_exposures_and_two_samples():
    exposures = np.array([[1.0, 2.0], [np.nan, 2.0]])
    line, _, left = exposure_line(
        exposures, np.tile(0.01 * np.eye(2), (2, 1, 1)), np.full((2, 2), 0.01), [1.0, 3.0]
    )
    assert line[:, 0] == pytest.approx([0.5, np.nan], nan_ok=True)
    assert line[0, 1] == pytest.approx(0.5)
    assert np.isnan(left["linearity_p"]).all()
    assert left["linearity_residual_stderr"][0].tolist() == [0.0, 0.0]
    with pytest.raises(ValueError, match="two different"):
        exposure_line(np.ones((1, 2)), np.ones((1, 2, 2)), np.ones((1, 2)), [1.0, 1.0])


@pytest.mark.parametrize("n", [1, 2, 3, 4, 7, 50, 51, 20_001])
@pytest.mark.parametrize("kind", ["normal", "ties", "skewed"])
def test_every_number_is_that_of_numpy_to_the_bit(n, kind):
    values = np.random.default_rng(n).standard_normal(n)
    if kind != "normal":
        values = np.floor(2.0 * values) if kind == "ties" else np.exp(4.0 * values)
    found = Ordered.of(values)
    shares = np.random.default_rng(values.size).random(9)
    np.testing.assert_array_equal(found.quantiles(shares), np.quantile(values, shares))
    assert found.median == median_of(values) == np.median(values)
    assert found.robust_sd == 1.4826 * float(np.median(np.abs(values - np.median(values))))
    for rank in (-1.0, 0.3 * values.size, values.size + 1.0):
        assert found.at_rank(rank) == np.interp(rank, np.arange(values.size), np.sort(values))
    edges = np.linspace(np.quantile(values, 0.1) - 1e-9, values.max(), 9)
    np.testing.assert_array_equal(found.histogram(edges), np.histogram(values, edges)[0])
    middle = values[values.size // 2]
    below, above = (values < middle).sum(), (values > middle).sum()
    assert (found.n_below(middle), found.n_above(middle)) == (below, above)
    inside = np.sort(values[(values >= 0.0) & (values <= middle)])
    np.testing.assert_array_equal(found.within(0.0, middle).values, inside)
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    shares = (np.cumsum(counts) - 0.5 * counts) / values.size
    np.testing.assert_array_equal(found.shares(values), shares[inverse])


def test_what_has_no_value_or_is_left_out_is_counted_and_the_map_stays():
    values = np.array([[3.0, np.nan, 1.0], [-np.inf, 2.0, 7.0]])
    before = values.copy()
    found = Ordered.of(values, values == 7.0)
    np.testing.assert_array_equal(found.values, [1.0, 2.0, 3.0])
    assert (found.n_missing, found.n_left_out) == (2, 1)
    assert found.median == median_of(values, values == 7.0) == 2.0
    np.testing.assert_array_equal(values, before)
    nothing = Ordered.of(np.full(3, np.nan))
    assert np.isnan([median_of(np.full(3, np.nan)), nothing.median, nothing.robust_sd]).all()
