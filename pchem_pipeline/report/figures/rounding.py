"""Figure of what rounding to whole DN does to estimates from the density, and where the sensor stands."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.errors.rounding import LARGEST_BIAS, rounding_bias
from pchem_pipeline.report.charts.chart import Axis, Chart, Level, Line, Panel, Span, Stack
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.figure import DataTable, Figure
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.report.style.ranges import finite
from pchem_pipeline.report.style.wording import short

_STEPS = np.geomspace(1.5, 30.0, 40)  # DN per electron
_PHASES = 8  # biases over a whole DN
_NEEDED = ("quanta_exposure", "conversion_gain", "read_noise_e")
_LEAST_NOISE = 0.01  # e-
_NAMES = ("quanta exposure", "conversion gain", "bias", "read noise")


def rounding_figures(data: ReportData, _: ReportSettings) -> Iterator[Figure]:
    """Return the bias by rounding against 1/g."""
    curves = rounding_curves(data)
    if not curves or not data.has_values("conversion_gain"):
        return
    gain = data.maps["conversion_gain"]
    step = 1.0 / data.summary("conversion_gain", with_flagged=True).median
    words = [f"{name} {short(float(np.interp(step, curves['1/g'], curves[name])), 2)}" for name in _NAMES]
    table = DataTable(curves, {"1/g": "DN/e-", **dict.fromkeys(_NAMES, "standard errors")})
    yield Figure(
        "rounding",
        "uncertainty",
        "Systematic error from rounding to whole DN",
        "Systematic error from rounding to whole DN if the density of the PCD is fitted, in standard errors "
        "per pixel, at this run's median quanta exposure, median read noise and number of frames (largest "
        "over the position of the bias between two DN). Above the dotted line (0.05) exact probabilities "
        "are fitted, unless fit.likelihood is density.",
        f"At {short(step)} DN per electron, in standard errors per pixel: {', '.join(words)}.",
        (table,),
        _rounding_chart(table, gain),
    )


def rounding_curves(data: ReportData) -> dict[str, NDArray[np.float64]]:
    """Return the largest bias by rounding of each parameter against 1/g, at the median H and read noise.

    Args:
        data: of the run; the medians of H, g and the read noise are taken.

    Returns:
        ``1/g``, DN per electron, and for each parameter the bias in standard errors of a pixel; empty where
        the run does not know what is needed.
    """
    n_frames = data.n_frames
    if not n_frames or not all(data.has_values(name) for name in _NEEDED):
        return {}
    exposure, gain, total = (data.summary(name, with_flagged=True).median for name in _NEEDED)
    noise = np.sqrt(max(total**2 - gain**2 * QUANTISATION_VARIANCE, _LEAST_NOISE**2))
    steps = np.repeat(_STEPS, _PHASES)
    phases = np.tile(np.arange(_PHASES) / _PHASES, _STEPS.size)
    sigma = np.sqrt((noise * steps) ** 2 + QUANTISATION_VARIANCE)
    found = rounding_bias(
        [np.full(steps.size, exposure), 1.0 / steps, 100.0 + phases, sigma],
        np.full(steps.size, float(n_frames)),
    )
    largest = np.abs(found).reshape(_STEPS.size, _PHASES, 4).max(axis=1)
    # beyond this the first order says no more than that the bias is large
    largest = np.where(largest < 30.0, largest, np.nan)
    return {"1/g": _STEPS, **{name: largest[:, i] for i, name in enumerate(_NAMES)}}


#: Hues of the parameters' curves.
_HUES = ("blue", "vermilion", "green", "orange")


def _rounding_chart(table: DataTable, gain: NDArray[Any]) -> Chart:
    """Return the chart of the bias of the density's estimates against 1/g, with the range of this sensor."""
    steps = table["1/g"]
    low, high = (1.0 / float(q) for q in np.quantile(finite(gain), [0.99, 0.01]))
    lines = [
        Line(steps, table[name], colour=hue, label=name) for hue, name in zip(_HUES, _NAMES, strict=True)
    ]
    limit = Level(LARGEST_BIAS, colour="green", width=0.9, dash=":")
    here = Span(low, high, axis="x", colour="sky", alpha=0.3, label="this sensor, 1–99 %")
    left, right = min(float(steps[0]), 0.9 * low), max(float(steps[-1]), 1.1 * high)
    ticks = tuple((float(tick), str(tick)) for tick in (1, 2, 5, 10, 20, 50) if left <= tick <= right)
    x = Axis("1/g (DN per electron)", left, right, log=True, ticks=ticks)
    y = Axis("bias (standard errors)", 1e-4, 30.0, log=True)
    return Chart((Stack((Panel(y, (here, *lines, limit), legend="upper right"),), x, height_mm=62.0),))
