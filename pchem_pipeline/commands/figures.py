"""``pchem figures``: each figure of a run as a file for papers, with its numbers beside it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.report.charts.on_paper import Look, drawing_bytes
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.catalogue import run_figures
from pchem_pipeline.report.figures.figure import Figure, csv_text
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.run.target import Target, find_run, with_maps
from pchem_pipeline.runner.session import run_status
from pchem_pipeline.stages.report.report import gather
from pchem_pipeline.store.files import write_atomic

#: File formats of figures for papers.
FORMATS = ("pdf", "svg", "png")

#: Narrowest and widest figure, mm.
_WIDTHS = (40.0, 400.0)
_UNITS = {"mm": 1.0, "cm": 10.0, "in": 25.4, "pt": 25.4 / 72.0, "": 1.0}


def millimetres(text: str) -> float:
    """Return the length that a text such as ``88mm``, ``8.8 cm``, ``3.5in`` or ``88`` (mm) says, mm.

    Raises:
        ConfigError: it is none, or none that a figure can have.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(mm|cm|in|pt)?\s*", text)
    if match is None:
        raise ConfigError(f"--width {text!r}: write a length such as 88mm, 8.8cm or 3.5in")
    length = float(match[1]) * _UNITS[match[2] or ""]
    if not _WIDTHS[0] <= length <= _WIDTHS[1]:
        raise ConfigError(f"--width {text}: give {_WIDTHS[0]:g} to {_WIDTHS[1]:g} mm, such as 88mm or 18cm")
    return length


def check_formats(given: Sequence[str], known: Sequence[str], done: str) -> None:
    """Raise ConfigError where formats are unknown, or none is given."""
    unknown = [name for name in given if name not in known]
    if unknown or not given:
        what = f"{', '.join(unknown)} cannot be {done}" if unknown else "no format"
        raise ConfigError(f"--format: {what}; choose from {', '.join(known)}")


def gather_run(target: Target) -> ReportData:
    """Return all that the report of a run shows.

    Raises:
        StoreError: the run lacks maps or histograms.
    """
    return gather(with_maps(target.stored()), target.config, [])


def figures_of_run(
    path: Path,
    folder: Path,
    reporter: Reporter,
    *,
    formats: Sequence[str] = ("pdf",),
    width: str | None = None,
    only: Sequence[str] = (),
    dpi: int = 600,
    style: str = "",
) -> list[Path]:
    """Write the figures of a run, given by its store or YAML, and their numbers; return the files.

    A width is a text such as ``88mm``; None: each figure's own. ``only`` are names of figures (empty: all),
    ``dpi`` is the resolution of PNG, and of maps inside the other formats, ``style`` a style sheet of
    matplotlib, a name or a file.

    Raises:
        ConfigError: an unknown format, width, figure or style.
        StoreError: the run has no maps, or the folder cannot be written.
    """
    check_formats(formats, FORMATS, "drawn")
    width_mm = None if width is None else millimetres(width)
    target = find_run(path)
    data = gather_run(target)
    warn_if_old(target, ("maps", "ensemble"), "drawn in this state", reporter)
    chosen, written = _chosen(run_figures(data), only), []
    with reporter.progress("figures", len(chosen), "figure") as advance:
        for figure in chosen:
            look = Look(width_mm or figure.width_mm, dpi=dpi, style=style)
            for name, content in paper_files(figure, tuple(dict.fromkeys(formats)), look).items():
                write_atomic(folder / name, content)
                written.append(folder / name)
            advance()
    return written


def paper_files(figure: Figure, formats: Sequence[str], look: Look) -> dict[str, bytes]:
    """Draw a figure; return its files and those of its tables by name."""
    drawing, dpi = figure.draw(look), look.dpi
    files = {
        f"{figure.name}.{kind}": drawing_bytes(drawing, kind, dpi=dpi, title=figure.title) for kind in formats
    }
    for table in figure.tables:
        part = f"_{table.part}" if table.part else ""
        files[f"{figure.name}{part}.csv"] = csv_text(table).encode()
    return files


def _chosen(found: list[Figure], only: Sequence[str]) -> list[Figure]:
    names = [figure.name for figure in found]
    unknown = [name for name in only if name not in names]
    if unknown:
        raise ConfigError(f"--only: this run has no figure {unknown[0]}; it has {', '.join(names)}")
    return [figure for figure in found if not only or figure.name in only]


def warn_if_old(target: Target, stages: Sequence[str], words: str, reporter: Reporter) -> None:
    """Warn if results of these stages are not up to date."""
    for state in run_status(target):
        if state.stage in stages and state.state != "complete":
            reporter.warning(f"{state.stage}: {state.words()}; {words}")
