"""Figures of the sensor: maps with their histograms (Appendix C), the read noise, and the fit status."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.image import AxesImage
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pchem_pipeline.model.maps.ordered import Ordered
from pchem_pipeline.report.data import FEW_CHANNELS, LINE_MAPS, MAP_NAMES, ReportData
from pchem_pipeline.report.figures.figure import DataTable, Figure
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.report.style.ranges import DisplayRange, finite, histogram_edges, robust_range
from pchem_pipeline.report.style.stretch import stretch_map
from pchem_pipeline.report.style.style import Drawing, Look, colours_of, inches, look_of, note, plain, styled
from pchem_pipeline.report.style.wording import count, measured, percent, short, stored_unit, symbol

FloatArray = NDArray[np.float64]

#: Sensors with so few rows or columns are drawn as points, not as an image.
_STRIP = 2
#: Images longer than this ratio are stretched to fit instead of keeping square pixels.
_LONGEST_RATIO = 4.0
#: Height of an image over the width of the figure, at most.
_TALLEST = 1.6
#: Rows or columns of an image up to which a vector file keeps each pixel.
_MOST_KEPT = 800

_CAPTIONS = {
    "charge_rate": "Charge rate: quanta exposure over integration time; what made the charge is not said.",
    "dark_current": "Dark current: quanta exposure over integration time, in the dark.",
    "conversion_gain": "Conversion gain: electrons per digital number.",
    "bias": "Bias: the digital number at zero electrons.",
    "read_noise_e": "Read noise in electrons, quantisation included.",
    "spurious_charge": "Spurious charge: quanta exposure that does not grow with time or light.",
    "charge_per_level": "Charge per light level: quanta exposure gained with each level.",
}
_READ_NOISE_CAPTION = (
    "Read noise, quantisation included. The blue line is the median, the shaded part holds the pixels"
    " from 5 to 95 %. {below} of the {noun}s with a value lie below 0.4 e⁻."
)
_STATUS_CAPTION = (
    "Light gray pixels have a good fit. A pixel with several reasons has the colour of the first that"
    " applies; the numbers count every reason."
)


#: Maps that have a figure, in their order.
DRAWN_MAPS = (*MAP_NAMES, *LINE_MAPS)


def map_figures(data: ReportData, settings: ReportSettings) -> list[Figure]:
    """Return a figure of each map of Appendix C, and of the line of several exposures, that has values."""
    return [_map(data, name, settings) for name in DRAWN_MAPS if data.has_values(name)]


def _map(data: ReportData, name: str, settings: ReportSettings) -> Figure:
    values = data.maps[name]
    strip = is_strip(values.shape)
    tables = map_tables(values, name, data.maps.get(f"{name}_stderr"), settings.histogram_bins)
    return Figure(
        f"map_{name}",
        "summary" if name == "read_noise_e" else "maps",
        symbol(name)[1].capitalize(),
        _CAPTIONS[name],
        _map_alt(data, name, "Values of the channels" if strip else "Histogram and map"),
        tables,
        partial(draw_map, tables=tables, name=name, stretch=settings.map_stretch),
    )


def _map_alt(data: ReportData, name: str, what: str) -> str:
    _, words, unit = symbol(name)
    summary = data.summary(name)
    low, high = summary.percentiles[5.0], summary.percentiles[95.0]
    return (
        f"{what} of the {words}: median {measured(summary.median, summary.median_stderr, unit)}, "
        f"5 to 95 % of the {data.noun}s from {short(low)} to {short(high)} {unit}, "
        f"extremes {short(summary.minimum)} and {short(summary.maximum)} {unit}; "
        f"{count(summary.n_missing, data.noun)} without a value"
        + (f", {count(summary.n_left_out, f'flagged {data.noun}')} left out." if summary.n_left_out else ".")
    )


def read_noise_figures(data: ReportData, settings: ReportSettings) -> list[Figure]:
    """Return the histogram of the read noise; a line of few channels is shown with the maps."""
    if not data.has_values("read_noise_e") or data.few_channels:
        return []
    values = data.maps["read_noise_e"]
    known = finite(values)
    below = percent(float((known < 0.4).sum()), known.size)
    bins = histogram_table(values, "read_noise_e", settings.histogram_bins)
    return [
        Figure(
            "read_noise_histogram",
            "",
            "Read noise of the pixels",
            _READ_NOISE_CAPTION.format(below=below, noun=data.noun),
            _map_alt(data, "read_noise_e", "Histogram")
            + f" {below} of the {data.noun}s with a value lie below 0.4 e⁻.",
            (bins,),
            partial(draw_read_noise, values=values, bins=bins),
        )
    ]


def status_figures(data: ReportData, _: ReportSettings) -> list[Figure]:
    """Return the map of the fit status."""
    status = data.fit.get("fit_status")
    if status is None:
        return []
    rows = status_counts(status, data.status_words)
    parts = [f"{count(int(((status == 0) & ~data.unfitted).sum()), data.noun)} with a good fit"]
    parts += [f"{count(n, data.noun)}: {text}" for _, text, n in rows]
    reasons = dict(zip(("bit", "meaning", "pixels"), map(list, zip(*rows, strict=True)), strict=False))
    return [
        Figure(
            "fit_status",
            "status",
            "Fit status of the pixels",
            _STATUS_CAPTION,
            "Map of the fit status. " + "; ".join(parts) + ".",
            (DataTable({"fit_status": status}), *([DataTable(reasons, part="reasons")] if rows else [])),
            partial(draw_status, status=status, rows=rows, unfitted=data.unfitted),
        )
    ]


def map_tables(
    values: NDArray[Any], name: str, stderr: NDArray[Any] | None, bins: int
) -> tuple[DataTable, ...]:
    """Return a map with its standard errors, and its histogram where one is drawn.

    Args:
        values: map (y, x), NaN where there is no value.
        name: name of the map in the store, e.g. ``"dark_current"``.
        stderr: standard errors (y, x).
        bins: largest number of bins.
    """
    unit = stored_unit(name)
    columns = {name: values} if stderr is None else {name: values, "standard error": stderr}
    table = DataTable(columns, dict.fromkeys(columns, unit))
    if not is_strip(values.shape):
        return table, histogram_table(values, name, bins, "histogram")
    many = finite(values).size >= FEW_CHANNELS
    return (table, histogram_table(values, name, min(bins, 64), "histogram")) if many else (table,)


def histogram_table(values: NDArray[Any], name: str, most: int, part: str = "") -> DataTable:
    """Return the histogram of a map as it is drawn: pixels in each bin, and its ends.

    Args:
        values: any shape; values that are not finite, or off the axis, are left out.
        name: name of the map in the store.
        most: largest number of bins.
        part: of the figure.
    """
    known = Ordered.of(values)
    edges = histogram_edges(known, robust_range(known), most=most)
    counts = known.histogram(edges)
    columns = {f"{name} from": edges[:-1], f"{name} to": edges[1:], "pixels": counts}
    return DataTable(columns, dict.fromkeys(list(columns)[:2], stored_unit(name)), part)


def is_strip(shape: tuple[int, ...]) -> bool:
    """Tell whether a sensor is a line of channels, drawn as points instead of an image."""
    return min(shape) < _STRIP


@styled
def draw_map(
    look: Look, *, tables: Sequence[DataTable], name: str, stretch: Literal["beta", "linear"] = "beta"
) -> Drawing:
    """Draw the histogram of a map on top and the map below (Appendix C; fig:iD_map to fig:sigmaR_map).

    A sensor of one row or column (ready-made histograms) is drawn as points with error bars.

    Args:
        look: width and colours.
        tables: of :func:`map_tables`.
        name: name of the map in the store.
        stretch: colours by rank (``beta``) or by value (``linear``).
    """
    full = tables[0][name]
    sign, words, unit = symbol(name)
    label = f"{words} {sign} ({unit})"
    if is_strip(full.shape):
        return _draw_channels(look, tables, full.ravel().astype(np.float64), label)
    map_height = _map_height(full.shape, look.width_mm - 24.0)
    figure = look.empty(34.0 + map_height)
    top, bottom = figure.subplots(2, 1, height_ratios=(30.0, map_height))
    known = Ordered.of(full)
    _draw_histogram(top, known, tables[1], label)
    _draw_image(figure, bottom, full, known, f"{sign} ({unit})", stretch)
    return figure


def _map_height(shape: tuple[int, ...], width_mm: float) -> float:
    ratio = shape[0] / shape[1]
    if ratio > _LONGEST_RATIO or ratio < 1.0 / _LONGEST_RATIO:
        ratio = 1.0
    return float(np.clip(width_mm * ratio, 28.0, _TALLEST * width_mm)) + 10.0


def _draw_histogram(axes: Axes, known: Ordered, bins: DataTable, label: str) -> DisplayRange:
    """Draw the histogram of a map with its median; return the range drawn."""
    colours = colours_of(axes)
    shown = robust_range(known)
    axes.set(xlabel=label, ylabel="pixels")
    if known.size == 0:
        axes.set_yticks([])
        note(axes, "no pixel has a value")
        return shown
    if shown.logarithmic:
        axes.set_xscale("log")
    low, high, counts = (bins[name] for name in bins.columns)
    axes.stairs(counts, [*low, high[-1]], fill=True, color=colours.bars)
    axes.axvline(known.median, color=colours.blue, linewidth=1.0)
    axes.set_xlim(shown.low, shown.high)
    if not shown.logarithmic:
        axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.set_title(shown.remark(), fontsize=6.5, color=colours.faint)
    return shown


def _draw_image(
    figure: Drawing,
    axes: Axes,
    values: NDArray[Any],
    known: Ordered,
    label: str,
    stretch: Literal["beta", "linear"],
) -> None:
    some = shown_pixels(figure.look, values)
    drawn = stretch_map(some, stretch, known)
    image = show_map(axes, drawn.colour, values.shape, vmin=0.0, vmax=1.0)
    if known.n_missing:
        words = f"no value: {count(known.n_missing, 'pixel')}"
        patch = Patch(facecolor=figure.look.palette.no_value, edgecolor="#888888", label=words)
        figure.legend(handles=[patch], loc="outside lower left")
    if drawn.levels:
        bar = figure.colorbar(image, ax=axes, ticks=list(drawn.levels), fraction=0.06, pad=0.02, aspect=25)
        bar.ax.set_yticklabels(list(drawn.labels))
        bar.ax.minorticks_off()
        bar.set_label(label)


def shown_pixels(look: Look, values: NDArray[Any], *, panels: int = 1) -> NDArray[Any]:
    """Return the rows and columns of a map that an image can show: every k-th where there are more.

    Args:
        look: of the figure.
        values: the map, (y, x).
        panels: side by side in the figure.
    """
    step = _step(look, values.shape, panels)
    return values[::step, ::step]


def _step(look: Look, shape: tuple[int, ...], panels: int) -> int:
    """Return k; it is odd, so that what differs from one row or column to the next is seen."""
    dots = inches(look.width_mm) * look.dpi / panels
    step = max(1, int(shape[1] / dots), int(shape[0] / (_TALLEST * dots)))
    return step if step % 2 else step - 1


def show_map(
    axes: Axes, colour: NDArray[Any], shape: tuple[int, ...], *, panels: int = 1, **options: Any
) -> AxesImage:
    """Draw an image of the pixels, square unless the sensor is very long; NaN has the colour of no value.

    Args:
        axes: where.
        colour: what the colour stands for, (y, x), of the pixels of :func:`shown_pixels`.
        shape: of the sensor.
        panels: side by side in the figure.
        options: of matplotlib's ``imshow``.
    """
    ny, nx = shape
    square = 1.0 / _LONGEST_RATIO <= ny / nx <= _LONGEST_RATIO
    axes.set_facecolor(colours_of(axes).no_value)
    # a vector file keeps the pixels as they are, but for more of them than it can show
    kept = "none" if max(ny, nx) <= _MOST_KEPT else "nearest"
    step = _step(look_of(axes), shape, panels)
    bottom, right = (step * n - 0.5 for n in colour.shape)
    image = axes.imshow(
        colour,
        origin="upper",
        interpolation=kept,
        aspect="equal" if square else "auto",
        extent=(-0.5, right, bottom, -0.5),
        **options,
    )
    axes.set(xlim=(-0.5, nx - 0.5), ylim=(ny - 0.5, -0.5))
    image.set_cmap(image.get_cmap().with_extremes(bad=colours_of(axes).no_value))
    axes.set(xlabel="x (pixel)", ylabel="y (pixel)")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(6, integer=True))
    for side in ("top", "right"):
        axes.spines[side].set_visible(True)
    return image


def _draw_channels(look: Look, tables: Sequence[DataTable], values: FloatArray, label: str) -> Drawing:
    """Draw a line of channels as points with error bars, and their histogram if they are many."""
    many, colours = len(tables) > 1, look.palette
    stderr = tables[0]["standard error"].ravel() if "standard error" in tables[0] else None
    figure = look.empty(92.0 if many else 52.0)
    if many:
        top, axes = figure.subplots(2, 1, height_ratios=(1.0, 1.4))
        _draw_histogram(top, Ordered.of(values), tables[1], label)
    else:
        axes = figure.add_subplot()
    known = np.isfinite(values)
    channel = np.arange(values.size)
    shown = robust_range(values)
    if shown.logarithmic:
        axes.set_yscale("log")
    inside = known & (values >= shown.low) & (values <= shown.high)
    errors = None
    if stderr is not None and not shown.logarithmic:
        errors = np.nan_to_num(stderr[inside], nan=0.0, posinf=0.0)
    size, cap = (1.5, 0) if many else (3, 2)
    points = {"fmt": "o", "markersize": size, "capsize": cap, "elinewidth": 0.8, "color": colours.blue}
    axes.errorbar(channel[inside], values[inside], yerr=errors, **points)
    axes.set(xlabel="channel", ylabel=label)
    _channel_axis(axes, values.size)
    if many or shown.n_outside:
        axes.set_ylim(*_padded(shown))
    missing = channel[~known]
    if missing.size:
        axes.plot(missing, np.full(missing.size, 0.03), "x", color=colours.vermilion, markersize=4,
                  transform=axes.get_xaxis_transform())  # fmt: skip
    if shown.remark():
        cross = " (×)" if missing.size else ""
        note(axes, shown.remark() + cross)
    return figure


def _channel_axis(axes: Axes, n_channels: int) -> None:
    axes.set_xlim(-0.5, n_channels - 0.5)
    if n_channels <= 12:
        axes.set_xticks(np.arange(n_channels))
    else:
        axes.xaxis.set_major_locator(MaxNLocator(8, integer=True))


def _padded(shown: DisplayRange) -> tuple[float, float]:
    if shown.logarithmic:
        return shown.low / 1.1, shown.high * 1.1
    margin = 0.06 * (shown.high - shown.low)
    return shown.low - margin, shown.high + margin


@styled
def draw_read_noise(look: Look, *, values: NDArray[Any], bins: DataTable) -> Drawing:
    """Draw the histogram of the read noise with its median marked (fig:sigma_r_dist).

    Args:
        look: width and colours.
        values: map of sigma_e-, e-, NaN where there is no value.
        bins: its histogram, of :func:`histogram_table`.
    """
    figure, colours = look.empty(56.0), look.palette
    axes = figure.add_subplot()
    sign, words, unit = symbol("read_noise_e")
    known = Ordered.of(values)
    shown = _draw_histogram(axes, known, bins, f"{words} {sign} ({unit})")
    axes.set_ylim(0.0, 1.1 * axes.get_ylim()[1])
    if known.size:
        median = f"median {short(known.median)} {unit}"
        axes.set_title("; ".join(filter(None, (median, shown.remark()))), fontsize=6.5, color=colours.faint)
    if known.size and shown.low < 0.5 < shown.high:
        axes.axvline(0.5, color=colours.vermilion, linewidth=0.9, linestyle=":")
        axes.text(
            0.5, 0.03, " 0.5 e⁻", color=colours.vermilion, fontsize=6.5, transform=axes.get_xaxis_transform()
        )
    if known.size > 1 and not shown.logarithmic:
        low, high = known.quantiles([0.05, 0.95]).tolist()
        axes.axvspan(low, high, color=colours.sky, alpha=0.18, linewidth=0, zorder=0)
        axes.text(
            low,
            0.98,
            "5–95 %",
            fontsize=6.5,
            va="top",
            transform=axes.get_xaxis_transform(),
            color=colours.faint,
        )
    return figure


def status_counts(fit_status: NDArray[Any], words: Mapping[int, str]) -> list[tuple[int, str, int]]:
    """Return ``(bit, sentence, pixels)`` of each bit that occurs, in the order of ``words``.

    A pixel with several bits counts for each of them. Bits that have no sentence are called by their number.

    Args:
        fit_status: status words, any shape.
        words: bit to sentence.
    """
    found = np.bincount(np.asarray(fit_status).ravel())
    status = np.flatnonzero(found)
    known = {int(bit): text for bit, text in words.items() if int(bit)}
    rest = int(np.bitwise_or.reduce(status, initial=0))
    for bit in known:
        rest &= ~bit
    known |= {1 << i: f"status bit {1 << i}" for i in range(rest.bit_length()) if rest >> i & 1}
    counts = [(bit, text, int(found[status[(status & bit) != 0]].sum())) for bit, text in known.items()]
    return [row for row in counts if row[2]]


@styled
def draw_status(
    look: Look,
    *,
    status: NDArray[Any],
    rows: Sequence[tuple[int, str, int]],
    unfitted: NDArray[np.bool_] | None = None,
) -> Drawing:
    """Draw where fits failed or deserve caution, with a legend of sentences.

    A pixel with several bits has the colour of the first of them in ``rows``; the legend counts every bit.

    Args:
        look: width and colours.
        status: status words (y, x).
        rows: of :func:`status_counts`.
        unfitted: pixels that no fit has reached yet (y, x).
    """
    c = look.palette
    palette = [c.band, c.vermilion, c.ink, c.orange, c.purple, c.blue, c.sky, c.green, c.yellow, "#8C8C8C"]
    last = len(palette) - 1
    missing = np.zeros(status.shape, dtype=bool) if unfitted is None else unfitted
    strip = is_strip(status.shape)
    some, gone = (each if strip else shown_pixels(look, each) for each in (status.astype(np.int64), missing))
    colour = np.where(gone & (some == 0), last, 0)
    for index in range(len(rows), 0, -1):
        colour[(some & rows[index - 1][0]) != 0] = min(index, last - 1)
    good = int(np.count_nonzero(status == 0)) - int(np.count_nonzero(missing & (status == 0)))
    legend = [(palette[0], f"good fit: {_share(good, status.size)}")]
    if missing.any():
        legend.append((palette[last], f"not fitted yet: {_share(int(missing.sum()), status.size)}"))
    legend += [
        (palette[min(i + 1, last - 1)], f"{text}: {_share(n, status.size)}")
        for i, (_, text, n) in enumerate(rows)
    ]
    legend = [(colour_, plain(textwrap.fill(text, int(look.width_mm * 0.62)))) for colour_, text in legend]
    legend_mm = 3.6 * sum(1 + text.count("\n") for _, text in legend) + 5.0
    if strip:
        figure = look.empty(30.0 + legend_mm)
        axes = figure.add_subplot()
        axes.bar(
            np.arange(status.size),
            1.0,
            width=1.0,
            color=[palette[c] for c in colour.ravel()],
            edgecolor=c.paper,
        )
        axes.set(xlabel="channel", yticks=[], ylim=(0.0, 1.0))
        _channel_axis(axes, status.size)
    else:
        figure = look.empty(_map_height(status.shape, look.width_mm - 14.0) + legend_mm)
        axes = figure.add_subplot()
        norm = BoundaryNorm(np.arange(len(palette) + 1) - 0.5, len(palette))
        show_map(axes, colour, status.shape, cmap=ListedColormap(palette), norm=norm)
    figure.legend(
        handles=[Patch(facecolor=c, edgecolor="#888888", label=text) for c, text in legend],
        loc="outside lower left",
    )
    return figure


def _share(part: int, whole: int) -> str:
    return f"{part:,} ({percent(part, whole)})"
