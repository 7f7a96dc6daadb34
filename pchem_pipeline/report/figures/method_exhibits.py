"""The comparison of methods in the report: its figure and its table."""

from __future__ import annotations

from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.exhibits import Exhibit, drawing
from pchem_pipeline.report.figures.method_figures import gain_error
from pchem_pipeline.report.pages.method_words import method_rows, verdict_words
from pchem_pipeline.report.pages.tables import Table
from pchem_pipeline.report.style.style import PAGE_MM

__all__ = ["METHOD_FIGURE", "method_exhibits", "method_tables"]

#: Name of the figure's files.
METHOD_FIGURE = "methods_gain_error"

_CAPTION = (
    "Left or top: simulated pixels at the exposure and gain of this run, as many frames in total for "
    "every method; hollow symbols: more than a tenth of the pixels got no answer. Lines without symbols "
    "are the smallest errors possible (Cramer-Rao), from one sample and from a dark and a bright one; the "
    "dotted line is where photon transfer begins to beat that of one sample. Right or bottom: pixels of "
    "this run; filled: root mean square error, hollow: robust scatter, bar: bound. "
    "Errors above 180 % are drawn there."
)
_HEAD = (
    "method",
    "pixels with an answer",
    "median g (e⁻/DN)",
    "bias of g (%)",
    "rms error of g (%)",
    "bound (%)",
    "error / bound",
    "rms error of the read noise (%)",
    "rms error of H (%)",
    "µs per pixel",
)


def method_exhibits(data: ReportData) -> list[Exhibit]:
    """Return the figure of the comparison, where one was made."""
    result = data.methods
    if result is None:
        return []
    words = [f"{row[0]}: {row[4]} %" for row in method_rows(result) if len(row) > 2 and row[4]]
    crossing = f" {verdict_words(result['study'])}." if result["study"] else ""
    return [
        Exhibit(
            METHOD_FIGURE,
            "methods",
            "Error of the conversion gain by each method",
            _CAPTION,
            f"Root mean square error of the gain on this run's pixels. {'; '.join(words)}.{crossing}",
            drawing(gain_error, result),
            PAGE_MM,
        )
    ]


def method_tables(data: ReportData) -> list[Table]:
    """Return the table of the comparison, where one was made."""
    result = data.methods
    if result is None:
        return []
    against = {"truth": "the truth", "fit": "the fit of this run, from the same frames"}[result["reference"]]
    rows = [row if len(row) > 2 else (*row, *[""] * (len(_HEAD) - 2)) for row in method_rows(result)]
    remarks = " ".join(f"{remark[0].upper()}{remark[1:]}." for remark in result["remarks"])
    verdict = verdict_words(result["study"]) if result["study"] else ""
    caption = (
        f"The same {result['pixels']:,} {data.noun}s for every method; errors against {against}. "
        f"{f'{verdict[0].upper()}{verdict[1:]}.' if verdict else ''} {remarks}"
    ).strip()
    caption = caption.replace(" e-", " e⁻")
    return [Table("methods-table", "Methods", caption, _HEAD, tuple(rows), section="methods")]
