"""The figure of a plan: frames that one sample needs, over exposure and read noise."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.report.charts.chart import (
    PAGE_MM,
    Axis,
    Chart,
    Image,
    Line,
    Mark,
    Panel,
    Points,
    Stack,
    Words,
)
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.figure import DataTable, Figure
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.report.style.wording import power_of_ten

FloatArray = NDArray[np.float64]

#: Powers of ten of the frames where the colours end, and of the contours.
_ENDS, _LEVELS = (0.0, 8.0), range(1, 9)
#: Ticks of the exposure, e-; points of the picture for one of the grid, along each axis.
_EXPOSURES, _FINER = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0), 8


def plan_figures(data: ReportData, _: ReportSettings) -> Iterator[Figure]:
    """Return the figure of the frames needed, where a pixel has a value."""
    plan = data.plan
    if plan is None:
        return
    words = "; ".join(
        f"{target_text(row['target'])}: {frames_text(row['frames'])} frames" for row in plan["rows"]
    )
    table = frames_table(plan["contours"])
    yield Figure(
        "frames_needed",
        "plan",
        "Frames needed for one sample",
        "Number of frames for the precision in the title (1 sigma error per pixel, Cramer-Rao bound). Dot: "
        "median pixel of this run; white dots: exposure with the fewest frames at each read noise. Weak "
        "peaks and many electrons (top right) need more frames than the bound, to rule out a wrong gain.",
        f"Contours of the frames needed over exposure and read noise. For the median pixel, {words}.",
        (table,),
        frames_chart(table, plan["mark"]),
        PAGE_MM,
    )


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


def target_text(target: str) -> str:
    """Return a target of a plan for people."""
    return target.replace("_e to", " (e⁻) to").replace("_", " ").replace("e-", "e⁻")


def frames_text(frames: float) -> str:
    """Return a number of frames for people."""
    return f"{frames:,.0f}" if math.isfinite(frames) else "none suffice"


def frames_chart(table: DataTable, mark: tuple[float, float] | None = None) -> Chart:
    """Return contours of the frames needed, one panel a target.

    Args:
        table: of :func:`frames_table`.
        mark: exposure and read noise of a pixel to show.
    """
    names = [name for name in table.columns if name.startswith(_FRAMES)]
    y, x = (np.unique(table[name]) for name in ("read_noise_e", "quanta_exposure"))
    stacks = [
        _stack(x, y, table[name].reshape(y.size, x.size), name.removeprefix(_FRAMES), mark) for name in names
    ]
    return Chart(tuple(stacks), (1.0, 1.0) if len(stacks) > 1 else (1.0,))


def _stack(x: FloatArray, y: FloatArray, frames: FloatArray, words: str, mark: Any) -> Stack:
    """Return the frames for one target over exposures x and read noises y."""
    # a picture cannot lie on a logarithmic axis
    across, power = np.log10(x), np.log10(np.where(np.isfinite(frames), np.clip(frames, 1.0, None), np.nan))
    fine = _finer(power)
    places, heights = (np.linspace(a[0], a[-1], n) for a, n in ((across, fine.shape[1]), (y, fine.shape[0])))
    marks: list[Mark] = [Image(fine, _half_steps(across), _half_steps(y), ends=_ENDS)]
    for level in _LEVELS:
        contour = _crossing(fine, heights, float(level))
        if np.isfinite(contour).any():
            line = Line(places, _joined(contour, y), colour="#FFFFFF", width=0.9)
            marks += [line, _named(places, y, contour, level)]
    known = np.isfinite(power).any(axis=1)
    best = np.argmin(np.where(np.isfinite(power), power, np.inf), axis=1)
    marks.append(Points(across[best][known], y[known], size=1.8, colour="#FFFFFF"))
    if mark is not None:
        spot = np.log10([mark[0]]), np.array([mark[1]])
        marks += [Points(*spot, size=6.5, colour="#FFFFFF"), Points(*spot, size=5.0, colour="vermilion")]
    ticks = tuple((math.log10(each), f"{each:g}") for each in _EXPOSURES)
    title = f"frames for {words.replace('_e to', ' to').replace('_', ' ').replace('e-', 'e⁻')}"
    panel = Panel(Axis("read noise (e⁻)", float(y[0]), float(y[-1])), tuple(marks))
    ends = float(across[0]), float(across[-1])
    return Stack((panel,), Axis("quanta exposure (e⁻)", *ends, ticks=ticks), title, height_mm=66.0)


def _half_steps(places: FloatArray) -> tuple[float, float]:
    """Return the ends of a picture whose first and last points lie on the first and last of some places."""
    half = (places[-1] - places[0]) / (places.size - 1) / _FINER / 2
    return float(places[0] - half), float(places[-1] + half)


def _finer(values: FloatArray) -> FloatArray:
    """Return values of a grid between whose points others are interpolated; NaN beside NaN."""
    for _ in range(2):
        n = len(values)
        at = np.linspace(0.0, n - 1.0, (n - 1) * _FINER + 1)
        below = np.minimum(at.astype(np.int64), n - 2)
        part = (at - below)[:, None]
        with np.errstate(invalid="ignore"):
            mixed = (1.0 - part) * values[below] + part * values[below + 1]
        exact = np.where(part == 0.0, values[below], np.where(part == 1.0, values[below + 1], mixed))
        values = exact.T
    return values


def _crossing(power: FloatArray, y: FloatArray, level: float) -> FloatArray:
    """Return the read noise at which each exposure needs so many frames; more read noise needs more.

    Infinite where no read noise, or even none, needs so many.
    """
    found = np.full(power.shape[1], np.nan)
    for j, column in enumerate(power.T):
        known = np.isfinite(column)
        if known.sum() > 1:
            found[j] = np.interp(level, column[known], y[known], left=-np.inf, right=np.inf)
    return found


def _joined(height: FloatArray, y: FloatArray) -> FloatArray:
    """Return a contour that goes on to the end of the axis where the next exposure does not cross it."""
    finite = np.isfinite(height)
    beside = np.convolve(finite, np.ones(3), "same") > 0
    return np.where(beside, np.clip(height, y[0], y[-1]), np.nan)


def _named(across: FloatArray, y: FloatArray, height: FloatArray, level: int) -> Words:
    """Return the words on a contour, a little farther to the right on each."""
    known = np.flatnonzero(np.isfinite(height))
    at = known[int((0.25 + 0.06 * level) * (known.size - 1))]
    up = (height[at] - y[0]) / (y[-1] - y[0])
    x = np.clip(across[at], *np.interp([0.05, 0.95], [0.0, 1.0], across[[0, -1]]))
    return Words(float(x), float(np.clip(up, 0.01, 0.93)), power_of_ten(level), colour="#000000")
