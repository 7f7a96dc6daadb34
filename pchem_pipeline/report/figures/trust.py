"""Figures of how far the numbers can be trusted: goodness of fit, samples left out, and uncertainties."""

from __future__ import annotations

from functools import partial

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pchem_pipeline.model.checks.multiple_testing import misfit
from pchem_pipeline.report.charts.chart import Axis, Bars, Chart, Level, Line, Mark, Panel, Stack, Words
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.figure import DataTable, Figure
from pchem_pipeline.report.figures.maps import is_strip, show_map, shown_pixels
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.report.style.ranges import finite
from pchem_pipeline.report.style.style import PAGE_MM, Drawing, Look, note, styled
from pchem_pipeline.report.style.wording import count, percent, symbol

FloatArray = NDArray[np.float64]

_P_BINS = 20
#: Deviates beyond these have the end colours.
_DEVIATES = (-4.0, 6.0)
_MOST_MARKS = 400


#: Maps of which the figure of uncertainties tells the share of noise.
_UNCERTAIN = ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn", "read_noise_e")
_GOODNESS = ("p", "chi2", "dof", "q")

_GOODNESS_CAPTION = (
    "p-values of the goodness of fit of all pixels (blue); by chance they are uniform (line, with two "
    "standard deviations in gray), a peak at 0 is made of pixels that the model does not describe. Map: "
    "chi-square as standard normal deviate, clipped at −4 and 6; circles are the misfits at a rate of "
    "false discoveries of {rate:g}."
)
_LEFT_OUT_CAPTION = (
    "Samples where the fitted model expects fewer than {floor:g} frames per DN are left out of the "
    "likelihood. Left: pixels by how many they lost. Right: where they are; white pixels lost none. "
    "Without outliers about one pixel in two hundred loses a single sample by chance."
)
_UNCERTAINTY_CAPTION = (
    "Left: part of the variance of each map over the pixels that is noise of the estimates; near 100 % "
    "(dotted) the map shows noise alone, and more frames would show more of the sensor. Right: "
    "predicted density of the ensemble (black), its standard error from those of the maps (blue), and "
    "the sampling noise of the data it is compared with (light blue)."
)


def goodness_figures(data: ReportData, _: ReportSettings) -> list[Figure]:
    """Return the p-values and the map of the goodness of fit."""
    if not data.misfits or any(f"goodness_{name}" not in data.fit for name in _GOODNESS):
        return []
    facts = data.misfits
    rate = float(facts["false_discovery_rate"])
    columns = {name: data.fit[f"goodness_{name}"] for name in _GOODNESS}
    columns["misfit"] = misfit(columns["chi2"], columns["dof"])
    table = DataTable(columns, {"misfit": "standard deviations"})
    text = (
        f"p-values and misfit of {count(int(facts['tested']), data.noun)}; "
        f"{count(int(facts['misfits']), 'misfit')} at a rate of false discoveries of {rate:g}."
    )
    return [
        Figure(
            "goodness",
            "goodness",
            "Goodness of fit of all pixels",
            _GOODNESS_CAPTION.format(rate=rate),
            text,
            (table,),
            partial(draw_goodness, table=table, false_discovery_rate=rate),
            PAGE_MM,
        )
    ]


def left_out_figures(data: ReportData, _: ReportSettings) -> list[Figure]:
    """Return where the tail guard left samples out of the fit."""
    share = data.fit.get("outlier_share")
    if share is None or not data.misfits.get("tail_guard"):
        return []
    hit = int((share > 0).sum())
    return [
        Figure(
            "left_out",
            "goodness",
            "Samples left out of the fit",
            _LEFT_OUT_CAPTION.format(floor=data.misfits["tail_guard"]),
            f"{count(hit, data.noun)} of {share.size:,} lost samples, at most "
            f"{percent(float(np.max(share, initial=0.0)), 1.0)} of their frames.",
            (DataTable({"share left out": share}),),
            partial(draw_left_out, share=share, n_frames=data.n_frames),
            PAGE_MM,
        )
    ]


def uncertainty_figures(data: ReportData, _: ReportSettings) -> list[Figure]:
    """Return the part of the maps that is noise, and the error of the predicted ensemble."""
    shares = noise_shares(data, _UNCERTAIN)
    arrays = data.ensemble
    if not shares or "epcd_exact" not in arrays:
        return []
    words = ", ".join(f"{symbol(name)[1]} {percent(min(value, 1.0), 1.0)}" for name, value in shares.items())
    maps = DataTable({"map": list(shares), "share of the variance": list(shares.values())}, part="maps")
    names = ("dn", "counts", "epcd_exact", "epcd_stderr")
    columns = {name: arrays[name] for name in names if name in arrays}
    units = {"dn": "DN", "epcd_exact": "1/DN", "epcd_stderr": "1/DN"}
    ensemble = DataTable(columns, units, "ensemble")
    return [
        Figure(
            "uncertainty",
            "uncertainty",
            "Noise in the maps and in the prediction",
            _UNCERTAINTY_CAPTION,
            f"Part of the variance of the maps that is noise of the estimates: {words}.",
            (maps, ensemble),
            uncertainty_chart(maps, ensemble),
            PAGE_MM,
        )
    ]


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


@styled
def draw_goodness(look: Look, *, table: DataTable, false_discovery_rate: float) -> Drawing:
    """Draw the p-values of all pixels against what chance gives, and a map of the goodness of fit.

    Args:
        look: width and colours.
        table: ``p``, ``q`` and ``misfit``, each (y, x).
        false_discovery_rate: pixels with a q-value up to it are marked.
    """
    deviate, colours = table["misfit"], look.palette
    left, right, figure = _two(look, deviate.shape)
    known = finite(table["p"])
    edges = np.linspace(0.0, 1.0, _P_BINS + 1)
    mean = known.size / _P_BINS
    spread = np.sqrt(mean * (1.0 - 1.0 / _P_BINS))
    left.axhspan(mean - 2 * spread, mean + 2 * spread, color=colours.band, linewidth=0)
    left.axhline(mean, color=colours.ink, linewidth=0.6)
    left.stairs(np.histogram(known, edges)[0], edges, color=colours.blue, linewidth=1.2)
    left.set(xlabel="p-value of the goodness of fit", ylabel="pixels", xlim=(0.0, 1.0), ylim=(0.0, None))
    marked = np.argwhere(table["q"] <= false_discovery_rate)
    if is_strip(deviate.shape):
        right.plot(deviate.ravel(), "o", markersize=2.5, color=colours.blue)
        right.plot(
            marked.max(axis=1), deviate[tuple(marked.T)], "o", markersize=5, mec=colours.vermilion, mfc="none"
        )
        right.set(xlabel="channel", ylabel="misfit (σ)")
        right.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        return figure
    shown = np.clip(shown_pixels(look, deviate, panels=_panels(look)), *_DEVIATES)
    image = show_map(right, shown, deviate.shape, panels=_panels(look), vmin=-4.0, vmax=6.0)
    if len(marked) <= _MOST_MARKS:
        right.plot(marked[:, 1], marked[:, 0], "o", markersize=5, mec=colours.vermilion, mfc="none", mew=0.8)
    bar = figure.colorbar(image, ax=right, fraction=0.06, pad=0.02, aspect=25)
    bar.set_label("misfit (σ)")
    return figure


def _panels(look: Look) -> int:
    """Return how many axes of two stand side by side."""
    return 2 if look.wide else 1


def _two(look: Look, shape: tuple[int, ...]) -> tuple[Axes, Axes, Drawing]:
    """Return two axes, side by side on a page, one above the other in a column."""
    if _panels(look) > 1:
        figure = look.empty(62.0)
        left, right = figure.subplots(1, 2, width_ratios=(1.0, 1.15))
    else:
        figure = look.empty(52.0 + (40.0 if is_strip(shape) else 62.0))
        left, right = figure.subplots(2, 1, height_ratios=(1.0, 1.2))
    return left, right, figure


@styled
def draw_left_out(look: Look, *, share: FloatArray, n_frames: int | None) -> Drawing:
    """Draw how many samples of each pixel the tail guard left out, as a histogram and as a map.

    Args:
        look: width and colours.
        share: of the frames of each pixel, (y, x).
        n_frames: frames of a pixel; None where pixels differ, and shares are drawn.
    """
    (left, right, figure), colours = _two(look, share.shape), look.palette
    samples = np.rint(share * n_frames) if n_frames else 100.0 * share
    label = "frames left out" if n_frames else "samples left out (%)"
    hit = samples[samples > 0]
    if hit.size:
        top = float(hit.max())
        edges = np.arange(0.5, min(top, 60.0) + 1.5) if n_frames else np.linspace(0.0, 1.05 * top, 21)
        left.stairs(
            np.histogram(np.minimum(hit, edges[-1] - 1e-9), edges)[0], edges, fill=True, color=colours.bars
        )
        left.xaxis.set_major_locator(MaxNLocator(6, integer=bool(n_frames), min_n_ticks=1))
        left.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        left.set_ylim(0.0, 1.18 * left.get_ylim()[1])  # room for the words above the bars
    else:
        left.set(xticks=[], yticks=[])
    left.set(xlabel=f"{label} of a pixel", ylabel="pixels")
    note(left, f"{count(int(hit.size), 'pixel')} of {samples.size:,} with any")
    if is_strip(samples.shape):
        right.plot(samples.ravel(), "o", markersize=2.5, color=colours.blue)
        right.set(xlabel="channel", ylabel=label)
        right.xaxis.set_major_locator(MaxNLocator(6, integer=True))
        return figure
    # nothing is white, a single sample is seen
    some = shown_pixels(look, samples, panels=_panels(look))
    shown = np.where(some > 0, some, np.nan)
    top = max(float(np.max(hit, initial=1.0)), 1.0)
    options = {"cmap": colours.from_paper, "vmin": 0.0, "vmax": top}
    image = show_map(right, shown, samples.shape, panels=_panels(look), **options)
    image.set_cmap(image.get_cmap().with_extremes(bad=colours.paper))
    bar = figure.colorbar(image, ax=right, fraction=0.06, pad=0.02, aspect=25)
    bar.set_label(label)
    if n_frames:
        bar.locator = MaxNLocator(6, integer=True)
        bar.update_ticks()
    return figure


def uncertainty_chart(maps: DataTable, ensemble: DataTable) -> Chart:
    """Return the chart of how much of each map is noise of the estimates, and how sure the prediction is.

    Args:
        maps: parts of the maps' variance that the errors of the estimates make, by map.
        ensemble: ``dn``, ``counts``, ``epcd_exact``, and ``epcd_stderr`` where it is known.
    """
    return Chart((_noise_stack(maps), _error_stack(ensemble)), (1.0, 1.15))


def _noise_stack(maps: DataTable) -> Stack:
    names, shares = maps["map"].tolist(), maps["share of the variance"].astype(np.float64)
    places, values = np.arange(shares.size), np.clip(100.0 * shares, 0.0, 130.0)
    end = 1.3 * max(float(values.max()), 1.0)
    marks: list[Mark] = [
        Bars(places, np.zeros(places.size), values, broad=0.6, colour="bars", label="noise", listed=False)
    ]
    for place, value, share in zip(places.tolist(), values.tolist(), shares.tolist(), strict=True):
        marks.append(Words(place, value / end + 0.015, percent(share, 1.0), colour="ink"))
    if end > 100.0:
        marks.append(Level(100.0, colour="vermilion", width=0.9, dash=":"))
    ticks = tuple((float(place), symbol(name)[0]) for place, name in enumerate(names))
    x = Axis("map", -0.7, len(names) - 0.3, ticks=ticks)
    return Stack((Panel(Axis("noise in the variance (%)", 0.0, end), tuple(marks)),), x, height_mm=62.0)


def _error_stack(ensemble: DataTable) -> Stack:
    x, label = Axis("signal (DN)"), "density (1/DN)"
    if "epcd_stderr" not in ensemble:
        note = "no error of the prediction: the model holds effects"
        return Stack((Panel(Axis(label), (), note=note),), x, height_mm=62.0)
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
    panel = Panel(Axis(label, low, log=True), lines, legend="upper right")
    return Stack((panel,), x, height_mm=62.0)
