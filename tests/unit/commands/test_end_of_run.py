"""The end of ``pchem run``, for a terminal and for cron."""

import json
from pathlib import Path
from unittest.mock import Mock

import pytest

from pchem_pipeline.base.errors import ExitCode, IncompleteRunError, NotBelievedError
from pchem_pipeline.commands import first_screen
from pchem_pipeline.config.load import parse_config
from pchem_pipeline.run.stage import Command
from pchem_pipeline.run.target import Target

STAGES = ("maps", "report")


def numbers(level):
    word = {"good": "Yes", "caution": "With caution", "serious": "No"}[level]
    return {
        "answers": [
            {"question": "All right?", "level": "good", "word": "Yes", "text": "All met.", "criteria": [
                {"words": "hot pixels", "found": "2 %", "limit": "≤ 1 %", "met": False},
            ]},
            {"question": "To be believed?", "level": level, "word": word, "text": "60 % flagged: so. More.",
             "criteria": []},
        ],
        "headline": [{"label": "read noise", "value": "0.280 ± 0.001 e⁻", "spread": "0.2 to 0.3 e⁻"}],
        "flags": [{"level": "serious", "text": "Two."}, {"level": "caution", "text": "Rounding."},
                  {"level": "good", "text": "Fine."}],
        "next": [{"command": "pchem view RUN", "why": "look"}],
    }  # fmt: skip


@pytest.fixture
def target(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(first_screen, "run_stages", lambda *_: [])
    (tmp_path / "my run.zarr").mkdir()
    config = parse_config("input: {files: [a.tif]}\n")
    return Target(config, tmp_path, tmp_path / "my run.zarr", tmp_path / "my run.yaml")


def run(target, level, *, strict=False, **options):
    (target.store / "report.json").write_text(json.dumps(numbers(level)))
    said: list[str] = []
    try:
        first_screen.run_to_first_screen(target, STAGES, Command(**options), said.append, strict=strict)
    finally:
        assert said == [str(target.store / "report.html")]


def test_the_first_screen_is_told_and_the_path_alone_is_a_result(target, capsys):
    run(target, "good")
    said = capsys.readouterr()
    assert said.out == ""
    lines = said.err.splitlines()
    assert "All right? Yes." in lines
    assert "  NOT hot pixels         2 %  (≤ 1 %)" in lines
    assert "median read noise  0.280 ± 0.001 e⁻   (5 to 95 %: 0.2 to 0.3 e⁻)" in lines
    assert lines[lines.index("Caution: Rounding.") - 1] == "Serious: Two."
    assert lines[-1] == "  pchem view 'my run.yaml'"


def test_a_serious_answer_is_one_line_even_where_quiet_and_strict_makes_it_exit_code_3(target, capsys):
    run(target, "serious", quiet=True)
    assert capsys.readouterr().err == "warning: To be believed? No: 60 % flagged: so.\n"
    for level in ("caution", "good"):
        run(target, level, quiet=True, strict=True)
        assert capsys.readouterr().err == ""
    with pytest.raises(NotBelievedError, match="To be believed") as raised:
        run(target, "serious", quiet=True, strict=True)
    assert raised.value.exit_code == ExitCode.INCOMPLETE == 3
    assert capsys.readouterr().err == ""  # the error says it


def test_an_incomplete_run_tells_what_it_has(target, capsys, monkeypatch):
    incomplete = Mock(side_effect=IncompleteRunError("12 of 40 pixels"))
    monkeypatch.setattr(first_screen, "run_stages", incomplete)
    with pytest.raises(IncompleteRunError):
        run(target, "serious")
    assert "To be believed? No." in capsys.readouterr().err


def test_without_a_report_the_store_is_told(target, capsys):
    said: list[str] = []
    first_screen.run_to_first_screen(target, STAGES, Command(dry_run=True), said.append)
    assert said == []
    first_screen.run_to_first_screen(target, ("maps",), Command(), said.append, strict=True)
    assert said == [str(target.store)]
    assert capsys.readouterr().err == ""


def test_a_json_log_has_the_answers(target):
    run(target, "serious", log_json=Path("log.jsonl"), quiet=True)
    events = [json.loads(line) for line in Path("log.jsonl").read_text().splitlines()]
    assert [event["event"] for event in events] == ["verdict", "warning"]
    assert events[0]["answers"][1]["word"] == "No"
