"""The report: one HTML file without network access, and ``report.json``.

The sections of the page are in one list, :data:`PAGE`, from top to bottom; the table of contents follows it.
A further one of figures and tables is a row; these name its id. One of another kind has a template
``section_<kind>.html.j2``, and what that shows comes from :data:`CONTENT`.
What a paper would say of the run, and cite, is at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from typing import Any

from pchem_pipeline.base.wording import symbol
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.catalogue import discrepancy_figures, report_figures
from pchem_pipeline.report.figures.figure import Figure, is_strip
from pchem_pipeline.report.figures.samples import AXES, slope_of
from pchem_pipeline.report.inspector import embedded, text_of
from pchem_pipeline.report.pages.discrepancy import DISCREPANCY_PAGE, evidence, finding
from pchem_pipeline.report.pages.emva import emva_tables
from pchem_pipeline.report.pages.page import DrawAll, Finding, Section, draw_here, render_page
from pchem_pipeline.report.pages.report_json import report_json
from pchem_pipeline.report.pages.summary import (
    answers,
    flags,
    key_numbers,
    next_steps,
    pixel_counts,
    sentence,
)
from pchem_pipeline.report.pages.tables import Table, method_tables, result_tables

#: The sections from top to bottom.
PAGE = (
    Section(
        "summary",
        "Is the sensor within limits, and are these results reliable?",
        name="Summary",
        kind="summary",
    ),
    Section(
        "maps",
        "Parameter maps",
        "Rank-based colours (histogram-equalised); labels at minimum, median ± 1 sigma and maximum. Blue "
        "line: median.",
    ),
    # its data are at the end of the page
    Section("inspector", "Look at pixels", kind="inspector"),
    Section(
        "exposures",
        "Exposures",
        "Each exposure has its own H. Slope against {against}: {noun}; offset: {offset} (or electrons in "
        "the bias stack).",
        empty="",
    ),
    Section(
        "photon-transfer",
        "Photon transfer",
        "Variance against mean. Points off the curve: nonlinearity, or samples of different gain.",
        empty="",
    ),
    Section(
        "stability", "Stability and structure", "Drift in time, fixed-pattern noise, row and column noise."
    ),
    Section("status", "Fit status"),
    Section("discrepancy", "What the model is missing", kind="discrepancy"),
    Section(
        "pixels", "Single pixels", "Histograms with the fitted photon counting distribution.", folded=True
    ),
    Section(
        "goodness",
        "Does the model describe each pixel?",
        "Chi-square of merged bins; misfits at a given false-discovery rate. Samples far outside the model "
        "(cosmic rays, glitches) are excluded from the fit.",
        folded=True,
    ),
    Section(
        "ensemble",
        "The sensor as a whole",
        "If the model holds, the parameters of the pixels predict the ensemble.",
        folded=True,
    ),
    Section(
        "electrons",
        "Electron numbers",
        "Most probable electron number of each sample of the ensemble.",
        folded=True,
    ),
    Section(
        "components",
        "Why the peaks of the ensemble blur",
        "Where the gain differs between pixels, peaks widen with the electron number.",
        folded=True,
    ),
    Section("uncertainty", "How precise are the numbers?", folded=True),
    Section(
        "methods",
        "Comparison with other methods",
        "The same pixels analysed by methods of the literature, and the smallest possible errors.",
        folded=True,
    ),
    Section("plan", "How many frames are enough?", folded=True),
    Section("tables", "Tables", empty="No pixel has a value.", folded=True),
    Section("emva", "Quantities of EMVA 1288", empty="", folded=True),
    Section("cite", "How to cite", kind="cite", folded=True),
    Section("provenance", "Provenance", empty="Nothing was recorded.", folded=True),
    Section("configuration", "Configuration", kind="text", folded=True),
)
#: Parts of the run that a section needs, where it is not the one of its name.
_NEEDS = {"maps": ("maps", "charge_rate"), "ensemble": ("ensemble", "nuced")}


def _page_sections(
    data: ReportData, figures: Sequence[Figure], tables: Sequence[Table], verdict: Finding | None
) -> list[Section]:
    """Return the sections of a run's page, those that have nothing to show left out."""
    found = []
    for each in PAGE:
        parts = _NEEDS.get(each.id, (each.id,))
        section = each.filled(
            intro=_intro(each, data),
            verdict=verdict if each.kind in ("summary", "discrepancy") else None,
            figures=[figure for figure in figures if figure.section == each.id],
            tables=[table for table in tables if table.section == each.id],
            missing=[f"Not shown: {data.missing[part]}" for part in parts if part in data.missing],
            # a joint fit has less to show
            empty="" if data.samples is not None and each.empty == Section.empty else each.empty,
            content=CONTENT[each.kind](data) if each.kind in CONTENT else each.content,
        )
        if section is not None:
            found.append(section)
    return found


def _intro(section: Section, data: ReportData) -> str:
    if section.id == "maps" and is_strip(data.shape):
        points = "Points: channels with their standard errors"
        return f"{points}; crosses at the bottom: channels without a value."
    if section.id != "exposures" or data.samples is None:
        return section.intro
    if data.samples.against not in AXES:
        return "The samples share g, μ and σ; no line was fitted (input.against: none)."
    against, _, _, offset = AXES[data.samples.against]
    slope = slope_of(data)
    noun = symbol(slope)[1] if slope else "charge"
    return section.intro.format(against=against, noun=noun, offset=symbol(offset)[1])


def _summary(data: ReportData) -> dict[str, Any]:
    remarks = flags(data)
    return {
        "answers": answers(data, remarks),
        "numbers": key_numbers(data),
        "sentence": "" if pixel_counts(data).fitted else sentence(data),
        "stepped_back": key_numbers(data, with_flagged=True) if data.mostly_flagged else [],
        "next": [(step.of(data.typed_run), step.why) for step in next_steps(data)],
        "flags": [flag for flag in remarks if flag.level != "good"],
        "passed": [flag for flag in remarks if flag.level == "good" and flag.about == "results"],
        "effects": data.discrepancy.found.effects if data.discrepancy else (),
    }


def _discrepancy(data: ReportData) -> dict[str, Any]:
    return {
        "found": data.quick_look is not None and bool(data.quick_look.found),
        "command": f"pchem discrepancy {data.typed_run}",
        "page": DISCREPANCY_PAGE,
    }


def render_report(data: ReportData, draw: DrawAll | None = None) -> dict[str, str]:
    """Draw everything and return the files of the report by name; nothing is written.

    ``draw`` draws all figures; None: one after the other, in this process.
    """
    # those without a section are drawn by ``pchem figures`` alone
    shown = [figure for figure in report_figures(data) if figure.section]
    others = discrepancy_figures(data.discrepancy)
    drawn = (draw or draw_here)([*shown, *others])
    verdict = None if data.discrepancy is None else finding(data.discrepancy)
    tables = [*result_tables(data), *method_tables(data), *emva_tables(data)]
    sections = _page_sections(data, shown, tables, verdict)
    files = {}
    if data.discrepancy is not None and verdict is not None:
        about = [] if data.shape[0] == 1 else [f"{data.shape[0]} × {data.shape[1]} pixels"]
        about += [f"{data.n_frames:,} frames"] if data.n_frames else []
        parts = [Section("verdict", "Verdict", verdict=verdict), *evidence(data.discrepancy, others)]
        files[DISCREPANCY_PAGE] = render_page(
            "discrepancy.html.j2", parts, drawn, title=data.title, about=", ".join(about)
        )
    inspector = embedded(data)
    files["report.json"] = report_json(data)
    files["report.html"] = render_page(
        "report.html.j2",
        sections,
        drawn,
        *([inspector["script"]] if inspector else []),
        title=data.title,
        data=data,
        inspector=inspector,
    )
    return files


def citation(data: ReportData) -> dict[str, str]:
    """Return what a paper would say of this run (``text``) and cite (``bibtex``)."""
    versions = data.run.get("versions")
    known: Mapping[str, str] = versions if isinstance(versions, Mapping) else {}
    version = known.get("pchem-pipeline") or metadata.version("pchem-pipeline")
    libraries = ", ".join(f"{name} {known[name]}" for name in ("numpy", "numba") if name in known)
    text = (
        f"{sentence(data)} Estimates and standard errors: maximum likelihood (PCH-EM), "
        f"pchem_pipeline {version}{f' with {libraries}' if libraries else ''}."
    )
    if digest := data.run.get("digest of the input"):
        text += f" Digest of the input: {digest}."
    software = f"""@software{{pchem_pipeline,
  title   = {{pchem\\_pipeline}},
  version = {{{version}}}
}}"""
    papers = text_of("papers.bib").strip().split("\n\n")  # the second one is on several exposures
    return {"text": text, "bibtex": "\n\n".join([*papers[: 1 if data.samples is None else 2], software])}


#: What sections of a kind of their own show.
CONTENT: dict[str, Callable[[ReportData], Any]] = {
    "summary": _summary,
    "discrepancy": _discrepancy,
    "cite": citation,
    "text": lambda data: data.config_yaml,
}
