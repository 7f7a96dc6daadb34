"""Functions in fresh processes: answers, errors, a process that dies, a script without a guard."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.report_material import report_data

from pchem_pipeline.base.errors import IncompleteRunError
from pchem_pipeline.compute import fresh_processes
from pchem_pipeline.compute.executor import SerialExecutor, Stop
from pchem_pipeline.compute.fresh_processes import FreshProcessExecutor
from pchem_pipeline.report.figures.catalogue import report_figures
from pchem_pipeline.report.pages.pictures import Drawn, draw_figure
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.stages.report.drawing import draw_by_workers, drawing_executor

QUICK = ReportSettings(figure_formats=("png",), dpi=72)


def outcomes(function, items, workers=2):
    found = {}
    FreshProcessExecutor(workers).map(function, items, lambda item, outcome: found.update({item: outcome}))
    return found


def test_answers_come_from_other_processes() -> None:
    found = outcomes(abs, [-3, -2, 5])
    assert {item: outcome.value for item, outcome in found.items()} == {-3: 3, -2: 2, 5: 5}
    assert outcomes(os.system, ["exit 0"], workers=1)["exit 0"].value == 0
    assert {o.value != os.getpid() for o in outcomes(eval, ["__import__('os').getpid()"]).values()} == {True}


def test_errors_and_deaths_hit_their_item_only() -> None:
    found = outcomes(eval, ["1/0", "__import__('os')._exit(7)", "6*7", "print('to stderr') or 2"], workers=1)
    assert isinstance(found["1/0"].error, ZeroDivisionError)
    assert "ZeroDivisionError" in found["1/0"].trace
    assert isinstance(found["__import__('os')._exit(7)"].error, IncompleteRunError)
    assert found["6*7"].value == 42
    assert found["print('to stderr') or 2"].value == 2
    assert outcomes(len, [lambda: 0])  # cannot be sent: an error, no hang
    [outcome] = outcomes(eval, ["(_ for _ in ()).throw(subprocess.CalledProcessError(1, 'x'))"]).values()
    assert outcome.error is not None


def test_a_stop_ends_the_work() -> None:
    seen = []

    def on_result(item, outcome):
        seen.append(item)
        raise Stop

    with pytest.raises(Stop):
        FreshProcessExecutor(1).map(abs, range(1000), on_result)
    assert len(seen) == 1


def test_figures_are_the_same_whoever_draws_them() -> None:
    shown = [
        each
        for each in report_figures(report_data((12, 16)), QUICK)
        if each.name in ("fit_status", "component_widths")
    ]
    here = {figure.name: draw_figure(figure, QUICK) for figure in shown}
    reporter = Reporter("off", quiet=True)
    assert draw_by_workers(2, reporter, "report")(shown, QUICK) == here
    assert all(isinstance(drawn, Drawn) and drawn.files for drawn in here.values())


def test_one_worker_draws_here() -> None:
    assert isinstance(drawing_executor(1, 9), SerialExecutor)
    assert isinstance(drawing_executor(8, 1), SerialExecutor)


def test_a_process_whose_parent_is_gone_ends_without_a_word() -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", fresh_processes.__name__],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
    )  # fmt: skip
    assert process.stdin is not None
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    process.stdin.write(pickle.dumps((abs, -3)))
    process.stdin.close()
    assert process.stderr.read() == b""
    assert process.wait(30) == 0
    process.stderr.close()


def test_a_script_without_a_guard_is_not_run_again(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "from pathlib import Path\n"
        "with open('runs', 'a') as file: file.write('x')\n"
        "from pchem_pipeline.compute.fresh_processes import FreshProcessExecutor\n"
        "FreshProcessExecutor(2).map(abs, [-1, -2], lambda item, outcome: print(outcome.value))\n"
    )
    result = subprocess.run(
        [sys.executable, script.name], cwd=tmp_path, capture_output=True, text=True, timeout=60,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
    )  # fmt: skip
    assert result.stderr == ""
    assert sorted(result.stdout.split()) == ["1", "2"]
    assert (tmp_path / "runs").read_text() == "x"
