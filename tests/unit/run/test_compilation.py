"""The second process that compiles kernels: when it is started, that it ends, and that it misses nothing."""

import gc
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from pchem_pipeline.base import kernel_cache
from pchem_pipeline.base.kernel import _Kernel
from pchem_pipeline.commands.compile_kernels import compile_kernels
from pchem_pipeline.config.load import make_config
from pchem_pipeline.discrepancy.observe.observe import observe
from pchem_pipeline.run import compilation
from pchem_pipeline.run.compilation import (
    announced,
    compilation_lines,
    compiled_ahead,
    known_compilation,
    mark_path,
)
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.run.target import Target
from pchem_pipeline.runner.session import Command, run_stages
from pchem_pipeline.simulate.chain import simulate_block
from pchem_pipeline.simulate.maps import draw_truth
from pchem_pipeline.simulate.settings import SimulateSettings

CONFIG = {"input": {"files": ["frames.npy"], "bit_depth": 14}, "compute": {"workers": 2}}


@pytest.fixture
def sleeper(tmp_path, monkeypatch):
    """A module that takes the place of the one that compiles: it says that it began, and sleeps."""
    (tmp_path / "sleeper.py").write_text(
        "import json, pathlib, sys, time\n"
        "pathlib.Path(__file__).with_name('begun').write_text(json.load(sys.stdin)['stages'][0])\n"
        "time.sleep(200)\n"
    )
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    monkeypatch.setattr(compilation, "_MODULE", "sleeper")
    monkeypatch.setattr(compilation, "available_workers", lambda: 2)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    kernel_cache.cache_folder.cache_clear()
    yield tmp_path / "begun"
    kernel_cache.cache_folder.cache_clear()


def started(monkeypatch, config, stages):
    """Enter and leave the block; return the processes that were started, all of which have ended."""
    processes = []
    start = compilation._start
    monkeypatch.setattr(
        compilation, "_start", lambda request: processes.append(start(request)) or processes[-1]
    )
    with compiled_ahead(config, stages):
        assert all(process.poll() is None for process in processes)
    assert all(process.poll() is not None for process in processes)
    return processes


def test_a_process_compiles_while_the_block_runs_and_ends_with_it(sleeper, monkeypatch):
    config = make_config(CONFIG, "test")
    with compiled_ahead(config, ["fit"]):
        for _ in range(600):
            if sleeper.exists() and sleeper.read_text() == "fit":
                break
            time.sleep(0.05)
        assert sleeper.read_text() == "fit"
    assert len(started(monkeypatch, config, ["fit"])) == 1


def test_nothing_is_started_where_it_would_not_help(sleeper, monkeypatch):
    config = make_config(CONFIG, "test")
    assert started(monkeypatch, config, []) == []
    assert started(monkeypatch, make_config({**CONFIG, "compute": {"workers": 1}}, "test"), ["fit"]) == []
    mark = mark_path(config, ["fit"])
    other = make_config({**CONFIG, "fit": {"likelihood": "exact"}}, "test")
    assert len({mark, mark_path(config, ["ensemble"]), mark_path(other, ["fit"])}) == 3
    assert mark_path(make_config({**CONFIG, "run": {"tile": 8}}, "test"), ["fit"]) == mark
    mark.parent.mkdir()
    mark.touch()
    assert started(monkeypatch, config, ["fit"]) == []


def test_a_process_that_cannot_be_started_stops_nothing(sleeper, monkeypatch):
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    with compiled_ahead(make_config(CONFIG, "test"), ["fit"]):
        pass


def heard(*calls):
    """Tell the listeners of kernels that begin (None) or are compiled."""
    for kernel, seconds in calls:
        for listener in kernel_cache._listeners:
            listener(kernel, seconds)


def test_the_terminal_says_what_is_compiled_and_what_is_left(sleeper, capsys, monkeypatch):
    def said():
        return capsys.readouterr().err.splitlines()

    kernel_cache.cache_folder().mkdir()
    with announced(Reporter("off"), "fit"):
        pass
    assert said() == []
    _, guess = known_compilation("fit")
    with announced(Reporter("off"), "fit"):
        heard(("one", None), ("one", 1.5), ("two", None), ("two", 2.5))
    assert said() == [
        f"fit: compiling kernels (about {guess:.0f} s), once after an installation or a change of them",
        "fit: 2 kernels compiled in 4 s",
    ]
    with announced(Reporter("off"), "maps", 400):
        heard(("one", None), ("one", 1.0))
    assert "490 MiB, more than compute.max_memory (--max-memory) allows (400)" in said()[1]
    with announced(Reporter("off"), "maps", 600):
        heard(("one", None), ("one", 1.0))
    assert len(said()) == 2
    # the next time this is known, and told on the way; a part alone is no new knowledge
    monkeypatch.setattr(compilation, "_PAUSE", -1.0)
    assert known_compilation("fit") == (2, 4.0)
    with announced(Reporter("off"), "fit"):
        heard(("one", None), ("one", 1.0))
    assert said()[1:] == [
        "fit: 1 of about 2 kernels compiled in 1 s, about 3 s left",
        "fit: one kernel compiled in 1 s",
    ]
    assert known_compilation("fit") == (2, 4.0)


def test_a_dry_run_tells_what_compiling_takes(sleeper):
    config = make_config(CONFIG, "test")
    ahead = ["fit", "ensemble"]
    expected = sum(known_compilation(name)[1] for name in ("fit", "ensemble", "report"))
    [line] = compilation_lines(config, ["fit", "maps", "ensemble", "report"], ahead)
    assert line.startswith(f"plan: up to {expected:.0f} s more where kernels are still to be compiled")
    assert compilation_lines(config, ["maps"], ahead) == []
    mark = mark_path(config, ahead)
    mark.parent.mkdir()
    mark.touch()
    assert compilation_lines(config, ["fit"], ahead) == []


def variants():
    """Return the name and the types of every compiled variant of a kernel that Python calls."""
    kernels = [each for each in gc.get_objects() if issubclass(type(each), _Kernel)]
    return {(each.py_func.__module__, each.__name__, key) for each in kernels for key in each.overloads}


def test_what_is_compiled_ahead_is_what_a_run_calls(tmp_path):
    rng = np.random.default_rng(2)
    frames = np.rint(100 + 12 * (rng.poisson(2.0, (700, 12, 9)) + 0.25 * rng.standard_normal((700, 12, 9))))
    np.save(tmp_path / "frames.npy", frames.astype(np.uint16))
    config = make_config({**CONFIG, "compute": {"backend": "serial", "workers": 1}}, "test")
    stages = ["fit", "ensemble"]
    compile_kernels(config.model_dump(mode="json", by_alias=True), stages)
    assert mark_path(config, stages).exists()
    ahead = variants()
    target = Target(config, tmp_path, tmp_path / "run.zarr")
    everything = ["ingest", "histogram", "fit", "maps", "ensemble"]
    run_stages(target, everything, Command(progress="off", quiet=True))
    missed = {(module, name) for module, name, _ in variants() - ahead}
    assert {module.rpartition(".")[2] for module, _ in missed} <= {"count_numba", "summaries_numba"}
    assert Path(tmp_path / "run.zarr").exists()


def test_what_a_search_calls_is_compiled_ahead(tmp_path):
    config = make_config(CONFIG, "test")
    compile_kernels(config.model_dump(mode="json", by_alias=True), ["discrepancy"])
    assert mark_path(config, ["discrepancy"]).exists()
    settings = SimulateSettings(shape=(5, 4), n_frames=3)
    truth = draw_truth(settings)
    ahead = variants()
    rng = np.random.default_rng(3)
    frames = np.rint(100 + 12 * (rng.poisson(2.0, (400, 6, 5)) + 0.25 * rng.standard_normal((400, 6, 5))))
    observe(frames.astype(np.uint16), np.arange(400), n_run=400, block_frames=50)
    simulate_block(truth, settings, (0, 3), electron_frames=0)
    assert {name for _, name, _ in variants() - ahead} == set()
