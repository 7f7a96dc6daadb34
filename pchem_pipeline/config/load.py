"""Reading and writing a run's YAML, with errors that name the key and the cure."""

from __future__ import annotations

import difflib
import re
from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any, get_args

import yaml
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import to_jsonable_python

from pchem_pipeline.base.errors import ConfigError, quoted
from pchem_pipeline.base.settings import SECRET, Section
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.effects.framework.settings import ModelSettings
from pchem_pipeline.store.files import remove_files, write_atomic

#: values of a configuration: 100,000 named files are not unusual
_MOST_VALUES, _MOST_KEYS = 1_000_000, 1000
#: complaints that are listed, and characters of a key or value in them
_MOST_LISTED, _MOST_SHOWN = 20, 200
#: end of the name of a file that holds the model of a YAML
_EFFECTS = ".effects.yaml"


class _StrictLoader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """A safe loader that refuses a key given twice, and numbers of hundreds of digits."""

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        if len(node.value) > _MOST_SHOWN:
            raise _refused(node, f"a number of {len(node.value)} digits")
        return int(super().construct_yaml_int(node))

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        if len(node.value) > _MOST_KEYS:
            raise _refused(node, f"a section of {len(node.value)} keys")
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, Hashable):
                raise _refused(key_node, "a key is a list or a mapping")
            if key in seen:
                raise _refused(key_node, f"the key {key!r} is given twice")
            seen.add(key)
        return dict(super().construct_mapping(node, deep))


def _refused(node: yaml.Node, words: str) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(None, None, words, node.start_mark)


_StrictLoader.add_constructor("tag:yaml.org,2002:int", _StrictLoader.construct_yaml_int)


class FoundModel(Section):
    """Content of ``RUN.effects.yaml``: the model that overrides the one in ``RUN.yaml``."""

    model: ModelSettings
    instead_of: ModelSettings


def load_config(path: Path) -> RunConfig:
    """Return the configuration in a YAML file, with the model of ``RUN.effects.yaml`` where there is one.

    Raises:
        ConfigError: the file is missing, is not YAML, or a setting is wrong; or the model in it is no longer
            the one that ``RUN.effects.yaml`` replaces.
    """
    if path.name.endswith(_EFFECTS):
        owner = path.with_name(f"{path.name.removesuffix(_EFFECTS)}.yaml")
        if owner.exists():
            raise ConfigError(f"{path}: holds the model of {owner.name}; give that file")
    config, found = _own_config(path), found_model(path)
    if found is None:
        return config
    if found.instead_of != config.model:
        file = effects_file(path)
        raise ConfigError(
            f"{path}: the section model was changed after {file}, which overrides it; delete {file.name} to "
            "use the section, or undo the change"
        )
    return config.model_copy(update={"model": found.model})


def effects_file(path: Path) -> Path:
    """Return the file of the model that overrides the one of a YAML: ``RUN.effects.yaml`` beside it."""
    path = path.resolve()
    return path.with_name(f"{path.stem}{_EFFECTS}")


def found_model(path: Path) -> FoundModel | None:
    """Return what is in the ``RUN.effects.yaml`` of a YAML file, None where there is none.

    Raises:
        ConfigError: it is not YAML, or a setting is wrong.
    """
    file = effects_file(path)
    if not file.exists():
        return None
    try:
        return FoundModel.model_validate(
            yaml_content(_text(file), str(file)), context={"folder": file.parent}
        )
    except ValidationError as error:
        raise ConfigError(f"{file}: {complaints(error, FoundModel)}") from error


def write_model(path: Path, model: ModelSettings) -> Path:
    """Make a model the one of a YAML file, which stays as it is; return the file that holds the model now.

    It is kept in ``RUN.effects.yaml``, which is removed where the YAML states the same model.

    Raises:
        ConfigError: the YAML is no configuration.
        StoreError: the file cannot be written.
    """
    file, own = effects_file(path), _own_config(path).model
    if model == own:
        remove_files(file)
        return path
    content = FoundModel(model=model, instead_of=own).model_dump(mode="json")
    head = f"# The model of {path.name}; delete this file to use the section model there.\n"
    write_atomic(file, (head + yaml_text(content)).encode())
    return file


def write_config(path: Path, text: str) -> None:
    """Write the YAML of a new run; a model found for an earlier YAML of that name is removed.

    Raises:
        StoreError: it cannot be written.
    """
    remove_files(effects_file(path))
    write_atomic(path, text.encode())


def _own_config(path: Path) -> RunConfig:
    """Return what a YAML file says by itself."""
    return parse_config(_text(path), str(path), path.parent)


def _text(path: Path) -> str:
    if path.exists() and not path.is_file():
        raise ConfigError(f"{path}: not a regular file; write the settings to a file")
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; write one with: pchem init {quoted(path)}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from error


def parse_config(text: str, name: str = "config", folder: Path | None = None) -> RunConfig:
    """Return the configuration in a YAML text, which messages call ``name``.

    Paths of files that are read with the YAML refer to the folder; None: the working directory.

    Raises:
        ConfigError: the text is not YAML or a setting is wrong.
    """
    return make_config(yaml_content(text, name), name, folder)


def yaml_content(text: str, name: str) -> dict[str, Any]:
    """Return the mapping in a YAML text.

    Raises:
        ConfigError: the text is not YAML, a key is given twice, or it holds no mapping.
    """
    try:
        content = yaml.load(text, Loader=_StrictLoader)
    except (yaml.YAMLError, ValueError) as error:  # numbers of thousands of digits, dates that are none
        tab = "; indent with spaces, not with tabs" if re.search(r"^ *\t", text, re.MULTILINE) else ""
        raise ConfigError(f"{name}: not valid YAML: {' '.join(str(error).split())}{tab}") from error
    except RecursionError as error:
        raise ConfigError(f"{name}: not valid YAML: brackets within brackets too deep to read") from error
    if not isinstance(content, dict):
        raise ConfigError(f"{name}: no settings; write a commented default with: pchem init")
    if fault := _fault(content):
        raise ConfigError(f"{name}: {fault}")
    return content


def _fault(content: Any) -> str:
    """Return what cannot be settings in values: a few lines of aliases can stand for billions."""
    found, held = 0, [content]
    while held and found <= _MOST_VALUES:
        value = held.pop()
        found += 1
        if isinstance(value, (dict, list)):
            held += value.values() if isinstance(value, dict) else value
        elif isinstance(value, str) and re.search("[\0\ud800-\udfff]", value):
            return f"a text is no valid name: {_shown(ascii(value))}; correct it"
    if found <= _MOST_VALUES:
        return ""
    return f"more than {_MOST_VALUES} values, or a recursive alias (*); write the settings out"


def make_config(content: Mapping[str, Any], name: str, folder: Path | None = None) -> RunConfig:
    """Return the configuration with these settings; ``name`` and ``folder`` as in :func:`parse_config`.

    Raises:
        ConfigError: a setting is wrong.
    """
    try:
        return RunConfig.model_validate(content, context={"folder": folder})
    except ValidationError as error:
        raise ConfigError(f"{name}: {complaints(error)}") from error


def dump_config(config: RunConfig) -> str:
    """Return the resolved YAML text of a configuration, every setting spelled out."""
    content = config.model_dump(mode="json", by_alias=True)
    if content["simulate"] is None:
        del content["simulate"]
    return yaml_text(content)


def yaml_text(content: Mapping[str, Any]) -> str:
    """Return plain data as YAML, in their order."""
    return yaml.safe_dump(dict(content), sort_keys=False, allow_unicode=True)


def states(config: RunConfig, dotted: str) -> bool:
    """Return whether a YAML states a setting such as ``fit.likelihood``, or leaves it at its default."""
    value: Any = config
    for name in dotted.split("."):
        if not isinstance(value, BaseModel):
            return True
        if name not in value.model_fields_set:
            return False
        value = getattr(value, name)
    return True


def setting_of(config: RunConfig, dotted: str) -> Any:
    """Return the value of ``section.key`` as plain JSON data."""
    value: Any = config
    for name in dotted.split("."):
        value = getattr(value, name)
    return to_jsonable_python(value, by_alias=True)


def complaints(error: ValidationError, model: type[BaseModel] = RunConfig) -> str:
    """Return in one line what is wrong with the settings of a model, each with its place."""
    found = error.errors()
    listed = "; ".join(_complaint(item, model) for item in found[:_MOST_LISTED])
    return listed + (f"; and {len(found) - _MOST_LISTED} more" if len(found) > _MOST_LISTED else "")


def _complaint(item: Any, root: type[BaseModel]) -> str:
    where = ".".join(_shown(str(part)) for part in item["loc"])
    message = item["msg"].removeprefix("Value error, ").replace("valid tuple", "list")  # as YAML calls it
    if item["type"] == "extra_forbidden":
        keys = _keys_at(item["loc"][:-1], root)
        close = difflib.get_close_matches(_shown(str(item["loc"][-1])), keys, 1)
        cure = f"did you mean {close[0]}?" if close else f"the keys here are {', '.join(keys)}"
        return f"{where}: unknown key; {cure}" if keys else f"{where}: unknown key"
    hidden = item["type"] == SECRET or isinstance(item["input"], dict | BaseModel)
    given = "" if hidden else f" (given: {_shown(repr(item['input']))})"
    return f"{where}: {message}{given}" if where else message


def _shown(text: str) -> str:
    return text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]} ..."


def section_of(field: FieldInfo) -> type[BaseModel] | None:
    """Return the section that a field holds, or None."""
    kinds = (field.annotation, *get_args(field.annotation))
    return next((k for k in kinds if isinstance(k, type) and issubclass(k, BaseModel)), None)


def _keys_at(location: tuple[Any, ...], root: type[BaseModel]) -> list[str]:
    """Return the keys that the section at ``location`` knows."""
    model: Any = root
    for name in location:
        if isinstance(name, int):
            continue
        fields = getattr(model, "model_fields", {})
        if name not in fields:
            return []
        model = section_of(fields[name])
    return list(getattr(model, "model_fields", {}))
