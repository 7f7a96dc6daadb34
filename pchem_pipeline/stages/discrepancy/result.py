"""Read the verdict that the stage ``discrepancy`` left in a run, with its arrays and the names of effects."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pchem_pipeline.base.variables import variables_of
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.verdict import read_verdict
from pchem_pipeline.report.data import DiscrepancyData

if TYPE_CHECKING:
    from pchem_pipeline.store.run_store import RunStore

__all__ = ["discrepancy_state", "read_discrepancy"]

_STAGE = "discrepancy"


def discrepancy_state(store: RunStore) -> str | None:
    """Return in words which verdict a run has, None without one: changes whenever the verdict was redone."""
    found = read_verdict(store.path)
    if found is None:
        return None
    record = store.records.read(_STAGE)
    when = f" ({record.fingerprint[:8]}, {record.started})" if record is not None else ""
    return f"{found.verdict}{when}"


def read_discrepancy(store: RunStore) -> DiscrepancyData | None:
    """Return what the report shows of the verdict, or None where there is none.

    Raises:
        StoreError: the JSON or an array cannot be read.
    """
    from pchem_pipeline.effects.framework.registry import effect_classes

    found = read_verdict(store.path)
    if found is None:
        return None
    effects = effect_classes()
    return DiscrepancyData(
        found=found,
        arrays={v.name: store.read(v.path) for v in variables_of(_STAGE) if store.has(v.path)},
        statistics={name: (s.channel, s.sentence) for name, s in STATISTICS.items()},
        titles={tag: effect.title for tag, effect in effects.items() if effect.title},
        sources={tag: effect.source for tag, effect in effects.items() if effect.source},
    )
