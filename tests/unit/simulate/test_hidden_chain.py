"""The chain that hides effects: a plain stack obeys the PCD, each effect has the size that its key states."""

from functools import cache

import numpy as np
import pytest
from helpers.places import TESTS
from hidden.chain import UNTESTABLE, hide

HIDDEN = TESTS / "hidden"
SHAPE, FRAMES = (24, 20), 500
SEED = 5


@cache
def made(tag=None, seed=SEED):
    return hide((tag,) if tag else (), 4.0, seed, SHAPE, FRAMES)


def test_another_take_is_the_same_sensor_with_other_electrons_even_beside_an_effect_on_the_light():
    """Rows of one stack in another: where both used the same numbers, pixels of a frame went together."""
    one, other = made("overdispersed_counts"), hide((), 4.0, SEED, SHAPE, FRAMES, take=1)
    assert np.array_equal(one.sensor.exposure, other.sensor.exposure)

    def common(other):
        """Sum of the correlations of all different pixels, in its standard deviations."""
        first, second = (each.frames.reshape(FRAMES, -1).astype(float) for each in (one, other))
        first, second = ((each - each.mean(axis=0)) / each.std(axis=0) for each in (first, second))
        product = first.T @ second / np.sqrt(FRAMES)
        np.fill_diagonal(product, 0.0)
        return product.sum() / np.sqrt(product.size)

    assert abs(common(other)) < 5.0
    assert common(made()) > 5.0


class View:
    """Deviations of a stack from what the true maps say, and their variance."""

    def __init__(self, hiding):
        s = hiding.sensor
        self.h, self.step = s.exposure, s.step
        self.quantum = 1 / (12 * s.step**2)
        self.e = (hiding.frames - s.bias) / s.step
        self.d = self.e - s.exposure
        self.var = s.exposure + s.noise**2 + self.quantum
        # fourth central moment of Poisson plus normal
        self.fourth = 3 * self.var**2 + s.exposure
        self.c = self.e - self.e.mean(axis=0)


def regress(v, regressor, scale=1.0):
    """Multiple of a regressor (e-) in the deviations, and its standard error."""
    regressor = np.broadcast_to(regressor, v.d.shape)
    weight = regressor / v.var
    norm = (weight * regressor).sum()
    return scale * (weight * v.d).sum() / norm, scale / np.sqrt(norm)


def times(effect):
    return effect.strength * np.array([effect.course(t) for t in range(FRAMES)])[:, None, None]


def covariance(v, one, other, expected):
    """Covariance of pairs of samples over the one expected of unit strength, and its standard error."""
    spread = np.sqrt((v.var[one[1:]] * v.var[other[1:]]).sum() * v.c[one].shape[0])
    return (v.c[one] * v.c[other]).sum() / expected, spread / expected


def neighbours(v, weight):
    """Mean of both axes of the covariance of neighbours over ``weight`` (H_i + H_j)."""
    a, f = slice(None), slice(None, -1)
    t = slice(1, None)
    both = []
    for one, other in (((a, a, f), (a, a, t)), ((a, f, a), (a, t, a))):
        expected = weight * (v.h[one[1:]] + v.h[other[1:]]).sum() * FRAMES
        both.append(covariance(v, one, other, expected))
    (x, sx), (y, sy) = both
    return (x + y) / 2, np.hypot(sx, sy) / 2


def lagged(v, expected):
    spread = np.sqrt((v.var**2).sum() * (FRAMES - 1))
    product = (v.c[1:] * v.c[:-1]).sum() + v.c.var(axis=0).sum() * (FRAMES - 1) / FRAMES
    return product / expected / (FRAMES - 1), spread / expected / (FRAMES - 1)


def excess(v, axes, unit):
    """Variance of means along axes beyond that of their samples, per unit^2, and its standard error."""
    w = unit / v.var
    mean = (w * v.d).sum(axis=axes) / (w * unit * np.ones_like(v.var)).sum(axis=tuple(a - 1 for a in axes))
    w2 = (w**2 * v.var * np.ones_like(v.var)).sum(axis=tuple(a - 1 for a in axes))
    plain = w2 / (w * unit * np.ones_like(v.var)).sum(axis=tuple(a - 1 for a in axes)) ** 2
    got = (mean**2 - plain).mean()
    return got, np.sqrt(2 * (plain**2).mean() / mean.size)


def overdispersion(v, e):
    error = np.sqrt(FRAMES * (v.fourth - v.var**2).sum())
    norm = FRAMES * (v.h**2).sum()
    return (v.d**2 - v.var).sum() / norm, error / norm


def offset(v, e):
    """Multiple of what an effect adds to the voltage."""
    return regress(v, np.array([e.voltage(t, np.zeros(SHAPE)) for t in range(FRAMES)]) / v.step, e.strength)


def light(v, e):
    """Multiple of what an effect adds to the exposure."""
    return regress(v, np.array([e.exposure(t, 0.0) for t in range(FRAMES)]), e.strength)


def amplifier(v, e):
    half = SHAPE[1] // 2
    left, right = v.c[:, :, :half], v.c[:, :, half:][:, :, ::-1]
    expected = v.h[:, :half].sum() * FRAMES
    spread = np.sqrt((v.var[:, :half] * v.var[:, half:][:, ::-1]).sum() * FRAMES)
    return (left * right).sum() / expected, spread / expected


#: by tag: (estimate of the strength, standard error) from a view of a stack and the effect
ESTIMATES = {
    "exposure_drift": lambda v, e: regress(v, v.h * times(e), e.strength),
    "persistence": light,
    "exposure_flicker": lambda v, e: excess(v, (1, 2), v.h),
    "overdispersed_counts": overdispersion,
    "branching_counts": lambda v, e: regress(v, v.h / (1 - e.strength)),
    "optical_crosstalk": lambda v, e: neighbours(v, 1 / 4),
    "nonlinearity": lambda v, e: regress(v, (v.h + v.h**2) / 5 * e.parameters["sign"]),
    "interpixel_capacitance": lambda v, e: neighbours(v, 1),
    "analog_memory": lambda v, e: lagged(v, v.h.sum()),
    "gain_drift": lambda v, e: regress(v, v.h * times(e), e.strength),
    "bias_drift": offset,
    "bias_jumps": offset,
    "frame_noise": lambda v, e: excess(v, (1, 2), 1 / v.step),
    "row_noise": lambda v, e: excess(v, (2,), 1 / v.step),
    "column_noise": lambda v, e: excess(v, (1,), 1 / v.step),
    "periodic_pickup": offset,
    "glow": light,
    "readout_alternation": offset,
    "checkerboard_offset": offset,
    "herring_bone": offset,
    "output_crosstalk": amplifier,
    "spurious_charge": lambda v, e: regress(v, np.ones(SHAPE)),
}
#: what grows with the square of the strength
SQUARED = ("exposure_flicker", "frame_noise", "row_noise", "column_noise")


@pytest.mark.parametrize("tag", sorted(ESTIMATES))
def test_an_effect_has_the_strength_that_its_key_states(tag):
    hiding = made(tag)
    (effect,) = hiding.effects
    expected = effect.strength ** (2 if tag in SQUARED else 1)
    value, error = ESTIMATES[tag](View(hiding), effect)
    # the effect itself adds to the noise of its own estimate
    assert abs(value - expected) < 5 * error + 0.15 * expected
    assert expected > 5 * error
    value, error = ESTIMATES[tag](View(made()), effect)
    assert abs(value) < 5 * error


@pytest.mark.parametrize("seed", [1, 2])
def test_a_plain_stack_has_the_moments_of_the_pcd(seed):
    hiding = made(seed=seed)
    v, n = View(hiding), FRAMES
    assert 0.3 <= v.h.min() <= v.h.max() <= 5
    assert 8 <= v.step.min() <= v.step.max() <= 20
    assert 0.2 <= hiding.sensor.noise.min() <= hiding.sensor.noise.max() <= 0.45
    mean = v.d.mean(axis=0) / np.sqrt(v.var / n)
    variance = (v.d.var(axis=0, ddof=1) - v.var) / np.sqrt((v.fourth - v.var**2) / n)
    for pulls in (mean, variance):
        assert abs(pulls.mean()) < 5 / np.sqrt(pulls.size)
        assert abs((pulls**2).mean() - 1) < 5 * np.sqrt(2.5 / pulls.size)
    # third central moment of Poisson plus normal: H
    third = (v.d**3).mean() - v.h.mean()
    assert abs(third) < 5 * np.sqrt((15 * v.var**3 + 25 * v.fourth + v.h).mean() / v.d.size)
    for value, error in (neighbours(v, 1), lagged(v, v.h.sum())):
        assert abs(value) < 5 * error


@pytest.mark.parametrize("tag", UNTESTABLE)
def test_the_untestable_leave_the_electrons_poisson_and_independent(tag):
    hiding = made(tag)
    v = View(hiding)
    inner = np.s_[:, 1:-1, 1:-1]
    noise = (v.var - v.h)[inner[1:]]
    mean, variance = v.e[inner].mean(axis=0), v.e[inner].var(axis=0, ddof=1)
    error = np.sqrt((2 * variance**2 + 2 * mean).sum() / FRAMES)
    assert abs((variance - noise - mean).sum()) < 5 * error
    for value, error in (neighbours(v, 1), lagged(v, v.h.sum())):
        assert abs(value) < 5 * error
    assert (hiding.frames != made().frames).mean() > 0.1


def test_the_sensor_does_not_depend_on_what_is_hidden():
    alone, pair = made("row_noise"), hide(("row_noise", "adc_dnl"), 4.0, SEED, SHAPE, FRAMES)
    for sensor in (alone.sensor, pair.sensor):
        np.testing.assert_array_equal(sensor.exposure, made().sensor.exposure)
    assert alone.effects[0].parameters == pair.effects[0].parameters
    with pytest.raises(SystemExit, match="nothing known as ghost"):
        hide(("ghost",), 4.0, 1)


def test_the_chain_shares_no_code_with_the_package():
    imports = [line for path in HIDDEN.glob("*.py") for line in path.read_text().splitlines()]
    assert not [line for line in imports if "import" in line and "pchem" in line]
