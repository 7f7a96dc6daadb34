"""Find effects by tag: our own files, and those of other installed packages, when somebody asks.

Our own are in the modules of the folder ``operators``, so that adding an effect touches no other file;
others' are announced by entry points of the group ``pchem_pipeline.effects`` (name: the tag; value:
``package.module:Class``).
"""

from __future__ import annotations

import difflib
import functools
import importlib
import logging
import pkgutil
from collections.abc import Mapping
from importlib.metadata import entry_points
from types import MappingProxyType
from typing import Annotated, Any

from pydantic import BeforeValidator, SerializeAsAny, ValidationInfo

from pchem_pipeline.base.errors import ConfigError, error_words
from pchem_pipeline.effects.framework.effect import Effect, registered_effects, tag_of

ENTRY_POINT_GROUP = "pchem_pipeline.effects"

_log = logging.getLogger(__name__)


def effect_classes() -> Mapping[str, type[Effect]]:
    """Return every effect by tag, ours and others', in alphabetical order."""
    return _discover()[0]


def effect_class(tag: str) -> type[Effect]:
    """Return the effect of a tag; ConfigError: there is none; it names those there are."""
    classes, broken = _discover()
    if tag in classes:
        return classes[tag]
    if tag in broken:
        raise ConfigError(f"effect {tag!r} comes from a plug-in that was left out: {broken[tag]}")
    close = difflib.get_close_matches(tag, classes, 1)
    hint = f"; did you mean {close[0]}?" if close else ""
    raise ConfigError(
        f"effect {tag!r} is unknown{hint}; known are {', '.join(classes)}; for one of another "
        "package, install that package"
    )


@functools.cache
def _discover() -> tuple[Mapping[str, type[Effect]], Mapping[str, str]]:
    """Return the effects by tag, and the plug-ins left out by name of their entry point, with the reason."""
    folder = importlib.import_module("pchem_pipeline.effects.operators")
    for module in pkgutil.iter_modules(folder.__path__, folder.__name__ + "."):
        importlib.import_module(module.name)
    classes = registered_effects()
    broken: dict[str, str] = {}
    for point in entry_points(group=ENTRY_POINT_GROUP):
        # a plug-in may raise anything when it is imported: a run that does not use it goes on
        try:
            effect = point.load()
            tag = tag_of(effect)
            if tag in classes:
                raise ConfigError(f"tag {tag!r} is taken by {classes[tag].__module__}")
            effect.typical()
        except Exception as error:
            broken[point.name] = f"{point.value}: {error_words(error)}"
            _log.warning("effect plug-in %s left out: %s", point.name, broken[point.name])
        else:
            classes[tag] = effect
    return MappingProxyType(dict(sorted(classes.items()))), MappingProxyType(broken)


def _as_effect(entry: Any, info: ValidationInfo) -> Effect:
    if isinstance(entry, Effect):
        return entry
    if isinstance(entry, str):
        entry = {"tag": entry}
    if not isinstance(entry, Mapping) or not isinstance(entry.get("tag"), str):
        raise ValueError(f"an effect needs a tag, for example `- tag: row_noise`; got {entry!r}")
    try:
        found = effect_class(entry["tag"])
    except ConfigError as error:
        raise ValueError(str(error)) from None
    return found.model_validate(dict(entry), context=info.context)


#: A list of effects in a YAML section: each is looked up by its tag and checked by its own class.
EffectList = tuple[SerializeAsAny[Annotated[Effect, BeforeValidator(_as_effect)]], ...]
