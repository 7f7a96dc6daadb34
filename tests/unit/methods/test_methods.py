"""The methods of the literature, each against plain numpy on raw samples, and with nothing to see."""

import numpy as np
import pytest
from helpers import reference_pchem
from helpers.drawn_pixels import draw, samples
from scipy.stats import kstat

from pchem_pipeline.methods.base import PixelSamples, Sample, methods
from pchem_pipeline.methods.compare import compare, errors_of, pixel_bounds, summarise_errors
from pchem_pipeline.methods.peak_valley import comb, read_noise_of_valley
from pchem_pipeline.methods.plain_em import run_em
from pchem_pipeline.methods.settings import MethodsSettings
from pchem_pipeline.model.errors.expected_information import expected_information, inverse_information
from pchem_pipeline.model.law.mass import draw_histograms


def sample(exposure, noise=0.3, n_pixels=3, n_frames=3000, seed=1, gain=1 / 11):
    rng = np.random.default_rng([seed, int(100 * exposure)])
    drawn = draw_histograms(rng, np.full(n_pixels, exposure), gain, 100.3, noise, n_frames)
    return Sample(drawn.counts, drawn.origin)


def estimated(name, *given, limits=None, **settings):
    """Return (H, g, mu, sigma) of each pixel by a method."""
    return methods()[name].estimate(PixelSamples(given, limits), MethodsSettings(**settings)).parameters


def test_drawn_histograms_have_the_moments_of_the_pcd():
    n = 400_000
    drawn = draw_histograms(np.random.default_rng(2), [0.0, 2.0], 0.1, 50.4, 0.31, n)
    found = Sample(drawn.counts, drawn.origin).moments()
    exposure, gain, bias, sigma = drawn.truth.T
    variance = sigma**2 + exposure / gain**2
    assert (found.n_frames == n).all()
    assert (np.abs(found.mean - bias - exposure / gain) < 5 * np.sqrt(variance / n)).all()
    spread = np.sqrt((exposure / gain**4 + 2 * variance**2) / n)
    assert (np.abs(found.variance - variance) < 5 * spread).all()
    with pytest.raises(ValueError, match="rounding"):
        draw_histograms(np.random.default_rng(2), 1.0, 1.0, 0.0, 0.2, 10)


def test_moments_are_k_statistics():
    drawn = draw(np.random.default_rng(3), [0.4, 3.0], 10.0, 0.4, n_frames=500)
    found = Sample(drawn.counts, drawn.origin).moments()
    raw = [samples(counts, origin) for counts, origin in zip(drawn.counts, drawn.origin, strict=True)]
    for order, name in enumerate(("mean", "variance", "third", "fourth"), 1):
        assert getattr(found, name) == pytest.approx([kstat(each, order) for each in raw], rel=1e-9)


@pytest.mark.parametrize("name", ["photon_transfer", "photon_transfer_series"])
def test_photon_transfer_of_two_samples_is_that_of_raw_samples(name):
    bright, dark = sample(2.0), sample(0.0)
    for pixel, found in enumerate(estimated(name, bright, dark)):
        b, d = (samples(s.counts[pixel], s.origin[pixel]) for s in (bright, dark))
        gain = (b.mean() - d.mean()) / (b.var(ddof=1) - d.var(ddof=1))
        expected = (gain * (b.mean() - d.mean()), gain, d.mean(), d.std(ddof=1))
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_emva_leaves_out_what_nears_saturation():
    dark, half, bright = sample(0.0), sample(1.0), sample(8.0, noise=0.9)
    top = int(bright.moments().mean.mean())
    whole, two = estimated("emva1288", half, dark, bright), estimated("emva1288", half, dark)
    inside = estimated("emva1288", half, dark, bright, limits=(0, top))
    np.testing.assert_allclose(inside, two)
    assert abs(whole[0, 1] / two[0, 1] - 1) > 1e-6
    assert np.unique(inside[:, 1]).size == 1


@pytest.mark.parametrize("noise", [0.3, 0.6])
def test_one_em_step_is_that_of_the_paper(noise):
    drawn = draw(np.random.default_rng(4), 1.7, 9.0, noise, n_frames=400)
    raw, origin = samples(drawn.counts[0], 0), int(drawn.origin[0])
    start = reference_pchem.Theta(1.2, 0.1, 100.0 - origin, 4.0)
    expected = reference_pchem.em_step(raw, start)
    at = np.array([[start.exposure, start.gain, start.bias, start.sigma]])
    one_step = MethodsSettings(em_iterations=1, em_tolerance=1e-12)
    found, steps = run_em(Sample(drawn.counts, np.zeros(1, int)), at, False, one_step)
    assert steps.tolist() == [1]
    np.testing.assert_allclose(found[0], expected, rtol=1e-9)


def test_em_with_known_bias_and_noise_is_a_maximum():
    """At the end of the steps no small change of H or g makes the bright sample likelier."""
    bright, dark = sample(1.5, noise=0.4), sample(0.0, noise=0.4)
    found = estimated("dark_and_bright_mle", bright, dark, em_tolerance=1e-10)
    raw = samples(bright.counts[0], bright.origin[0])
    exposure, gain, bias, sigma = found[0]

    def height(h, g):
        return reference_pchem.log_likelihood(raw, reference_pchem.Theta(h, g, bias, sigma))

    # the exposure told is that of the mean; the likelihood has its own, near it
    best = max((height(h, gain), h) for h in exposure * np.linspace(0.97, 1.03, 121))[1]
    assert height(best, gain) > max(height(best, gain * 1.003), height(best, gain / 1.003))
    moments = dark.moments()
    np.testing.assert_allclose(found[:, 2], moments.mean)
    np.testing.assert_allclose(found[:, 3], np.sqrt(moments.variance))


@pytest.mark.parametrize(
    ("exposure", "noise", "gain"), [(8.0, 0.15, 0.02), (30.0, 0.15, 0.09), (5.0, 0.2, 0.4)]
)
def test_peaks_need_no_luck_with_their_first_distance(exposure, noise, gain):
    """No pixel takes every second peak, or half a peak: the rms error of g is the spread of all."""
    one = sample(exposure, noise=noise, n_pixels=150, n_frames=1500, gain=gain)
    error = estimated("peak_valley", one)[:, 1] / gain - 1
    assert np.abs(error).max() < 0.05
    assert np.sqrt(np.mean(error**2)) < 2 * 1.4826 * np.median(np.abs(error - np.median(error)))


def test_a_comb_is_measured():
    x = np.arange(120.0)
    heights = {0: 30.0, 1: 60.0, 2: 45.0, 4: 9.0}  # one peak is missing
    counts = 1e4 * sum(h * np.exp(-0.5 * ((x - 20.3 - 12.4 * k) / 2.0) ** 2) for k, h in heights.items())
    step, first, exposure, valley = comb(np.rint(counts).astype(np.uint32), 12.0, 1.5)
    assert (step, first) == pytest.approx((12.4, 20.3), abs=0.02)
    assert exposure == pytest.approx(2 * 45 / 60, rel=0.01)
    tails = (60 + 45) * np.exp(-0.5 * 6.2**2 / (2.0**2 + 1.5**2))
    assert valley == pytest.approx(tails / 52.5, rel=0.1)
    assert np.isnan(read_noise_of_valley(np.array([1.0, 1.5, 0.0, -1.0]))).all()


EMPTY = np.zeros((1, 40), np.uint32)


def spikes(*bins):
    counts = EMPTY.copy()
    counts[0, list(bins)] = 50
    return counts


@pytest.mark.parametrize("counts", [EMPTY, spikes(7), spikes(7, 8), spikes(0, 39), spikes(7, 18, 29)])
def test_no_pixel_stops_a_method(counts):
    one = Sample(counts, np.array([100]))
    for other in (one, sample(2.0, n_pixels=1)):
        for result in compare(PixelSamples((one, other, one)), None, MethodsSettings()):
            assert result.facts["missing"] == ""
            assert result.estimates.shape == (1, 4)


def test_methods_say_which_samples_they_lack():
    results = {r.facts["name"]: r for r in compare(PixelSamples((sample(1.0),)), None, MethodsSettings())}
    missing = {name: result.facts["missing"] for name, result in results.items()}
    assert missing["photon_transfer"] == "needs a dark and a bright sample; this comparison has 1"
    assert missing["photon_transfer_series"].startswith("needs a series")
    assert missing["pchem_em"] == ""
    assert results["photon_transfer"].estimates is None
    told = results["pchem_em"].facts["medians"]
    assert told["conversion_gain"] == pytest.approx(1 / 11, rel=0.05)
    assert told["read_noise_e"] == pytest.approx(0.3, rel=0.1)


def test_bounds_are_those_of_the_samples_given():
    bright, dark = sample(2.0), sample(0.0)
    truth = np.tile([2.0, 1 / 11, 100.3, 0.3 * 11], (3, 1))
    one = pixel_bounds([bright], truth)[0]
    covariance = inverse_information(3000 * expected_information(2.0, 0.3))
    slopes = np.array([[0.5, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 1, 0, 1]])
    assert one == pytest.approx(np.sqrt(np.diagonal(slopes @ covariance @ slopes.T)))
    assert (pixel_bounds([bright, dark], truth)[0] < one).all()
    truth[1] = np.nan
    assert np.isnan(pixel_bounds([bright], truth)[1]).all()


def test_errors_are_relative_and_summed_up_over_answers():
    truth = np.array([[2.0, 0.1, 100.0, 3.0]] * 3)
    found = truth * np.array([[1.1, 1.0, 1.0, 1.0], [1.0, 0.9, 1.0, 1.0], [np.nan] * 4])
    found[0, 2] += 2.0
    errors = errors_of(found, truth)
    for name, two in (("quanta_exposure", [0.1, 0]), ("bias", [0.2, 0]), ("read_noise_e", [0, -0.1])):
        np.testing.assert_allclose(errors[name][:2], two, atol=1e-12)
    summary = summarise_errors(errors["conversion_gain"], np.full(3, 0.05))
    assert (summary["n"], summary["bound"]) == (2, pytest.approx(0.05))
    assert summary["rmse"] == pytest.approx(0.1 / np.sqrt(2))
    assert summarise_errors(np.full(2, np.nan), np.ones(2))["rmse"] is None
