"""The sections of the report's page, from top to bottom, in one list.

A further section of figures and tables is a row in ``captions.SECTIONS``; exhibits and tables name its id.
One of another kind is a maker in :data:`PAGE` and a template ``section_<kind>.html.j2``. The table of
contents follows the list.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.pages.answers import answers
from pchem_pipeline.report.pages.captions import MAP_READING, SECTIONS
from pchem_pipeline.report.pages.discrepancy_page import DiscrepancyView
from pchem_pipeline.report.pages.tables import Table, provenance_tables
from pchem_pipeline.report.pages.verdict import flags, key_numbers, sentence
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.report.style.pictures import Picture

__all__ = ["PAGE", "Material", "Section", "page_sections"]


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
    view: DiscrepancyView[Picture] | None = None


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


def _figures(row: tuple[str, str, str, tuple[str, ...]], material: Material) -> Section:
    """Put figures and tables into their section; one without any says why."""
    id_, title, intro, parts = row
    data = material.data
    shown = [picture for picture in material.pictures if picture.exhibit.section == id_]
    tables = [table for table in material.tables if table.section == id_]
    missing = [data.missing[part] for part in parts if part in data.missing]
    if id_ == "read-noise" and data.few_channels and not shown:
        missing.append("few channels have no histogram; their values are with the parameter maps")
    if not shown and not tables and not missing:
        missing = ["this run has no data for it."]
    if id_ == "maps":
        reading = "channels" if min(data.shape) < 2 else material.settings.map_stretch
        intro = f"{intro} {MAP_READING[reading]}"
    content = {"intro": intro, "missing": missing, "pictures": shown, "tables": tables}
    return Section(id_, title, "figures", content)


def _discrepancy(material: Material) -> Section:
    content = {
        "view": material.view,
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


def _configuration(material: Material) -> Section:
    return Section("configuration", "Configuration", "text", {"text": material.data.config_yaml})


#: The page from top to bottom.
PAGE: tuple[Maker, ...] = (
    _summary,
    _inspector,
    *(partial(_figures, row) for row in SECTIONS),
    _discrepancy,
    _tables,
    _provenance,
    _configuration,
)
