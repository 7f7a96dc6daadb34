"""Figures of stability and structure: means of frames, rows and columns, and their spectra.

Made of the sums that the stage ``histogram`` keeps, with their expectation from sampling noise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.wording import count, short
from pchem_pipeline.discrepancy.observe.laws import FAR
from pchem_pipeline.discrepancy.quick.sums import Lines, StackSums
from pchem_pipeline.model.histogram.spectrum import FEWEST_LINES
from pchem_pipeline.report.charts.chart import Axis, Band, Chart, Level, Line, Panel, Stack
from pchem_pipeline.report.figures.figure import DataTable, Figure

#: Points of a curve at most; longer runs are averaged over frames.
_MOST_POINTS = 1200
_LINES = ("row", "column")
#: Values of lines that are worked on at a time.
_AT_ONCE = 1 << 17
_EXPECTED = Level(1.0, colour="ink", width=0.6, dash="--")  # sampling noise alone


def stability_figures(sums: StackSums | None) -> list[Figure]:
    """Return means against frame, row and column, and their spectra, where the run has the sums."""
    if sums is None:
        return []
    return [*_frame_figure(sums), *_profile_figure(sums), *_spectrum_figure(sums)]


def _frame_figure(sums: StackSums) -> Iterator[Figure]:
    means, power = frame_table(sums), power_table(sums)
    together = math.ceil(sums.n_frames / _MOST_POINTS)
    averaged = f" over {together} frames each" if together > 1 else " of each frame"
    centre, error, scatter = float(means["mean"].mean()), means["expected error"], float(means["mean"].std())
    spectrum = (
        Line(power["frequency"], power["largest"], colour="sky", width=0.6, label="largest"),
        Line(power["frequency"], power["power"], label="mean power"),
        _EXPECTED,
    )
    some = bool((power["power"] > 0.0).any())  # of frames that are all alike there is none
    panel = Panel(Axis("power / expected", log=some), spectrum)
    ends = centre - 2 * error, centre + 2 * error
    series = _series(means["frame"], means["mean"], ends, "mean", "frame", 0.7)
    yield Figure(
        "frame_means",
        "stability",
        "Mean of the frames",
        f"Top: mean of all pixels{averaged}; gray: 2 sigma for independent pixels. Below: power spectrum "
        "relative to independent pixels (1): mean and maximum of neighbouring frequencies.",
        f"Mean of {count(sums.n_frames, 'frame')}: {short(centre, 5)} DN, scatter "
        f"{short(scatter)} DN ({short(float(error[0]))} DN for independent pixels); largest power "
        f"{short(float(power['largest'].max()), 2)} times the expected one.",
        (means, power),
        Chart((series, Stack((panel,), Axis("frequency (1/frame)", log=True), height_mm=44.0))),
    )


def _profile_figure(sums: StackSums) -> Iterator[Figure]:
    tables = [profile_table(sums, axis) for axis in (0, 1) if sums.shape[1 - axis] > 1]
    tables = [table for table in tables if table["mean signal"].size > 1]
    if not tables:
        return
    words, stacks = [], []
    for table in tables:
        name, signal, ends = (
            next(iter(table.columns)),
            table["mean signal"],
            (table["expected from"], table["expected to"]),
        )
        outside = int(((signal < ends[0]) | (signal > ends[1])).sum())
        words.append(f"{outside} of {count(signal.size, table.part)} outside 2 sigma")
        stacks.append(_series(table[name], signal, ends, "median", f"{table.part} {name} (pixel)", 0.8))
    yield Figure(
        "profiles",
        "stability",
        "Profiles of rows and columns",
        "Median of the pixels' mean signal over each row and column; gray: median of the sensor ± 2 sigma "
        "for independent pixels.",
        f"Profiles of the mean signal: {'; '.join(words)}.",
        tuple(tables),
        Chart(tuple(stacks)),
    )


def _spectrum_figure(sums: StackSums) -> Iterator[Figure]:
    fixed, temporal = pattern_spectra(sums), line_spectra(sums)
    if not fixed or not temporal:
        return
    largest = [
        f"{table.part.replace('_', ' of ')}s {short(float(table['power'].max()), 2)}"
        for table in (*fixed, *temporal)
    ]
    yield Figure(
        "spatial_spectra",
        "stability",
        "Spectra of rows and columns",
        "Top: fixed pattern (means of rows and columns over all frames, hot pixels clipped). Below: noise of "
        "rows and columns from frame to frame. 1: independent pixels.",
        f"Largest power relative to independent pixels: {', '.join(largest)}.",
        (*fixed, *temporal),
        _spectra_chart(fixed, temporal),
    )


def frame_table(sums: StackSums) -> DataTable:
    """Return the mean of all pixels in each frame, or in as many together as a curve can show."""
    together = math.ceil(sums.n_frames / _MOST_POINTS)
    starts = np.arange(0, sums.n_frames, together)
    lengths = np.diff(np.append(starts, sums.n_frames))
    means = np.add.reduceat(sums.frame_mean, starts) / lengths
    error = _chance(sums) / np.sqrt(lengths)
    columns = {"frame": sums.numbers[starts], "mean": means, "expected error": error}
    return DataTable(columns, {"mean": "DN", "expected error": "DN"})


def _chance(sums: StackSums) -> float:
    """Return the standard deviation of a frame's mean over independent pixels, DN."""
    return float(np.sqrt(np.nansum(sums.variance)) / sums.variance.size)


def power_table(sums: StackSums) -> DataTable:
    """Return the power spectrum of the frames' means over that of independent pixels, by frequency."""
    series = sums.frame_mean - sums.frame_mean.mean()
    power = np.abs(np.fft.rfft(series)[1:]) ** 2 / series.size / max(_chance(sums) ** 2, 1e-300)
    frequency = np.arange(1, power.size + 1) / series.size
    edges = np.unique(np.geomspace(1, power.size + 1, 160).astype(np.int64)) - 1
    starts = edges[:-1] if edges.size > 1 else edges
    lengths = np.diff(np.append(starts, power.size))
    columns = {
        "frequency": np.add.reduceat(frequency, starts) / lengths,
        "power": np.add.reduceat(power, starts) / lengths,
        "largest": np.maximum.reduceat(power, starts),
    }
    return DataTable(columns, {"frequency": "1/frame"}, "spectrum")


def profile_table(sums: StackSums, axis: int) -> DataTable:
    """Return the median of the pixels' means over each row (axis 0) or column (axis 1), and chance.

    Chance are two standard errors of the median of that many pixels drawn from the whole sensor.
    """
    image, (middle, width) = sums.mean_signal, sums.typical_signal
    # the standard error of a median is so many times that of a mean
    reach = 2.0 * math.sqrt(math.pi / 2.0) * width / math.sqrt(image.shape[1 - axis])
    medians = np.median(image, axis=1 - axis)
    columns = {
        "yx"[axis]: np.arange(medians.size),
        "mean signal": medians,
        "expected from": np.full(medians.size, middle - reach),
        "expected to": np.full(medians.size, middle + reach),
    }
    return DataTable(columns, {"yx"[axis]: "pixel"} | dict.fromkeys(list(columns)[1:], "DN"), _LINES[axis])


def pattern_spectra(sums: StackSums) -> tuple[DataTable, ...]:
    """Return the power of the means of rows and columns by frequency, over that of unrelated pixels."""
    image, (middle, width) = sums.mean_signal, sums.typical_signal
    image = np.clip(image - middle, -FAR * width, FAR * width)
    found = []
    for axis, line in enumerate(_LINES):
        if image.shape[axis] < FEWEST_LINES:
            continue
        power = np.abs(np.fft.rfft(image.mean(axis=1 - axis))[1:]) ** 2
        chance = max(float(image.var()), 1e-300) * image.shape[axis] / image.shape[1 - axis]
        found.append(_spectrum(power / chance, image.shape[axis], f"pattern_{line}", line))
    return tuple(found)


def line_spectra(sums: StackSums) -> tuple[DataTable, ...]:
    """Return the power of what rows, and columns, do within a frame by frequency, over independent pixels."""
    lines = (sums.rows, sums.columns)
    return tuple(
        _spectrum(_line_power(each, length), length, f"noise_{line}", line)
        for each, length, line in zip(lines, sums.shape, _LINES, strict=True)
        if length >= FEWEST_LINES and each.freedom > 1
    )


def _line_power(lines: Lines, length: int) -> FloatArray:
    """Return the mean power of the sums of lines along the sensor, over that of independent pixels."""
    power, step = np.zeros(length // 2 + 1), max(1, _AT_ONCE // length)
    groups = lines.variance.size // length
    for start in range(0, lines.sums.shape[0] * groups, step):
        frames = slice(start // groups, -(-(start + step) // groups))
        values = lines.centred(frames).reshape(-1, length)[start - groups * frames.start :][:step]
        power += (np.abs(np.fft.rfft(values, axis=1)) ** 2).sum(axis=0)
    power = power[1:] / length
    return np.asarray(power / max(lines.freedom * groups * float(lines.variance.mean()), 1e-300))


def _spectrum(power: FloatArray, length: int, part: str, unit: str) -> DataTable:
    frequency = np.arange(1, power.size + 1) / length
    return DataTable({"frequency": frequency, "power": power}, {"frequency": f"1/{unit}"}, part)


def _series(
    x: FloatArray, y: FloatArray, ends: tuple[FloatArray, FloatArray], what: str, axis: str, width: float
) -> Stack:
    """Return a series in DN over the band of 2 sigma of sampling noise."""
    band = Band(x, *ends, colour="band", label="±2 sigma")
    panel = Panel(Axis(f"{what} (DN)"), (band, Line(x, y, width=width, label=what)))
    return Stack((panel,), Axis(axis), height_mm=44.0)


def _spectra_chart(fixed: Sequence[DataTable], temporal: Sequence[DataTable]) -> Chart:
    stacks = []
    for tables, title in ((fixed, "fixed pattern"), (temporal, "noise")):
        lines = []
        for table in tables:
            line = table.part.split("_")[1]
            # where nothing ever changes there is no power, and no logarithm of it
            power = np.where(table["power"] > 0.0, table["power"], np.nan)
            colour = "blue" if line == "row" else "vermilion"
            lines.append(Line(table["frequency"], power, colour=colour, width=0.8, label=f"{line}s"))
        known = np.concatenate([[1.0], *(line.y[np.isfinite(line.y)] for line in lines)])
        y = Axis("power / expected", min(0.8 * known.min(), 0.09), max(1.25 * known.max(), 11.0), log=True)
        panel = Panel(y, (*lines, _EXPECTED), legend="upper right", columns=2, room=(3.0, 3.0))
        x = Axis("frequency (1/row, 1/column)", 0.0, 0.5)
        stacks.append(Stack((panel,), x, title, height_mm=44.0))
    return Chart(tuple(stacks))
