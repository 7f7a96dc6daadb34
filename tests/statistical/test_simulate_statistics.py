"""Simulated frames have the distribution of the model: exact masses, independence, correlations.

Limits are five standard errors from theory, or a probability of 6e-7; each test also shows that it would
have caught the error that it guards against.
"""

from itertools import combinations

import numpy as np
import pytest
from helpers.plain_law import joint_mass
from helpers.small_sensors import a_uniform_sensor
from scipy import stats

from pchem_pipeline.simulate.chain import simulate_block
from pchem_pipeline.simulate.maps import draw_truth
from pchem_pipeline.simulate.settings import SimulateSettings

FALSE_ALARM = 6e-7
N = 1 << 20


def chi_square_p(dn, h, g, mu, sigma):
    """Probability of a larger chi-square against the exact mass, bins of fewer than 20 expected merged."""
    top = int(mu + (h + 12 * np.sqrt(h) + 20) / g)
    fitted = np.sqrt((sigma / g) ** 2 + 1 / 12)
    expected = joint_mass(np.arange(top), h, g, mu, fitted).sum(axis=0) * dn.size
    observed = np.bincount(dn.ravel(), minlength=top)[:top]
    full = expected >= 20
    o = np.append(observed[full], dn.size - observed[full].sum())
    e = np.append(expected[full], dn.size - expected[full].sum())
    return float(stats.chi2.sf(((o - e) ** 2 / e).sum(), full.sum()))


@pytest.mark.parametrize("effects", [[], [{"tag": "row_noise", "row_noise_dn": 0.0}]])
@pytest.mark.parametrize(
    ("h", "dn_per_electron", "mu", "sigma"),
    [
        (2.0, 11.0, 100.3, 0.3),
        (0.1, 8.0, 90.0, 0.2),
        (8.0, 14.0, 100.0, 0.42),
        (150.0, 3.0, 20.0, 0.9),
        (1.5, 1.0, 5.2, 0.25),
    ],
)
def test_frames_have_the_exact_mass_of_the_model(h, dn_per_electron, mu, sigma, effects):
    settings = SimulateSettings(shape=(32, 64), n_frames=N // 2048, seed=21, effects=effects)
    truth = a_uniform_sensor(settings.shape, h, 1 / dn_per_electron, mu, sigma)
    dn, electrons = simulate_block(truth, settings, (0, settings.n_frames))
    assert chi_square_p(dn, h, 1 / dn_per_electron, mu, sigma) > FALSE_ALARM
    # an exposure wrong by 5 % would not have passed, nor, with peaks, a read noise wrong by 10 %
    assert chi_square_p(dn, h * 1.05, 1 / dn_per_electron, mu, sigma) < 1e-20
    if sigma < 0.5 and dn_per_electron > 4:
        assert chi_square_p(dn, h, 1 / dn_per_electron, mu, sigma * 1.1) < 1e-20
    counts = np.bincount(electrons.ravel())
    expected = stats.poisson.pmf(np.arange(counts.size), h) * N
    full = expected >= 20
    chi2 = ((counts - expected)[full] ** 2 / expected[full]).sum()
    assert stats.chi2.sf(chi2, full.sum()) > FALSE_ALARM


def test_maps_have_the_distributions_and_rank_correlations_asked_for():
    settings = SimulateSettings(
        shape=(200, 200),
        seed=10,
        parameters={
            "quanta_exposure": {"kind": "lognormal", "median": 2.0, "log_std": 0.4},
            "dn_per_electron": {"kind": "uniform", "low": 8, "high": 14},
            "bias": {"kind": "normal", "mean": 100, "std": 4},
            "analog_read_noise_e": {"kind": "gamma", "mean": 0.3, "std": 0.05},
            "correlations": [
                {"between": ["dn_per_electron", "analog_read_noise_e"], "rank": -0.6},
                {"between": ["quanta_exposure", "bias"], "rank": 0.3},
            ],
            "hot_pixels": {"fraction": 0.0},
        },
    )
    truth = draw_truth(settings)
    given = {
        "quanta_exposure": (truth.quanta_exposure, stats.lognorm(0.4, scale=2)),
        "dn_per_electron": (1 / truth.conversion_gain, stats.uniform(8, 6)),
        "bias": (truth.bias, stats.norm(100, 4)),
        "analog_read_noise_e": (truth.analog_read_noise_e, stats.gamma(36, scale=0.3 / 36)),
    }
    for values, reference in given.values():
        assert stats.kstest(values.ravel(), reference.cdf).pvalue > FALSE_ALARM
        assert stats.kstest(values.ravel() * 1.02, reference.cdf).pvalue < 1e-4
    wanted = {("dn_per_electron", "analog_read_noise_e"): -0.6, ("quanta_exposure", "bias"): 0.3}
    for a, b in combinations(given, 2):
        found = stats.spearmanr(given[a][0].ravel(), given[b][0].ravel()).statistic
        # the rank correlation of a normal copula has at most the error of an independent one
        assert abs(found - wanted.get((a, b), 0.0)) < 5 / np.sqrt(200 * 200)
