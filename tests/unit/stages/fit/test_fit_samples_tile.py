"""The pure tile function of the stage fit where a run has several samples."""

import numpy as np
import pytest

from pchem_pipeline.base.variables import FREE_SATELLITES, PARAMETERS, interval_names, variables_of
from pchem_pipeline.effects.charge.branching_counts import BranchingCounts
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.stages.fit.fit import fit_tile
from pchem_pipeline.stages.fit.samples import SampleFit, fit_samples_tile

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
    codes = np.rint(BIAS + (electrons + NOISE * rng.standard_normal(born.shape)) / GAIN).astype(int)
    origin, width = codes.min(), int(np.ptp(codes)) + 1
    counts = np.apply_along_axis(lambda x: np.bincount(x - origin, minlength=width), 0, codes)
    nothing = np.zeros(SHAPE, np.uint32)
    return {
        "counts": np.ascontiguousarray(np.moveaxis(counts, 0, -1)).astype(np.uint32),
        "origin": np.full(SHAPE, origin, np.int32),
        "under": nothing,
        "over": nothing,
    }


def tile(branching=0.0):
    rng = np.random.default_rng(5)
    return [histogram(rng, exposure, branching) for exposure in (1.0, 3.0, 7.0, 0.0)]


def test_the_shown_sample_stands_where_a_run_of_one_has_its_own():
    arrays = fit_samples_tile(tile(), SampleFit([False, False, False, True], 1, FitSettings()))
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


def test_one_sample_is_the_fit_of_a_run_of_one():
    one = tile()[1]
    alone = fit_tile(one, FitSettings(), None)
    arrays = fit_samples_tile([one], SampleFit([False], 0, FitSettings()))
    for name in PARAMETERS:
        error = alone[f"{name}_stderr"]
        assert (np.abs(arrays[f"fit/{name}"] - alone[name]) < 1e-3 * error).all(), name


@pytest.mark.parametrize(
    "settings",
    [
        FitSettings(),
        FitSettings(likelihood="exact", errors="sandwich", intervals="profile"),
    ],
    ids=["information", "sandwich and profile"],
)
def test_effects_go_with_several_samples(settings):
    given, bias = tile(BRANCHING), [False, False, False, True]
    plain = fit_samples_tile(given, SampleFit(bias, 1, FitSettings()))
    how = SampleFit(bias, 1, settings, effects=(BranchingCounts(branching=BRANCHING),))
    arrays = fit_samples_tile(given, how)
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
