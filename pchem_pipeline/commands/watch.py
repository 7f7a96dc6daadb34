"""``pchem status``: how far a run is, once or until the command that works on it ends."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from pchem_pipeline.base.errors import one_line
from pchem_pipeline.run.fingerprint import StageState
from pchem_pipeline.run.progress import read_progress
from pchem_pipeline.run.target import Target
from pchem_pipeline.runner.session import run_status


def rows(states: Sequence[StageState], progress: Mapping[str, Any] | None) -> list[str]:
    """Return a line for each stage, with the progress of a command that works on one."""
    label = "" if progress is None else one_line(str(progress.get("stage", "")))
    running = label.partition(":")[0]
    lines = []
    for state in states:
        words = state.words()
        if progress is not None and state.stage == running:
            words = pace_words(progress)
        elif state.model is not None:
            words += f"  ({'searched from' if state.stage == 'discrepancy' else 'with'} model {state.model})"
        lines.append(f"{state.stage:<11} {words}")
    if progress is not None and running not in {state.stage for state in states}:
        lines.append(f"{'':<11} {pace_words({**progress, 'stage': f': {label}' if label else ''})}")
    return lines


def pace_words(progress: Mapping[str, Any]) -> str:
    """Return how far a command is, its rate and the time that remains, in words."""
    label, done, total = one_line(str(progress.get("stage", ""))), progress.get("done"), progress.get("total")
    part = label.partition(": ")[2]
    words = f"running{f' ({part})' if part else ''}"
    if done is None or total is None:
        return words
    unit = one_line(str(progress.get("unit", "unit")))
    words += f" {done} of {total} {unit}{'s' if unit.islower() else ''}"
    rate, remaining = progress.get("rate"), progress.get("remaining")
    if rate:
        words += f", {rate:.3g}/s" if rate >= 1 else f", {1 / rate:.3g} s each"
    if remaining is not None:
        words += f", {_time(remaining)} left"
    return words


def _time(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes:02d} min"
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


def json_line(states: Sequence[StageState], progress: Mapping[str, Any] | None) -> str:
    """Return how far a run is as one line of JSON."""
    content = {
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "stages": [vars(state) for state in states],
        "progress": None if progress is None else dict(progress),
    }
    return json.dumps(content)


def watch(
    target: Target,
    write: Callable[[str], None],
    *,
    follow: bool = False,
    as_json: bool = False,
    terminal: bool = False,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Write how far a run is; ``write`` takes a text of whole lines, the last without its end.

    With ``follow`` it goes on until no command works on the run, or Ctrl-C. On a terminal rows are drawn
    over, else only those that changed are written.
    """
    shown: list[str] = []
    try:
        while True:
            # before the states: what is complete when no command works stays complete
            progress = read_progress(target.store)
            states = run_status(target)
            lines = [json_line(states, progress)] if as_json else rows(states, progress)
            if as_json or not shown:
                write("\n".join(lines))
            elif terminal:
                # the cursor goes up so many lines, and what is below is cleared
                write(f"\x1b[{len(shown)}A\x1b[J" + "\n".join(lines))
            elif changed := [line for line in lines if line not in shown]:
                write("\n".join(changed))
            if not follow or progress is None:
                return
            shown = lines
            sleep(1.0)
    except KeyboardInterrupt:
        return
