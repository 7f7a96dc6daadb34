"""Reports without pictures."""

from collections.abc import Sequence

import pytest

from pchem_pipeline.report.figures.figure import Figure
from pchem_pipeline.report.pages import report as report_module
from pchem_pipeline.report.pages.page import Drawn


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Texts without pictures: fast."""

    def dots(figures: Sequence[Figure]) -> dict[str, Drawn]:
        return {figure.name: Drawn("data:image/png;base64,AA==", 10, 10) for figure in figures}

    monkeypatch.setattr(report_module, "draw_here", dots)
