"""The end of ``pchem run``: what the report's first screen says, for a terminal and for cron."""

from __future__ import annotations

import contextlib
import os
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pchem_pipeline.base.errors import IncompleteRunError, NotBelievedError, quoted
from pchem_pipeline.commands.new_run import first_try
from pchem_pipeline.run.stage import Command
from pchem_pipeline.run.target import Target
from pchem_pipeline.runner.session import run_stages
from pchem_pipeline.store.files import read_json
from pchem_pipeline.store.remote_path import RemotePath

_WIDTH = 100


def run_to_first_screen(
    target: Target,
    stages: Sequence[str],
    command: Command,
    say: Callable[[str], None],
    *,
    is_new: bool = False,
    strict: bool = False,
) -> None:
    """Bring stages up to date; print the report's summary on stderr and its path by ``say``.

    Answers that are serious are one line of warning, also where the command is quiet. Without the stage
    ``report`` only the store is printed. Of a new run the YAML is written first.

    Raises:
        NotBelievedError: ``strict``, and an answer is serious.
        PchEmError: the stages raised it; the summary is printed all the same if there is a report.
    """
    if command.dry_run:
        run_stages(target, stages, command)
        return
    with first_try(target) if is_new else contextlib.nullcontext():
        try:
            run_stages(target, stages, command)
        except IncompleteRunError:
            _tell(target, stages, command, say, warn=True)
            raise
        serious = _tell(target, stages, command, say, warn=not strict)
        if strict and serious:
            raise NotBelievedError(f"--strict: {serious}")


def _tell(
    target: Target, stages: Sequence[str], command: Command, say: Callable[[str], None], *, warn: bool
) -> str:
    """Tell the first screen and the path; return what is serious in one line, or nothing."""
    numbers = read_json(target.store / "report.json", "run again to write it")
    if "report" not in stages or numbers is None:
        say(str(target.store))
        return ""
    with contextlib.closing(command.reporter()) as reporter:
        reporter.event("verdict", answers=numbers["answers"], next=numbers["next"])
        if not command.quiet:
            for line in first_screen(numbers, typed(target)):
                reporter.info(line)
        serious = " ".join(_one_line(each) for each in numbers["answers"] if each["level"] == "serious")
        if serious and warn:
            reporter.warning(serious)
    say(str(target.store / "report.html"))
    return serious


def typed(target: Target) -> str:
    """Return how the run is named in a command typed here: its YAML, or its store."""
    path = target.config_path if target.config_path is not None else target.store
    if isinstance(path, RemotePath):
        return quoted(path)
    near = os.path.relpath(path)
    return quoted(Path(near if not near.startswith("..") else path))


def first_screen(numbers: Mapping[str, Any], run: str) -> list[str]:
    """Return the first screen of a report by its ``report.json``, as lines; ``run`` names it in commands."""
    lines = [""]
    for answer in numbers["answers"]:
        lines.append(f"{answer['question']} {answer['word']}.")
        lines += _criteria(answer["criteria"]) or _wrapped(answer["text"], "  ")
    if rows := numbers["headline"]:
        wide = max(len(row["label"]) for row in rows)
        lines.append("")
        for row in rows:
            lines.append(f"median {row['label']:<{wide}}  {row['value']}   (5 to 95 %: {row['spread']})")
    shown = " ".join(answer["text"] for answer in numbers["answers"] if not answer["criteria"])
    for flag in numbers["flags"]:
        level = flag["level"]
        listed = level in ("serious", "caution") or (level == "note" and flag["about"] == "sensor")
        if listed and flag["text"] not in shown:
            lines += _wrapped(f"{level.capitalize()}: {flag['text']}")
    lines.append("")
    for i, step in enumerate(numbers["next"]):
        words = " ".join(run if word == "RUN" else word for word in step["command"].split(" "))
        lines += _wrapped(f"{'Or' if i else 'Next'}: {step['why']}:")
        lines.append(f"  {words}")
    return lines


def _one_line(answer: Mapping[str, Any]) -> str:
    """Return question and answer, with the first sentence of its reasons."""
    return f"{answer['question']} {answer['word']}: {answer['text'].split('. ')[0].rstrip('.')}."


def _wrapped(text: str, first: str = "") -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent=first, subsequent_indent="  ")


def _criteria(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the criteria as a table: met or not, what was found, the limit."""
    wide = max((len(row["words"]) for row in rows), default=0)
    return [
        f"  {'ok ' if row['met'] else 'NOT'} {row['words']:<{wide}}  {row['found']:>10}  ({row['limit']})"
        for row in rows
    ]
