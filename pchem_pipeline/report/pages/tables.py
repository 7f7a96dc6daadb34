"""The tables of a report, as plain rows of text: results, and what was run on what."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from typing import Any

import numpy as np

from pchem_pipeline.base.wording import (
    MAPS,
    capitalised,
    count,
    heading,
    measured,
    percent,
    scientific,
    short,
    signed,
    unit_text,
)
from pchem_pipeline.discrepancy.quick.checks import QuickLook
from pchem_pipeline.model.fit.status import describe
from pchem_pipeline.model.maps.maps import summarise
from pchem_pipeline.report.data import ReportData, truth_errors
from pchem_pipeline.report.figures.ensemble import HALVES, PREDICTIONS
from pchem_pipeline.report.figures.methods import crossing_text, percent_text
from pchem_pipeline.report.figures.samples import AXES, middle
from pchem_pipeline.report.pages.summary import size_text
from pchem_pipeline.report.style.ranges import finite

#: A row of a table: cells by the heading of their column.
Row = Mapping[str, str]


@dataclass(frozen=True)
class Table:
    """A table: rows of the same columns, the first with the headings of the rows; ``section`` is an id."""

    id: str
    title: str
    caption: str
    rows: Sequence[Row]
    section: str = "tables"

    @property
    def head(self) -> tuple[str, ...]:
        """Headings of the columns."""
        return tuple(self.rows[0]) if self.rows else ()


def result_tables(data: ReportData) -> list[Table]:
    """Return the tables that the data allow: of results, and of what was run on what."""
    makers = (
        _channels, _parameters, _regions, _overscan, _flagged, _against_truth, _moments, _misfits, _intervals,
        _samples, _plan, _quick_look, _run, _stages, _inputs,
    )  # fmt: skip
    return [table for make in makers if (table := make(data)) is not None and table.rows]


def _quick_look(data: ReportData) -> Table:
    look = data.quick_look or QuickLook(())
    missing = "".join(f" Not tested: {part} ({why})." for part, why in look.missing.items())
    return Table(
        "quick-look",
        "Quick look",
        "Under the model, samples of different pixels and frames are independent. This is tested for all "
        f"pixels from sums that every run keeps; p-values are corrected for the number of checks.{missing}",
        [
            {
                "check": capitalised(check.title),
                "found": ("in the model" if check.in_model else "yes") if check.found else "no",
                "size": size_text(check) if check.found else "",
                "detection limit": size_text(
                    replace(check, size=check.limit, size_e=math.nan, share=math.nan)
                )
                if math.isfinite(check.limit)
                else "not known",
                "p-value": _chance_text(check.p_global),
                "where": check.where if check.found else "",
            }
            for check in look.checks
        ],
        "discrepancy",
    )


def _chance_text(p: float) -> str:
    return "< 10⁻⁶" if p < 1e-6 else short(p, 2) if p > 1e-3 else scientific(p, 1)


def _parameters(data: ReportData) -> Table:
    return Table(
        "parameters",
        "Parameters",
        f"Median over the {data.noun}s with its standard error, robust standard deviation between "
        f"{data.noun}s (1.4826 MAD), median 1 sigma error per {data.noun}, percentiles, and outliers beyond "
        f"{data.outlier_sigmas:g} robust standard deviations.{_left_out(data)}",
        [
            {
                "parameter": heading(name),
                "median": measured(summary.median, summary.median_stderr),
                "spread": short(summary.robust_sd),
                f"error per {data.noun}": "not known" if error is None else short(error, 2),
                **{f"{p:g} %": short(value, 4) for p, value in summary.percentiles.items() if p != 50.0},
                "outliers": f"{summary.n_low + summary.n_high:,}",
                "pixels": f"{summary.n_valid:,}",
            }
            for name in _known(data)
            for summary, error in [(data.summary(name), data.pixel_error(name))]
        ],
    )


def _regions(data: ReportData) -> Table:
    rows = [
        {"region": name, "where": region.describe()}
        | {heading(m): measured(found[m].median, found[m].median_stderr) for m in MAPS if m in found}
        | {"pixels": f"{region.mask(data.shape).sum():,}"}
        for name, region in data.regions.items()
        for found in [data.in_region(name)]
    ]
    words = "Median of each parameter with its standard error, in the parts of the sensor of report.regions."
    return Table("regions", "Regions", words, rows)


def _overscan(data: ReportData) -> Table:
    found, rows = data.overscan_medians, []
    for name in data.overscan:
        row = {"parameter": heading(name)}
        for head, where in (("overscan", "overscan"), ("other pixels", "active")):
            cell = found[name].get(where)
            row[head] = measured(cell["median"], cell["median_stderr"]) if cell else "not known"
        rows.append(row)
    noises = [f"{key} noise {short(found[f'{key}_noise_dn'])} DN" for key in ("row", "frame") if rows]
    return Table(
        "overscan",
        "Overscan",
        "Medians with their standard errors. Of pixels without electrons: mean and standard deviation of "
        f"their codes, {' and '.join(noises)} included. They are in no other table.",
        rows,
    )


def _known(data: ReportData) -> list[str]:
    """Return the maps that have values, in the order of the tables."""
    return [name for name in MAPS if data.has_values(name)]


def _left_out(data: ReportData) -> str:
    flagged = int(data.flagged.sum())
    return f" {count(flagged, f'flagged {data.noun}')} excluded (see the table below)." if flagged else ""


def _flagged(data: ReportData) -> Table:
    """Return what flagged pixels read; their errors are no errors and are not shown."""
    rows = []
    for name in _known(data) if data.flagged.any() else ():
        flagged = data.flagged_in(name)
        if not flagged.any():
            continue
        summary = summarise(data.maps[name][flagged], percentiles=(5.0, 95.0))
        numbers = {"median": summary.median}
        numbers |= {f"{p:g} %": value for p, value in summary.percentiles.items()}
        numbers |= {"smallest": summary.minimum, "largest": summary.maximum}
        cells = {head: short(number, 4) for head, number in numbers.items()}
        rows.append({"parameter": heading(name), **cells, f"{data.noun}s": f"{summary.n_valid:,}"})
    return Table(
        "flagged",
        f"Flagged {data.noun}s",
        "The data do not fix these values: they can be off by an electron or more, far beyond their standard "
        "errors. Excluded from the other tables.",
        rows,
    )


def _channels(data: ReportData) -> Table | None:
    if data.shape[0] > 1 or data.shape[1] > 100:
        return None  # the maps of the store have them all
    labels = [*data.channel_names, *[""] * data.shape[1]]
    rows = [
        {"channel": f"{x} {label}".strip()}
        | {heading(name): measured(*data.estimate(name, 0, x)) for name in _known(data)}
        | {"fit status": describe(int(data.status[0, x]))}
        for x, label in enumerate(labels[: data.shape[1]])
    ]
    return Table("channels", "Channels", "Estimates with their standard errors.", rows)


def _against_truth(data: ReportData) -> Table:
    return Table(
        "truth",
        "Estimates against the truth",
        "Simulated data only. Pull: (estimate − truth) / standard error; mean 0 if estimates are unbiased, "
        f"scatter (standard deviation) 1 if errors are correct.{_left_out(data)}",
        [
            {
                "parameter": heading(name),
                "true median": short(found.true_median, 4),
                "estimated median": short(found.median, 4),
                "RMSE": short(found.rmse),
                "mean pull": measured(float(pull.mean()), n**-0.5) if n else "not known",
                "scatter of pulls": measured(float(pull.std()), (2 * n) ** -0.5) if n else "not known",
            }
            for name, found in truth_errors(data).items()
            for pull, n in [(found.pulls, found.pulls.size)]
        ],
    )


#: RMSE of each prediction of the ensemble, and of the sampling noise beside them, to words and unit.
RMSES = {
    name: (f"{half.words.removesuffix(' data')}, {words}", f"1/{unit_text(half.unit)}")
    for half in HALVES
    for name, words in (
        *((f"{half.model}{each}", words) for each, (words, *_) in reversed(PREDICTIONS.items())),
        (f"{half.data}noise_floor", "sampling noise alone"),
    )
}


def _moments(data: ReportData) -> Table:
    return Table(
        "moments",
        "Moments of the ensemble",
        "From the parameter maps (Hendrickson et al. 2023, Appendix A) and from the data with their "
        f"standard error.{_bias_remark(data)}",
        [_moment_row(row) for row in data.moments],
        "ensemble",
    )


def _bias_remark(data: ReportData) -> str:
    """Return how pixels count whose bias may be an electron off; empty where there are none."""
    lost = float(data.ensemble_facts.get("pixels_of_open_bias", 0.0))
    if lost < 0.05:
        return ""
    return (
        " In the variance of the bias, pixels whose bias can be off by an electron have a lower weight "
        "(tanh(d/2), d: log-likelihood ratio to the next best fit; 0 if it can be off by more or the gain is "
        f"open): {short(lost, 2)} {data.noun}s fewer in total."
    )


def _moment_row(row: Mapping[str, Any]) -> Row:
    unit = unit_text(str(row.get("unit", "")))
    observed, error = row.get("observed"), row.get("stderr")
    predicted = float(row["predicted"])
    expected, seen, difference = short(predicted, 3 if observed is None else 5), "", ""
    if observed is not None and error:
        # to the digits of the data that it is compared with
        expected = measured(predicted, float(error)).partition(" ±")[0]
        seen = measured(float(observed), float(error))
        difference = signed((float(observed) - predicted) / float(error))
    elif observed is not None:
        seen = short(float(observed), 5)
    return {
        "moment": f"{row['quantity']} ({unit})" if unit else str(row["quantity"]),
        "from the maps": expected,
        "from the data": seen,
        "difference in standard errors": difference,
    }


def _misfits(data: ReportData) -> Table | None:
    facts = data.misfits
    if not facts.get("worst"):
        return None
    return Table(
        "misfits",
        f"Worst {data.noun}s",
        f"{int(facts['misfits']):,} of {int(facts['tested']):,} tested {data.noun}s disagree with the model "
        f"at a false-discovery rate of {facts['false_discovery_rate']:g} (Benjamini and Hochberg 1995). "
        f"{count(int(facts['pixels_with_outliers']), data.noun)} with excluded samples, at most "
        f"{percent(float(facts['largest_outlier_share']))} of their frames.",
        [
            {
                data.noun: f"channel {row['x']}" if data.shape[0] == 1 else f"y = {row['y']}, x = {row['x']}",
                "χ²": f"{row['chi2']:.1f}",
                "degrees of freedom": f"{row['dof']:.1f}".removesuffix(".0"),
                "p": _chance_text(float(row["p"])),
                "q": _chance_text(float(row["q"])),
                "misfit": "yes" if float(row["q"]) <= float(facts["false_discovery_rate"]) else "no",
            }
            for row in facts["worst"]
        ],
        "goodness",
    )


def _intervals(data: ReportData) -> Table:
    words = (
        f"Median 1 sigma error per {data.noun}, and the share of the map's variance that is noise of the "
        "estimates; near 100 % the map shows only noise: take more frames."
    )
    if data.intervals:
        words += (
            f" Profile: distance of the ends of the {100 * data.interval_level:g} % profile-likelihood "
            "interval from the estimate, in standard errors."
        )
    rows = []
    for name in _known(data):
        error, summary = data.pixel_error(name, with_flagged=True), data.summary(name, with_flagged=True)
        if error is None:
            continue
        # both robust: the median squared error over (1.4826 MAD)^2
        known = summary.n_valid >= 8 and summary.robust_sd > 0
        noise = percent(min(error**2 / summary.robust_sd**2, 1.0)) if known else "not known"
        row = {
            "quantity": heading(name),
            f"error per {data.noun}": short(error, 3),
            "relative error": percent(error, abs(summary.median)),
            "noise in the map": noise,
        }
        if data.intervals:
            ends = ["", ""]
            if name in data.intervals:
                values, errors = data.maps[name], data.maps[f"{name}_stderr"]
                low, high = data.intervals[name]
                ends = [short(float(np.nanmedian(part / errors))) for part in (values - low, high - values)]
            row |= dict(zip(("profile: below", "profile: above"), ends, strict=True))
        rows.append(row)
    return Table("uncertainties", "Uncertainties", words, rows, "uncertainty")


def _samples(data: ReportData) -> Table | None:
    found, rows = data.samples, []
    if found is None:
        return None
    words, unit, *_ = AXES.get(found.against, ("exposure", ""))
    for i, sample in enumerate(found.samples):
        centre, error, *_ = middle(found.arrays["quanta_exposure"][i])
        residual = share = "–"
        if sample.x is not None and len(found.on_line) > 2 and "linearity_residual" in found.arrays:
            rest, rest_error, *_ = middle(found.arrays["linearity_residual"][i])
            residual = measured(rest, rest_error)
            if centre > 0:
                share = f"{100.0 * rest / centre:+.2f} %".replace("-", "−")
        rows.append(
            {
                "sample": sample.name,
                f"{words} ({unit})" if unit else words: "–" if sample.x is None else f"{sample.x:g}",
                "frames": f"{sample.n_frames:,}",
                "H (e⁻)": "0 (bias)" if sample.kind == "bias" else measured(centre, error),
                "residual (e⁻)": residual,
                "residual / H": share,
            }
        )
    p = finite(found.arrays.get("linearity_p", np.empty(0)))
    off = percent(int((p < 0.01).sum()), p.size)
    remark = f" {off} of the {data.noun}s are off the line (p < 0.01; 1 % expected)." if p.size else ""
    return Table(
        "samples",
        "Samples",
        f"Medians over the {data.noun}s, with their standard errors.{remark}",
        rows,
        "exposures",
    )


def _plan(data: ReportData) -> Table | None:
    plan = data.plan
    if plan is None:
        return None
    rows = []
    for row in plan["rows"]:
        target = row["target"].replace("_e to", " (e⁻) to").replace("_", " ").replace("e-", "e⁻")
        frames = f"{row['frames']:,.0f}" if math.isfinite(row["frames"]) else "none suffice"
        unit, scale = ("e⁻", 1.0) if row["name"] == "bias" else ("%", 100.0)
        reached = plan["reached"].get(row["name"])
        text = "" if reached is None else f"{short(scale * reached, 2)} {unit}"
        rows.append({"precision": target, "frames needed": frames, "this run's": text})
    return Table(
        "plan-table",
        "Frames for a precision",
        f"Cramer-Rao bound for the median pixel (H = {short(plan['exposure'])} e⁻, read noise "
        f"{short(plan['read_noise'])} e⁻). "
        "Best exposure, other sensors, several samples, check by simulation: pchem plan.",
        rows,
        "plan",
    )


def _bytes_text(size: float) -> str:
    if size >= 1e9:
        return f"{size / 1e9:.2f} GB"
    return f"{size / 1e6:.1f} MB" if size >= 1e5 else f"{size / 1e3:.1f} kB"


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[Row]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}: ")
        else:
            several = isinstance(value, Sequence) and not isinstance(value, str)
            text = ", ".join(map(str, value)) if several else "not known" if value is None else str(value)
            yield {"item": f"{prefix}{key}", "value": text}


def _run(data: ReportData) -> Table:
    return Table("run", "Run", "Program and settings of this report.", list(_flat(data.run)), "provenance")


def _stages(data: ReportData) -> Table:
    words = "Wall time, CPU time and largest resident memory of a process."

    def text(stage: Mapping[str, Any], key: str, words: str = "{}", unit: float | None = None) -> str:
        value = stage.get(key)
        return "" if value is None else words.format(value if unit is None else float(value) / unit)

    rows = [
        {
            "stage": text(stage, "stage"),
            "state": text(stage, "state"),
            "wall": text(stage, "seconds", "{:.1f} s", 1.0),
            "CPU": text(stage, "cpu_seconds", "{:.1f} s", 1.0),
            "peak memory": text(stage, "peak_memory_bytes", "{:.0f} MiB", 2**20),
            "started (UTC)": text(stage, "started"),
        }
        for stage in data.stages
    ]
    return Table("stages", "Stages", words, rows, "provenance")


#: Files that are listed at most.
_MOST_FILES = 200


def _inputs(data: ReportData) -> Table:
    more = len(data.inputs) - _MOST_FILES
    words = f" The first {_MOST_FILES} of {len(data.inputs):,} files." if more > 0 else ""
    return Table(
        "inputs",
        "Input files",
        f"Names, sizes and content hashes of the files that were read.{words}",
        [
            {
                "file": str(entry.get("name", "")),
                "size": _bytes_text(float(entry["size"])) if entry.get("size") is not None else "",
                "hash": str(entry.get("hash", "")),
            }
            for entry in data.inputs[:_MOST_FILES]
        ],
        "provenance",
    )


#: Heading of each column of the comparison of methods on the page, and in the terminal.
_HEADS = {
    "method": "method",
    "pixels with a result": "pixels",
    "median g (e⁻/DN)": "g, e-/DN",
    "bias of g (%)": "g bias %",
    "rms error of g (%)": "g rms %",
    "robust spread of g (1.4826 MAD, %)": "g spread %",
    "bound (%)": "g bound %",
    "error / bound": "rms/bound",
    "rms error of the read noise (%)": "noise rms %",
    "rms error of H (%)": "H rms %",
    "µs per pixel": "µs/pixel",
}


def methods_text(result: Mapping[str, Any]) -> str:
    """Return the comparison in ``methods.json`` as the command prints it."""
    against = {"truth": "the truth", "fit": "this run's fit of the same frames"}[result["reference"]]
    lines = [f"{result['pixels']:,} pixels, errors against {against}"]
    lines += [f"sample {i}: {_sample(sample)}" for i, sample in enumerate(result["samples"])]
    first, *others = _HEADS.values()
    head = f"{first:<30}" + "".join(f"{column:>12}" for column in others)
    lines += ["", head, "-" * len(head)]
    for row in method_rows(result):
        lines.append(
            f"{row[0]:<30}" + (f"  {row[1]}" if len(row) == 2 else "".join(f"{c:>12}" for c in row[1:]))
        )
    if result["study"]:
        lines += ["", *textwrap.wrap(crossing_text(result["study"]), 100)]
    return "\n".join(lines)


def _sample(sample: Mapping[str, Any]) -> str:
    exposure = sample["quanta_exposure"]
    words = "exposure not known" if exposure is None else f"H = {exposure:.3g} e-"
    return f"{sample['run']}, {sample['n_frames']:,} frames, {words}"


def method_rows(result: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a row for every method in ``methods.json``: title and numbers, or title and why it was not run.

    Against a fit of the same frames an error is no multiple of the bound: the reference errs too.
    """
    rows: list[tuple[str, ...]] = []
    for method in result["methods"]:
        if method["missing"]:
            rows.append((method["title"], method["missing"]))
            continue
        cells = ["reference", *[""] * 6]
        if errors := method["errors"]:
            gain = errors["conversion_gain"]
            known = result["reference"] == "truth" and gain["rmse"] is not None and gain["bound"]
            cells = [percent_text(gain[name]) for name in ("bias", "rmse", "robust_sd", "bound")]
            cells.append(f"{gain['rmse'] / gain['bound']:.2f}" if known else "-")
            cells += [percent_text(errors[name]["rmse"]) for name in ("read_noise_e", "quanta_exposure")]
        median = method["medians"]["conversion_gain"]
        value = "-" if median is None else f"{median:.5g}"
        time = f"{1e6 * method['seconds_per_pixel']:.0f}"
        rows.append((method["title"], f"{method['n_answered']:,}", value, *cells, time))
    return rows


def method_tables(data: ReportData) -> list[Table]:
    """Return the table of the comparison, where one was made."""
    result = data.methods
    if result is None:
        return []
    against = {"truth": "the truth", "fit": "the fit of this run, from the same frames"}[result["reference"]]
    rows = [dict(zip_longest(_HEADS, row, fillvalue="")) for row in method_rows(result)]
    remarks = " ".join(f"{capitalised(remark)}." for remark in result["remarks"])
    verdict = f"{capitalised(crossing_text(result['study']))}." if result["study"] else ""
    pixels = f"The same {result['pixels']:,} {data.noun}s for every method; errors against {against}."
    caption = f"{pixels} {verdict} {remarks}".strip().replace(" e-", " e⁻")
    return [Table("methods-table", "Methods", caption, rows, "methods")]
