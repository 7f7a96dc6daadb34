"""The joint fit against dense algebra, finite differences, plain numpy EM, iminuit and the single fit."""

from typing import NamedTuple

import numpy as np
import pytest
from helpers.drawn_pixels import codes, draw, histograms

from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import FitStatus

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
            drawn = draw(rng, np.full(n_pixels, exposure), step, noise_e, bias, n_frames)[:2]
        else:
            analog = np.sqrt(noise_e**2 - 1 / (12 * step**2))
            drawn = histograms(codes(rng, (n_pixels, n_frames), 0.0, step, analog, bias))
        counts.append(drawn[0])
        origins.append(drawn[1])
    return Drawn(counts, origins, [exposure == 0 for exposure in exposures])


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


def test_plain_em_ends_at_the_same_maximum():
    series = draw_series(np.random.default_rng(8), [0.8, 3.0, 0.0], 0.25, 3)
    settings = [FitSettings(algorithm=each, likelihood="density") for each in ("newton", "em")]
    newton, em = (fit_histograms(*series[:2], dark=series.dark, settings=each) for each in settings)
    np.testing.assert_allclose(em.quanta_exposure[:, :2], newton.quanta_exposure[:, :2], rtol=1e-4)
    for name in ("conversion_gain", "bias", "read_noise_dn"):
        np.testing.assert_allclose(getattr(em, name), getattr(newton, name), rtol=1e-4)


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
