"""The figure of a plan: frames that one sample needs, over exposure and read noise."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm

from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.figure import DataTable, Figure
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.report.style.style import PAGE_MM, Drawing, Look, colours_of, styled
from pchem_pipeline.report.style.wording import power_of_ten

_LEVELS = np.logspace(1, 8, 8)

_CAPTION = (
    "Frames with which one sample reaches the precision in the title, one standard deviation of a pixel, by "
    "the Cramer-Rao bound. The dot is the median pixel of this run; white dots mark the exposure that needs "
    "the fewest frames at each read noise, as far as it is drawn. Weak peaks and many electrons (top right) "
    "need more frames than the bound asks for, until no other gain is as likely by chance."
)


def plan_figures(data: ReportData, _: ReportSettings) -> list[Figure]:
    """Return the figure of the frames needed, where a pixel has a value."""
    plan = data.plan
    if plan is None:
        return []
    words = "; ".join(
        f"{target_text(row['target'])}: {frames_text(row['frames'])} frames" for row in plan["rows"]
    )
    table = frames_table(plan["contours"])
    return [
        Figure(
            "frames_needed",
            "plan",
            "Frames that one sample needs",
            _CAPTION,
            f"Contours of the frames needed over exposure and read noise. For the median pixel, {words}.",
            (table,),
            partial(draw_frames_needed, table=table, mark=plan["mark"]),
            PAGE_MM,
        )
    ]


def frames_table(contours: Mapping[str, Any]) -> DataTable:
    """Return the frames needed over read noise (rows) and exposure.

    Args:
        contours: ``exposures`` (e-), ``read_noises`` (e-) and ``frames``: target in words to an array (read
            noise, exposure).
    """
    noise, exposure = np.meshgrid(contours["read_noises"], contours["exposures"], indexing="ij")
    columns = {"read_noise_e": noise, "quanta_exposure": exposure}
    columns |= {f"{_FRAMES}{words}": np.asarray(values) for words, values in contours["frames"].items()}
    units = {"read_noise_e": "e-", "quanta_exposure": "e-"}
    return DataTable({name: values.ravel() for name, values in columns.items()}, units)


_FRAMES = "frames for "
#: Part of an axis at its ends where a label of a contour would be cut.
_EDGE = 0.04


def target_text(target: str) -> str:
    """Return a target of a plan for people."""
    return target.replace("_e to", " (e⁻) to").replace("_", " ").replace("e-", "e⁻")


def frames_text(frames: float) -> str:
    """Return a number of frames for people."""
    return f"{frames:,.0f}" if math.isfinite(frames) else "none suffice"


@styled
def draw_frames_needed(look: Look, *, table: DataTable, mark: tuple[float, float] | None = None) -> Drawing:
    """Draw contours of the frames needed, one panel a target.

    Args:
        look: width and colours.
        table: of :func:`frames_table`.
        mark: exposure and read noise of a pixel to show.
    """
    names = [name for name in table.columns if name.startswith(_FRAMES)]
    y, x = (np.unique(table[name]) for name in ("read_noise_e", "quanta_exposure"))
    columns = 2 if look.wide and len(names) > 1 else 1
    rows = -(-len(names) // columns)
    figure = look.empty(70.0 * rows)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in grid[len(names) :]:
        axes.set_axis_off()
    for axes, name in zip(grid, names, strict=False):
        _panel(axes, x, y, table[name].reshape(y.size, x.size), name.removeprefix(_FRAMES), mark)
    return figure


def _panel(axes: Axes, x: Any, y: Any, frames: Any, words: str, mark: tuple[float, float] | None) -> None:
    colours = colours_of(axes)
    axes.set_facecolor(colours.no_value)
    # first of all: labels of contours are placed and turned on the axes as they are
    axes.set(xscale="log", xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    shown = np.ma.masked_invalid(np.where(np.isfinite(frames), np.clip(frames, 1.0, None), np.nan))
    axes.contourf(
        x,
        y,
        shown,
        levels=np.logspace(0, 8, 33),
        norm=LogNorm(1, 1e8),
        extend="max",
        alpha=0.85,
    )
    lines = axes.contour(x, y, shown, levels=_LEVELS, colors="white", linewidths=0.9)
    labels = axes.clabel(
        lines,
        fontsize=6.5,
        fmt=lambda level: power_of_ten(round(np.log10(level))),
        colors="black",
        inline_spacing=2,
    )
    to_axes = axes.transData + axes.transAxes.inverted()
    for label in labels:
        if not all(_EDGE < each < 1.0 - _EDGE for each in to_axes.transform(label.get_position())):
            label.remove()  # it would be cut
    best = np.ma.argmin(shown, axis=1)
    axes.plot(np.asarray(x)[best], y, ".", color="white", markersize=2.5)
    if mark is not None:
        axes.plot(*mark, "o", color=colours.vermilion, markersize=5, markeredgecolor="white", clip_on=False)
    axes.set(xlabel="quanta exposure (e⁻)", ylabel="read noise (e⁻)")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_title(f"frames for {words.replace('_e to', ' to').replace('_', ' ').replace('e-', 'e⁻')}")
