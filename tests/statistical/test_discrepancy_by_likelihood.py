"""The search on ready-made histograms: samples drawn one by one, effects hidden in them, and what it says."""

import numpy as np
import pytest

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.discrepancy.by_likelihood.explainer import find_in_histograms
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.effects.framework.registry import effect_class

PIXELS, SAMPLES = 24, 9000
CANDIDATES = (
    "branching_counts",
    "overdispersed_counts",
    "signal_dependent_noise",
    "nonlinearity",
    "heavy_tailed_noise",
    "noise_skew",
    "row_noise",
)
SETTINGS = DiscrepancySettings(replicates=24, candidates=CANDIDATES, seed=3)


def branching_numbers(rng, mean, branching, size):
    """Electron numbers by their definition: every electron makes Poisson many more, and these again."""
    total = rng.poisson(mean * (1 - branching), size)
    young = total.copy()
    while young.any():
        young = rng.poisson(branching * young)
        total += young
    return total


def histograms(seed, *, hidden="", sigma_e=0.25, strength=0.0):
    """Histograms of sensors with every sample drawn; ``hidden`` names what the PCD does not have."""
    rng = np.random.default_rng(seed)
    exposure = rng.uniform(0.6, 4.0, PIXELS)
    step, bias = rng.uniform(13.0, 15.0, PIXELS), rng.uniform(80.0, 120.0, PIXELS)
    counts, size = [], (PIXELS, SAMPLES)
    h = np.broadcast_to(exposure[:, None], size)
    if hidden == "branching_counts":
        k = branching_numbers(rng, h, strength, size)
    elif hidden == "overdispersed_counts":
        k = rng.poisson(h * rng.gamma(1 / strength, strength, size))
    else:
        k = rng.poisson(h)
    noise = rng.normal(size=size) * sigma_e
    if hidden == "signal_dependent_noise":
        noise += rng.normal(size=size) * np.sqrt(k) * strength
    x = np.rint(bias[:, None] + step[:, None] * (k + noise)).astype(np.int64)
    origin = x.min(axis=1)
    width = int((x.max(axis=1) - origin).max()) + 1
    for row, first in zip(x, origin, strict=True):
        counts.append(np.bincount(row - first, minlength=width))
    return np.array(counts, np.uint32), origin


def test_nothing_hidden_is_consistent():
    found = find_in_histograms(*histograms(1), SETTINGS).verdict
    assert found.verdict == "consistent"
    assert found.model_effects == ()
    assert found.effects == ()
    assert found.gap.before < 3 * found.gap.floor
    assert "row_noise" in found.untestable
    assert "no order in time and no neighbours" in found.untestable["row_noise"]


@pytest.mark.parametrize(
    ("hidden", "strength", "name"),
    [("branching_counts", 0.08, "branching"), ("signal_dependent_noise", 0.11, "noise_e")],
)
def test_what_is_hidden_is_named(hidden, strength, name):
    found = find_in_histograms(*histograms(7, hidden=hidden, strength=strength), SETTINGS).verdict
    assert found.verdict == "named", found.sentence
    assert found.effects == (hidden,)
    [step] = found.steps
    fitted = step.parameters[name]
    assert abs(fitted.value - strength) < 5 * fitted.stderr
    assert 0 < fitted.stderr < 0.2 * strength
    # the gap falls to what chance leaves, and a wrong effect in its place does not bring it there
    assert step.gap_before > 3 * step.gap_floor
    assert step.gap_after < 2 * step.gap_floor
    assert step.runner_up.gap_after > step.gap_after + 0.5 * step.gap_floor
    assert found.set_aside == ()


def test_a_near_twin_is_told_apart_or_listed_beside_the_right_name():
    found = find_in_histograms(*histograms(7, hidden="overdispersed_counts", strength=0.06), SETTINGS).verdict
    assert found.verdict in ("named", "ambiguous"), found.sentence
    listed = {c.effect for s in found.steps for c in s.candidates[:2]}
    assert "overdispersed_counts" in listed
    assert listed <= {"overdispersed_counts", "branching_counts"}
    assert found.gap.closed_fraction > 0.6


def test_an_effect_of_the_model_is_not_added_again_and_the_rest_is_consistent():
    present = effect_class("branching_counts")(branching=0.08)
    found = find_in_histograms(
        *histograms(7, hidden="branching_counts", strength=0.08), SETTINGS, model=(present,)
    )
    assert found.verdict.gap.before < 2 * found.verdict.gap.floor
    assert found.verdict.effects == ()
    assert found.model == (present,)


def test_a_peak_that_was_cut_is_set_aside_and_bends_nothing():
    counts, origin = histograms(11, hidden="branching_counts", strength=0.2, sigma_e=0.12)
    # a trigger that drops nine of ten samples without electrons
    rng = np.random.default_rng(2)
    for row in counts:
        zero = np.argmax(row[:14]) + 7
        row[:zero] = rng.binomial(row[:zero], 0.1)
    found = find_in_histograms(counts, origin, SETTINGS).verdict
    assert "branching_counts" in found.effects, found.sentence
    assert found.set_aside == ((None, 0.5),)
    fitted = next(s for s in found.steps if s.effect == "branching_counts")
    assert fitted.parameters["branching"].value == pytest.approx(0.2, abs=0.03)
    first = found.unexplained[0]
    assert first.direction == "-"
    assert "0-electron peak" in first.sentence
    assert found.gap.after < found.gap.before


def test_too_few_samples_are_refused_in_one_line():
    with pytest.raises(InputError, match="fewer than 900"):
        find_in_histograms(np.ones((4, 50), np.uint32), np.zeros(4, np.int64), SETTINGS)
