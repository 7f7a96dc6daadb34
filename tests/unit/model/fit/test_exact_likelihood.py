"""The exact quantised likelihood of one sample: where it is used, and what rounding does without it."""

import numpy as np
import pytest
from helpers.drawn_pixels import codes, draw, histograms
from helpers.plain_law import pcd_mass
from scipy.optimize import minimize

from pchem_pipeline.effects.operators.offsets import RowNoise
from pchem_pipeline.model.errors.expected_information import (
    LARGEST_BIAS,
    biased_by_rounding,
    expected_information,
    rounding_bias,
)
from pchem_pipeline.model.fit.api import fit_histograms, likelihood_moments
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.model.law.pcd import log_pcd
from pchem_pipeline.run.stage import Command
from pchem_pipeline.run.target import find_run
from pchem_pipeline.runner.session import run_stages
from pchem_pipeline.stages.fit.tile import TileFit, fit_tile
from pchem_pipeline.store.run_store import RunStore

EXACT, DENSITY = FitSettings(likelihood="exact"), FitSettings(likelihood="density")
AUTO = FitSettings()


def test_the_predicted_bias_is_where_the_density_goes_on_the_exact_masses():
    h, a, mu, sigma, n = 1.3, 3.2, 100.4, 1.0, 1e6
    x = np.arange(90, 150)
    weights = pcd_mass(x, h, 1 / a, mu, np.sqrt(sigma**2 - 1 / 12) / a)

    def cost(theta):
        own = np.exp(theta[0]), 1 / theta[1], theta[2], np.exp(theta[3] / 2)
        return -n * float(weights @ log_pcd(x, *own))

    truth = np.array([np.log(h), a, mu, 2 * np.log(sigma)])
    options = {"xatol": 1e-9, "fatol": 1e-9, "maxiter": 4000}
    shift = minimize(cost, truth, method="Nelder-Mead", options=options).x - truth
    bound = np.linalg.inv(n * expected_information(h, sigma / a))  # of H, ln g, g mu and ln sigma
    errors = np.sqrt(np.diagonal(bound)) * [1 / h, -a, a, 2.0]
    predicted = rounding_bias([np.array([v]) for v in (h, 1 / a, mu, sigma)], np.array([n]))[0]
    assert np.abs(predicted).max() > 0.3
    np.testing.assert_allclose(predicted, shift / errors, rtol=0.05, atol=0.005)


def test_pixels_are_named_where_rounding_matters_and_what_is_skipped_is_safe():
    n = np.full(6, 17_750.0)
    gains = 1 / np.array([1.5, 2.5, 4.0, 5.0, 10.0, np.nan])
    parameters = [np.full(6, 2.0), gains, np.full(6, 100.3), 0.3 / gains]
    named = biased_by_rounding(parameters, n)
    assert named.tolist() == [True, True, True, False, False, False]
    for h in (0.2, 2.0, 12.0):
        for noise in (0.12, 0.2, 0.35, 0.6):
            sigma = (17_750**0.5 / 20.0) ** 0.25 * np.ones(16)
            if noise / sigma[0] < 0.7:
                pixels = [np.full(16, h), noise / sigma, np.arange(16) / 16, sigma]
                assert np.abs(rounding_bias(pixels, np.full(16, 17_750.0))).max() < LARGEST_BIAS


def test_density_is_left_alone_and_auto_refits_only_what_rounding_biases():
    fine, coarse = (draw(np.random.default_rng(2), [1.0, 2.0], step, 0.3) for step in (10.0, 2.5))
    for drawn, changes in ((fine, False), (coarse, True)):
        plain = fit_histograms(drawn.counts, drawn.origin, settings=DENSITY)
        same = fit_histograms(drawn.counts, drawn.origin, settings=DENSITY, start=plain)
        np.testing.assert_array_equal(same.conversion_gain, plain.conversion_gain)
        auto = fit_histograms(drawn.counts, drawn.origin, settings=AUTO, start=plain)
        assert ((auto.conversion_gain != plain.conversion_gain) == changes).all()
    exact = fit_histograms(drawn.counts, drawn.origin, settings=EXACT, start=plain)
    np.testing.assert_array_equal(exact.conversion_gain, auto.conversion_gain)
    assert (plain.fit_status & FitStatus.COARSE_STEPS == 0).all() or (exact.fit_status == 0).all()


def few_electrons(seed, n, n_frames=2000):
    """Return histograms by plain numpy, where a DN is coarse and few frames hold electrons."""
    rng = np.random.default_rng(seed)
    step, bias = rng.uniform(3.3, 3.7, n), rng.uniform(95.0, 105.0, n)
    return *histograms(codes(rng, (n_frames, n), 0.1, step, 0.2, bias).T), step


def test_the_default_takes_no_pixel_for_a_comb_of_electrons_that_are_not_there():
    counts, origin, step = few_electrons(31, 300)
    by_default, by_density = (
        fit_histograms(counts, origin, settings=each).conversion_gain * step for each in (AUTO, DENSITY)
    )
    assert np.abs(by_default - 1).max() < 0.25
    wrong = np.abs(by_density - 1) > 1
    assert wrong.sum() > 5  # as it would be
    assert (by_density[wrong] > 2).all()


@pytest.mark.parametrize("start", ["density", "auto"])
def test_a_law_with_effects_starts_at_the_comb_of_electrons_that_are_there(start):
    counts, origin, step = few_electrons(32, 100)
    histogram = {"counts": counts[:, None], "origin": origin[:, None].astype(np.int32)}
    histogram |= {name: np.zeros((100, 1), np.int32) for name in ("under", "over")}
    how = TileFit(FitSettings(likelihood=start), effects=[RowNoise(row_noise_dn=0.1)])
    found = fit_tile([histogram], how)["fit"]
    off = np.abs(found["conversion_gain"][:, 0] * step - 1)
    assert (off > 1).any() == (start == "density")


def test_moments_are_those_of_the_likelihood_of_each_pixel():
    drawn = draw(np.random.default_rng(2), [1.0, 2.0, 1.0, 2.0], [10.0, 3.0, 3.0, 10.0], 0.3)
    fit = fit_histograms(drawn.counts, drawn.origin)
    known = np.column_stack([fit.columns, fit.likelihood_gap])
    auto, density, exact = (
        likelihood_moments(drawn.counts, drawn.origin, known, fit.outlier_share, settings=settings).covariance
        for settings in (AUTO, DENSITY, EXACT)
    )
    np.testing.assert_array_equal(auto[[0, 3]], density[[0, 3]])
    np.testing.assert_array_equal(auto[[1, 2]], exact[[1, 2]])
    assert (density[1] != exact[1]).all()


def test_few_dn_per_electron_have_their_own_starts():
    drawn = draw(np.random.default_rng(1), np.full(8, 2.0), 1.2, 0.384)
    plain = fit_histograms(drawn.counts, drawn.origin, settings=DENSITY)
    mine = fit_histograms(drawn.counts, drawn.origin, settings=AUTO, start=plain)
    good = mine.fit_status == 0
    assert good.sum() >= 5
    pulls, before = (
        (each.conversion_gain - 1 / 1.2) / np.sqrt(each.covariance[:, 1, 1]) for each in (mine, plain)
    )
    assert (np.abs(pulls[good]) < 5).all()
    assert abs(pulls[good].mean()) * np.sqrt(good.sum()) < 5
    known = np.isfinite(before)
    assert known.sum() >= 4
    assert abs(before[known].mean()) * np.sqrt(known.sum()) > 5  # rounding biases the density


def test_a_run_says_how_many_pixels_rounding_biases_and_that_a_default_would_do_it_again(tmp_path, capsys):
    drawn = draw(np.random.default_rng(3), [1.0, 2.0, 1.5], 2.5, 0.3)
    dn = drawn.origin[0] + np.arange(drawn.counts.shape[1])
    np.savez(tmp_path / "h.npz", dn=dn, counts=drawn.counts)
    gains = {}
    path, common = tmp_path / "run.yaml", "run: {store: run.zarr, tile: 8}\ninput: {files: [h.npz]}\n"
    for likelihood, words in (("density", "biases 100.0 % of the pixels by more than 0.05"), ("auto", "")):
        path.write_text(common + ("fit: {likelihood: density}\n" if likelihood == "density" else ""))
        run_stages(find_run(path), ["ingest", "histogram", "fit"], Command(progress="off"))
        store = RunStore.open(tmp_path / "run.zarr")
        notes = " ".join(store.records.read("fit").notes)
        assert words in notes
        assert ("rounding" in notes) == bool(words)
        gains[likelihood] = store.read("fit/conversion_gain")
    assert (gains["density"] != gains["auto"]).all()
    change = "density → auto (the default; fit.likelihood: density in the YAML keeps the result)"
    assert f"fit: running again: fit.likelihood {change}" in capsys.readouterr().err
