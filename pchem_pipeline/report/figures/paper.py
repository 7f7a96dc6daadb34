"""Figures as files for papers, each with its numbers beside it as CSV."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.style import library

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.report.charts.on_paper import Look, drawing_bytes
from pchem_pipeline.report.figures.figure import Figure, csv_text

#: File formats of figures for papers.
FORMATS = ("pdf", "svg", "png")

#: Parameters of programs, not of figures.
_NOT_STYLE = (
    "backend",
    "interactive",
    "toolbar",
    "webagg",
    "tk.",
    "savefig.directory",
    "timezone",
    "docstring",
)


@dataclass(frozen=True)
class PaperFigure:
    """A figure and how it is wanted.

    Attributes:
        figure: the figure.
        formats: any of ``FORMATS``.
        width_mm: width; None: the figure's own.
        dpi: resolution of PNG, and of maps inside the other formats, dots per inch.
        sheet: matplotlib parameters that prevail over the style of this package.
    """

    figure: Figure
    formats: tuple[str, ...]
    width_mm: float | None = None
    dpi: int = 600
    sheet: Mapping[str, Any] = field(default_factory=dict)


def draw_paper_figure(wanted: PaperFigure) -> dict[str, bytes]:
    """Draw a figure and return its files and those of its tables by name; pure."""
    figure, files = wanted.figure, {}
    drawing = figure.draw(Look.of_sheet(wanted.width_mm or figure.width_mm, wanted.sheet, wanted.dpi))
    for kind in wanted.formats:
        content = drawing_bytes(drawing, kind, dpi=wanted.dpi, title=figure.title)
        files[f"{figure.name}.{kind}"] = content
    for table in figure.tables:
        part = f"_{table.part}" if table.part else ""
        files[f"{figure.name}{part}.csv"] = csv_text(table).encode()
    return files


def read_style_sheet(name: str) -> dict[str, Any]:
    """Return the parameters of a matplotlib style sheet.

    Args:
        name: path of a ``.mplstyle`` file, or the name of one of matplotlib's own.

    Raises:
        ConfigError: there is none, or it has a parameter or a value that matplotlib does not know.
    """
    path = Path(name)
    if name in library and not path.is_file():
        found = dict(library[name])
    else:
        if not path.is_file():
            raise ConfigError(f"--style {name}: no such file, and no style of matplotlib has that name")
        complaints = _Complaints()
        logger = logging.getLogger("matplotlib")
        logger.addHandler(complaints)
        propagate, logger.propagate = logger.propagate, False
        try:
            found = dict(mpl.rc_params_from_file(path, fail_on_error=True, use_default_template=False))
        except (ValueError, OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"--style {name}: {' '.join(str(error).split())}") from error
        finally:
            logger.removeHandler(complaints)
            logger.propagate = propagate
        if complaints.texts:
            raise ConfigError(f"--style {name}: {complaints.texts[0]}")
    return {key: value for key, value in found.items() if not key.startswith(_NOT_STYLE)}


class _Complaints(logging.Handler):
    """Keeps what matplotlib only logs: unknown parameters, lines that are none."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keep the first line of a message."""
        self.texts.append(" ".join(record.getMessage().split(". You")[0].split()))
