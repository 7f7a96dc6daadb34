"""The fit of several samples against plain EM and the single fit, its words, and what it refuses."""

import numpy as np
import pytest
from helpers.drawn_pixels import codes, draw, histograms

from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import FitStatus


def draw_series(seed, exposures, noise_e, n_pixels, step=10.0, n_frames=4000):
    """Draw n pixels at each exposure; an exposure of 0 is a sample without electrons."""
    rng, drawn = np.random.default_rng(seed), []
    for exposure in exposures:
        if exposure > 0:
            drawn.append(draw(rng, np.full(n_pixels, exposure), step, noise_e, n_frames=n_frames)[:2])
        else:
            analog = np.sqrt(noise_e**2 - 1 / (12 * step**2))
            drawn.append(histograms(codes(rng, (n_pixels, n_frames), 0.0, step, analog)))
    counts, origin = map(list, zip(*drawn, strict=True))
    return {"counts": counts, "origin": origin, "dark": [exposure == 0 for exposure in exposures]}


@pytest.mark.parametrize("settings", [FitSettings(), FitSettings(likelihood="exact")])
def test_one_sample_is_the_single_fit(settings):
    drawn = draw(np.random.default_rng(3), [0.5, 2.0, 6.0], 10.0, 0.3)
    single = fit_histograms(drawn.counts, drawn.origin)
    joint = fit_histograms([drawn.counts], [drawn.origin], settings=settings)
    errors = np.sqrt(np.diagonal(single.covariance, axis1=1, axis2=2))
    close = 1e-4 if settings.likelihood == "density" else 0.05
    assert (np.abs(joint.columns - single.columns) < close * errors).all()
    np.testing.assert_allclose(
        np.diagonal(joint.covariance, axis1=1, axis2=2), errors**2, rtol=1e-3 if close < 1e-3 else 0.05
    )
    assert (joint.fit_status == single.fit_status).all()


def test_plain_em_ends_at_the_same_maximum():
    series = draw_series(8, [0.8, 3.0, 0.0], 0.25, 3)
    settings = [FitSettings(algorithm=each, likelihood="density") for each in ("newton", "em")]
    newton, em = (fit_histograms(**series, settings=each) for each in settings)
    np.testing.assert_allclose(em.columns, newton.columns, rtol=1e-4)


def test_words_say_why_a_pixel_has_no_value():
    series = draw_series(6, [0.6, 2.5, 0.0], 0.3, 3)
    series["counts"][1][0] = 0
    for counts in series["counts"][:2]:
        counts[1] = 0
        counts[1, 5] = 4000
    found = fit_histograms(**series, adc_limits=(0, 150), under=np.array([0, 0, 3]))
    assert found.fit_status[0] & FitStatus.NO_DATA
    assert found.fit_status[1] & FitStatus.TOO_FEW_BINS
    assert np.isnan(found.conversion_gain[:2]).all()
    assert found.fit_status[2] & FitStatus.ADC_LIMIT
    assert found.fit_status[2] & FitStatus.OUTSIDE_WINDOW
    assert np.isfinite(found.conversion_gain[2])


def test_samples_without_any_electrons_do_not_give_a_gain():
    found = fit_histograms(**draw_series(6, [0.0, 0.0], 0.3, 3) | {"dark": [False, True]})
    assert np.isnan(found.conversion_gain).all()
    lacking = FitStatus.GAIN_NOT_IDENTIFIED | FitStatus.EXPOSURE_AT_BOUND | FitStatus.NOT_CONVERGED
    assert ((found.fit_status & int(lacking)) != 0).all()


def test_what_does_not_fit_together_is_refused():
    series = draw_series(6, [0.6, 2.5], 0.3, 3)
    [one, other], [origin, _] = series["counts"], series["origin"]
    for wrong, words in (
        ({"dark": [True, True]}, "no sample has electrons"),
        ({"origin": [origin]}, "one entry per sample"),
        ({"counts": [one, other[:2]]}, r"different numbers of pixels: \[2, 3\]"),
    ):
        with pytest.raises(ValueError, match=words):
            fit_histograms(**series | wrong)


def test_a_few_glitches_do_not_move_the_estimates():
    series = draw_series(12, [0.6, 3.0, 0.0], 0.4, 6)
    clean = fit_histograms(**series)
    assert (clean.outlier_share == 0).all()
    series["counts"] = [np.pad(sample, ((0, 0), (0, 3000))) for sample in series["counts"]]
    for sample, place in zip(series["counts"], (2500, 900, 1700), strict=True):
        sample[:, place] += 2
    free = [0, 1, 3, 4, 5]  # the dark sample has no electrons
    errors = np.sqrt(np.diagonal(clean.covariance, axis1=1, axis2=2))[:, free]
    guarded, unguarded = (fit_histograms(**series, settings=FitSettings(tail_guard=g)) for g in (1e-3, 0.0))
    np.testing.assert_allclose(guarded.outlier_share, 6 / (3 * 4000 + 6), rtol=1e-9)
    shift, unguarded_shift = (
        np.abs(each.columns - clean.columns)[:, free] / errors for each in (guarded, unguarded)
    )
    assert shift.max() < 0.1
    assert not (unguarded_shift.max(axis=1) < 2.0).any()  # or it has no value
