"""The effects with which the maps of a run were fitted, whatever its configuration says by now."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pchem_pipeline.effects.settings import ModelSettings

if TYPE_CHECKING:
    from pchem_pipeline.effects.base import Effect
    from pchem_pipeline.store.run_store import RunStore

__all__ = ["fitted_effects"]


def fitted_effects(store: RunStore) -> tuple[Effect, ...]:
    """Return the effects of the model of the stored fit, in their order; none without a fit.

    Raises:
        pydantic.ValidationError: an effect came from a package that is no longer there.
    """
    record = store.records.read("fit")
    settings = {} if record is None else record.content.get("settings", {}).get("model") or {}
    return ModelSettings.model_validate(settings).effects
