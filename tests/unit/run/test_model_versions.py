"""The model of a run as an artefact: its versions, and the one in force."""

import json
import shutil
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from helpers.commands import arrays_of, assert_equal_arrays, invoke
from helpers.discrepancy_material import verdict_of

from pchem_pipeline.base.errors import ConfigError, StoreError
from pchem_pipeline.commands.model import adopt_verdict, model_lines, use_model
from pchem_pipeline.config.load import dump_config, load_config
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.discrepancy.verdict import VERDICT_FILE
from pchem_pipeline.effects.framework.compose import AddedExposure
from pchem_pipeline.effects.framework.settings import ModelSettings
from pchem_pipeline.run.model_versions import (
    keep_in_force,
    model_in_force,
    model_versions,
    read_added_exposure,
    verdict_version,
    version_with,
    write_added_exposure,
)
from pchem_pipeline.run.stage import Command
from pchem_pipeline.run.target import find_run
from pchem_pipeline.runner.session import run_stages, run_status
from pchem_pipeline.stages.table import STAGES
from pchem_pipeline.store.files import fingerprint_of, read_record, write_record
from pchem_pipeline.store.records import StageRecord
from pchem_pipeline.store.run_store import RunStore

QUIET = Command(quiet=True)
ROW: dict[str, Any] = {"tag": "row_noise", "row_noise_dn": 1.2}
BLINK: dict[str, Any] = {"tag": "dark_current_rts", "fraction": 0.1}


def settings(*effects, **more):
    return ModelSettings.model_validate({"effects": list(effects), **more})


@pytest.fixture
def store(tmp_path):
    return RunStore.create(tmp_path / "run.zarr")


def put(store, model):
    return keep_in_force(store, model_in_force(store, model)).number


def test_the_same_model_is_the_same_version(store):
    assert model_versions(store) == ()
    assert model_in_force(store, settings()).made == ""  # looked at, not written
    assert not (store.path / "model").exists()
    assert [put(store, m) for m in (settings(), settings(ROW), settings(), settings(ROW))] == [1, 2, 1, 2]
    first, second = model_versions(store)
    assert (first.source, first.parent, second.parent) == ("config", None, 1)
    assert second.effects[0].tag == "row_noise"
    assert first.digest != second.digest
    assert read_record(store.path / "model/current.json") == {"number": 2}
    place = store.path / "model/0002.json"
    written = place.stat().st_mtime_ns
    put(store, settings(ROW))
    assert place.stat().st_mtime_ns == written
    with pytest.raises(ConfigError, match="no model 3; it has: 1, 2"):
        version_with(store, 3)


def test_a_verdict_makes_a_version_with_its_arrays_and_the_same_effects_without_them_are_another(store):
    store.create_array("histogram/origin", (4, 5), chunks=(4, 5))
    start = keep_in_force(store, model_in_force(store, settings()))
    plain = keep_in_force(store, model_in_force(store, settings(BLINK)))
    exposure = np.zeros((2, 4, 5))
    exposure[1, 2, 3] = 0.7
    added = AddedExposure(exposure, np.full((2, 4, 5), 0.5))
    write_added_exposure(store, "discrepancy", added, plain.effects, (0, 4), (0, 5))
    found = verdict_version(store, settings(BLINK), start, group="discrepancy", closed_fraction=0.97)
    found = keep_in_force(store, found)
    assert (found.number, found.source, found.parent, found.closed_fraction) == (3, "verdict", 1, 0.97)
    kept = read_added_exposure(store, found)
    np.testing.assert_array_equal(kept.exposure_e, exposure)
    assert read_added_exposure(store, plain) is None
    # both are the same section of the YAML: the one in force stays
    assert model_in_force(store, settings(BLINK)).number == 3
    keep_in_force(store, plain)
    assert model_in_force(store, settings(BLINK)).number == 2
    again = verdict_version(store, settings(BLINK), start, group="discrepancy")
    assert again.number == 3
    assert store.array("model/0003/added_exposure").attrs["units"] == "e-"


def test_what_a_killed_command_left_is_no_version(store):
    put(store, settings())
    arrays = AddedExposure(*np.zeros((2, 1, 2, 2)))  # without their version
    write_added_exposure(store, "model/0002", arrays, [], (0, 2), (0, 2))
    assert put(store, settings(ROW)) == 2
    assert not store.has("model/0002")
    (store.path / "model/0002.json").write_text('{"number": 2}')
    with pytest.raises(StoreError, match=r"0002\.json is damaged"):
        model_versions(store)


def test_an_effect_of_a_package_that_is_gone_is_told_and_other_versions_can_be_used(store):
    put(store, settings())
    put(store, settings(ROW))
    place = store.path / "model/0002.json"
    changed = read_record(place)
    write_record(place, json.loads(json.dumps(changed).replace("row_noise", "their_effect")))
    assert put(store, settings()) == 1
    with pytest.raises(ConfigError, match=r"model 2 of the run: .*their_effect"):
        _ = version_with(store, 2).effects


def configured(folder, **sections):
    content = {
        "run": {"tile": 8},
        "simulate": {"shape": [8, 8], "n_frames": 700, "seed": 3, "format": "npy"},
        "compute": {"backend": "serial"},
        **sections,
    }
    path = folder / "run.yaml"
    path.write_text(dump_config(RunConfig.model_validate(content)), encoding="utf-8")
    return path


def states(path):
    return {state.stage: (state.words(), state.model) for state in run_status(find_run(path))}


DONE = ["simulate", "ingest", "histogram", "fit", "maps"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run up to its maps; do not change it."""
    path = configured(tmp_path_factory.mktemp("finished"))
    run_stages(find_run(path), DONE, QUIET)
    return path


@pytest.fixture
def run(finished, tmp_path):
    """A copy of that run."""
    shutil.copytree(finished.parent, tmp_path / "copy")
    return tmp_path / "copy" / "run.yaml"


def verdict(path, *effects):
    """Leave the result of a search that started from the model in force."""
    store = RunStore.open(path.parent / "run.zarr", writable=True)
    model = model_in_force(store, load_config(path).model)
    found = verdict_of("named")
    gap = found.gap.model_copy(update={"closed_fraction": 0.9})
    found = found.model_copy(update={"model_effects": effects, "gap": gap})
    store.write_file(VERDICT_FILE, found.to_json().encode())
    content = {
        "stage": "discrepancy",
        "version": STAGES["discrepancy"].version,
        "settings": {"discrepancy": load_config(path).discrepancy.model_dump(mode="json")},
        "upstream": {"ingest": store.records.read("ingest").fingerprint},
        "input": {"model": model.digest, "roi": []},
    }
    store.records.write(StageRecord("discrepancy", 1, fingerprint_of(content), content, 1, True))
    store.records.mark("discrepancy", fingerprint_of(content), "all", {})


def test_status_tells_the_model_that_each_result_rests_on(run):
    assert states(run)["maps"] == ("complete", 1)
    assert states(run)["histogram"] == ("complete", None)
    path = configured(run.parent, model={"effects": [ROW]})
    assert states(path)["fit"] == ("stale - model 1 -> 2", 1)
    assert not (run.parent / "run.zarr/model/0002.json").exists()  # a look changes nothing
    run_stages(find_run(path), ["fit"], QUIET)
    assert states(path)["fit"] == ("complete", 2)
    assert states(path)["maps"] == ("stale - new fit", 1)
    shown = invoke("status", path).stdout
    assert "fit         complete  (with model 2)" in shown.splitlines()
    shown = invoke("status", path, "--json").stdout
    assert [stage["model"] for stage in json.loads(shown)["stages"]][3:5] == [2, 1]


def test_a_verdict_is_put_in_force_and_taken_back(run):
    before, text = arrays_of(run.parent / "run.zarr", ("fit", "maps")), run.read_text(encoding="utf-8")
    verdict(run, ROW)
    target, words = adopt_verdict(find_run(run))
    beside = run.with_name("run.effects.yaml")
    held = f"model 2 is now in use: plain model + row_noise 1.2 DN (in {beside})"
    assert words == f"{held}; to go back: pchem model {run} --use 1"
    assert run.read_text(encoding="utf-8") == text
    shown = invoke("fit", run).stderr
    assert "the model is from run.effects.yaml, not from run.yaml" in shown
    assert load_config(run).model == settings(ROW) == target.config.model
    assert states(run)["fit"] == ("complete", 2)
    # what the search found is not what it started from
    assert states(run)["discrepancy"] == ("complete", 1)
    run_stages(find_run(run), DONE, QUIET)
    after = arrays_of(run.parent / "run.zarr", ("fit", "maps"))
    assert not np.array_equal(before["fit/read_noise_dn"], after["fit/read_noise_dn"])
    lines = model_lines(find_run(run))
    assert [" ".join(line.split()) for line in lines[1:]] == [
        "1 config discrepancy plain model",
        "* 2 verdict on 1 90.0 % fit, maps plain model + row_noise 1.2 DN",
    ]
    words = use_model(find_run(run), 1)
    assert "stale: fit, maps; to update: pchem run" in words
    assert run.read_text(encoding="utf-8") == text
    assert not beside.exists()
    # through the store, too, whose copy of the YAML goes with it
    assert find_run(run.parent / "run.zarr").config.model == settings()
    run_stages(find_run(run), DONE, QUIET)
    assert_equal_arrays(arrays_of(run.parent / "run.zarr", ("fit", "maps")), before)
    assert "is already in use" in use_model(find_run(run), 1)
    use_model(find_run(run.parent / "run.zarr"), 2)
    assert load_config(run).model == settings(ROW)
    run_stages(find_run(run), DONE, QUIET)
    assert_equal_arrays(arrays_of(run.parent / "run.zarr", ("fit", "maps")), after)
    assert [version.number for version in model_versions(RunStore.open(run.parent / "run.zarr"))] == [1, 2]


def test_what_a_new_verdict_withdraws_leaves_the_model(run):
    verdict(run, ROW)
    assert adopt_verdict(find_run(run))[1]
    assert not adopt_verdict(find_run(run))[1]  # the same once more
    # the search was done again from where it had started, and found nothing
    store = RunStore.open(run.parent / "run.zarr", writable=True)
    nothing = verdict_of("consistent").model_copy(update={"model_effects": ()})
    store.write_file(VERDICT_FILE, nothing.to_json().encode())
    assert adopt_verdict(find_run(run))[1].startswith("model 1 is now in use")
    assert load_config(run).model == settings()


def test_a_model_edited_by_hand_is_kept_before_another_is_used(run):
    run_stages(find_run(run), ["ingest"], QUIET)
    configured(run.parent, model={"effects": [BLINK]})
    # the command is given the store, which does not know yet what stands in the YAML
    use_model(find_run(run.parent / "run.zarr"), 1)
    second = version_with(RunStore.open(run.parent / "run.zarr"), 2)
    assert second.effects[0].tag == "dark_current_rts"
    assert load_config(run).model == settings()


def test_the_yaml_of_another_run_stays(finished, run):
    # the store of a copy remembers where the first one's YAML is
    text = finished.read_text(encoding="utf-8")
    verdict(run, ROW)
    target = find_run(run.parent / "run.zarr")
    assert target.config_path == finished
    assert adopt_verdict(target)[1]
    assert finished.read_text(encoding="utf-8") == text
    assert find_run(run.parent / "run.zarr").config.model == settings(ROW)


def test_a_model_that_is_not_there_or_cannot_be_written_leaves_all_as_it_is(run, monkeypatch):
    [only] = json.loads(invoke("model", run, "--json").stdout)["models"]
    assert (only["number"], only["current"], only["results"]) == (1, True, ["fit", "maps"])
    with pytest.raises(ConfigError, match="has no model 7"):
        invoke("model", run, "--use", "7")
    verdict(run, ROW)
    refusal = StoreError("no permission to write there")
    monkeypatch.setattr("pchem_pipeline.config.load.write_atomic", Mock(side_effect=refusal))
    with pytest.raises(StoreError, match="no permission"):
        adopt_verdict(find_run(run))
    assert find_run(run.parent / "run.zarr").config.model == settings()
    assert states(run)["fit"] == ("complete", 1)
