"""The figure of a plan: frames that one sample needs, over exposure and read noise."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from pchem_pipeline.report.style.style import COLUMN_MM, MAP_COLOURS, NO_VALUE, VERMILION, new_figure, styled
from pchem_pipeline.report.style.wording import power_of_ten

__all__ = ["frames_contours"]

_LEVELS = np.logspace(1, 8, 8)


@styled
def frames_contours(
    data: Mapping[str, Any], mark: tuple[float, float] | None = None, *, width_mm: float | None = None
) -> Figure:
    """Draw contours of the frames needed, one panel a target.

    Args:
        data: ``exposures`` (e-), ``read_noises`` (e-) and ``frames``: target in words to an array (read
            noise, exposure).
        mark: exposure and read noise of a pixel to show.
        width_mm: width of the figure; by default a column, or two for two targets and more.
    """
    panels = list(data["frames"].items())
    if width_mm is None:
        width_mm = COLUMN_MM * min(len(panels), 2)
    columns = 2 if width_mm > 1.5 * COLUMN_MM and len(panels) > 1 else 1
    rows = -(-len(panels) // columns)
    figure = new_figure(width_mm, 70.0 * rows)
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    for axes, (words, frames) in zip(grid, panels, strict=False):
        _panel(axes, data["exposures"], data["read_noises"], np.asarray(frames), words, mark)
    return figure


def _panel(axes: Axes, x: Any, y: Any, frames: Any, words: str, mark: tuple[float, float] | None) -> None:
    axes.set_facecolor(NO_VALUE)
    shown = np.ma.masked_invalid(np.where(np.isfinite(frames), np.clip(frames, 1.0, None), np.nan))
    axes.contourf(
        x,
        y,
        shown,
        levels=np.logspace(0, 8, 33),
        norm=LogNorm(1, 1e8),
        cmap=MAP_COLOURS,
        extend="max",
        alpha=0.85,
    )
    lines = axes.contour(x, y, shown, levels=_LEVELS, colors="white", linewidths=0.9)
    axes.clabel(
        lines,
        fontsize=6.5,
        fmt=lambda level: power_of_ten(round(np.log10(level))),
        colors="black",
        inline_spacing=2,
    )
    best = np.ma.argmin(shown, axis=1)
    axes.plot(np.asarray(x)[best], y, ".", color="white", markersize=2.5)
    if mark is not None:
        axes.plot(*mark, "o", color=VERMILION, markersize=5, markeredgecolor="white", clip_on=False)
    axes.set(xscale="log", xlabel="quanta exposure (e⁻)", ylabel="read noise (e⁻)")
    axes.set_xlim(x[0], x[-1])
    axes.set_ylim(y[0], y[-1])
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_title(f"frames for {words.replace('_e to', ' to').replace('_', ' ').replace('e-', 'e⁻')}")
