"""Parameter maps: bounds, patterns, defects, position."""

import numpy as np
import pytest
from scipy import stats

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.simulate.distributions import Gamma, LogNormal, LogUniform, Normal, Uniform
from pchem_pipeline.simulate.maps import draw_truth, truncated_quantile
from pchem_pipeline.simulate.settings import SimulateSettings
from pchem_pipeline.simulate.truth import Defect

PLAIN = {
    "quanta_exposure": {"kind": "constant", "value": 2.0},
    "dn_per_electron": {"kind": "constant", "value": 10.0},
    "bias": {"kind": "constant", "value": 100.0},
    "analog_read_noise_e": {"kind": "constant", "value": 0.3},
    "hot_pixels": {"fraction": 0.0},
}


def settings(shape=(12, 10), seed=1, **parameters):
    return SimulateSettings(shape=shape, seed=seed, parameters={**PLAIN, **parameters})


def with_pattern(**pattern):
    return {"kind": "constant", "value": 100.0, "patterns": [pattern]}


@pytest.mark.parametrize(
    ("distribution", "reference"),
    [
        (Normal(mean=3, std=2), stats.norm(3, 2)),
        (LogNormal(median=2, log_std=0.4), stats.lognorm(0.4, scale=2)),
        (Gamma(mean=2, std=1.5), stats.gamma((2 / 1.5) ** 2, scale=1.5**2 / 2)),
        (Uniform(low=-1, high=4), stats.uniform(-1, 5)),
        (LogUniform(low=0.1, high=10), stats.loguniform(0.1, 10)),
    ],
)
def test_quantiles_agree_with_scipy_and_truncation_keeps_the_shape(distribution, reference):
    u = np.linspace(0.001, 0.999, 501)
    np.testing.assert_allclose(truncated_quantile(distribution, u), reference.ppf(u), rtol=1e-9)
    low, high = reference.ppf([0.3, 0.8])
    inside = truncated_quantile(distribution.model_copy(update={"minimum": low, "maximum": high}), u)
    np.testing.assert_allclose(inside, reference.ppf(0.3 + 0.5 * u), rtol=1e-9)


def test_bounds_that_leave_nothing_are_refused():
    with pytest.raises(ConfigError, match="exclude the whole"):
        truncated_quantile(Normal(mean=0, std=1, minimum=50), np.array([0.5]))


def test_constant_maps_and_derived_noise_and_other_ways_to_say_the_same():
    truth = draw_truth(settings())
    assert (truth.quanta_exposure == 2).all()
    np.testing.assert_allclose(truth.conversion_gain, 0.1)
    np.testing.assert_allclose(truth.read_noise_dn, np.sqrt(9 + 1 / 12))
    np.testing.assert_allclose(truth.read_noise_e, 0.1 * np.sqrt(9 + 1 / 12))
    other = {"dark_current": 0.5, "conversion_gain": 0.1}
    parameters = {name: {"kind": "constant", "value": value} for name, value in other.items()}
    parameters["hot_pixels"] = {"fraction": 0}
    same = draw_truth(SimulateSettings(shape=(3, 3), integration_time=4.0, parameters=parameters))
    assert (same.quanta_exposure == 2).all()
    assert (same.conversion_gain == 0.1).all()


def test_a_smaller_sensor_is_part_of_a_larger_one():
    whole = draw_truth(SimulateSettings(shape=(20, 30), parameters={"stuck_fraction": 0.05}))
    small = draw_truth(SimulateSettings(shape=(8, 9), parameters={"stuck_fraction": 0.05}))
    for name, values in whole.arrays().items():
        np.testing.assert_array_equal(small.arrays()[name], values[:8, :9])


@pytest.mark.parametrize(("kind", "n"), [("column", 10), ("row", 12)])
def test_column_and_row_patterns_repeat_along_their_lines(kind, n):
    bias = draw_truth(settings(bias=with_pattern(kind=kind, amplitude=2.0))).bias
    lines = bias if kind == "column" else bias.T
    assert (lines == lines[0]).all()
    assert np.unique(lines[0]).size == n


@pytest.mark.parametrize(
    ("pattern", "bounds", "along_y", "along_x"),
    [
        ({"amplitude": 4.0}, (0, 200), (100, 100), (98, 102)),
        ({"amplitude": 4.0, "angle": 90}, (0, 200), (98, 102), (100, 100)),
        ({"amplitude": 40.0}, (90, 105), (100, 100), (80, 120)),
    ],
)
def test_gradient_runs_from_edge_to_edge_in_its_direction_within_bounds(pattern, bounds, along_y, along_x):
    plane = np.linspace(*along_y, 12)[:, None] + np.linspace(*along_x, 10) - 100
    bias = with_pattern(kind="gradient", **pattern) | dict(zip(("minimum", "maximum"), bounds, strict=True))
    np.testing.assert_allclose(draw_truth(settings(bias=bias)).bias, plane.clip(*bounds))


def test_radial_pattern_is_zero_in_the_centre_and_whole_in_the_corners():
    bias = draw_truth(settings((5, 7), bias=with_pattern(kind="radial", amplitude=-0.2, relative=True))).bias
    np.testing.assert_allclose(bias[2, 3], 100.0)
    np.testing.assert_allclose(bias[[0, 0, -1, -1], [0, -1, 0, -1]], 80.0)


@pytest.mark.parametrize(
    "name", ["quanta_exposure", "dn_per_electron", "conversion_gain", "analog_read_noise_e", "dark_current"]
)
def test_impossible_values_are_named_with_the_cure(name):
    given = {k: v for k, v in PLAIN.items() if k not in ("quanta_exposure", "dn_per_electron")}
    wide = {"kind": "normal", "mean": 1.0, "std": 5.0}
    bad = SimulateSettings(shape=(12, 12), parameters={**given, name: wide})
    with pytest.raises(ConfigError, match=f"{name} is -.* minimum"):
        draw_truth(bad)


def test_defects_are_exclusive_and_do_what_they_say():
    hot = {"fraction": 0.2, "multiplier": {"kind": "uniform", "low": 5, "high": 6}}
    truth = draw_truth(settings((100, 100), dead_fraction=0.1, stuck_fraction=0.1, hot_pixels=hot))
    kinds = {kind: truth.defect == kind for kind in Defect}
    for kind, fraction in ((Defect.DEAD, 0.1), (Defect.STUCK, 0.1), (Defect.HOT, 0.2)):
        # five standard errors of a binomial fraction of 10,000
        assert abs(kinds[kind].mean() - fraction) < 5 * np.sqrt(fraction * (1 - fraction)) / 100
    hot = truth.quanta_exposure[kinds[Defect.HOT]]
    assert ((hot >= 10) & (hot <= 12)).all()
    assert (truth.quanta_exposure[kinds[Defect.DEAD] | kinds[Defect.STUCK]] == 0).all()
    assert (truth.analog_read_noise_e[kinds[Defect.STUCK]] == 0).all()
    stuck = truth.bias[kinds[Defect.STUCK]]
    assert (stuck == np.rint(stuck)).all()
    assert stuck.max() <= 2**14 - 1
    assert (truth.quanta_exposure[kinds[Defect.NONE]] == 2).all()
