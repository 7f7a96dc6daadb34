"""The figures of a run for notebooks: the drawings of the report, one or several at a time."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pchem_pipeline.base.errors import ConfigError, StoreError
from pchem_pipeline.commands.figures import millimetres
from pchem_pipeline.report.charts.chart import COLUMN_MM
from pchem_pipeline.report.charts.on_paper import Look, draw_chart, drawing_bytes
from pchem_pipeline.report.figures.catalogue import run_figures
from pchem_pipeline.report.figures.maps import map_chart, map_tables
from pchem_pipeline.report.figures.paper import FORMATS
from pchem_pipeline.store.files import write_atomic

if TYPE_CHECKING:
    from pchem_pipeline.report.charts.on_paper import Drawing
    from pchem_pipeline.report.data import ReportData
    from pchem_pipeline.report.settings import ReportSettings

#: The maps that ``Plots.maps`` draws where none is named.
_MAPS = ("quanta_exposure", "conversion_gain", "bias", "read_noise_e")


def width_of(width: float | str) -> float:
    """Return a width in mm, given as a number of mm or as a text such as ``"3.5in"``.

    Raises:
        ConfigError: no figure can be so wide.
    """
    return millimetres(width if isinstance(width, str) else f"{width:f}".rstrip("0"))


class Figures(Mapping[str, "Drawing"]):
    """Several figures by name; a notebook shows them one after the other."""

    def __init__(self, figures: Mapping[str, Drawing]) -> None:
        self._figures = dict(figures)

    def __getitem__(self, name: str) -> Drawing:
        return self._figures[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._figures)

    def __len__(self) -> int:
        return len(self._figures)

    def __repr__(self) -> str:
        return f"<Figures {', '.join(self._figures)}>"

    def _repr_html_(self) -> str:
        """Return the figures as a notebook shows them."""
        return "".join(
            f'<img alt="{name}" style="display: inline-block; background: white" src="data:image/png;base64,'
            f'{base64.b64encode(drawing_bytes(figure, "png", dpi=110)).decode("ascii")}">'
            for name, figure in self._figures.items()
        )

    def save(self, folder: str | Path, formats: tuple[str, ...] = ("pdf",), *, dpi: int = 300) -> list[Path]:
        """Write each figure to a folder, fonts embedded.

        Args:
            folder: made if needed.
            formats: pdf, svg, png.
            dpi: resolution of PNG and of maps, dots per inch.

        Returns:
            The files written.

        Raises:
            ConfigError: an unknown format.
            StoreError: the folder cannot be written.
        """
        unknown = [kind for kind in formats if kind not in FORMATS]
        if unknown:
            raise ConfigError(f"{unknown[0]} cannot be drawn; choose from {', '.join(FORMATS)}")
        written = []
        for name, figure in self._figures.items():
            for kind in formats:
                written.append(Path(folder) / f"{name}.{kind}")
                write_atomic(written[-1], drawing_bytes(figure, kind, dpi=dpi, title=name))
        return written


class Plots:
    """Draws the figures of a run, with the code that draws the report. Found as ``run.plot``."""

    def __init__(self, data: Callable[[], ReportData], settings: ReportSettings) -> None:
        self._data = data
        self._settings = settings

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all figures of the run, for :meth:`figure`."""
        return tuple(figure.name for figure in run_figures(self._data(), self._settings))

    def figure(self, name: str, width: float | str | None = None) -> Drawing:
        """Draw a figure of the report or of the discrepancy page.

        Args:
            name: one of :attr:`names`.
            width: mm, or a text such as ``"3.5in"``; None: the figure's own.

        Raises:
            ConfigError: the run has no such figure.
        """
        found = {figure.name: figure for figure in run_figures(self._data(), self._settings)}
        if name not in found:
            raise ConfigError(f"this run has no figure {name}; it has {', '.join(found)}")
        figure = found[name]
        return figure.draw(Look(figure.width_mm if width is None else width_of(width)))

    def map(
        self, name: str, width: float | str = COLUMN_MM, *, stretch: Literal["beta", "linear"] | None = None
    ) -> Drawing:
        """Draw a map below its histogram.

        Args:
            name: of a map, such as ``"bias"``.
            width: mm, or a text such as ``"3.5in"``.
            stretch: colours by rank (``beta``) or by value (``linear``); None: as in the report.

        Raises:
            StoreError: the run has no such map.
        """
        maps = self._data().maps
        if name not in maps or name.endswith("_stderr"):
            known = ", ".join(each for each in maps if not each.endswith("_stderr"))
            raise StoreError(f"this run has no map {name}; it has {known}")
        tables = map_tables(maps[name], name, maps.get(f"{name}_stderr"), self._settings.histogram_bins)
        chart = map_chart(tables, name, stretch or self._settings.map_stretch)
        return draw_chart(Look(width_of(width)), chart)

    def maps(self, *names: str, width: float | str = COLUMN_MM) -> Figures:
        """Draw several maps; without names the four parameters."""
        return Figures({name: self.map(name, width) for name in names or _MAPS})

    def pixels(self, width: float | str | None = None) -> Drawing:
        """Draw the histograms of the pixels of the report with their fits."""
        return self.figure("pixel_fits", width)

    def read_noise(self, width: float | str | None = None) -> Drawing:
        """Draw the histogram of the read noise."""
        return self.figure("read_noise_histogram", width)

    def ensemble(self, width: float | str | None = None) -> Drawing:
        """Draw the ensemble histograms with their predictions."""
        return self.figure("ensemble", width)

    def electrons(self, width: float | str | None = None) -> Drawing:
        """Draw the estimated electron numbers against the prediction."""
        return self.figure("electron_numbers", width)

    def components(self, width: float | str | None = None) -> Drawing:
        """Draw the widths of the components of the ensemble."""
        return self.figure("component_widths", width)

    def status(self, width: float | str | None = None) -> Drawing:
        """Draw where fits failed or deserve caution."""
        return self.figure("fit_status", width)

    def discrepancy(self) -> Figures:
        """Draw the figures of the discrepancy verdict; none where nobody looked for one."""
        chosen = [name for name in self.names if name.startswith("discrepancy_")]
        return Figures({name: self.figure(name) for name in chosen})
