"""Put effects into the section ``model`` of a run's YAML, and leave every other line as it is."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import yaml

from pchem_pipeline.config.load import parse_config

__all__ = ["with_model_effects"]

_MODEL = re.compile(r"^model:.*?(?=^[^\s#-]|\Z)", re.MULTILINE | re.DOTALL)


def with_model_effects(
    text: str,
    effects: Sequence[dict[str, Any]],
    name: str,
    set_aside: Sequence[Sequence[float | None]] = (),
) -> str:
    """Return the YAML text with these effects in ``model.effects``; comments elsewhere stay.

    Args:
        text: the YAML of a run.
        effects: as JSON data, each with its ``tag``.
        name: of the file, for messages.
        set_aside: codes that the fit leaves out, ``model.set_aside_e``.

    Raises:
        ConfigError: the text would no longer be a configuration.
    """
    model: dict[str, Any] = {"effects": list(effects)}
    if set_aside:
        model["set_aside_e"] = [list(interval) for interval in set_aside]
    block = yaml.safe_dump({"model": model}, sort_keys=False, allow_unicode=True)
    if _MODEL.search(text):
        grown = _MODEL.sub(lambda _: block, text, count=1)
    else:
        grown = text.rstrip("\n") + "\n\n" + block
    parse_config(grown, name)
    return grown
