"""What the stage fit does with the sensor as a whole: words given in common, codes at which it is cut off."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.run.stage import StageContext
from pchem_pipeline.runner.execute import execute
from pchem_pipeline.stages.fit import together
from pchem_pipeline.store.run_store import RunStore

WEAK = np.uint16(int(FitStatus.WEAKLY_IDENTIFIED))


def sensor(folder: Path, noise: float, steps: float, n_frames: int, tile: int) -> StageContext:
    """A run up to its fit: H = 2, equal pixels."""
    values = {"quanta_exposure": 2.0, "dn_per_electron": steps, "analog_read_noise_e": noise}
    constant = {name: {"kind": "constant", "value": value} for name, value in values.items()}
    simulate = {
        "shape": [12, 14],
        "n_frames": n_frames,
        "format": "npy",
        "parameters": {**constant, "correlations": [], "hot_pixels": {"fraction": 0}},
    }
    return fitted(folder, "simulate", run={"tile": tile, "store": f"run{tile}.zarr"}, simulate=simulate)


def fitted(folder: Path, *before: str, **sections: dict[str, Any]) -> StageContext:
    """A run up to its fit, and what comes before it."""
    config = RunConfig.model_validate(sections)
    store = RunStore.create(folder / config.run.store)
    context = StageContext(config, folder, store)
    for stage in (*before, "ingest", "histogram", "fit"):
        assert execute(stage, context).state == "complete"
    return context


def test_words_given_in_common_depend_on_no_tiling(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    contexts = [sensor(tmp_path, 0.48, 7.0, 2000, tile) for tile in (8, 64)]
    words = [context.store.read("fit/fit_status") for context in contexts]
    np.testing.assert_array_equal(*words)
    assert (words[0] & WEAK != 0).all()
    assert np.count_nonzero((words[0] & ~WEAK) == 0) > 5  # clear one by one
    # given again it is the same, and a pool of some pixels says the same of all
    context = contexts[0]
    assert together.judge_sensor(context) == words[0].size
    monkeypatch.setattr(together, "_LARGEST_POOL", 60)
    assert together.judge_sensor(context) == words[0].size
    np.testing.assert_array_equal(context.store.read("fit/fit_status"), words[0])
    monkeypatch.setattr(together, "_LARGEST_KEPT", 0)
    assert together.judge_sensor(context) == words[0].size
    # fewer pixels than make a pool take the words back
    monkeypatch.setattr(together, "_LARGEST_POOL", 10)
    assert together.judge_sensor(context) == 0
    np.testing.assert_array_equal(context.store.read("fit/fit_status"), words[0] & ~WEAK)


def test_a_good_sensor_keeps_its_words(tmp_path: Path) -> None:
    words = sensor(tmp_path, 0.3, 7.0, 4000, 64).store.read("fit/fit_status")
    assert not (words & WEAK).any()
    assert (words == 0).mean() > 0.95


@pytest.mark.parametrize(("low", "high"), [(0, 200), (90, 255)])
def test_samples_cut_off_at_a_code_that_no_file_states_are_censored(
    tmp_path: Path, low: int, high: int
) -> None:
    """A fifth of the samples at 200 DN, in 16 bits: the gain came out twelve times too large."""
    rng = np.random.default_rng(3)
    electrons = rng.poisson(1.5, (1500, 12, 14)) + 0.3 * rng.standard_normal((1500, 12, 14))
    dn = 100.0 + 2.0 * rng.standard_normal((12, 14)) + 40.0 * electrons
    np.save(tmp_path / "frames.npy", np.rint(dn).clip(low, high).astype(np.uint16))
    context = fitted(tmp_path, input={"files": ["frames.npy"]}, run={"store": "run.zarr"})
    assert context.adc_limits == (low, high)
    for name, truth in (("quanta_exposure", 1.5), ("conversion_gain", 1 / 40.0)):
        value, error = (context.store.read(f"fit/{each}") for each in (name, f"{name}_stderr"))
        pulls = (value - truth) / error
        assert np.abs(pulls).max() < 5.0
        assert abs(pulls.mean()) < 5.0 / np.sqrt(pulls.size)
