"""Drawing the figures of a report with the workers of the run, and telling how far it is."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence

from pchem_pipeline.compute.environment import available_workers
from pchem_pipeline.compute.executor import (
    Executor,
    PoolExecutor,
    SerialExecutor,
    can_start_processes,
    map_all,
)
from pchem_pipeline.compute.memory import BASE_BYTES, SECOND_PROGRAM_BYTES
from pchem_pipeline.compute.settings import ComputeSettings
from pchem_pipeline.report.figures.figure import Figure
from pchem_pipeline.report.pages.pictures import DrawAll, Drawn, draw_figure
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.run.progress import Reporter


def drawing_executor(workers: int, n_figures: int) -> Executor:
    """Return who draws: processes, since drawing shares its settings within one; or this one alone."""
    count = min(workers, available_workers(), n_figures)
    several = count > 1 and can_start_processes()
    return PoolExecutor(count, processes=True) if several else SerialExecutor()


def drawing_workers(wanted: int | None, settings: ComputeSettings) -> int:
    """Return how many may work on a report at a time: as asked for, else as the section ``compute`` says."""
    if wanted is not None:
        return wanted
    workers = available_workers() if settings.workers == "auto" else settings.workers
    if settings.max_memory is not None:
        workers = min(workers, max(1, ((settings.max_memory << 20) - BASE_BYTES) // SECOND_PROGRAM_BYTES))
    return workers


def draw_by_workers(workers: int, reporter: Reporter, label: str) -> DrawAll:
    """Return a function that draws figures with up to so many processes.

    It raises the first error of a figure once the others are drawn.

    Args:
        workers: of the run.
        reporter: hears of each figure.
        label: of the bar.
    """

    def draw(figures: Sequence[Figure], settings: ReportSettings) -> Mapping[str, Drawn]:
        drawn: dict[str, Drawn] = {}
        task = functools.partial(draw_figure, settings=settings)
        executor = drawing_executor(workers, len(figures))
        with reporter.progress(label, len(figures), "figure") as advance:
            map_all(executor, task, figures, lambda each, value: drawn.update({each.name: value}), advance)
        return drawn

    return draw
