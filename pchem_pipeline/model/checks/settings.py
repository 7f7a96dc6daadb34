"""The YAML section ``compare``: by how much a camera may change."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import BeforeValidator, Field

from pchem_pipeline.base.settings import Section


def _limit(value: object) -> object:
    """Return a limit as a number or as text such as ``5%``."""
    if value is None:
        return None
    text = str(value).replace(" ", "")
    if re.fullmatch(r"(\d+\.?\d*|\.\d+)(e[+-]?\d{1,2})?%?", text, re.IGNORECASE) is None:
        raise ValueError("give a number from 0 on, or per cent, such as 0.5 or 5%")
    return text if text.endswith("%") else float(text)


Limit = Annotated[float | str | None, BeforeValidator(_limit)]


class CompareSettings(Section):
    """Limits of ``pchem compare``; with one or more of them only what has a limit is judged."""

    quanta_exposure: Limit = Field(
        default=None, description="change of its median that is allowed, e- or per cent, such as 0.1 or 5%"
    )
    conversion_gain: Limit = Field(default=None, description="the same, e-/DN or per cent")
    bias: Limit = Field(default=None, description="the same, DN or per cent")
    read_noise_dn: Limit = Field(default=None, description="the same, DN or per cent")
    read_noise_e: Limit = Field(default=None, description="the same, e- or per cent")
    analog_read_noise_e: Limit = Field(default=None, description="the same, e- or per cent")
    dark_current: Limit = Field(default=None, description="the same, e-/px/s or per cent")
    charge_rate: Limit = Field(default=None, description="the same, e-/px/s or per cent")
    pixels: Limit = Field(
        default=None,
        description="limit of the number of pixels that changed by significantly more than these limits, or "
        "have other defects; or in per cent of the pixels",
    )


def allowed(limit: float | str | None, whole: float) -> float:
    """Return a limit as a number, per cent of ``whole``; 0 where there is none."""
    if isinstance(limit, str):
        return float(limit.removesuffix("%")) / 100.0 * abs(whole)
    return limit or 0.0
