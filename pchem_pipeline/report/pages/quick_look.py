"""The quick look in words: title, size and consequence of each check."""

from __future__ import annotations

import math

from pchem_pipeline.discrepancy.quick.checks import Check, QuickLook
from pchem_pipeline.report.style.wording import percent, short


def check_title(check: Check) -> str:
    """Return the title of a check with a capital."""
    return f"{check.title[:1].upper()}{check.title[1:]}"


def check_sentence(check: Check) -> str:
    """State title, size, place and consequence of a check, without a full stop."""
    advice = "the model includes such an effect" if check.in_model else check.advice
    if check.unit in ("DN", "LSB") and check.name != "levels":
        place = f", {check.where}" if check.where else ""
        return f"{check_title(check)} of {size_text(check)}{place}{f': {advice}' if advice else ''}"
    place = f" ({check.where})" if check.where else ""
    place = f" at {check.where}" if check.name.endswith("_code") else place
    return f"{check_title(check)}: {size_text(check)}{place}{f'; {advice}' if advice else ''}"


def size_text(check: Check) -> str:
    """Format the size of a check, in DN, e- and as a share of the read noise."""
    if check.name == "levels":
        return f"{short(check.size, 2)} DN apart"
    if check.unit == "DN":
        electrons = f"{short(check.size_e, 2)} e⁻" if math.isfinite(check.size_e) else ""
        share = f"{percent(check.share, 1.0)} of the read noise" if math.isfinite(check.share) else ""
        others = ", ".join(filter(None, (electrons, share)))
        return f"{short(check.size, 2)} DN{f' ({others})' if others else ''}"
    if check.unit == "LSB":
        return f"{short(check.size, 2)} LSB rms" if math.isfinite(check.size) else "unknown size"
    if check.name in ("lag", "frame_lag", "neighbours_x", "neighbours_y"):
        return short(check.size, 2)
    noun = (
        "frames"
        if check.name.endswith("frames")
        else "pixels"
        if check.name.endswith("pixels")
        else "samples"
    )
    return f"{percent(check.size, 1.0)} of the {noun}"


def nothing_found(look: QuickLook) -> str:
    """State that no check is significant, and the detection limit of row noise."""
    rows = next((check for check in look.checks if check.name == "row_noise"), None)
    if rows is None:
        return "Quick look: the codes agree with the model within sampling noise."
    codes = "" if "codes" in look.missing else ", codes"
    text = f"Quick look: frames, rows, columns, neighbours{codes} and pickup agree with the model"
    if math.isfinite(rows.limit):
        text += f"; row noise above {short(rows.limit, 2)} DN is excluded (95 %)"
    return f"{text}."
