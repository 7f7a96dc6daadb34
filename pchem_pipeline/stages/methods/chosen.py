"""Settings of a comparison of methods: its section of the YAML, with what the command line chose."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic_core import to_jsonable_python

if TYPE_CHECKING:
    from pchem_pipeline.methods.settings import MethodsSettings
    from pchem_pipeline.run.stage import StageContext


def chosen_settings(context: StageContext) -> dict[str, Any]:
    """Return what the command line chooses, as JSON data; unasked, what it chose for the last result.

    The result of a command with ``--pixels`` is thereby up to date until another one is asked for, whatever
    the YAML says.
    """
    if context.options.settings is not None:
        chosen: dict[str, Any] = to_jsonable_python(dict(context.options.settings))
        return chosen
    record = context.store.records.known("methods")
    kept = {} if record is None else record.content.get("input") or {}
    return dict(kept.get("chosen", {}))


def methods_settings(context: StageContext) -> MethodsSettings:
    """Return the settings of the comparison."""
    section = context.config.methods
    return type(section).model_validate({**section.model_dump(), **chosen_settings(context)})
