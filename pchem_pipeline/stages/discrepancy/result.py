"""The verdict that the stage ``discrepancy`` left in a run: its state, and what the report shows of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.verdict import Verdict, read_verdict
from pchem_pipeline.report.data import DiscrepancyData

if TYPE_CHECKING:
    from pchem_pipeline.store.run_store import RunStore


def discrepancy_state(store: RunStore) -> str | None:
    """Return in words which verdict a run has, None without one that can be read.

    It changes whenever the verdict was redone.
    """
    try:
        found = read_verdict(store.path)
    except StoreError:  # the stage that wrote it is stale
        return None
    if found is None:
        return None
    record = store.records.known("discrepancy")
    when = f" ({record.fingerprint[:8]}, {record.started})" if record is not None else ""
    return f"{found.verdict}{when}"


def verdict_data(found: Verdict, arrays: Mapping[str, NDArray[Any]]) -> DiscrepancyData:
    """Return what the report shows of a verdict, with the names of effects and statistics.

    Args:
        found: the verdict.
        arrays: group ``discrepancy`` of the store.
    """
    from pchem_pipeline.effects.framework.registry import effect_classes

    effects = effect_classes()
    # those of a search with other statistics are in another order: what its JSON tells is left
    vectors = ("z_before", "z_after")  # a number for each statistic
    arrays = {n: array for n, array in arrays.items() if n not in vectors or len(array) == len(STATISTICS)}
    signs = dict(zip(STATISTICS, arrays.get("z_before", ()), strict=False))
    return DiscrepancyData(
        found=found,
        arrays=arrays,
        statistics={name: (s.channel, s.says(signs.get(name, 1.0))) for name, s in STATISTICS.items()},
        titles={tag: effect.title for tag, effect in effects.items() if effect.title},
        sources={tag: effect.source for tag, effect in effects.items() if effect.source},
    )
