"""Watching a run: rows that tell rate and remaining time, JSON lines, and an end when the work ends."""

import json
from pathlib import Path

import pytest
from helpers.commands import invoke

from pchem_pipeline.commands import watch as watch_module
from pchem_pipeline.commands.watch import pace_words, rows, watch
from pchem_pipeline.config.load import parse_config
from pchem_pipeline.run import target
from pchem_pipeline.run.fingerprint import StageState
from pchem_pipeline.run.target import Target

TARGET = Target(parse_config("input: {files: [a.tif]}\n"), Path("/x"), Path("/x/run.zarr"))
PACE = {"stage": "fit", "unit": "tile", "done": 8, "total": 64, "rate": 2.0, "remaining": 28.0}
DONE, PART = StageState("ingest", "complete"), StageState("fit", "partial", "", 8, 64, 2)


def test_rows_tell_rate_and_remaining_time():
    assert rows([DONE, PART], None) == ["ingest      complete", "fit         partial 8 of 64  (with model 2)"]
    assert rows([DONE, PART], PACE)[1] == "fit         running 8 of 64 tiles, 2/s, 28 s left"
    both = {**PACE, "stage": "ingest and histogram", "unit": "MiB"}
    assert rows([PART], both)[1].strip() == "running (ingest and histogram) 8 of 64 MiB, 2/s, 28 s left"


def test_paces_in_words():
    for change, words in (
        ({"rate": 0.05, "remaining": 1120.0}, "running 8 of 64 tiles, 20 s each, 18 min 40 s left"),
        ({"rate": 0.005, "remaining": 11200.0}, "running 8 of 64 tiles, 200 s each, 3 h 06 min left"),
        ({"rate": None, "remaining": None}, "running 8 of 64 tiles"),
        ({"stage": "ingest: hash"}, "running (hash) 8 of 64 tiles, 2/s, 28 s left"),
    ):
        assert pace_words({**PACE, **change}) == words
    assert pace_words({"stage": ""}) == "running"
    codes = {"stage": "fit: \x1b[2Jgone", "done": 1, "total": 2, "unit": "\x1b[31mtile"}  # of a terminal
    assert "\x1b" not in "".join(rows([StageState("fit", "partial")], codes))


@pytest.fixture
def looks(monkeypatch):
    """Three looks: at work, further, done."""
    paces = iter([PACE, {**PACE, "done": 16, "remaining": 24.0}, None])
    states = iter([[DONE, PART], [DONE, PART], [DONE, StageState("fit", "complete")]])
    monkeypatch.setattr(watch_module, "read_progress", lambda store: next(paces))
    monkeypatch.setattr(watch_module, "run_status", lambda target: next(states))
    return []


@pytest.mark.parametrize("terminal", [False, True])
def test_watching_ends_with_the_work_and_tells_what_changed(looks, terminal):
    written: list[str] = []
    watch(TARGET, written.append, follow=True, terminal=terminal, sleep=looks.append)
    assert len(looks) == 2
    first, again, last = written
    assert first == "ingest      complete\nfit         running 8 of 64 tiles, 2/s, 28 s left"
    over = "\x1b[2A\x1b[Jingest      complete\n" if terminal else ""  # what is there is drawn over
    assert again == f"{over}fit         running 16 of 64 tiles, 2/s, 24 s left"
    assert last == f"{over}fit         complete"


def test_json_lines_and_ctrl_c(looks):
    def stop(seconds):
        raise KeyboardInterrupt

    written: list[str] = []
    watch(TARGET, written.append, follow=True, as_json=True, sleep=stop)
    [content] = map(json.loads, written)
    assert content["progress"]["remaining"] == 28.0
    fit = {"stage": "fit", "state": "partial", "why": "", "done": 8, "total": 64, "model": 2}
    assert content["stages"][1] == fit


def test_the_command_looks_once_unless_asked(looks, monkeypatch):
    monkeypatch.setattr(target, "find_run", lambda path: TARGET)
    result = invoke("status", "run.yaml")
    assert result.stdout.splitlines() == rows([DONE, PART], PACE)
    result = invoke("status", "run.yaml", "--json")
    assert json.loads(result.stdout)["progress"]["done"] == 16
