"""A sensor with pixels whose dark current blinks: after the search the fit gives their steady exposure."""

import numpy as np

from pchem_pipeline.commands.model import adopt_verdict, use_model
from pchem_pipeline.config.load import dump_config
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.run.stage import Command
from pchem_pipeline.run.target import find_run
from pchem_pipeline.runner.session import run_stages, run_status
from pchem_pipeline.store.run_store import RunStore

QUIET = Command(quiet=True)
BLINKING = {"tag": "dark_current_rts", "fraction": 0.12, "step_e": 1.2}
BLINKING |= {"dwell_low_frames": 60, "dwell_high_frames": 60}


def states(path):
    return {state.stage: state.words() for state in run_status(find_run(path))}


def test_exposure_of_blinking_pixels_is_their_steady_one(tmp_path):
    content = {
        "run": {"tile": 8},
        "simulate": {"shape": [12, 16], "n_frames": 1400, "seed": 3, "format": "npy", "effects": [BLINKING]},
        "discrepancy": {"replicates": 20, "extended_replicates": 12, "candidates": ["dark_current_rts"]},
        "compute": {"backend": "serial"},
    }
    path = tmp_path / "run.yaml"
    path.write_text(dump_config(RunConfig.model_validate(content)), encoding="utf-8")
    run_stages(find_run(path), ["simulate", "ingest", "histogram", "fit"], QUIET)
    store = RunStore.open(tmp_path / "run.zarr")
    truth = store.read("truth/quanta_exposure")
    before, stderr = store.read("fit/quanta_exposure"), store.read("fit/quanta_exposure_stderr")
    run_stages(find_run(path), ["discrepancy"], QUIET)
    assert states(path)["fit"] == "complete"
    adopted, words = adopt_verdict(find_run(path))
    assert words.endswith("--use 1")
    assert find_run(path).config == adopted.config
    assert adopted.config.model.effects[0].tag == "dark_current_rts"
    assert states(path)["discrepancy"] == "complete"
    assert states(path)["fit"] == "stale - model 1 -> 2"
    blinks = (before - truth) / stderr > 6
    assert 12 < blinks.sum() < 40
    added = store.read("model/0002/added_exposure")
    assert ((added > 0).any(axis=0) & blinks).sum() > 0.9 * blinks.sum()
    run_stages(find_run(path), ["fit", "maps", "ensemble", "electrons"], QUIET)
    after = store.read("fit/quanta_exposure")
    bias = [np.clip((h - truth) / stderr, -50, 50)[blinks].mean() for h in (before, after)]
    assert bias[0] > 10
    assert abs(bias[1]) < bias[0] / 5
    others = ~(added > 0).any(axis=0) & np.isfinite(after)
    assert abs(((after - truth) / stderr)[others & ~blinks].mean()) < 4 / np.sqrt(others.sum())
    # the ensemble is predicted with what was added: its mean is that of the frames
    ensemble = {name: store.read(f"ensemble/{name}") for name in ("dn", "epcd_exact", "counts")}
    mean = [np.average(ensemble["dn"], weights=ensemble[name]) for name in ("epcd_exact", "counts")]
    spread = np.sqrt(np.average((ensemble["dn"] - mean[1]) ** 2, weights=ensemble["counts"]))
    assert abs(mean[0] - mean[1]) < 4 * spread / np.sqrt(ensemble["counts"].sum())
    # the arrays belong to the model, not to the search: without this nothing changes
    RunStore.open(store.path, writable=True).delete("discrepancy/added_exposure")
    assert states(path)["fit"] == "complete"
    # back to the first model, and to its very bits
    use_model(find_run(path), 1)
    run_stages(find_run(path), ["fit"], QUIET)
    np.testing.assert_array_equal(store.read("fit/quanta_exposure"), before)
