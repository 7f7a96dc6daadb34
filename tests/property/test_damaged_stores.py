"""Any file of a finished store is changed, cut or removed: the same numbers, or a line whose cure works."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.without_pictures import undrawn

from pchem_pipeline import open_run
from pchem_pipeline.base.errors import PchEmError, StoreError
from pchem_pipeline.model.maps.maps import NO_VALUE
from pchem_pipeline.run.stage import Command, open_store
from pchem_pipeline.run.target import find_run
from pchem_pipeline.runner.session import run_stages, run_status
from pchem_pipeline.stages import maps
from pchem_pipeline.stages.table import pipeline_of

STAGES = ("simulate", "ingest", "histogram", "fit", "maps", "ensemble", "report")
FORCED = STAGES[2:]  # what comes before them looks at the camera files
GROUPS = ("histogram", "summary", "fit", "maps", "ensemble")


@pytest.fixture(scope="module", autouse=True)
def _undrawn():
    with undrawn():
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A folder with run.yaml and its finished run.zarr; do not change it."""
    folder = tmp_path_factory.mktemp("finished")
    content = {
        "run": {"store": "run.zarr", "tile": 8},
        "input": {"mode": "copy"},
        "simulate": {"shape": [8, 16], "n_frames": 600, "seed": 5, "integration_time": 1.0},
        "compute": {"backend": "serial", "workers": 1},
        "model": {"effects": [{"tag": "row_noise", "row_noise_dn": 0.4}]},
    }
    (folder / "run.yaml").write_text(yaml.safe_dump(content))
    run_stages(find_run(folder / "run.yaml"), STAGES, Command(quiet=True, progress="off"))
    return folder


def run(path, stages=None, *, force=False):
    open_store.cache_clear()
    target = find_run(path)
    command = Command(force=force, quiet=True, progress="off")
    run_stages(target, stages or pipeline_of(target.config), command)


def numbers(path):
    """Return what a notebook finds in a run: every array, the medians over good pixels, a pixel."""
    found = open_run(path)
    arrays = {f"{group}/{name}": each.values for group in GROUPS for name, each in found.group(group).items()}
    arrays["good"] = found.maps.where(found.good).median().to_array().values
    arrays["frames/dn"] = found.group("frames").dn.values
    arrays["pixel"] = np.array([*found.pixel(3, 5).parameters.values(), found.pixel(3, 5).goodness_p])
    arrays["expected"] = found.pixel(3, 5).expected.values  # under the model of the fit
    found._repr_html_()
    return arrays


def damaged(path, kind, rng):
    content = bytearray(path.read_bytes())
    if kind == "delete":
        path.unlink()
    elif kind == "cut":
        path.write_bytes(content[: int(rng.integers(len(content)))])
    elif content:
        content[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
        path.write_bytes(content)


def asked(action, *given, **options):
    """Do something with a run; return the line that refuses it, or nothing."""
    try:
        action(*given, **options)
    except PchEmError as error:
        return str(error)
    return ""


@pytest.fixture
def copy(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "run")
    return tmp_path / "run"


def cured(folder, words):
    forced = re.search(r"pchem (\w+) \S+ --force", words)
    removed = re.search(r"(?:delete (/\S+)|(/\S+) (?:is damaged|is missing).*; delete it)", words)
    if removed:
        place = Path(removed[1] or removed[2])
        assert folder in place.parents
        shutil.rmtree(place) if place.is_dir() else place.unlink()
    elif forced:
        run(folder / "run.yaml", [forced[1]], force=True)
    else:
        assert re.search("run again|run it again|run the stage again", words), words


def check(folder, victim, expected, forced):
    """Ask status, notebook, run and a stage; follow each line; the numbers are the same in the end."""
    place, store = folder / "run.yaml", folder / "run.zarr"
    for words in (
        asked(lambda: run_status(find_run(store))),
        asked(lambda: same(numbers(store), expected, victim)),
        asked(run, place, [forced], force=True),
        asked(run, place),
    ):
        assert not words or (str(folder) in words and "; " in words and "\n" not in words), words
    for _ in range(8):
        words = asked(run, place) or asked(lambda: same(numbers(store), expected, victim))
        if not words:
            break
        asked(cured, folder, words)
    assert not words, f"{victim}: {words}"
    assert {state.state for state in run_status(find_run(place))} == {"complete"}, victim


def same(found, expected, victim=""):
    assert found.keys() == expected.keys(), victim
    for name, values in found.items():
        np.testing.assert_array_equal(values, expected[name], err_msg=f"{victim}: {name}")


def files_of(folder):
    files = (path for path in (folder / "run.zarr").rglob("*") if path.is_file() and path.name != "lock")
    return sorted(path.relative_to(folder) for path in files)


@pytest.mark.parametrize("step", [191, pytest.param(1, marks=(pytest.mark.long, pytest.mark.timeout(7200)))])
def test_any_file_is_damaged(finished, tmp_path, step):
    expected = numbers(finished / "run.zarr")
    files, rng = files_of(finished), np.random.default_rng(step)
    # all kinds of files early: the arrays of a group are alike
    cases = [(file, kind) for file in files for kind in ("flip", "cut", "delete")]
    for i in range(int(rng.integers(step)), len(cases), step):
        victim, kind = cases[i]
        folder = tmp_path / "case"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(finished, folder)
        damaged(folder / victim, kind, rng)
        check(folder, f"{victim} {kind}", expected, FORCED[i % len(FORCED)])


@pytest.mark.parametrize(("array", "reader"), [("histogram/counts", "fit"), ("maps/read_noise_e", "report")])
def test_chunks_that_are_exchanged_or_cut_are_found(finished, tmp_path, array, reader):
    """Each has the right checksum, in the wrong place."""
    expected = numbers(finished / "run.zarr")
    group = array.partition("/")[0]
    for kind in ("exchanged", "cut"):
        folder = tmp_path / kind
        shutil.copytree(finished, folder)
        files = (folder / "run.zarr" / array / "c").rglob("*")
        one, other, *_ = sorted(each for each in files if each.is_file())
        content = one.read_bytes()
        one.write_bytes(other.read_bytes() if kind == "exchanged" else content[:-9])
        if kind == "exchanged":
            other.write_bytes(content)
        states = {each.stage: each for each in run_status(find_run(folder / "run.yaml"))}
        words = f"{array} is missing or has changed"
        assert (states[group].state, states[group].why) == ("stale", words)
        assert f"{words}; " in asked(run, folder / "run.yaml", [reader], force=True)
        run(folder / "run.yaml")
        same(numbers(folder / "run.zarr"), expected)


def test_without_the_model_of_the_fit_nothing_is_expected_of_a_pixel(finished, copy):
    """It was expected of the plain PCD, without a word."""
    (copy / "run.zarr/model/0001.json").unlink()
    with pytest.raises(StoreError, match="the model used by fit is missing; run again"):
        open_run(copy / "run.zarr").pixel(3, 5)
    run(copy / "run.yaml")
    same(numbers(copy / "run.zarr"), numbers(finished / "run.zarr"))


def test_pixels_of_a_tile_that_failed_have_no_value(copy, monkeypatch, capsys):
    do_tile = maps._do_tile

    def failing(tile, store, **more):
        if tile.key == "0.1":
            raise ValueError("odd")
        return do_tile(tile, store, **more)

    monkeypatch.setattr(maps, "_do_tile", failing)
    assert "maps: 1 of 2 units failed" in asked(run, copy / "run.yaml", ["maps"], force=True)
    assert "odd" not in capsys.readouterr().err  # the error says it
    found = open_run(copy / "run.zarr")
    assert found.maps.quality.values[:, 8:].tolist() == [[NO_VALUE] * 8] * 8
    assert not found.usable[:, 8:].any()
    assert found.good[:, :8].sum() > 32
    assert np.isnan(found.maps.bias[:, 8:]).all()


def test_chunks_that_0_2_left_out_are_read(copy):
    """There a chunk of the fill value alone was not written, and descriptions have no digest."""
    store = copy / "run.zarr"
    expected = numbers(store)
    for place in {*store.rglob("*.json")} - {store / "report.json"}:
        content = json.loads(place.read_text())
        for part in (content, content.get("attributes", {})):
            part.pop("digest_of_content", None)
        content.pop("files", None)
        place.write_text(json.dumps(content))
    place = store / ".pchem/config.yaml"
    place.write_text(place.read_text().partition("\n")[2])
    assert not np.any(expected["histogram/under"])
    shutil.rmtree(store / "histogram/under/c")
    same(numbers(store), expected)
    assert {state.state for state in run_status(find_run(copy / "run.yaml"))} == {"complete"}
