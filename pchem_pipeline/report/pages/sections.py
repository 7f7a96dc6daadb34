"""The sections of the report's page, from top to bottom, in one list.

A further section of figures and tables is a row in :data:`SECTIONS`; figures and tables name its id. One of
another kind is a maker in :data:`PAGE` and a template ``section_<kind>.html.j2``. The table of contents
follows the list.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.samples import AXES, slope_of
from pchem_pipeline.report.pages.cite import citation
from pchem_pipeline.report.pages.discrepancy import DiscrepancyView
from pchem_pipeline.report.pages.next_steps import next_steps
from pchem_pipeline.report.pages.pictures import Picture
from pchem_pipeline.report.pages.summary import answers, flags, key_numbers, sentence
from pchem_pipeline.report.pages.tables import Table, provenance_tables
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.report.style.wording import symbol

#: (id, heading, introduction, parts that may be missing) of the sections that show figures.
SECTIONS: tuple[tuple[str, str, str, tuple[str, ...]], ...] = (
    (
        "pixels",
        "Single pixels",
        "Each pixel is described by the photon counting distribution (PCD): a Poisson number of electrons"
        " with mean H, converted with gain g, on top of the bias μ, with Gaussian read noise σ.",
        ("pixels",),
    ),
    (
        "goodness",
        "Does the model describe each pixel?",
        "The histogram of each pixel is tested against its fitted density by a chi-square of merged bins, "
        "whose p-values are uniform by chance. Of many thousand tests some look significant: pixels are "
        "called misfits only as far as the rate of false discoveries allows. Single samples that the model "
        "does not expect at all (cosmic rays, glitches) are left out of the fit and counted.",
        (),
    ),
    (
        "exposures",
        "Exposures",
        "Each exposure has its own H; what grows with {against} is the {noun}, and what does not is "
        "spurious charge (or a bias stack that holds electrons). The exposures of a pixel share the errors "
        "of its gain and bias, which the line takes into account.",
        ("samples",),
    ),
    (
        "photon-transfer",
        "Photon transfer",
        "The same data as moments: where the points leave the curve, the sensor is not linear or the samples "
        "are not of one gain.",
        ("samples",),
    ),
    (
        "cells",
        "From signal to electron number",
        "The peaks of the PCD are whole electrons. Each signal belongs to the electron number that "
        "explains it best; the edges between these cells are not half-way between the peaks, since small "
        "and large numbers are not equally likely.",
        (),
    ),
    (
        "read-noise",
        "Read noise",
        "Read noise in electrons, quantisation included, of every pixel with a fit.",
        ("maps",),
    ),
    (
        "maps",
        "Parameter maps",
        "Histogram and map of each parameter. Structure in a map points to the architecture of the sensor.",
        (
            "maps",
            "charge_rate",
        ),
    ),
    (
        "stability",
        "Stability and structure",
        "From sums over all pixels and frames: what moves, and what repeats along rows and columns.",
        (),
    ),
    (
        "ensemble",
        "The sensor as a whole",
        "If the model holds, the parameters of the pixels predict the distribution of all raw data taken "
        "together.",
        (
            "ensemble",
            "nuced",
        ),
    ),
    (
        "electrons",
        "Electron numbers",
        "Each raw value of the ensemble frames was turned into a number of electrons.",
        ("electrons",),
    ),
    (
        "components",
        "Why the peaks of the ensemble fade",
        "The ensemble is a sum of components, one for each electron number. Where pixels differ in gain, "
        "the components become wider with the electron number.",
        ("components",),
    ),
    (
        "uncertainty",
        "How sure are the numbers?",
        "Standard errors follow from the curvature of each pixel's likelihood, those of derived "
        "quantities from the whole covariance of the four parameters.",
        (),
    ),
    (
        "methods",
        "Other methods beside PCH-EM",
        "The same pixels characterised by the methods of the literature, with the smallest errors that any "
        "method could have.",
        ("methods",),
    ),
    (
        "plan",
        "How many frames are enough?",
        "The information of one frame tells how many of them a precision needs, before they are taken.",
        (),
    ),
    (
        "status",
        "Fit status",
        "Pixels that could not be fitted, or whose values deserve caution, and why.",
        (),
    ),
)

#: How to read the figures of the section ``maps``, by how they are drawn.
MAP_READING: dict[str, str] = {
    "beta": (
        "Colours follow the rank of a pixel (Beta(2,2) stretch), so that a few outliers do not hide the "
        "structure: the five labels of the colour bar are the minimum, the 15.6, 50 and 84.4 % quantiles "
        "and the maximum. The blue line in a histogram is the median."
    ),
    "linear": (
        "Colours are linear between the 1st and the 99th percentile; values beyond have the end colours. "
        "The blue line in a histogram is the median."
    ),
    "channels": (
        "Each point is a channel with its standard error; crosses at the bottom are channels without a value."
    ),
}

#: Sections that only a run of several samples has.
_OF_SAMPLES = ("exposures", "photon-transfer")
_NO_LINE = "The samples share g, μ and σ; no line was asked for (input.against: none)."


@dataclass(frozen=True)
class Material:
    """What sections are made of.

    Attributes:
        data: what the run found.
        settings: section ``report``.
        pictures: all drawn figures; each names its section.
        tables: all tables of results; each names its section.
        view: what the model is missing, or None where nobody looked.
    """

    data: ReportData
    settings: ReportSettings
    pictures: list[Picture]
    tables: list[Table]
    view: DiscrepancyView | None = None


@dataclass(frozen=True)
class Section:
    """One section of the page.

    Attributes:
        id: anchor in the page.
        title: heading, also in the table of contents.
        kind: the template ``section_<kind>.html.j2`` shows it, as ``section``.
        content: what that template shows.
    """

    id: str
    title: str
    kind: str
    content: Mapping[str, Any] = field(default_factory=dict)


Maker = Callable[[Material], Section | None]


def page_sections(material: Material) -> list[Section]:
    """Return the sections of a run's page; makers that have nothing to show return None."""
    return [section for make in PAGE if (section := make(material)) is not None]


def _summary(material: Material) -> Section:
    data = material.data
    content = {
        "answers": answers(data),
        "sentence": sentence(data),
        "numbers": key_numbers(data),
        "stepped_back": key_numbers(data, with_flagged=True) if data.mostly_flagged else [],
        "next": [(step.of(str(data.run.get("store", "RUN"))), step.why) for step in next_steps(data)],
        "flags": flags(data),
        "verdict": material.view,
        "effects": data.discrepancy.found.effects if data.discrepancy else (),
    }
    return Section("summary", "Is this sensor all right, and can I believe it?", "summary", content)


def _inspector(material: Material) -> Section:
    """Say where the inspector is; what it shows lies at the end of the page."""
    shown = material.data.inspector is not None
    content = {"shown": shown, "why": "No pixel was fitted; there is nothing to look at."}
    return Section("inspector", "Look at pixels", "inspector", content)


def _figures(row: tuple[str, str, str, tuple[str, ...]], material: Material) -> Section | None:
    """Put figures and tables into their section; one without any says why."""
    id_, title, intro, parts = row
    data = material.data
    if data.samples is None and id_ in _OF_SAMPLES:
        return None
    shown = [picture for picture in material.pictures if picture.figure.section == id_]
    tables = [table for table in material.tables if table.section == id_]
    missing = [data.missing[part] for part in parts if part in data.missing]
    if id_ == "read-noise" and data.few_channels and not shown:
        missing.append("few channels have no histogram; their values are with the parameter maps")
    if not shown and not tables and not missing:
        if data.samples is not None:
            return None  # a joint fit has less to show
        missing = ["this run has no data for it."]
    if id_ == "maps":
        reading = "channels" if min(data.shape) < 2 else material.settings.map_stretch
        intro = f"{intro} {MAP_READING[reading]}"
    if id_ == "exposures" and data.samples is not None:
        words = AXES.get(data.samples.against)
        slope = slope_of(data)
        noun = symbol(slope)[1] if slope else "charge"
        intro = intro.format(against=words[0], noun=noun) if words else _NO_LINE
    content = {"intro": intro, "missing": missing, "pictures": shown, "tables": tables}
    return Section(id_, title, "figures", content)


def _discrepancy(material: Material) -> Section:
    content = {
        "view": material.view,
        "tables": [table for table in material.tables if table.section == "discrepancy"],
        "command": f"pchem discrepancy {material.data.run.get('store', 'RUN')}",
    }
    return Section("discrepancy", "What the model is missing", "discrepancy", content)


def _tables(material: Material) -> Section:
    tables = [table for table in material.tables if table.section == "tables"]
    nothing = "No pixel has a value; there is nothing to list."
    return Section("tables", "Tables", "tables", {"tables": tables, "empty": nothing})


def _provenance(material: Material) -> Section:
    tables = provenance_tables(material.data)
    content = {"tables": tables, "empty": "Nothing was recorded."}
    return Section("provenance", "Origin of the results", "tables", content)


def _cite(material: Material) -> Section:
    return Section("cite", "How to describe and cite this", "cite", {"citation": citation(material.data)})


def _configuration(material: Material) -> Section:
    return Section("configuration", "Configuration", "text", {"text": material.data.config_yaml})


#: The page from top to bottom.
PAGE: tuple[Maker, ...] = (
    _summary,
    _inspector,
    *(partial(_figures, row) for row in SECTIONS),
    _discrepancy,
    _tables,
    _cite,
    _provenance,
    _configuration,
)
