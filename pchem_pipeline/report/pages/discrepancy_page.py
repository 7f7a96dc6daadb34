"""The discrepancy verdict as the report and its own page show it, verdict first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from pchem_pipeline.report.figures.discrepancy_exhibits import discrepancy_exhibits
from pchem_pipeline.report.figures.exhibits import Exhibit
from pchem_pipeline.report.pages.discrepancy_data import DiscrepancyData
from pchem_pipeline.report.pages.discrepancy_tables import discrepancy_tables
from pchem_pipeline.report.pages.discrepancy_text import PARTS, KeyFact, key_facts, remarks, verdict_level
from pchem_pipeline.report.pages.tables import Table
from pchem_pipeline.report.pages.verdict import Flag

__all__ = ["DISCREPANCY_PAGE", "DiscrepancyView", "Part", "discrepancy_view"]

#: File of the verdict's own page in the folder of a run.
DISCREPANCY_PAGE = "discrepancy.html"

#: A drawn figure, whatever the page makes of it.
Drawn = TypeVar("Drawn")


@dataclass(frozen=True)
class Part(Generic[Drawn]):
    """A part of the page: figures and tables under a heading; ``empty`` says why there are none."""

    id: str
    title: str
    intro: str
    empty: str
    pictures: list[Drawn]
    tables: list[Table]


@dataclass(frozen=True)
class DiscrepancyView(Generic[Drawn]):
    """All that the templates show.

    Attributes:
        level: how grave it is (a class of the style sheet).
        name: the verdict's name.
        sentence: the verdict in one sentence.
        facts: the key numbers.
        remarks: what speaks for and against it.
        parts: figures and tables.
    """

    level: str
    name: str
    sentence: str
    facts: list[KeyFact]
    remarks: list[Flag]
    parts: list[Part[Drawn]]


def discrepancy_view(data: DiscrepancyData, draw: Callable[[Exhibit], Drawn]) -> DiscrepancyView[Drawn]:
    """Return the page's content.

    Args:
        data: verdict and arrays.
        draw: makes of a figure what the templates show.
    """
    level, name = verdict_level(data.found)
    pictures = [(exhibit.section, draw(exhibit)) for exhibit in discrepancy_exhibits(data)]
    tables = discrepancy_tables(data)
    parts = []
    for id_, title, intro in PARTS:
        shown = [picture for section, picture in pictures if section == id_]
        rows = tables.get(id_, [])
        empty = "" if shown or rows else _EMPTY[id_]
        parts.append(Part(f"discrepancy-part-{id_}", title, intro, empty, shown, rows))
    sentence = data.found.sentence.replace(" -> ", " → ")
    return DiscrepancyView(level, name, sentence, key_facts(data.found), remarks(data), parts)


_EMPTY = {
    "where": "Nothing was kept to draw.",
    "evidence": "No candidate was asked for: nothing disagrees beyond chance.",
    "shown": "No gap was measured.",
    "parameters": "Nothing was added to the model.",
    "limits": "Nothing was recorded.",
}
