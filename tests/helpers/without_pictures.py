"""Pages without pictures: drawing takes most of the time of a report."""

from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.pages.page import Drawn
from pchem_pipeline.report.pages.report import render_report

DOT = Drawn("data:image/gif;base64,R0lGODlhAQABAAAAACwAAAAAAQABAAA=", 10, 10)


@contextmanager
def undrawn() -> Iterator[None]:
    """Put a dot in the place of every figure that this process draws for a page."""
    with (
        patch("pchem_pipeline.report.pages.page.draw_figure", lambda figure: DOT),
        patch("pchem_pipeline.stages.report.report.draw_figure", lambda figure: DOT),
    ):
        yield


def page_without_pictures(data: ReportData) -> str:
    """Return the page of a report with a dot for every figure."""
    with undrawn():
        return render_report(data)["report.html"]
