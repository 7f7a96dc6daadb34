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
        both = (each.frames.reshape(FRAMES, -1).astype(float) for each in (one, other))
        first, second = ((each - each.mean(axis=0)) / each.std(axis=0) for each in both)
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


def times(v, effect):
    """Multiple of a course that the signal follows."""
    course = effect.strength * np.array([effect.course(t) for t in range(FRAMES)])[:, None, None]
    return regress(v, v.h * course, effect.strength)


def neighbours(v, weight):
    """Mean of both axes of the covariance of neighbours over ``weight`` (H_i + H_j)."""
    both = []
    for one, other in ((np.s_[:, :, :-1], np.s_[:, :, 1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        expected = weight * (v.h[one[1:]] + v.h[other[1:]]).sum() * FRAMES
        spread = np.sqrt((v.var[one[1:]] * v.var[other[1:]]).sum() * FRAMES)
        both.append(((v.c[one] * v.c[other]).sum() / expected, spread / expected))
    (x, sx), (y, sy) = both
    return (x + y) / 2, np.hypot(sx, sy) / 2


def lagged(v, expected):
    spread = np.sqrt((v.var**2).sum() * (FRAMES - 1))
    product = (v.c[1:] * v.c[:-1]).sum() + v.c.var(axis=0).sum() * (FRAMES - 1) / FRAMES
    return product / expected / (FRAMES - 1), spread / expected / (FRAMES - 1)


def excess(v, axes, unit):
    """Variance of means along axes beyond that of their samples, per unit^2, and its standard error."""
    w = unit / v.var
    norm = (w * unit).sum(axis=tuple(a - 1 for a in axes))  # the variance of the sum of w d, too
    mean, plain = (w * v.d).sum(axis=axes) / norm, 1 / norm
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


def blinking(v, e):
    regressor = np.zeros((FRAMES, *SHAPE))
    regressor[:, *e.where] = e.extra
    return regress(v, regressor, e.strength)


def amplifier(v, e):
    half = np.s_[..., : SHAPE[1] // 2]
    mirrored = np.s_[..., : SHAPE[1] // 2 - 1 : -1]
    expected = v.h[half].sum() * FRAMES
    spread = np.sqrt((v.var[half] * v.var[mirrored]).sum() * FRAMES)
    return (v.c[half] * v.c[mirrored]).sum() / expected, spread / expected


#: by tag: (estimate of the strength, standard error) from a view of a stack and the effect
ESTIMATES = {
    "dark_current_rts": blinking,
    "exposure_drift": times,
    "persistence": light,
    "exposure_flicker": lambda v, e: excess(v, (1, 2), v.h),
    "overdispersed_counts": overdispersion,
    "branching_counts": lambda v, e: regress(v, v.h / (1 - e.strength)),
    "optical_crosstalk": lambda v, e: neighbours(v, 1 / 4),
    "nonlinearity": lambda v, e: regress(v, (v.h + v.h**2) / 5 * e.parameters["sign"]),
    "interpixel_capacitance": lambda v, e: neighbours(v, 1),
    "analog_memory": lambda v, e: lagged(v, v.h.sum()),
    "gain_drift": times,
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


def noise_of(tag, k=None, n=400):
    """The hook of a noise effect on normal numbers, in units of the plain noise."""
    (effect,) = made(tag).effects
    rng = np.random.default_rng(1)
    s, k = effect.sensor.noise, np.zeros(SHAPE, int) if k is None else k
    return effect, np.array([effect.noise(t, s * rng.standard_normal(SHAPE), k) / s for t in range(n)])


def test_rts_widens_the_chosen_pixels_only():
    hiding = made("rts_noise")
    (effect,) = hiding.effects
    found, plain = (
        (v.c.var(axis=0, ddof=1) - v.var) / np.sqrt((v.fourth - v.var**2) / FRAMES)
        for v in (View(hiding), View(made()))
    )
    inside, outside = found[effect.affected], found[~effect.affected]
    assert inside.sum() > 5 * np.sqrt(inside.size)
    assert abs(outside.mean()) < 5 / np.sqrt(outside.size)
    assert abs(plain[effect.affected].sum()) < 5 * np.sqrt(inside.size)


def test_heavy_tails_and_skew():
    effect, noise = noise_of("heavy_tailed_noise")
    kurtosis = (noise**4).mean() / (noise**2).mean() ** 2 - 3
    # a mixture of widths, or Student's law of the same excess kurtosis
    expected = 3 * effect.strength * (effect.parameters.get("width", 3.0) ** 2 - 1) ** 2
    assert abs(kurtosis - expected) < 0.3 * expected
    assert expected > 5 * np.sqrt(24 / noise.size)
    effect, noise = noise_of("noise_skew")
    assert abs((noise**2).mean() - 1) < 0.05
    assert abs((noise**3).mean() - 2 * effect.side * effect.strength**3) < 0.15


@pytest.mark.parametrize("seed", range(4))
def test_flicker_keeps_the_power_and_correlates_its_part(seed):
    (effect,) = hide(("flicker_noise",), 100.0, seed, (64, 64), 400).effects
    rng = np.random.default_rng(seed)
    s = effect.sensor.noise
    noise = np.array([effect.noise(t, s * rng.standard_normal(s.shape), None) / s for t in range(60)])
    assert abs((noise**2).mean() - 1) < 0.05
    expected = effect.strength * np.exp(-1 / effect.tau).mean()
    assert abs((noise[1:] * noise[:-1]).mean() - expected) < 5 / np.sqrt(noise.size) + 0.05 * expected
    assert expected > 10 / np.sqrt(noise.size)


def test_noise_grows_with_the_electrons():
    effect, noise = noise_of("signal_dependent_noise", k=np.full(SHAPE, 4))
    expected = 1 + effect.each**2 * 4 ** (2 * effect.power) * (1 / effect.sensor.noise**2).mean()
    assert abs((noise**2).mean() - expected) < 5 * np.sqrt(2 / noise.size) * expected
    assert expected - 1 > 5 * np.sqrt(2 / noise.size)
    empty = noise_of("signal_dependent_noise")[1]
    assert abs((empty**2).mean() - 1) < 5 * np.sqrt(2 / noise.size)


@pytest.mark.parametrize("seed", range(6))
def test_codes_have_the_widths_of_their_pattern(seed):
    (effect,) = hide(("adc_dnl",), 40.0, seed, (8, 8), 400).effects
    fine = np.arange(80, 240, 1 / 2000)
    code = effect.convert(0, fine, np.floor(fine + 0.5).astype(int))
    assert (np.diff(code) >= 0).all()
    width = np.bincount(code, minlength=300)[90:230] / 2000
    np.testing.assert_allclose(width, 1 + np.diff(effect.edges)[90:230], atol=2e-3)
    assert abs(width - 1).max() > 0.1
    assert abs(width.mean() - 1) < 0.02


def test_a_bent_converter_stays_within_its_amplitude():
    (effect,) = made("adc_inl").effects
    dn = np.linspace(*effect.sensor.code_range, 1000)
    bend = effect.voltage(0, dn) - dn
    assert 0.9 * effect.strength < abs(bend).max() <= effect.strength * (1 + 1e-9)


def hidden_in(tag, level=4.0, seed=SEED):
    """Return an effect, the frames with it and those without."""
    hiding = hide((tag,), level, seed, SHAPE, FRAMES)
    return hiding.effects[0], hiding.frames.astype(int), made(seed=seed).frames.astype(int)


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_clipping_catches_the_part_that_is_asked(seed):
    effect, frames, plain = hidden_in("clipping", seed=seed)
    cut = (np.maximum if effect.side == "low" else np.minimum)(plain, effect.parameters["limit_dn"])
    np.testing.assert_array_equal(frames, cut)
    assert 0.4 < effect.parameters["samples"] / (effect.strength * plain.size) < 2.5


def test_repeats_are_exact_and_where_the_key_says():
    effect, *both = hidden_in("repeated_frames")
    same, by_chance = ((f[1:, effect.rows] == f[:-1, effect.rows]).all(axis=(1, 2)) for f in both)
    assert (np.flatnonzero(same) + 1).tolist() == effect.parameters["frames"]
    assert not by_chance.any()


def test_corrected_pixels_equal_their_median():
    effect, frames, plain = hidden_in("pixel_correction", 20.0)
    changed = np.argwhere(frames != plain)
    assert len(changed) > 50
    for t, y, x in changed[:50]:
        around = np.delete(plain[t, y - 1 : y + 2, x - 1 : x + 2].ravel(), 4)
        assert frames[t, y, x] == int(np.median(around)) < plain[t, y, x] - effect.limit


def test_wrong_bits_are_the_bit_and_the_share_of_the_key():
    effect, frames, plain = hidden_in("bit_errors")
    wrong = frames ^ plain
    assert set(wrong[wrong > 0].tolist()) == {2**effect.bit}
    n = plain.size if effect.kind == "flip" else int((plain >> effect.bit & 1).sum())
    assert abs((wrong > 0).sum() - n * effect.strength) < 5 * np.sqrt(n * effect.strength)


def test_offsets_follow_the_bit_before():
    effect, frames, plain = hidden_in("binary_offset", 20.0)
    moved, one = (frames - plain)[:, :, 1:], (frames[:, :, :-1] >> effect.bit & 1) == 1
    apart = moved[one].mean() - moved[~one].mean()
    assert abs(apart / (effect.side * effect.strength) - 1) < 0.05


def test_misplaced_lines_hold_the_samples_of_others():
    moves = set()
    for seed in range(12):
        effect, *both = hidden_in("misplaced_lines", 20.0, seed)
        found, before = (np.moveaxis(f, effect.axis + 1, 1) for f in both)
        changed = (found != before).any(axis=2)
        # a line that is lost moves all after it
        hits = changed.any(axis=1) if effect.move == "line_lost" else changed
        expected = hits.size * effect.strength
        # a sample lost near the end of a short line is often not seen
        assert 0.6 * expected < hits.sum() < expected + 5 * np.sqrt(expected)
        if effect.move in ("early", "late"):
            last, step = found.shape[2] - 1, 1 if effect.move == "early" else -1
            come = np.clip(np.arange(last + 1) + step, 0, last)
            np.testing.assert_array_equal(found[changed], before[changed][:, come])
        moves.add(effect.move)
    assert len(moves) >= 4


def test_particles_leave_what_no_electron_count_does():
    hot = View(made("cosmic_rays")).d > 40
    assert 4 <= hot.any(axis=(1, 2)).sum() <= made("cosmic_rays").effects[0].parameters["tracks"]
    assert not (View(made()).d > 40).any()


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


def test_those_outside_the_library_do_something():
    (effect,) = made("self_trigger_cut").effects
    k = np.random.default_rng(2).poisson(effect.sensor.exposure, (400, *SHAPE))
    cut = np.array([effect.electrons(0, one) for one in k])
    expected = ((k == 0).sum(axis=0) * (1 + effect.strength * np.expm1(-effect.sensor.exposure))).sum()
    assert abs((cut == 0).sum() / expected - 1) < 0.01
    assert (cut == 0).sum() < 0.995 * (k == 0).sum()


def test_the_sensor_does_not_depend_on_what_is_hidden():
    alone, pair = made("row_noise"), hide(("row_noise", "adc_dnl"), 4.0, SEED, SHAPE, FRAMES)
    for sensor in (alone.sensor, pair.sensor):
        np.testing.assert_array_equal(sensor.exposure, made().sensor.exposure)
    assert alone.effects[0].parameters == pair.effects[0].parameters
    with pytest.raises(SystemExit, match="nothing known as ghost"):
        hide(("ghost",), 4.0, 1)


@pytest.mark.parametrize("other", ["adc_dnl", "binary_offset", "bit_errors"])
def test_lines_are_repeated_as_they_were_converted_in_whatever_order_they_are_hidden(other):
    seen = []
    for tags in (("repeated_lines", other), (other, "repeated_lines")):
        hiding = hide(tags, 400.0, SEED, SHAPE, 100)
        axis = 1 if hiding.effects[-1].parameters["lines"] == "rows" else 2
        frames = np.moveaxis(hiding.frames, axis, 1)
        seen.append((frames[:, 1:] == frames[:, :-1]).all(axis=2).mean())
        share = hiding.effects[-1].strength
        assert seen[-1] == pytest.approx(share, abs=5 * np.sqrt(share / (100 * 19)))
    assert seen[0] == seen[1]


def test_the_chain_shares_no_code_with_the_package():
    imports = [line for path in HIDDEN.glob("*.py") for line in path.read_text().splitlines()]
    assert not [line for line in imports if "import" in line and "pchem" in line]
