"""Read the verdict that the stage ``discrepancy`` left in a run: its JSON, its arrays, words of effects."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.base.variables import variables_of
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.report.pages.discrepancy_data import DiscrepancyData

if TYPE_CHECKING:
    from pchem_pipeline.store.run_store import RunStore

__all__ = ["RESULT_FILE", "discrepancy_state", "read_discrepancy", "read_result"]

#: File of the verdict in the folder of a run.
RESULT_FILE = "discrepancy.json"
_STAGE = "discrepancy"


def read_result(store: Path) -> dict[str, Any] | None:
    """Return the content of ``discrepancy.json`` of a run, or None where there is none.

    Raises:
        StoreError: it cannot be read.
    """
    path = store / RESULT_FILE
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise StoreError(f"{path} is damaged ({error}); run pchem discrepancy with --force") from error
    if not isinstance(result, dict):
        raise StoreError(f"{path} holds no verdict; run pchem discrepancy with --force")
    return result


def discrepancy_state(store: RunStore) -> str | None:
    """Return in words which verdict a run has, None without one: changes whenever the verdict was redone."""
    result = read_result(store.path)
    if result is None:
        return None
    record = store.records.read(_STAGE)
    when = f" ({record.fingerprint[:8]}, {record.started})" if record is not None else ""
    return f"{result.get('verdict', 'unknown')}{when}"


def read_discrepancy(store: RunStore) -> DiscrepancyData | None:
    """Return what the report shows of the verdict, or None where there is none.

    Raises:
        StoreError: the JSON or an array cannot be read.
    """
    from pchem_pipeline.effects.framework.registry import effect_classes

    result = read_result(store.path)
    if result is None:
        return None
    effects = effect_classes()
    return DiscrepancyData(
        result=result,
        arrays={v.name: store.read(v.path) for v in variables_of(_STAGE) if store.has(v.path)},
        statistics={name: (s.channel, s.sentence) for name, s in STATISTICS.items()},
        titles={tag: effect.title for tag, effect in effects.items() if effect.title},
        sources={tag: effect.source for tag, effect in effects.items() if effect.source},
    )
