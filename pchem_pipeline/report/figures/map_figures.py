"""Figures of the sensor: maps with their histograms (Appendix C), the read noise, and the fit status."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pchem_pipeline.report.data import FEW_CHANNELS
from pchem_pipeline.report.style.ranges import DisplayRange, finite, histogram_edges, robust_range
from pchem_pipeline.report.style.stretch import stretch_map
from pchem_pipeline.report.style.style import (
    BLACK,
    BLUE,
    COLUMN_MM,
    GRAY,
    GREEN,
    NO_VALUE,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    YELLOW,
    new_figure,
    note,
    plain,
    styled,
)
from pchem_pipeline.report.style.wording import count, percent, short, symbol

__all__ = [
    "fit_status_map",
    "is_strip",
    "map_and_histogram",
    "map_bins",
    "read_noise_histogram",
    "show_map",
    "status_counts",
]

FloatArray = NDArray[np.float64]

#: Sensors with so few rows or columns are drawn as points, not as an image.
_STRIP = 2
#: Images longer than this ratio are stretched to fit instead of keeping square pixels.
_LONGEST_RATIO = 4.0

_STATUS_COLOURS = (VERMILION, BLACK, ORANGE, PURPLE, BLUE, SKY, GREEN, YELLOW)


def is_strip(shape: tuple[int, ...]) -> bool:
    """Tell whether a sensor is a line of channels, drawn as points instead of an image."""
    return min(shape) < _STRIP


@styled
def map_and_histogram(
    values: NDArray[Any],
    name: str,
    *,
    stderr: NDArray[Any] | None = None,
    stretch: Literal["beta", "linear"] = "beta",
    bins: int = 128,
    width_mm: float = COLUMN_MM,
) -> Figure:
    """Draw the histogram of a map on top and the map below (Appendix C; fig:iD_map to fig:sigmaR_map).

    A sensor of one row or column (ready-made histograms) is drawn as points with error bars.

    Args:
        values: map (y, x), NaN where there is no value.
        name: name of the map in the store, e.g. ``"dark_current"``.
        stderr: standard errors (y, x) for the error bars of single channels.
        stretch: colours by rank (``beta``) or by value (``linear``).
        bins: largest number of bins.
        width_mm: width of the figure.
    """
    full = np.asarray(values, dtype=np.float64)
    sign, words, unit = symbol(name)
    label = f"{words} {sign} ({unit})"
    if is_strip(full.shape):
        return _channels(full.ravel(), None if stderr is None else np.ravel(stderr), label, unit, width_mm)
    map_height = _map_height(full.shape, width_mm - 24.0)
    figure = new_figure(width_mm, 34.0 + map_height)
    top, bottom = figure.subplots(2, 1, height_ratios=(30.0, map_height))
    _histogram(top, full, label, unit, bins)
    _image(figure, bottom, full, f"{sign} ({unit})", stretch)
    return figure


def _map_height(shape: tuple[int, ...], width_mm: float) -> float:
    ratio = shape[0] / shape[1]
    if ratio > _LONGEST_RATIO or ratio < 1.0 / _LONGEST_RATIO:
        ratio = 1.0
    return float(np.clip(width_mm * ratio, 28.0, 1.6 * width_mm)) + 10.0


def _histogram(axes: Axes, values: FloatArray, label: str, unit: str, bins: int) -> DisplayRange:
    """Draw the histogram of a map with its median; return the range drawn."""
    shown = robust_range(values)
    known = finite(values)
    axes.set(xlabel=label, ylabel="pixels")
    if known.size == 0:
        axes.set_yticks([])
        note(axes, "no pixel has a value")
        return shown
    if shown.logarithmic:
        axes.set_xscale("log")
    axes.stairs(*map_bins(values, bins), fill=True, color=GRAY)
    median = float(np.median(known))
    axes.axvline(median, color=BLUE, linewidth=1.0)
    axes.set_xlim(shown.low, shown.high)
    if not shown.logarithmic:
        axes.xaxis.set_major_locator(MaxNLocator(5))
    words = f"; {shown.words()}" if shown.words() else ""
    axes.set_title(f"median {short(median)} {unit}{words}", fontsize=6.5, color="#444444")
    return shown


def map_bins(values: NDArray[Any], most: int) -> tuple[NDArray[np.int64], FloatArray]:
    """Return the histogram of a map as it is drawn: pixels in each bin, and the edges of the bins.

    Args:
        values: any shape; values that are not finite, or off the axis, are left out.
        most: largest number of bins.
    """
    edges = histogram_edges(values, robust_range(values), most=most)
    return np.histogram(finite(values), edges)[0], edges


def _image(
    figure: Figure, axes: Axes, values: FloatArray, label: str, stretch: Literal["beta", "linear"]
) -> None:
    drawn = stretch_map(values, stretch)
    image = show_map(axes, drawn.colour, vmin=0.0, vmax=1.0)
    n_missing = int(np.isnan(drawn.colour).sum())
    if n_missing:
        patch = Patch(facecolor=NO_VALUE, edgecolor="#888888", label=f"no value: {count(n_missing, 'pixel')}")
        figure.legend(handles=[patch], loc="outside lower left")
    if drawn.levels:
        bar = figure.colorbar(image, ax=axes, ticks=list(drawn.levels), fraction=0.06, pad=0.02, aspect=25)
        bar.ax.set_yticklabels(list(drawn.labels))
        bar.ax.minorticks_off()
        bar.set_label(label)


def show_map(axes: Axes, colour: NDArray[Any], **options: Any) -> AxesImage:
    """Draw an image of the pixels, square unless the sensor is very long; NaN has the colour of no value.

    Args:
        axes: where.
        colour: what the colour stands for, (y, x).
        options: of matplotlib's ``imshow``.
    """
    ny, nx = colour.shape
    square = 1.0 / _LONGEST_RATIO <= ny / nx <= _LONGEST_RATIO
    axes.set_facecolor(NO_VALUE)
    image = axes.imshow(
        colour, origin="upper", interpolation="nearest", aspect="equal" if square else "auto", **options
    )
    axes.set(xlabel="x (pixel)", ylabel="y (pixel)")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(6, integer=True))
    for side in ("top", "right"):
        axes.spines[side].set_visible(True)
    return image


def _channels(
    values: FloatArray, stderr: FloatArray | None, label: str, unit: str, width_mm: float
) -> Figure:
    """Draw a line of channels as points with error bars, and their histogram if they are many."""
    many = finite(values).size >= FEW_CHANNELS
    figure = new_figure(width_mm, 92.0 if many else 52.0)
    if many:
        top, axes = figure.subplots(2, 1, height_ratios=(1.0, 1.4))
        _histogram(top, values, label, unit, 64)
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
    axes.errorbar(
        channel[inside], values[inside], yerr=errors, fmt="o", markersize=3 if not many else 1.5, color=BLUE,
        elinewidth=0.8, capsize=2 if not many else 0,
    )  # fmt: skip
    axes.set(xlabel="channel", ylabel=label)
    _channel_axis(axes, values.size)
    if many or shown.n_outside:
        axes.set_ylim(*_padded(shown))
    missing = channel[~known]
    if missing.size:
        axes.plot(missing, np.full(missing.size, 0.03), "x", color=VERMILION, markersize=4,
                  transform=axes.get_xaxis_transform())  # fmt: skip
    if shown.words():
        cross = " (×)" if missing.size else ""
        note(axes, shown.words() + cross)
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
def read_noise_histogram(
    read_noise_e: NDArray[Any], *, bins: int = 128, width_mm: float = COLUMN_MM
) -> Figure:
    """Draw the histogram of the read noise with its median marked (fig:sigma_r_dist).

    Args:
        read_noise_e: map of sigma_e-, e-, NaN where there is no value.
        bins: largest number of bins.
        width_mm: width of the figure.
    """
    figure = new_figure(width_mm, 56.0)
    axes = figure.add_subplot()
    sign, words, unit = symbol("read_noise_e")
    known = finite(read_noise_e)
    shown = _histogram(
        axes, np.asarray(read_noise_e, dtype=np.float64), f"{words} {sign} ({unit})", unit, bins
    )
    axes.set_ylim(0.0, 1.1 * axes.get_ylim()[1])
    if known.size and shown.low < 0.5 < shown.high:
        axes.axvline(0.5, color=VERMILION, linewidth=0.9, linestyle=":")
        axes.text(0.5, 0.03, " 0.5 e⁻", color=VERMILION, fontsize=6.5, transform=axes.get_xaxis_transform())
    if known.size > 1 and not shown.logarithmic:
        low, high = (float(q) for q in np.quantile(known, [0.05, 0.95]))
        axes.axvspan(low, high, color=SKY, alpha=0.18, linewidth=0, zorder=0)
        axes.text(
            low, 0.98, "5–95 %", fontsize=6.5, va="top", transform=axes.get_xaxis_transform(), color="#33607F"
        )
    return figure


def status_counts(fit_status: NDArray[Any], words: Mapping[int, str]) -> list[tuple[int, str, int]]:
    """Return ``(bit, sentence, pixels)`` of each bit that occurs, in the order of ``words``.

    A pixel with several bits counts for each of them. Bits that have no sentence are called by their number.

    Args:
        fit_status: status words, any shape.
        words: bit to sentence.
    """
    status = np.asarray(fit_status).astype(np.int64).ravel()
    known = {int(bit): text for bit, text in words.items() if int(bit)}
    rest = int(np.bitwise_or.reduce(status, initial=0))
    for bit in known:
        rest &= ~bit
    known |= {1 << i: f"status bit {1 << i}" for i in range(rest.bit_length()) if rest >> i & 1}
    counts = [(bit, text, int(((status & bit) != 0).sum())) for bit, text in known.items()]
    return [row for row in counts if row[2]]


@styled
def fit_status_map(
    fit_status: NDArray[Any],
    words: Mapping[int, str],
    *,
    unfitted: NDArray[np.bool_] | None = None,
    width_mm: float = COLUMN_MM,
) -> Figure:
    """Draw where fits failed or deserve caution, with a legend of sentences.

    A pixel with several bits has the colour of the first of them in ``words``; the legend counts every bit.

    Args:
        fit_status: status words (y, x).
        words: bit to sentence, gravest first.
        unfitted: pixels that no fit has reached yet (y, x).
        width_mm: width of the figure.
    """
    status = np.asarray(fit_status).astype(np.int64)
    rows = status_counts(status, words)
    missing = np.zeros(status.shape, dtype=bool) if unfitted is None else unfitted
    last = len(_STATUS_COLOURS) + 1
    colour = np.where(missing & (status == 0), last, 0)
    for index in range(len(rows), 0, -1):
        colour[(status & rows[index - 1][0]) != 0] = min(index, last - 1)
    palette = ["#EDEDED", *_STATUS_COLOURS, "#8C8C8C"]
    legend = [(palette[0], f"good fit: {_share(int((colour == 0).sum()), status.size)}")]
    if missing.any():
        legend.append((palette[last], f"not fitted yet: {_share(int(missing.sum()), status.size)}"))
    legend += [
        (palette[min(i + 1, last - 1)], f"{text}: {_share(n, status.size)}")
        for i, (_, text, n) in enumerate(rows)
    ]
    legend = [(colour_, plain(textwrap.fill(text, int(width_mm * 0.62)))) for colour_, text in legend]
    legend_mm = 3.6 * sum(1 + text.count("\n") for _, text in legend) + 5.0
    if is_strip(status.shape):
        figure = new_figure(width_mm, 30.0 + legend_mm)
        axes = figure.add_subplot()
        axes.bar(
            np.arange(status.size),
            1.0,
            width=1.0,
            color=[palette[c] for c in colour.ravel()],
            edgecolor="white",
        )
        axes.set(xlabel="channel", yticks=[], ylim=(0.0, 1.0))
        _channel_axis(axes, status.size)
    else:
        figure = new_figure(width_mm, _map_height(status.shape, width_mm - 14.0) + legend_mm)
        axes = figure.add_subplot()
        norm = BoundaryNorm(np.arange(len(palette) + 1) - 0.5, len(palette))
        show_map(axes, colour, cmap=ListedColormap(palette), norm=norm)
    figure.legend(
        handles=[Patch(facecolor=c, edgecolor="#888888", label=text) for c, text in legend],
        loc="outside lower left",
    )
    return figure


def _share(part: int, whole: int) -> str:
    return f"{part:,} ({percent(part, whole)})"
