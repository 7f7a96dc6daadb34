"""The search on ready-made histograms: samples drawn one by one, effects hidden in them, and what it says."""

import numpy as np
import pytest
from helpers.drawn_pixels import histograms

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.discrepancy.by_likelihood.explainer import find_in_histograms
from pchem_pipeline.discrepancy.by_likelihood.observed import SampleHistograms
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.effects.framework.registry import effect_class

PIXELS, SAMPLES = 24, 9000
CANDIDATES = (
    "branching_counts", "overdispersed_counts", "signal_dependent_noise", "nonlinearity",
    "heavy_tailed_noise", "noise_skew", "row_noise",
)  # fmt: skip
SETTINGS = DiscrepancySettings(replicates=20, candidates=CANDIDATES, seed=3)


def branching_numbers(rng, mean, branching, size):
    """Electron numbers by their definition: every electron makes Poisson many more, and these again."""
    total = rng.poisson(mean * (1 - branching), size)
    young = total.copy()
    while young.any():
        young = rng.poisson(branching * young)
        total += young
    return total


def signal(rng, h, hidden, strength, sigma_e):
    """Electrons of every sample and their noise, e-; ``hidden`` names what the PCD does not have."""
    if hidden == "branching_counts":
        k = branching_numbers(rng, h, strength, h.shape)
    elif hidden == "overdispersed_counts":
        k = rng.poisson(h * rng.gamma(1 / strength, strength, h.shape))
    else:
        k = rng.poisson(h)
    noise = rng.normal(size=h.shape) * sigma_e
    if hidden == "signal_dependent_noise":
        noise += rng.normal(size=h.shape) * np.sqrt(k) * strength
    return k + noise


def a_sample(seed, *, hidden="", sigma_e=0.25, strength=0.0):
    """Histograms of pixels with every sample drawn, and their DN per electron and bias."""
    rng = np.random.default_rng(seed)
    h, step, bias = (rng.uniform(*each, (PIXELS, 1)) for each in ((0.6, 4.0), (13.0, 15.0), (80.0, 120.0)))
    h = np.broadcast_to(h, (PIXELS, SAMPLES))
    return counted(bias + step * signal(rng, h, hidden, strength, sigma_e)), step.ravel(), bias.ravel()


def counted(x, **sample):
    x = np.rint(x).astype(np.int64)
    origin = x.min(axis=1)
    return SampleHistograms(histograms(x - origin[:, None])[0], origin, **sample)


def test_a_peak_that_is_taken_for_that_of_no_electron_is_put_right_with_the_effect():
    """The plain fit of some bright pixels is an electron off; with the effect from there, too, it misfits."""
    sample, step, bias = a_sample(101, hidden="branching_counts", sigma_e=0.2, strength=0.1)
    found = find_in_histograms([sample], SETTINGS)
    assert found.verdict.verdict == "named"
    assert found.verdict.effects == ("branching_counts",)
    assert abs((found.maps.bias.ravel() - bias) / step).max() < 0.2


def test_nothing_hidden_is_consistent():
    found = find_in_histograms([a_sample(1)[0]], SETTINGS).verdict
    assert (found.verdict, found.model_effects, found.effects) == ("consistent", (), ())
    assert found.gap.before < 3 * found.gap.floor
    assert "row_noise" in found.untestable
    assert "no frame order and no neighbours" in found.untestable["row_noise"]


@pytest.mark.parametrize(
    ("hidden", "strength", "name"),
    [("branching_counts", 0.08, "branching"), ("signal_dependent_noise", 0.11, "noise_e")],
)
def test_what_is_hidden_is_named(hidden, strength, name):
    found = find_in_histograms([a_sample(7, hidden=hidden, strength=strength)[0]], SETTINGS).verdict
    assert found.verdict == "named", found.sentence
    assert found.effects == (hidden,)
    [step] = found.steps
    assert_strength(step, name, strength)
    # the gap falls to what chance leaves, and a wrong effect in its place does not bring it there
    assert step.gap_before > 3 * step.gap_floor
    assert step.gap_after < 2 * step.gap_floor
    assert step.runner_up.gap_after > step.gap_after + 0.5 * step.gap_floor
    assert found.set_aside == ()


def test_a_search_that_ends_at_its_limit_names_nothing_and_says_what_was_not_tried():
    short = SETTINGS.model_copy(update={"effort": 1e-5})
    sample, _, _ = a_sample(7, hidden="branching_counts", strength=0.08)
    found = find_in_histograms([sample], short).verdict
    assert (found.verdict, found.effects) == ("unexplained", ())
    assert "used its budget" in found.limit
    assert "branching_counts" in found.limit
    assert find_in_histograms([sample], short).verdict == found


def test_an_effect_of_the_model_is_not_added_again_and_the_rest_is_consistent():
    present = effect_class("branching_counts")(branching=0.08)
    sample, _, _ = a_sample(7, hidden="branching_counts", strength=0.08)
    found = find_in_histograms([sample], SETTINGS, model=(present,))
    assert found.verdict.gap.before < 2 * found.verdict.gap.floor
    assert found.verdict.effects == ()
    assert found.model == (present,)


def test_a_peak_that_was_cut_is_set_aside_and_bends_nothing():
    sample, _, _ = a_sample(11, hidden="branching_counts", strength=0.2, sigma_e=0.12)
    # a trigger that drops nine of ten samples without electrons
    rng = np.random.default_rng(2)
    for row in sample.counts:
        zero = np.argmax(row[:14]) + 7
        row[:zero] = rng.binomial(row[:zero], 0.1)
    found = find_in_histograms([sample], SETTINGS).verdict
    assert "branching_counts" in found.effects, found.sentence
    assert found.set_aside == ((None, 0.5),)
    fitted = next(s for s in found.steps if s.effect == "branching_counts")
    assert fitted.parameters["branching"].value == pytest.approx(0.2, abs=0.03)
    first = found.unexplained[0]
    assert first.direction == "-"
    assert "0-electron peak" in first.sentence
    assert found.gap.after < found.gap.before


def test_too_few_samples_and_samples_of_other_pixels_are_refused_in_one_line():
    def sample(pixels, count):
        return SampleHistograms(np.full((pixels, 50), count, np.uint32), np.zeros(pixels, np.int64))

    with pytest.raises(InputError, match="900 needed"):
        find_in_histograms([sample(4, 1)], SETTINGS)
    with pytest.raises(InputError, match="different numbers of pixels"):
        find_in_histograms([sample(4, 99), sample(5, 99)], SETTINGS)


def exposures(seed, levels, *, hidden="", strength=0.0, sigma_e=0.25, times=(None, None, None)):
    """A bias and three exposures of a sensor whose pixels differ by some percent, every sample drawn."""
    rng = np.random.default_rng(seed)
    step, bias = rng.uniform(13.9, 14.1, (PIXELS, 1)), rng.uniform(80.0, 120.0, (PIXELS, 1))
    scale = rng.uniform(0.98, 1.02, PIXELS)
    samples = []
    for level, time in zip((0.0, *levels), (None, *times), strict=True):
        charge = strength if hidden == "spurious_charge" and level else 0.0
        h = np.broadcast_to((level * scale)[:, None] + charge, (PIXELS, 6000))
        x = bias + step * signal(rng, h, hidden, strength, sigma_e)
        samples.append(counted(x, bias=level == 0.0, integration_time=time))
    return samples


def assert_strength(step, name, expected):
    fitted = step.parameters[name]
    assert 0 < fitted.stderr < 0.2 * fitted.value
    assert abs(fitted.value - expected) < 5 * fitted.stderr


@pytest.mark.parametrize(
    ("hidden", "strength", "name"),
    [("branching_counts", 0.08, "branching"), ("overdispersed_counts", 0.1, "relative_variance")],
)
def test_several_exposures_tell_branching_from_overdispersion(hidden, strength, name):
    samples = exposures(1, (0.5, 1.5, 4.5), hidden=hidden, strength=strength)
    single = find_in_histograms(samples[2:3], SETTINGS).verdict
    assert single.verdict == "ambiguous", single.sentence
    [step] = single.steps
    assert {c.effect for c in step.candidates} == {"branching_counts", "overdispersed_counts"}
    joint = find_in_histograms(samples, SETTINGS).verdict
    assert joint.verdict == "named", joint.sentence
    assert joint.effects == (hidden,)
    assert_strength(joint.steps[0], name, strength)
    assert joint.gap.after < joint.gap.before / 5


def test_several_exposures_tell_signal_dependent_noise_from_a_gain_error():
    """Where peaks overlap, var = H / g^2 (1 + s^2): one exposure takes such noise for another gain."""
    samples = exposures(1, (0.7, 2.5, 8.0), hidden="signal_dependent_noise", strength=0.15, sigma_e=0.35)
    single = find_in_histograms(samples[3:], SETTINGS)
    assert single.verdict.verdict == "consistent", single.verdict.sentence
    # what the noise adds to the DN per electron, s^2, drowns in what one exposure leaves open
    assert np.nanstd(1.0 / single.maps.conversion_gain) / 14.0 > 2 * 0.15**2
    joint = find_in_histograms(samples, SETTINGS)
    assert joint.verdict.effects == ("signal_dependent_noise",), joint.verdict.sentence
    assert_strength(joint.verdict.steps[0], "noise_e", 0.15)
    steps = 1.0 / joint.maps.conversion_gain[:, 0]
    assert abs(np.median(steps) / 14.0 - 1.0) < 0.15**2 / 4


def test_integration_times_tell_spurious_charge_from_dark_current():
    settings = SETTINGS.model_copy(update={"candidates": (*CANDIDATES, "spurious_charge")})
    levels, times = (0.5, 1.5, 4.5), (1.0, 3.0, 9.0)
    hidden = {"hidden": "spurious_charge", "strength": 0.1}
    found = find_in_histograms(exposures(1, levels, times=times, **hidden), settings).verdict
    assert found.effects == ("spurious_charge",), found.sentence
    assert_strength(found.steps[0], "mean_e", 0.1)
    assert "spurious_charge" not in found.untestable
    # dark current alone, exposures that are no matter of time, and the same charge without times
    alone = find_in_histograms(exposures(1, levels, times=times), settings).verdict
    other = find_in_histograms(exposures(1, levels, times=(1.0, 2.0, 9.0)), settings).verdict
    timeless = find_in_histograms(exposures(1, levels, **hidden), settings).verdict
    for verdict in (alone, other, timeless):
        assert verdict.verdict == "consistent", verdict.sentence
    assert "spurious_charge" in timeless.untestable


def test_places_are_those_of_the_sensor():
    """Pixel 13 of a sensor of 6 columns, whichever of its samples shows it."""
    samples = exposures(1, (0.5, 1.5), times=(None, None))
    for sample in samples[1:]:
        row = sample.counts[13]
        row[:] = 0
        row[::2] = 200
    one = SETTINGS.model_copy(update={"candidates": ("branching_counts",)})
    found = find_in_histograms(samples, one, width=6).verdict
    assert (found.examined.rows, found.examined.columns) == ((0, 4), (0, 6))
    assert all(y < 4 and x < 6 for place in found.where for y, x in place.pixels)
