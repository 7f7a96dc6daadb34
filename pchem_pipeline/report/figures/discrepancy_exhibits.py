"""The figures of the discrepancy page with their titles, captions and alternative texts."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from pchem_pipeline.discrepancy.verdict import Pull, Verdict
from pchem_pipeline.report.figures import discrepancy_gap, discrepancy_maps, discrepancy_series
from pchem_pipeline.report.figures.exhibits import Exhibit, drawing
from pchem_pipeline.report.pages.discrepancy_data import CHANNELS, DiscrepancyData
from pchem_pipeline.report.pages.discrepancy_text import CAPTIONS, gap_words
from pchem_pipeline.report.style.ranges import finite
from pchem_pipeline.report.style.style import PAGE_MM
from pchem_pipeline.report.style.wording import count, short

__all__ = ["DISCREPANCY_NAMES", "discrepancy_exhibits", "telling_pulls"]

#: Names of all figures that the page can have, in their order.
DISCREPANCY_NAMES = (
    "discrepancy_maps",
    "discrepancy_codes",
    "discrepancy_frames",
    "discrepancy_lines",
    "discrepancy_gap",
    "discrepancy_pulls",
)

#: Statistics in the figure of pulls.
_MOST_PULLS = 12


def discrepancy_exhibits(data: DiscrepancyData) -> list[Exhibit]:
    """Return the figures that the data allow; ``section`` is the id of a part of the page."""
    makers = (_maps, _codes, _frames, _lines, _gap, _pulls)
    return [exhibit for make in makers for exhibit in make(data)]


def telling_pulls(data: DiscrepancyData) -> list[Pull]:
    """Return the statistics farthest from chance before and after.

    Those that the JSON tells, else those of the vectors ``z_before`` and ``z_after``.
    """
    found = data.found
    rows: dict[str, Pull] = {}
    for step in found.steps:
        for pull in step.pulls:
            known = rows.get(pull.statistic, pull)
            after = pull.after if math.isfinite(pull.after) else known.after
            rows[pull.statistic] = known.model_copy(update={"after": after})
    if not rows and "z_before" in data.arrays:
        before = np.asarray(data.arrays["z_before"], dtype=np.float64)
        after_all = np.asarray(data.arrays.get("z_after", np.full(before.size, np.nan)), dtype=np.float64)
        for i, (name, (_, sentence)) in enumerate(data.statistics.items()):
            if i < before.size and np.isfinite(before[i]):
                later = float(after_all[i]) if i < after_all.size else math.nan
                rows[name] = Pull(statistic=name, sentence=sentence, before=float(before[i]), after=later)

    def far(pull: Pull) -> float:
        return max((abs(v) for v in (pull.before, pull.after) if math.isfinite(v)), default=0.0)

    return sorted(rows.values(), key=far, reverse=True)[:_MOST_PULLS]


def _has(data: DiscrepancyData, *names: str) -> bool:
    return all(name in data.arrays and data.arrays[name].size for name in names)


def _exhibit(
    name: str, part: str, title: str, alt: str, draw: Callable[[float], Figure], raster: bool = False
) -> list[Exhibit]:
    return [Exhibit(name, part, title, CAPTIONS[name], alt, draw, PAGE_MM, raster)]


def _maps(data: DiscrepancyData) -> list[Exhibit]:
    maps = [each for each in discrepancy_maps.telling_maps(data.arrays) if finite(each.z).size]
    if not maps:
        return []
    flagged = [pixel for place in data.found.where for pixel in place.pixels]
    words = []
    for each in maps:
        known = finite(each.z)
        words.append(
            f"{each.words}: mean {known.mean():+.2f}, standard deviation {known.std():.2f} (by chance 0 "
            f"and 1), {count(each.outliers, 'pixel')} beyond 5"
        )
    return _exhibit(
        "discrepancy_maps",
        "where",
        "On the sensor",
        "Maps in standard deviations of chance. " + "; ".join(words).replace("-", "−") + ".",
        drawing(discrepancy_maps.pixel_maps, maps, flagged=flagged, origin=data.found.examined.origin),
        raster=True,
    )


def _codes(data: DiscrepancyData) -> list[Exhibit]:
    if not _has(data, "code_dn", "code_observed", "code_expected"):
        return []
    dn, residual = discrepancy_series.code_residuals(data.arrays)
    if dn.size == 0:
        return []
    order = np.argsort(-np.abs(residual))[:3]
    largest = ", ".join(f"{residual[i]:+.1f} at {dn[i]:.0f} DN" for i in order).replace("-", "−")
    even = dn % 2 == 0
    comb = "not known"
    if even.any() and (~even).any():
        comb = f"{residual[even].mean():+.2f} on even and {residual[~even].mean():+.2f} on odd DN"
    alt = (
        f"Counts from {dn[0]:.0f} to {dn[-1]:.0f} DN and their residuals in standard deviations: root mean "
        f"square {np.sqrt(np.mean(residual**2)):.2f} (by chance below 1); largest {largest}; mean "
        f"{comb.replace('-', '−')}."
    )
    return _exhibit(
        "discrepancy_codes",
        "where",
        "Along the digital numbers",
        alt,
        drawing(discrepancy_series.codes, data.arrays, marked=data.found.where),
    )


def _frames(data: DiscrepancyData) -> list[Exhibit]:
    if not _has(data, "frame_number", "frame_charge", "frame_readout"):
        return []
    arrays = data.arrays
    sds = np.asarray(arrays.get("frame_sd", np.full(2, np.nan)), dtype=np.float64)
    words = []
    for channel, sd, scale, unit in zip(CHANNELS, sds, (100.0, 1.0), ("%", "DN"), strict=True):
        values = np.asarray(arrays[f"frame_{channel}"], dtype=np.float64)
        centre, mean, _ = discrepancy_series.trends(arrays["frame_number"], values)
        drift = float(np.polyfit(centre, mean, 1)[0] * np.ptp(centre)) if centre.size > 2 else math.nan
        chance = f" (by chance {short(scale * float(sd))})" if np.isfinite(sd) else ""
        words.append(
            f"{channel}: standard deviation {short(scale * float(values.std()))} {unit}{chance}, change "
            f"along the run {short(scale * drift)} {unit}"
        )
    path = "; the path of the named effects is drawn over them" if _has(data, "frame_readout_model") else ""
    return _exhibit(
        "discrepancy_frames",
        "where",
        "Along time",
        f"Means of {count(int(arrays['frame_number'].size), 'frame')}. {'; '.join(words)}{path}.",
        drawing(discrepancy_series.frame_strip, arrays, marked=data.found.where),
    )


def _lines(data: DiscrepancyData) -> list[Exhibit]:
    there = [line for line in discrepancy_maps.LINE_WORDS if _has(data, f"{line}_rms")]
    if not there:
        return []
    words = [_line_words(line, np.asarray(data.arrays[f"{line}_rms"])) for line in there]
    return _exhibit(
        "discrepancy_lines",
        "where",
        "Rows and columns",
        "Scatter of the means over the frames, relative to chance (1). " + "; ".join(words) + ".",
        drawing(discrepancy_maps.line_pictures, data.arrays, origin=data.found.examined.origin),
        raster=True,
    )


def _line_words(line: str, rms: np.ndarray[Any, Any]) -> str:
    found = []
    for channel, values in zip(CHANNELS, rms, strict=False):
        known = finite(values)
        if known.size:
            found.append(f"{channel} median {np.median(known):.2f}, largest {known.max():.2f}")
    return f"{discrepancy_maps.LINE_WORDS[line]}: {' and '.join(found) or 'not known'}"


def _pulls(data: DiscrepancyData) -> list[Exhibit]:
    rows = telling_pulls(data)
    if not rows:
        return []
    return _exhibit(
        "discrepancy_pulls",
        "shown",
        "The most telling statistics, before and after",
        f"Standard deviations of chance. {_pull_words(rows)}.",
        drawing(discrepancy_gap.pulls, rows),
    )


def _pull_words(rows: Sequence[Pull]) -> str:
    words = []
    for row in rows[:6]:
        after = f", after {row.after:+.1f}" if math.isfinite(row.after) else ""
        before = f"{row.before:+.1f}" if math.isfinite(row.before) else "not known"
        words.append(f"{row.sentence or row.statistic}: before {before}{after}")
    return "; ".join(words).replace("-", "−")


def _gap(data: DiscrepancyData) -> list[Exhibit]:
    found = data.found
    if not discrepancy_gap.gap_bars(found):
        return []
    return _exhibit(
        "discrepancy_gap",
        "shown",
        "The gap against its floor",
        f"Gap in 10⁻⁶ nats per sample: {_gap_alt(found)}.",
        drawing(discrepancy_gap.gap, found),
    )


def _gap_alt(found: Verdict) -> str:
    words = [
        f"{bar.words} {short(bar.gap)}"
        + (f" ({short(bar.low)} to {short(bar.high)})" if math.isfinite(bar.low + bar.high) else "")
        for bar in discrepancy_gap.gap_bars(found)
    ]
    return "; ".join([*words, f"floor {gap_words(found.gap.floor)}"])
