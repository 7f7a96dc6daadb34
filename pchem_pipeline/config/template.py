"""The commented YAML that ``pchem init`` writes, made from the sections themselves."""

from __future__ import annotations

import json
import textwrap
from typing import Any

import yaml
from pydantic import BaseModel
from pydantic_core import PydanticUndefined, to_jsonable_python

from pchem_pipeline.base.wording import typeset
from pchem_pipeline.config.load import section_of
from pchem_pipeline.config.tree import RunConfig

_HEAD = """\
# A run of pchem_pipeline. Every setting is shown with its default; delete what you do not change.
# Paths are relative to this file. Start with: pchem run {name}
"""


#: File name of the JSON schema of the YAML.
SCHEMA_NAME = "pchem.schema.json"


def json_schema() -> str:
    """Return the JSON schema of a run's YAML, as text; editors complete and check keys by it."""
    schema = RunConfig.model_json_schema(by_alias=True)
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "A run of pchem_pipeline"}
    return json.dumps({**schema, **head}, indent=1, sort_keys=True) + "\n"


def commented_config(name: str, *, files: list[str], simulated: bool = False, schema: bool = False) -> str:
    """Return the YAML text of a file with every setting, its default and what it means.

    With ``schema`` it names the schema beside it, as the language server of YAML reads it.
    """
    stem = name.rsplit(".", 1)[0]
    given = {"input.files": files, "run.store": f"{stem}.zarr", "simulate.output": f"{stem}-frames"}
    lines = [f"# yaml-language-server: $schema={SCHEMA_NAME}"] if schema else []
    lines.append(_HEAD.format(name=name))
    for key, field in RunConfig.model_fields.items():
        if key == "simulate" and not simulated:
            continue
        model = section_of(field)
        assert model is not None
        lines += [f"# {field.description}", f"{key}:", *_section(model, key, given, 1), ""]
    return "\n".join(lines)


def _section(model: type[BaseModel], path: str, given: dict[str, Any], depth: int) -> list[str]:
    pad = "  " * depth
    lines: list[str] = []
    for key, field in model.model_fields.items():
        name = field.alias or key
        default = field.get_default(call_default_factory=True, validated_data={})
        value = given.get(f"{path}.{key}", None if default is PydanticUndefined else default)
        width = max(40, 100 - len(pad))
        lines += [f"{pad}# {line}" for line in textwrap.wrap(typeset(field.description or ""), width)]
        section = section_of(field)
        if isinstance(value, BaseModel) and section is not None and type(value) is section:
            lines += [f"{pad}{name}:", *_section(section, f"{path}.{key}", given, depth + 1)]
        else:
            text = yaml.safe_dump(
                to_jsonable_python(value, by_alias=True),
                sort_keys=False,
                allow_unicode=True,
                default_flow_style=True,
                width=10**6,
            )
            lines.append(f"{pad}{name}: {text.removesuffix('...' + chr(10)).strip()}")
    return lines
