"""Every status word from a pixel built for it; degenerate input never raises and never hangs."""

from functools import partial

import numpy as np
import pytest
from helpers.drawn_pixels import draw, samples

from pchem_pipeline.model.fit import search_numba
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import FAILED, FLAGGED, MEANINGS, FitStatus, describe, flags_of
from pchem_pipeline.model.law.mass import draw_histograms


def fit_one(counts, origin=100, **options):
    return fit_histograms(np.asarray(counts, np.uint32)[None], np.array([origin]), **options)


def drawn(exposure, step, noise, n_frames=17_750, **options):
    pixel = draw(np.random.default_rng(1), exposure, step, noise, n_frames=n_frames)
    return fit_histograms(pixel.counts, pixel.origin, **options)


def word(result):
    return FitStatus(int(result.fit_status[0]))


def histogram_of(values, size=400):
    return np.bincount(np.rint(values).astype(int), minlength=size)


def normal(sigma, telegraph=0.0):
    """Return the histogram of a Gaussian, of which half stands beside."""
    rng = np.random.default_rng(3)
    return histogram_of(rng.normal(60, sigma, 17_750) + telegraph * (rng.random(17_750) < 0.5))


@pytest.mark.parametrize(
    ("counts", "options", "expected"),
    [
        (np.zeros(50), {}, FitStatus.NO_DATA),
        (np.zeros(0), {}, FitStatus.NO_DATA),
        (np.zeros(50), {"adc_limits": (100, 149)}, FitStatus.NO_DATA),
        (np.bincount([7] * 1000, minlength=50), {}, FitStatus.TOO_FEW_BINS),
        (np.bincount([7] * 1000 + [30] * 10, minlength=50), {}, FitStatus.TOO_FEW_BINS),
        *((normal(sigma), {}, FitStatus.GAIN_NOT_IDENTIFIED) for sigma in (2.0, 3.0, 5.0)),
        (normal(3.0, telegraph=30.0), {}, FitStatus.POOR_FIT),
    ],
)
def test_histograms_that_are_none_of_electrons(counts, options, expected):
    result = fit_one(counts, **options)
    nothing = expected in (FitStatus.NO_DATA, FitStatus.TOO_FEW_BINS)
    assert (word(result) if nothing else word(result) & expected) == expected
    assert (result.goodness_p[0] < 1e-6) == (expected == FitStatus.POOR_FIT)


DENSITY, FEW_STEPS = {"likelihood": "density"}, {"algorithm": "em", "em_max_iterations": 20}


@pytest.mark.parametrize(
    ("expected", "pixel", "settings", "given"),
    [
        (FitStatus.NOT_CONVERGED, (2.0, 11.0, 0.4), {**FEW_STEPS, **DENSITY}, True),
        (FitStatus.EXPOSURE_AT_BOUND, (0.03, 11.0, 0.2), {"minimum_quanta_exposure": 0.1}, True),
        (FitStatus.EXPOSURE_AT_BOUND, (0.03, 11.0, 0.2), {}, False),
        (FitStatus.BIAS_AMBIGUOUS, (40.0, 11.0, 0.35), {}, True),
        (FitStatus.BIAS_AMBIGUOUS, (40.0, 11.0, 0.35), {"gap_threshold": 0.0}, False),
        (FitStatus.NOT_INFORMATIVE, (1.0, 11.0, 0.6), {}, True),
        (FitStatus.NOT_INFORMATIVE, (1.0, 11.0, 0.6), {"read_noise_limit": 0.9}, False),
        (FitStatus.COARSE_STEPS, (2.0, 2.2, 0.35), DENSITY, True),
        (FitStatus.COARSE_STEPS, (2.0, 4.0, 0.3), DENSITY, False),
        (FitStatus.COARSE_STEPS, (2.0, 2.2, 0.25), {}, False),
        (FitStatus.COARSE_STEPS, (2.0, 2.2, 0.25, 300), {}, False),  # of few frames rounding matters less
    ],
)
def test_a_word_is_given_where_it_is_due_and_takes_values_only_where_it_is_a_failure(
    expected, pixel, settings, given
):
    result = drawn(*pixel, settings=FitSettings(**settings))
    assert bool(word(result) & expected) == given
    failed = bool(word(result) & FAILED)
    assert np.isnan(result.columns[0]).all() == np.isnan(result.covariance[0]).all() == failed


def test_a_rival_is_of_bias_where_peaks_are_resolved_and_of_gain_where_they_overlap():
    resolved, overlapping = drawn(20.0, 11.0, 0.15, n_frames=500), drawn(20.0, 11.0, 0.4, n_frames=500)
    assert word(resolved) & FLAGGED == FitStatus.BIAS_AMBIGUOUS
    assert word(overlapping) & FitStatus.GAIN_AMBIGUOUS


def test_flags_name_what_they_concern():
    for name in ("quanta_exposure", "bias", "dark_current", "spurious_charge", "dark_signal"):
        assert flags_of(name) == FLAGGED
    for name in ("conversion_gain", "read_noise_dn", "read_noise_e", "analog_read_noise_e"):
        assert flags_of(name) == FLAGGED & ~(FitStatus.BIAS_AMBIGUOUS | FitStatus.BIAS_UNSURE)
    assert [int(FitStatus.BIAS_AMBIGUOUS), int(FitStatus.WEAKLY_IDENTIFIED)] == [32, 2048]  # in old files


def test_bias_frames_make_it_the_gain_that_is_ambiguous():
    rng = np.random.default_rng(4)
    shown = draw_histograms(rng, np.full(60, 8.0), 0.09, 100.0 + rng.random(60), 0.7, 400)
    dark = draw_histograms(rng, 0.0, shown.truth[:, 1], shown.truth[:, 2], 0.7, 400)
    both = zip(shown[:2], dark[:2], strict=True)
    fit = fit_histograms(*both, dark=[False, True], settings=FitSettings(gap_threshold=50.0))
    assert np.any(fit.fit_status & int(FitStatus.GAIN_AMBIGUOUS))
    assert not np.any(fit.fit_status & int(FitStatus.BIAS_AMBIGUOUS))


def test_limits_of_the_adc_and_samples_outside_of_the_window():
    pixel = draw(np.random.default_rng(1), 2.0, 11.0, 0.3)
    fit = partial(fit_histograms, pixel.counts, pixel.origin)
    low, high = (int(pixel.origin[0] + np.flatnonzero(pixel.counts[0])[end]) for end in (0, -1))
    cases = (((low, high + 9), True), ((low - 9, high), True), ((low - 1, high + 1), False))
    for limits, expected in cases:
        assert bool(word(fit(adc_limits=limits)) & FitStatus.ADC_LIMIT) is expected
    n, outside = int(pixel.counts.sum()), FitStatus.OUTSIDE_WINDOW
    cases = (
        (3, 0, outside),
        (0, 3, outside),
        (0, n // 100, outside | FitStatus.BIAS_AMBIGUOUS),  # so many are missed in the mean
        (n - 5, 5, outside),
        (n - 4, 5, FitStatus.NO_DATA),
    )
    for under, over, expected in cases:
        result = fit(np.array([under]), np.array([over]))
        assert word(result) & expected == expected
        assert np.isnan(result.bias[0]) == (expected == FitStatus.NO_DATA)
        assert under + over > 3 or word(result) == expected
    assert word(fit(np.array([0]), np.array([0]))) == FitStatus.OK


def test_every_word_has_a_sentence_and_the_loops_agree_on_the_bits():
    assert set(MEANINGS) == set(FitStatus)
    everything = int(sum(FitStatus))
    assert describe(everything).count(";") >= len(MEANINGS) - 1
    assert (FAILED & FitStatus.BIAS_AMBIGUOUS) == 0
    names = {"FIT_NOT_CONVERGED": "NOT_CONVERGED"}
    for name in ("NO_DATA", "TOO_FEW_BINS", "FIT_NOT_CONVERGED", "GAIN_NOT_IDENTIFIED", "EXPOSURE_AT_BOUND",
                 "BIAS_AMBIGUOUS", "NOT_INFORMATIVE", "COARSE_STEPS"):  # fmt: skip
        assert getattr(search_numba, name) == FitStatus[names.get(name, name)]


def degenerate_pixels():
    rng = np.random.default_rng(0)
    pixel = draw(rng, 2.0, 11.0, 0.3)
    values = samples(pixel.counts[0], int(pixel.origin[0]))
    huge = np.zeros(300)
    huge[[0, 10, 20, 21]] = [4e9, 3e9, 1e9, 10]
    return {
        "three bins": histogram_of(np.repeat([7, 8, 9], [100, 50, 2])),
        "three bins far apart": histogram_of(np.repeat([0, 1999, 3999], [5, 50, 5])),
        "uniform": np.full(256, 70),
        "comb": np.where(np.arange(300) % 7 == 0, 60_000, 0),
        "needles at every DN": np.full(30, 600),
        "saturated high": histogram_of(np.minimum(values, 105.0)),
        "saturated low": histogram_of(np.maximum(values, 120.0)),
        "mirrored": histogram_of(300.0 - values),
        "huge outlier above": histogram_of(np.append(values, 5000.0), 5001),
        "huge outlier below": histogram_of(np.append(values + 5000.0, 0.0), 5300),
        "one frame": histogram_of(values[:1]),
        "four frames": histogram_of(values[::5000]),
        "huge counts": huge,
        "hot": histogram_of(rng.poisson(300, 17_750) * 11.0 + rng.normal(60, 3, 17_750), 6000),
    }


@pytest.mark.timeout(60)
def test_degenerate_pixels_end_with_a_word_or_an_answer():
    for algorithm in ("newton", "em"):
        settings = FitSettings(algorithm=algorithm, em_max_iterations=200)
        for name, counts in degenerate_pixels().items():
            result = fit_one(counts, settings=settings)
            failed = bool(word(result) & FAILED)
            assert np.isnan(result.conversion_gain[0]) == failed, name
            assert result.n_iterations[0] < 6000, name
            if name not in ("huge outlier above", "huge outlier below", "hot", "four frames"):
                assert word(result) != FitStatus.OK, name
