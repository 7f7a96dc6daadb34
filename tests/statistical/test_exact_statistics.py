"""Few DN per electron: the exact likelihood is unbiased where the density is not; limits are five sd."""

import numpy as np
import pytest
from helpers.drawn_pixels import draw

from pchem_pipeline.model.errors.rounding import rounding_bias
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.settings import FitSettings

N = 800


@pytest.mark.parametrize(("step", "exposure"), [(1.5, 0.5), (2.5, 2.0), (4.0, 2.0)])
def test_exact_is_unbiased_and_the_density_biased_as_predicted(step, exposure):
    noise = np.sqrt(0.25**2 + 1 / (12 * step**2))
    rng = np.random.default_rng(int(10 * step))
    frames = 100_000
    drawn = draw(rng, np.full(N, exposure), step, noise, np.full(N, 100.3), frames)
    plain = fit_histograms(drawn.counts, drawn.origin, settings=FitSettings(likelihood="density"))
    exact = fit_histograms(drawn.counts, drawn.origin, settings=FitSettings(likelihood="exact"), start=plain)
    predicted = rounding_bias(list(drawn.truth[:1].T), np.array([float(frames)]))[0]
    names = ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn")
    shifts = []
    for i, name in enumerate(names):
        errors = np.sqrt(exact.covariance[:, i, i])
        pulls = (getattr(exact, name) - drawn.truth[:, i]) / errors
        assert np.isfinite(pulls).all()
        # second-order bias of a maximum: below 0.05 standard errors at so many frames
        assert abs(pulls.mean()) < 5 / np.sqrt(N) + 0.05, name
        assert abs(pulls.std() - 1) < 5 / np.sqrt(2 * N), name
        shifts.append((np.median(getattr(plain, name)) - np.median(getattr(exact, name))) / np.median(errors))
    if step > 2:
        signed = predicted * np.array([1, -1, 1, 1])
        np.testing.assert_allclose(shifts, signed, atol=0.1 + 0.15 * np.abs(signed).max())
    assert np.abs(shifts).max() > 5 / np.sqrt(N) + 0.05
