"""The quick look in words: what each check says, with its size in the units that a reader thinks in."""

from __future__ import annotations

import math

from pchem_pipeline.discrepancy.quick.checks import Check, QuickLook
from pchem_pipeline.report.style.wording import percent, short

#: What was looked at, in the order of a reader's questions.
_SUBJECTS = "frames, rows, columns, neighbours, successive samples, pickup and codes"


#: What a check of resemblance finds where the correlation is negative.
_OPPOSED = {
    "lag": "samples differ from those of the frame before more than chance makes them",
    "frame_lag": "the mean of a frame differs from that of the frame before more than chance makes it",
    "neighbours_x": "neighbours in a row differ more than chance makes them",
    "neighbours_y": "neighbours in a column differ more than chance makes them",
}


def check_title(check: Check) -> str:
    """Return what was looked for, or where the opposite was found that."""
    title = _OPPOSED.get(check.name, check.title) if check.found and check.size < 0 else check.title
    return f"{title[:1].upper()}{title[1:]}"


def check_sentence(check: Check) -> str:
    """Return what a check found, without the full stop."""
    text = f"{check_title(check)}: {size_text(check)}"
    if check.name.endswith("_code"):
        text += f" are {check.where}"
    elif check.where:
        text += f" ({check.where})"
    if check.in_model:
        return f"{text}; the model has an effect like it"
    return f"{text}; {check.advice}" if check.advice else text


def size_text(check: Check) -> str:
    """Return the size of what a check found, in DN, e- and as a share of the read noise."""
    if check.name == "levels":
        return f"{short(check.size, 2)} DN apart"
    if check.unit == "DN":
        size = f"{short(check.size, 2)} DN"
        if math.isfinite(check.size_e):
            size += f", {short(check.size_e, 2)} e⁻"
        if math.isfinite(check.share):
            size += f", {percent(check.share, 1.0)} of the read noise"
        return size
    if check.unit == "LSB":
        return f"{short(check.size, 2)} LSB rms" if math.isfinite(check.size) else "size not known"
    if check.name in ("lag", "frame_lag", "neighbours_x", "neighbours_y"):
        return f"correlation {short(check.size, 2)}"
    noun = (
        "frames"
        if check.name.endswith("frames")
        else "pixels"
        if check.name.endswith("pixels")
        else "samples"
    )
    return f"{percent(check.size, 1.0)} of the {noun}"


def nothing_found(look: QuickLook) -> str:
    """Return that nothing was found, and how small it would have been found."""
    rows = next((check for check in look.checks if check.name == "row_noise"), None)
    if rows is None:
        return "A quick look at the codes found nothing beyond chance."
    text = f"A quick look at {_SUBJECTS} found nothing beyond chance"
    if math.isfinite(rows.limit):
        text += f"; row noise of {short(rows.limit, 2)} DN would have been found"
    return f"{text}."
