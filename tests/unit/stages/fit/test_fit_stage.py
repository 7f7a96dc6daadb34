"""The stage fit: a tile, tiles of several samples, and the sensor as a whole."""

import numpy as np
import pytest
from helpers.drawn_pixels import codes, histograms
from helpers.stage_runs import completed, stage_context

from pchem_pipeline.base.variables import FREE_SATELLITES, PARAMETERS, interval_names, variables_of
from pchem_pipeline.effects.operators.fate import BranchingCounts
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.stages.fit import fit
from pchem_pipeline.stages.fit.tile import TileFit, fit_tile

WEAK = np.uint16(int(FitStatus.WEAKLY_IDENTIFIED))


def sensor(folder, noise, steps, n_frames, tile):
    """A run up to its fit: H = 2, equal pixels."""
    values = {"quanta_exposure": 2.0, "dn_per_electron": steps, "analog_read_noise_e": noise}
    constant = {name: {"kind": "constant", "value": value} for name, value in values.items()}
    parameters = {**constant, "correlations": [], "hot_pixels": {"fraction": 0}}
    simulate = {"shape": [12, 14], "n_frames": n_frames, "format": "npy", "parameters": parameters}
    context = stage_context(folder, run={"tile": tile, "store": f"run{tile}.zarr"}, simulate=simulate)
    return completed(context, "simulate", "ingest", "histogram", "fit")


def test_words_given_in_common_depend_on_no_tiling(tmp_path, monkeypatch):
    contexts = [sensor(tmp_path, 0.48, 7.0, 2000, tile) for tile in (8, 64)]
    words = [context.store.read("fit/fit_status") for context in contexts]
    np.testing.assert_array_equal(*words)
    assert (words[0] & WEAK != 0).all()
    assert np.count_nonzero((words[0] & ~WEAK) == 0) > 5  # clear one by one
    # given again it is the same, and a pool of some pixels says the same of all
    context = contexts[0]
    assert fit.judge_sensor(context) == words[0].size
    monkeypatch.setattr(fit, "_LARGEST_POOL", 60)
    assert fit.judge_sensor(context) == words[0].size
    np.testing.assert_array_equal(context.store.read("fit/fit_status"), words[0])
    # fewer pixels than make a pool take the words back
    monkeypatch.setattr(fit, "_LARGEST_POOL", 10)
    assert fit.judge_sensor(context) == 0
    np.testing.assert_array_equal(context.store.read("fit/fit_status"), words[0] & ~WEAK)


def test_a_good_sensor_keeps_its_words(tmp_path):
    words = sensor(tmp_path, 0.3, 7.0, 4000, 64).store.read("fit/fit_status")
    assert not (words & WEAK).any()
    assert (words == 0).mean() > 0.95


@pytest.mark.parametrize(("low", "high"), [(0, 200), (90, 255)])
def test_samples_cut_off_at_a_code_that_no_file_states_are_censored(tmp_path, low, high):
    """A fifth of the samples at 200 DN, in 16 bits: the gain came out twelve times too large."""
    rng = np.random.default_rng(3)
    dn = codes(rng, (1500, 12, 14), 1.5, 40.0, 0.3, 100.0 + 2.0 * rng.standard_normal((12, 14)))
    np.save(tmp_path / "frames.npy", dn.clip(low, high).astype(np.uint16))
    context = stage_context(tmp_path, input={"files": ["frames.npy"]})
    completed(context, "ingest", "histogram", "fit")
    assert context.sensor.adc_limits == (low, high)
    for name, truth in (("quanta_exposure", 1.5), ("conversion_gain", 1 / 40.0)):
        value, error = (context.store.read(f"fit/{each}") for each in (name, f"{name}_stderr"))
        pulls = (value - truth) / error
        assert np.abs(pulls).max() < 5.0
        assert abs(pulls.mean()) < 5.0 / np.sqrt(pulls.size)


SHAPE, FRAMES = (8, 8), 2500
GAIN, BIAS, NOISE = 0.1, 100.3, 0.35
BRANCHING = 0.12


def histogram(rng, exposure, branching=0.0):
    """Draw the histograms of a tile; every electron makes Poisson many (mean ``branching``) more."""
    born = rng.poisson(exposure * (1.0 - branching), (FRAMES, *SHAPE))
    electrons = born.copy()
    while born.any():
        born = rng.poisson(branching * born)
        electrons += born
    dn = np.rint(BIAS + (electrons + NOISE * rng.standard_normal(born.shape)) / GAIN).astype(int)
    counts, origin = histograms(dn.reshape(FRAMES, -1).T)
    nothing = np.zeros(SHAPE, np.uint32)
    tile = {"counts": counts.reshape(*SHAPE, -1), "origin": origin.reshape(SHAPE).astype(np.int32)}
    return {**tile, "under": nothing, "over": nothing}


def tile(branching=0.0):
    rng = np.random.default_rng(5)
    return [histogram(rng, exposure, branching) for exposure in (1.0, 3.0, 7.0, 0.0)]


def by_path(groups):
    return {f"{group}/{name}": values for group, arrays in groups.items() for name, values in arrays.items()}


def test_the_shown_sample_stands_where_a_run_of_one_has_its_own():
    arrays = by_path(fit_tile(tile(), TileFit(bias=[False, False, False, True], shown=1)))
    ends = {path for name in (*PARAMETERS, "read_noise_e") for path in interval_names(name)}
    named = {v.path for v in variables_of("fit") if v.name not in ends | set(FREE_SATELLITES)}
    assert {path for path in arrays if path.startswith("fit/")} == named
    for end in ("", "_stderr"):
        np.testing.assert_array_equal(
            arrays[f"fit/quanta_exposure{end}"], arrays[f"samples/quanta_exposure{end}"][1]
        )
    assert arrays["samples/covariance"].shape == (*SHAPE, 7, 7)
    np.testing.assert_allclose(
        arrays["fit/bias_stderr"] ** 2, arrays["samples/covariance"][..., 5, 5], rtol=1e-12
    )
    assert (arrays["samples/quanta_exposure"][3] == 0).all()


@pytest.mark.parametrize(
    "settings",
    [FitSettings(), FitSettings(likelihood="exact", errors="sandwich", intervals="profile")],
    ids=["information", "sandwich and profile"],
)
def test_effects_go_with_several_samples(settings):
    given, bias = tile(BRANCHING), [False, False, False, True]
    plain = by_path(fit_tile(given, TileFit(bias=bias, shown=1)))
    how = TileFit(settings, None, (BranchingCounts(branching=BRANCHING),), (), bias, 1)
    arrays = by_path(fit_tile(given, how))
    n = plain["fit/bias"].size
    # the plain model is refused almost everywhere, the law with the effect as often as chance wants
    assert (plain["fit/goodness_p"] < 0.01).mean() > 0.9
    p = arrays["fit/goodness_p"]
    assert abs(p.mean() - 0.5) < 5 / np.sqrt(12 * n)
    truth = {"quanta_exposure": 3.0, "conversion_gain": GAIN, "bias": BIAS}
    for name, value in truth.items():
        pulls = (arrays[f"fit/{name}"] - value) / arrays[f"fit/{name}_stderr"]
        assert abs(pulls.mean()) < 5 / np.sqrt(n), name
        assert abs(pulls.std() - 1) < 5 / np.sqrt(2 * n), name
    if settings.intervals == "profile":
        low, high = (arrays[f"fit/conversion_gain_{end}"] for end in ("low", "high"))
        share = ((low < GAIN) & (high > GAIN)).mean()
        level = settings.interval_level
        assert abs(share - level) < 5 * np.sqrt(level * (1 - level) / n)
