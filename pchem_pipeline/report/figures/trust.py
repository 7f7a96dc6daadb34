"""Figures of how far to trust the numbers: goodness of fit, samples left out, uncertainties, rounding."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.checks.multiple_testing import misfit
from pchem_pipeline.model.errors.rounding import LARGEST_BIAS, rounding_bias
from pchem_pipeline.report.charts.chart import (
    PAGE_MM,
    Axis,
    Chart,
    Level,
    Line,
    Panel,
    Span,
    Stack,
    Steps,
)
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.figure import DataTable, Figure, is_strip, sensor_stack
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.report.style.ranges import finite
from pchem_pipeline.report.style.wording import count, percent, short

FloatArray = NDArray[np.float64]

_P_BINS = 20
#: Deviates beyond these have the end colours.
_DEVIATES = (-4.0, 6.0)
_MOST_MARKS = 400
#: Widths of two stacks side by side.
_TWO = (1.0, 1.15)

_GOODNESS = ("p", "chi2", "dof", "q")


def goodness_figures(data: ReportData, _: ReportSettings) -> Iterator[Figure]:
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


def left_out_figures(data: ReportData, _: ReportSettings) -> Iterator[Figure]:
    """Return where the tail guard left samples out of the fit."""
    share = data.fit.get("outlier_share")
    if share is None or not data.misfits.get("tail_guard"):
        return
    hit = int((share > 0).sum())
    yield Figure(
        "left_out",
        "goodness",
        "Samples excluded from the fit",
        f"Samples where the fitted model expects fewer than {data.misfits['tail_guard']:g} frames per DN "
        "are excluded from the likelihood. Left: number of pixels by excluded samples. Right: map; white: "
        "none. Without outliers, about one pixel in two hundred has an excluded sample.",
        f"{count(hit, data.noun)} of {share.size:,} with excluded samples, at most "
        f"{percent(float(np.max(share, initial=0.0)), 1.0)} of their frames.",
        (DataTable({"share left out": share}),),
        left_out_chart(share, data.n_frames),
        PAGE_MM,
    )


def uncertainty_figures(data: ReportData, _: ReportSettings) -> Iterator[Figure]:
    """Return the error of the predicted ensemble; a model with effects has none."""
    names = ("dn", "counts", "epcd_exact", "epcd_stderr")
    if any(name not in data.ensemble for name in names):
        return
    table = DataTable(
        {name: data.ensemble[name] for name in names},
        {"dn": "DN", "epcd_exact": "1/DN", "epcd_stderr": "1/DN"},
        "ensemble",
    )
    exact, error = table["epcd_exact"], table["epcd_stderr"]
    peak = int(np.argmax(exact))
    yield Figure(
        "uncertainty",
        "uncertainty",
        "Noise in the prediction",
        "Predicted density of the ensemble (black), its standard error from the errors of the maps (blue), "
        "and the sampling noise of the data (light blue).",
        f"Standard error of the predicted density at its peak: {percent(float(error[peak]), exact[peak])}.",
        (table,),
        _error_chart(table),
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


def left_out_chart(share: FloatArray, n_frames: int | None) -> Chart:
    """Return how many samples of each pixel the tail guard left out, as a histogram and as a map.

    Args:
        share: of the frames of each pixel, (y, x).
        n_frames: frames of a pixel; None where pixels differ, and shares are drawn.
    """
    # nothing is white, a single sample is seen
    lost = share > 0
    samples = np.where(lost, np.rint(share * n_frames) if n_frames else 100.0 * share, np.nan)
    label = "excluded frames" if n_frames else "excluded samples (%)"
    hit = samples[lost]
    top = max(float(np.max(hit, initial=1.0)), 1.0)
    edges = np.arange(0.5, min(top, 60.0) + 1.5) if n_frames else np.linspace(0.0, 1.05 * top, 21)
    counts = np.histogram(np.minimum(hit, edges[-1] - 1e-9), edges)[0]
    x = Axis(f"{label} per pixel", float(edges[0]), float(edges[-1]), whole=bool(n_frames))
    # room for the words above the bars
    y = Axis("pixels", 0.0, 1.18 * max(float(counts.max()), 1.0), whole=True)
    note = f"{count(int(hit.size), 'pixel')} of {samples.size:,} with any"
    left = Stack((Panel(y, (Steps(edges, counts, filled=True, colour="bars"),), note=note),), x)
    shown = np.where(lost, samples, 0.0) if is_strip(samples.shape) else samples
    whole = bool(n_frames)
    right = sensor_stack(shown, (0.0, top), label, scale="from_paper", none="paper", whole=whole)
    return Chart((left, right), _TWO)


def _error_chart(ensemble: DataTable) -> Chart:
    """Return the chart of how sure the prediction is."""
    exact, error = ensemble["epcd_exact"], ensemble["epcd_stderr"]
    total = max(float(ensemble["counts"].sum()), 1.0)
    seen = exact > 1e-6 * exact.max()
    curves = (
        ("EPCD", "ink", exact),
        ("sampling noise of the data", "sky", np.sqrt(exact / total)),
        ("standard error of the EPCD", "blue", error),
    )
    dn = ensemble["dn"][seen]
    lines = tuple(Line(dn, values[seen], colour=colour, label=words) for words, colour, values in curves)
    floor = float(np.min(error[seen & (error > 0)], initial=np.inf))
    low = max(0.5 * floor, 1e-5 * float(exact.max())) if np.isfinite(floor) else None
    panel = Panel(Axis("density (1/DN)", low, log=True), lines, legend="upper right")
    return Chart((Stack((panel,), Axis("signal (DN)"), height_mm=62.0),))


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
