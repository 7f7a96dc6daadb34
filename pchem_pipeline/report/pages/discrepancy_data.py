"""What the page of a discrepancy verdict is made of: the verdict, small arrays, and names of effects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from pchem_pipeline.discrepancy.verdict import Verdict

__all__ = ["CHANNELS", "DiscrepancyData"]

#: Order of the axis ``channel`` of the arrays.
CHANNELS = ("charge", "readout")


@dataclass(frozen=True)
class DiscrepancyData:
    """All that the page shows.

    Attributes:
        found: the verdict.
        arrays: arrays of group ``discrepancy`` by name; any may lack.
        statistics: name of each statistic, in the order of ``z_before``, to its channel and sentence.
        titles: tag of an effect to its name in the literature.
        sources: tag of an effect to where it is described.
    """

    found: Verdict
    arrays: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    statistics: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    titles: Mapping[str, str] = field(default_factory=dict)
    sources: Mapping[str, str] = field(default_factory=dict)

    def title(self, tag: str) -> str:
        """Return the name of an effect in the literature, or its tag."""
        return self.titles.get(tag) or tag.replace("_", " ")
