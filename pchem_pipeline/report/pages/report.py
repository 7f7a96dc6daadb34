"""The report: one HTML file without network access, and ``report.json``.

The sections of the page are in one list, from top to bottom. A further one of figures and tables is a row in
:data:`OPEN` or :data:`FOLDED`; figures and tables name its id. One of another kind is a maker in :data:`PAGE`
and a template ``section_<kind>.html.j2``. The table of contents follows the list.
What a paper would say of the run, and cite, is at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import metadata

from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.catalogue import discrepancy_figures, report_figures
from pchem_pipeline.report.figures.figure import Figure
from pchem_pipeline.report.figures.samples import AXES, slope_of
from pchem_pipeline.report.inspector import embedded, script, text_of
from pchem_pipeline.report.pages.discrepancy import DISCREPANCY_PAGE, evidence, finding
from pchem_pipeline.report.pages.emva import emva_tables
from pchem_pipeline.report.pages.page import DrawAll, Drawn, Finding, Section, draw_here, render_page
from pchem_pipeline.report.pages.report_json import report_json
from pchem_pipeline.report.pages.summary import (
    answers,
    flags,
    key_numbers,
    next_steps,
    pixel_counts,
    sentence,
)
from pchem_pipeline.report.pages.tables import Table, method_tables, provenance_tables, result_tables
from pchem_pipeline.report.style.wording import symbol

#: (id, heading, introduction, parts that may be missing) of the sections that show figures; the first ones
#: are open.
OPEN: tuple[tuple[str, str, str, tuple[str, ...]], ...] = (
    ("maps", "Parameter maps", "", ("maps", "charge_rate")),
    (
        "exposures",
        "Exposures",
        "Each exposure has its own H. Slope against {against}: {noun}; offset: {offset} (or electrons in the "
        "bias stack).",
        ("samples",),
    ),
    (
        "photon-transfer",
        "Photon transfer",
        "Variance against mean. Points off the curve: nonlinearity, or samples of different gain.",
        ("samples",),
    ),
    ("stability", "Stability and structure", "Drift in time, fixed-pattern noise, row and column noise.", ()),
    ("status", "Fit status", "", ()),
)
FOLDED: tuple[tuple[str, str, str, tuple[str, ...]], ...] = (
    ("pixels", "Single pixels", "Histograms with the fitted photon counting distribution.", ("pixels",)),
    (
        "goodness",
        "Does the model describe each pixel?",
        "Chi-square of merged bins; misfits at a given false-discovery rate. Samples far outside the model "
        "(cosmic rays, glitches) are excluded from the fit.",
        (),
    ),
    (
        "ensemble",
        "The sensor as a whole",
        "If the model holds, the parameters of the pixels predict the ensemble.",
        ("ensemble", "nuced"),
    ),
    (
        "electrons",
        "Electron numbers",
        "Most probable electron number of each sample of the ensemble.",
        ("electrons",),
    ),
    (
        "components",
        "Why the peaks of the ensemble blur",
        "Where pixels differ in gain, the peak of an electron number is the wider, the larger the number.",
        ("components",),
    ),
    ("uncertainty", "How precise are the numbers?", "", ()),
    (
        "methods",
        "Comparison with other methods",
        "The same pixels analysed by methods of the literature, and the smallest possible errors.",
        ("methods",),
    ),
    ("plan", "How many frames are enough?", "", ()),
)

#: How to read the figures of the section ``maps``: images, or lines of channels.
_READ_IMAGES = (
    "Rank-based colours (histogram-equalised); labels at minimum, median ± 1 sigma and maximum. "
    "Blue line: median."
)
_READ_CHANNELS = (
    "Points: channels with their standard errors; crosses at the bottom: channels without a value."
)

#: Sections that only a run of several samples has.
_OF_SAMPLES = ("exposures", "photon-transfer")
_NO_LINE = "The samples share g, μ and σ; no line was fitted (input.against: none)."


@dataclass(frozen=True)
class Material:
    """What sections are made of.

    Attributes:
        data: what the run found.
        figures: all of the page; each names its section.
        tables: all tables of results; each names its section.
        verdict: on what the model is missing, or None where nobody looked.
    """

    data: ReportData
    figures: list[Figure]
    tables: list[Table]
    verdict: Finding | None = None

    def figures_of(self, section: str) -> list[Figure]:
        """Return the figures of a section, by its id."""
        return [figure for figure in self.figures if figure.section == section]

    def tables_of(self, section: str) -> list[Table]:
        """Return the tables of a section, by its id."""
        return [table for table in self.tables if table.section == section]


Maker = Callable[[Material], Section | None]


def page_sections(material: Material) -> list[Section]:
    """Return the sections of a run's page; makers that have nothing to show return None."""
    return [section for make in PAGE if (section := make(material)) is not None]


def _summary(material: Material) -> Section:
    data = material.data
    remarks = flags(data)
    content = {
        "answers": answers(data, remarks),
        "caption": f"unflagged {data.noun}s" if data.often_flagged else f"{data.noun}s",
        "numbers": key_numbers(data),
        "sentence": "" if pixel_counts(data).fitted else sentence(data),
        "stepped_back": key_numbers(data, with_flagged=True) if data.mostly_flagged else [],
        "next": [(step.of(data.typed_run), step.why) for step in next_steps(data)],
        "flags": [flag for flag in remarks if flag.level != "good"],
        "passed": [flag for flag in remarks if flag.level == "good" and flag.about == "results"],
        "effects": data.discrepancy.found.effects if data.discrepancy else (),
    }
    return Section(
        id="summary",
        title="Is the sensor within limits, and are these results reliable?",
        name="Summary",
        verdict=material.verdict,
        figures=material.figures_of("summary"),
        kind="summary",
        content=content,
    )


def _inspector(_: Material) -> Section:
    """Say where the inspector is; what it shows lies at the end of the page."""
    return Section(id="inspector", title="Look at pixels", kind="inspector")


def _part(row: tuple[str, str, str, tuple[str, ...]], folded: bool, material: Material) -> Section | None:
    """Put figures and tables into their section; one without any says why."""
    id_, title, intro, parts = row
    data = material.data
    if data.samples is None and id_ in _OF_SAMPLES:
        return None
    shown, tables = material.figures_of(id_), material.tables_of(id_)
    missing = [data.missing[part] for part in parts if part in data.missing]
    if not shown and not tables and not missing:
        if data.samples is not None:
            return None  # a joint fit has less to show
        missing = ["no data in this run."]
    if id_ == "maps":
        intro = _READ_CHANNELS if min(data.shape) < 2 else _READ_IMAGES
    if id_ == "exposures" and data.samples is not None:
        words = AXES.get(data.samples.against)
        slope = slope_of(data)
        noun = symbol(slope)[1] if slope else "charge"
        intro = intro.format(against=words[0], noun=noun, offset=symbol(words[3])[1]) if words else _NO_LINE
    reasons = [f"Not shown: {reason}" for reason in missing]
    return Section(
        id=id_, title=title, intro=intro, missing=reasons, figures=shown, tables=tables, folded=folded
    )


def _discrepancy(material: Material) -> Section:
    look = material.data.quick_look
    content = {
        "found": look is not None and bool(look.found),
        "command": f"pchem discrepancy {material.data.typed_run}",
        "page": DISCREPANCY_PAGE,
    }
    return Section(
        id="discrepancy",
        title="What the model is missing",
        verdict=material.verdict,
        tables=material.tables_of("discrepancy"),
        kind="discrepancy",
        content=content,
    )


def _tables(id_: str, title: str, empty: str, material: Material) -> Section | None:
    """Put tables into their section; one without any says why, or is left out."""
    tables = material.tables_of(id_)
    missing = (empty,) if empty and not tables else ()
    return (
        Section(id=id_, title=title, missing=missing, tables=tables, folded=True) if tables or empty else None
    )


def _cite(material: Material) -> Section:
    content = citation(material.data)
    return Section(id="cite", title="How to cite", kind="cite", content=content, folded=True)


def _configuration(material: Material) -> Section:
    content = material.data.config_yaml
    return Section(id="configuration", title="Configuration", kind="text", content=content, folded=True)


#: The page from top to bottom.
PAGE: tuple[Maker, ...] = (
    _summary,
    partial(_part, OPEN[0], False),
    _inspector,
    *(partial(_part, row, False) for row in OPEN[1:]),
    _discrepancy,
    *(partial(_part, row, True) for row in FOLDED),
    partial(_tables, "tables", "Tables", "No pixel has a value."),
    partial(_tables, "emva", "Quantities of EMVA 1288", ""),
    _cite,
    partial(_tables, "provenance", "Provenance", "Nothing was recorded."),
    _configuration,
)


def render_report(data: ReportData, draw: DrawAll | None = None) -> dict[str, str]:
    """Draw everything and return the files of the report by name; nothing is written.

    Args:
        data: what the run found.
        draw: draws all figures at once, for example by several workers; None: one after the other, here.
    """
    # those without a section are drawn by ``pchem figures`` alone
    shown = [figure for figure in report_figures(data) if figure.section]
    others = discrepancy_figures(data.discrepancy)
    drawn = (draw or draw_here)([*shown, *others])
    verdict = None if data.discrepancy is None else finding(data.discrepancy)
    makers = (result_tables, method_tables, emva_tables, provenance_tables)
    tables = [table for make in makers for table in make(data)]
    sections = page_sections(Material(data, shown, tables, verdict))
    files = {}
    if data.discrepancy is not None and verdict is not None:
        parts = evidence(data.discrepancy, others)
        files[DISCREPANCY_PAGE] = _discrepancy_page(data, verdict, parts, drawn)
    inspector = embedded(data)
    files["report.json"] = report_json(data)
    files["report.html"] = render_page(
        "report.html.j2",
        sections,
        drawn,
        *([script()] if inspector else []),
        title=data.title,
        data=data,
        inspector=inspector,
    )
    return files


def _discrepancy_page(
    data: ReportData, verdict: Finding, parts: Sequence[Section], drawn: Mapping[str, Drawn]
) -> str:
    about = "" if data.shape[0] == 1 else f"{data.shape[0]} × {data.shape[1]} pixels"
    if data.n_frames:
        about += f"{', ' if about else ''}{data.n_frames:,} frames"
    sections = [Section(id="verdict", title="Verdict", verdict=verdict), *parts]
    return render_page("discrepancy.html.j2", sections, drawn, title=data.title, about=about)


def citation(data: ReportData) -> dict[str, str]:
    """Return what a paper would say of this run (``text``) and cite (``bibtex``)."""
    versions = data.run.get("versions")
    known: Mapping[str, str] = versions if isinstance(versions, Mapping) else {}
    version = known.get("pchem-pipeline") or metadata.version("pchem-pipeline")
    libraries = ", ".join(f"{name} {known[name]}" for name in ("numpy", "numba") if name in known)
    text = (
        f"{sentence(data)} Estimates and standard errors are those of maximum likelihood (PCH-EM), made with "
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
