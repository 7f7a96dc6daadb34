"""The figure of the goodness of fit, and the share of noise in the maps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.checks.multiple_testing import misfit
from pchem_pipeline.report.charts.chart import (
    PAGE_MM,
    Axis,
    Chart,
    Level,
    Panel,
    Span,
    Stack,
    Steps,
)
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.figure import DataTable, Figure, is_strip, sensor_stack
from pchem_pipeline.report.style.ranges import finite
from pchem_pipeline.report.style.wording import count

FloatArray = NDArray[np.float64]

_P_BINS = 20
#: Deviates beyond these have the end colours.
_DEVIATES = (-4.0, 6.0)
_MOST_MARKS = 400
#: Widths of two stacks side by side.
_TWO = (1.0, 1.15)

_GOODNESS = ("p", "chi2", "dof", "q")


def goodness_figures(data: ReportData) -> Iterator[Figure]:
    """Return the p-values and the map of the goodness of fit."""
    if not data.misfits or any(f"goodness_{name}" not in data.fit for name in _GOODNESS):
        return
    facts = data.misfits
    rate = float(facts["false_discovery_rate"])
    columns = {name: data.fit[f"goodness_{name}"] for name in _GOODNESS}
    columns["misfit"] = misfit(columns["chi2"], columns["dof"])
    table = DataTable(columns, {"misfit": "standard deviations"})
    text = (
        f"p-values and misfit of {count(int(facts['tested']), data.noun)}; "
        f"{count(int(facts['misfits']), 'misfit')} at a false-discovery rate of {rate:g}."
    )
    yield Figure(
        "goodness",
        "goodness",
        "Goodness of fit of all pixels",
        "p-values of the goodness of fit of all pixels (blue): uniform where the model holds (line; gray: 2 "
        "sigma), with a peak at 0 from pixels that the model does not describe. Map: chi-square as standard "
        f"normal deviate, clipped at −4 and 6; circles: misfits at a false-discovery rate of {rate:g}.",
        text,
        (table,),
        _goodness_chart(table, rate),
        PAGE_MM,
    )


def noise_shares(data: ReportData, names: tuple[str, ...]) -> dict[str, float]:
    """Return, by map, the part of its variance over the pixels that the errors of the estimates make.

    Both are robust: the median squared standard error over ``(1.4826 MAD)^2``.

    Args:
        data: with the maps.
        names: maps to look at; those that do not exist or have fewer than 8 values are left out.
    """
    found = {}
    for name in names:
        error = data.pixel_error(name, with_flagged=True)
        if error is None or not data.has_values(name):
            continue
        summary = data.summary(name, with_flagged=True)
        if summary.n_valid >= 8 and summary.robust_sd > 0:
            found[name] = float(error**2 / summary.robust_sd**2)
    return found


def _goodness_chart(table: DataTable, false_discovery_rate: float) -> Chart:
    """Return the p-values of all pixels against what chance gives, and a map of the goodness of fit."""
    deviate, known = table["misfit"], finite(table["p"])
    counts, edges = np.histogram(known, _P_BINS, (0.0, 1.0))
    mean = known.size / _P_BINS
    spread = np.sqrt(mean * (1.0 - 1.0 / _P_BINS))
    marks = (
        Span(mean - 2 * spread, mean + 2 * spread, colour="band"),
        Level(mean, colour="ink", width=0.6),
        Steps(edges, counts, width=1.2),
    )
    high = 1.05 * max(float(counts.max()), mean + 2 * spread)
    left = Stack((Panel(Axis("pixels", 0.0, high), marks),), Axis("p-value of the goodness of fit", 0.0, 1.0))
    found = table["q"] <= false_discovery_rate
    ringed = found if is_strip(found.shape) or found.sum() <= _MOST_MARKS else None
    right = sensor_stack(deviate, _DEVIATES, "misfit (σ)", ringed=ringed, ring="vermilion", whole=True)
    return Chart((left, right), _TWO)
