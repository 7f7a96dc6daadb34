"""The base of every YAML section.

A section lives beside the code that it configures (``frames``, ``simulate``, ``model``,
``compute``, ``render``); ``config`` assembles the sections into the tree of a run. The description of
each field is the comment that ``pchem init`` writes.
"""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Section(BaseModel):
    """A frozen YAML section: unknown keys, NaN and infinities are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)
