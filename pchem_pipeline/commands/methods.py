"""``pchem methods``: compare, refresh the report where there is one, and read the result again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pchem_pipeline.report.pages.tables import methods_text
from pchem_pipeline.run.stage import Command
from pchem_pipeline.run.target import Target
from pchem_pipeline.runner.session import run_stages, run_status
from pchem_pipeline.stages.methods import METHODS_FILE, open_other_runs, read_methods


def compare_methods(target: Target, command: Command, given: Mapping[str, Any]) -> str:
    """Run the stage, refresh the report where there is one, and return the table in words.

    ``given`` are settings of the section ``methods``; paths refer to the present folder.

    Raises:
        PchEmError: the comparison cannot be made.
    """
    values = dict(given)
    if "with_runs" in values:
        values["with_runs"] = tuple(str(Path(path).resolve()) for path in values["with_runs"])
    changed = target.changed("methods", **values)  # says what is wrong with them
    store = target.stored()
    # before anything of an earlier comparison is given up
    if store.has("histogram/counts"):
        open_other_runs(target, changed.config.methods.with_runs)
    run_stages(target, ["methods"], replace(command, settings=tuple(values.items())))
    if command.dry_run:
        return ""
    reported = {state.stage: state.state for state in run_status(target)}["report"] != "missing"
    if reported:
        run_stages(target, ["report"], replace(command, force=False))
    result = read_methods(target.stored())
    if result is None:
        return ""
    files = [target.store / METHODS_FILE, *([target.store / "report.html"] if reported else [])]
    return "\n".join([methods_text(result), "", *map(str, files)])
