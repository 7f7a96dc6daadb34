"""The comparison of methods in words and tables: on the command line and on the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.methods import crossing_text, gain_rmse, percent_text
from pchem_pipeline.report.pages.tables import Table

_COLUMNS = (
    "pixels",
    "g, e-/DN",
    "g bias %",
    "g rmse %",
    "g spread %",
    "g bound %",
    "rmse/bound",
    "s_e rmse %",
    "H rmse %",
    "us/pixel",
)


_HEAD = (
    "method",
    "pixels with a result",
    "median g (e⁻/DN)",
    "bias of g (%)",
    "rms error of g (%)",
    "robust spread of g (1.4826 MAD, %)",
    "bound (%)",
    "error / bound",
    "rms error of the read noise (%)",
    "rms error of H (%)",
    "µs per pixel",
)


def methods_text(result: Mapping[str, Any]) -> str:
    """Return the comparison as the command prints it.

    Args:
        result: content of ``methods.json``.
    """
    against = {"truth": "the truth", "fit": "this run's fit of the same frames"}[result["reference"]]
    lines = [f"{result['pixels']:,} pixels, errors against {against}"]
    lines += [f"sample {i}: {_sample(sample)}" for i, sample in enumerate(result["samples"])]
    head = f"{'method':<34}" + "".join(f"{column:>12}" for column in _COLUMNS)
    lines += ["", head, "-" * len(head)]
    for row in method_rows(result):
        lines.append(
            f"{row[0]:<34}" + (f"  {row[1]}" if len(row) == 2 else "".join(f"{c:>12}" for c in row[1:]))
        )
    if result["study"]:
        at = result["study_at"]
        lines += [
            "",
            f"simulated, H = {at['quanta_exposure']:.3g} e-, {at['n_frames']:,} frames for every method, "
            f"{at['n_pixels']} pixels at each read noise: rmse of g in %",
            *_study_lines(result["study"]),
            "",
            crossing_text(result["study"]),
        ]
    return "\n".join(lines)


def _sample(sample: Mapping[str, Any]) -> str:
    exposure = sample["quanta_exposure"]
    words = "exposure not known" if exposure is None else f"H = {exposure:.3g} e-"
    return f"{sample['run']}, {sample['n_frames']:,} frames, {words}"


def method_rows(result: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """Return a row of text for every method: title and numbers, or title and why it was not run.

    Against a fit of the same frames an error is no multiple of the bound: the reference errs too.

    Args:
        result: content of ``methods.json``.
    """
    rows: list[tuple[str, ...]] = []
    for method in result["methods"]:
        if method["missing"]:
            rows.append((method["title"], method["missing"]))
            continue
        errors = method["errors"]
        gain = errors.get("conversion_gain", {})
        ratio = _ratio(gain.get("rmse"), gain.get("bound")) if result["reference"] == "truth" else "-"
        if not errors:
            cells = ["reference", *[""] * 6]
        else:
            cells = [percent_text(gain.get(name)) for name in ("bias", "rmse", "robust_sd", "bound")]
            cells += [
                ratio,
                *(percent_text(errors[name]["rmse"]) for name in ("read_noise_e", "quanta_exposure")),
            ]
        time = f"{1e6 * method['seconds_per_pixel']:.0f}"
        gain_value = method["medians"]["conversion_gain"]
        value = "-" if gain_value is None else f"{gain_value:.5g}"
        rows.append((method["title"], f"{method['n_answered']:,}", value, *cells, time))
    return rows


def _ratio(value: float | None, bound: float | None) -> str:
    return "-" if value is None or not bound else f"{value / bound:.2f}"


def _study_lines(study: Sequence[Mapping[str, Any]]) -> list[str]:
    titles = {name: method["title"] for name, method in study[0]["methods"].items()}
    lines = [f"{'read noise, e-':<34}" + "".join(f"{point['read_noise_e']:>9g}" for point in study)]
    for name, title in titles.items():
        cells = [percent_text(gain_rmse(point, name)) for point in study]
        lines.append(f"{title:<34}" + "".join(f"{cell:>9}" for cell in cells))
    for name in ("one sample", "a dark and a bright sample"):
        cells = [percent_text(point["bounds"][name]) for point in study]
        lines.append(f"{'bound, ' + name:<34}" + "".join(f"{cell:>9}" for cell in cells))
    return lines


def method_tables(data: ReportData) -> list[Table]:
    """Return the table of the comparison, where one was made."""
    result = data.methods
    if result is None:
        return []
    against = {"truth": "the truth", "fit": "the fit of this run, from the same frames"}[result["reference"]]
    rows = [row if len(row) > 2 else (*row, *[""] * (len(_HEAD) - 2)) for row in method_rows(result)]
    remarks = " ".join(f"{remark[0].upper()}{remark[1:]}." for remark in result["remarks"])
    verdict = crossing_text(result["study"]) if result["study"] else ""
    caption = (
        f"The same {result['pixels']:,} {data.noun}s for every method; errors against {against}. "
        f"{f'{verdict[0].upper()}{verdict[1:]}.' if verdict else ''} {remarks}"
    ).strip()
    caption = caption.replace(" e-", " e⁻")
    return [Table("methods-table", "Methods", caption, _HEAD, tuple(rows), section="methods")]
