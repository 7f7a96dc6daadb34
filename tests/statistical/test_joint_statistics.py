"""Where one exposure tells little, several reach the joint Cramer-Rao bound; limits are five sd."""

import numpy as np
import pytest
from helpers.bounds import cramer_rao
from helpers.joint_material import draw_series

from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.settings import FitSettings

EXPOSURES = [0.5, 3.0, 12.0]
N_PIXELS = 150


@pytest.mark.parametrize(("noise", "dark"), [(0.3, False), (0.7, False), (1.0, True)])
def test_the_joint_fit_is_efficient(noise, dark):
    exposures = EXPOSURES + [0.0] * dark
    series = draw_series(np.random.default_rng(int(100 * noise)), exposures, noise, N_PIXELS)
    found = fit_histograms(series.counts, series.origins, dark=series.dark)
    size = len(exposures)
    bound = cramer_rao(exposures, 0.1, noise * 10.0, 4000)
    truth = {size: 0.1, size + 1: 100.3, size + 2: 10.0 * noise} | dict(enumerate(exposures))
    columns = {size: found.conversion_gain, size + 1: found.bias, size + 2: found.read_noise_dn}
    columns |= {j: found.quanta_exposure[:, j] for j in range(size)}
    assert (found.fit_status == 0).mean() > 0.98
    for place, values in columns.items():
        if place < size and exposures[place] == 0.0:
            continue
        sd = np.sqrt(bound[place, place])
        z = (values - truth[place]) / sd
        z = z[np.isfinite(z)]
        assert abs(z.mean()) < 5 / np.sqrt(z.size)
        # the mean of z^2 has sd sqrt(2 / n); a tenth of the bound more comes from its second order
        assert abs((z**2).mean() - 1) < 5 * np.sqrt(2 / z.size) + 0.1
        pulls = (values - truth[place]) / np.sqrt(found.covariance[:, place, place])
        assert abs(np.nanstd(pulls) - 1) < 5 / np.sqrt(2 * z.size)
    # one exposure alone, given all the frames, knows far less
    alone = cramer_rao(3.0, 0.1, noise * 10.0, 4000 * size)
    if noise > 0.5:
        assert alone[1, 1] / bound[size, size] - 1 > 20 * np.sqrt(2 / N_PIXELS)


def test_clipped_samples_are_censored():
    # the ADC ends inside the brighter sample: its last code takes what lies beyond
    series = draw_series(np.random.default_rng(4), [0.8, 4.0], 0.5, 80)
    top = 143
    counts = []
    for sample, origin in zip(series.counts, series.origins, strict=True):
        last = top - int(origin[0])
        clipped = sample[:, : last + 1].copy()
        clipped[:, last] += sample[:, last + 1 :].sum(axis=1, dtype=np.uint32)
        counts.append(clipped)
    share = counts[1][:, -1].mean() / 4000
    assert share > 0.3
    found = {}
    for likelihood in ("exact", "density"):
        fit = fit_histograms(
            counts, series.origins, settings=FitSettings(likelihood=likelihood), adc_limits=(0, top)
        )
        found[likelihood] = (fit.conversion_gain - 0.1) / np.sqrt(fit.covariance[:, 2, 2])
    pulls = found["exact"]
    assert np.isfinite(pulls).all()
    assert abs(pulls.mean()) < 5 / np.sqrt(pulls.size)
    assert abs(pulls.std() - 1) < 5 / np.sqrt(2 * pulls.size)
    others = found["density"][np.isfinite(found["density"])]
    assert others.size < 40 or abs(others.mean()) > 20 / np.sqrt(others.size)
