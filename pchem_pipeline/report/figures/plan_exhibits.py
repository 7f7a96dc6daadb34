"""How many frames are enough, in the report: the contours and a table for the median pixel of the run."""

from __future__ import annotations

import math

from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.exhibits import Exhibit, drawing
from pchem_pipeline.report.figures.plan_figures import frames_contours
from pchem_pipeline.report.pages.tables import Table
from pchem_pipeline.report.style.style import PAGE_MM
from pchem_pipeline.report.style.wording import short

__all__ = ["PLAN_FIGURE", "plan_exhibits", "plan_tables"]

#: Name of the figure's files.
PLAN_FIGURE = "frames_needed"

_CAPTION = (
    "Frames with which one sample reaches the precision in the title, one standard deviation of a pixel, by "
    "the Cramer-Rao bound. The dot is the median pixel of this run; white dots mark the exposure that needs "
    "the fewest frames at each read noise, as far as it is drawn. Weak peaks and many electrons (top right) "
    "need more frames than the bound asks for, until no other gain is as likely by chance."
)


def plan_exhibits(data: ReportData) -> list[Exhibit]:
    """Return the figure of the frames needed, where a pixel has a value."""
    plan = data.plan
    if plan is None:
        return []
    words = "; ".join(f"{_words(row['target'])}: {_count(row['frames'])} frames" for row in plan["rows"])
    return [
        Exhibit(
            PLAN_FIGURE,
            "plan",
            "Frames that one sample needs",
            _CAPTION,
            f"Contours of the frames needed over exposure and read noise. For the median pixel, {words}.",
            drawing(frames_contours, plan["contours"], plan["mark"]),
            PAGE_MM,
        )
    ]


def plan_tables(data: ReportData) -> list[Table]:
    """Return the table of the frames needed, where a pixel has a value."""
    plan = data.plan
    if plan is None:
        return []
    rows = []
    for row in plan["rows"]:
        reached = plan["reached"].get(row["name"])
        unit, scale = ("e⁻", 1.0) if row["name"] == "bias" else ("%", 100.0)
        now = "" if reached is None else f"{short(scale * reached, 2)} {unit}"
        rows.append((_words(row["target"]), _count(row["frames"]), now))
    exposure, noise = plan["mark"]
    caption = (
        f"For the median pixel, H = {short(exposure)} e⁻ and read noise {short(noise)} e⁻, by the bound. For "
        "the best exposure, other sensors, several samples, and a check by simulation: pchem plan."
    )
    head = ("precision", "frames needed", "this run's")
    return [Table("plan-table", "Frames for a precision", caption, head, tuple(rows), section="plan")]


def _words(target: str) -> str:
    return target.replace("_e to", " (e⁻) to").replace("_", " ").replace("e-", "e⁻")


def _count(frames: float) -> str:
    return f"{frames:,.0f}" if math.isfinite(frames) else "none suffice"
