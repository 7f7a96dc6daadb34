"""``pchem figures``: each figure of a run as a file for papers, with its numbers beside it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.compute.executor import map_all
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.catalogue import run_figures
from pchem_pipeline.report.figures.figure import Figure
from pchem_pipeline.report.figures.paper import FORMATS, PaperFigure, draw_paper_figure
from pchem_pipeline.run.progress import ProgressMode, Reporter
from pchem_pipeline.run.target import Target, find_run, with_maps
from pchem_pipeline.runner.session import run_status
from pchem_pipeline.stages.report.report import drawing_executor, drawing_workers, gather
from pchem_pipeline.store.files import write_atomic

#: Narrowest and widest figure, mm.
_WIDTHS = (40.0, 400.0)
_UNITS = {"mm": 1.0, "cm": 10.0, "in": 25.4, "pt": 25.4 / 72.0, "": 1.0}


@dataclass(frozen=True)
class Wanted:
    """How the figures are wanted.

    Attributes:
        formats: pdf, svg, png.
        width: such as ``88mm`` or ``3.5in``; None: each figure's own.
        only: names of figures; empty: all.
        dpi: resolution of PNG and of maps, dots per inch.
        workers: processes that draw; None: as the run's section ``compute`` says.
        progress: auto | on | off.
    """

    formats: Sequence[str] = ("pdf",)
    width: str | None = None
    only: Sequence[str] = ()
    dpi: int = 600
    workers: int | None = None
    progress: ProgressMode = "auto"


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
        raise ConfigError(f"--width {text}: give {_WIDTHS[0]:g} to {_WIDTHS[1]:g} mm")
    return length


def gather_run(target: Target) -> ReportData:
    """Return all that the report of a run shows.

    Raises:
        StoreError: the run lacks maps or histograms.
    """
    return gather(with_maps(target.stored()), target.config, [])


def figures_of_run(path: Path, folder: Path, wanted: Wanted) -> list[Path]:
    """Write the figures of a run and their numbers.

    Args:
        path: the run's store, or the YAML that made it.
        folder: where to write; made if needed.
        wanted: which, and how.

    Returns:
        The files written, figure by figure.

    Raises:
        ConfigError: an unknown format, width or figure.
        StoreError: the run has no maps, or the folder cannot be written.
    """
    unknown = [name for name in wanted.formats if name not in FORMATS]
    if unknown or not wanted.formats:
        what = f"{', '.join(unknown)} cannot be drawn" if unknown else "no format"
        raise ConfigError(f"--format: {what}; choose from {', '.join(FORMATS)}")
    width = None if wanted.width is None else millimetres(wanted.width)
    target = find_run(path)
    data = gather_run(target)
    warn_if_old(target, ("maps", "ensemble"), "drawn in this state")
    kinds = tuple(dict.fromkeys(wanted.formats))
    jobs = [PaperFigure(each, kinds, width, wanted.dpi) for each in _chosen(run_figures(data), wanted.only)]
    workers = drawing_workers(wanted.workers, target.config.compute)
    return _drawn(jobs, folder, workers, Reporter(wanted.progress))


def _chosen(found: list[Figure], only: Sequence[str]) -> list[Figure]:
    names = [figure.name for figure in found]
    unknown = [name for name in only if name not in names]
    if unknown:
        raise ConfigError(f"--only: this run has no figure {unknown[0]}; it has {', '.join(names)}")
    return [figure for figure in found if not only or figure.name in only]


def _drawn(jobs: list[PaperFigure], folder: Path, workers: int, reporter: Reporter) -> list[Path]:
    """Draw with several processes and write each figure when it is there."""
    written: dict[str, list[Path]] = {}

    def write(job: PaperFigure, files: dict[str, bytes]) -> None:
        written[job.figure.name] = [folder / name for name in files]
        for name, content in files.items():
            write_atomic(folder / name, content)

    with reporter.progress("figures", len(jobs), "figure") as advance:
        map_all(drawing_executor(workers, len(jobs)), draw_paper_figure, jobs, write, advance)
    return [path for job in jobs for path in written[job.figure.name]]


def warn_if_old(target: Target, stages: Sequence[str], words: str) -> None:
    """Warn where results of these stages are not those of the present settings and input."""
    for state in run_status(target):
        if state.stage in stages and state.state != "complete":
            Reporter("off").warning(f"{state.stage}: {state.words()}; {words}")
