"""Put a model into the section ``model`` of a run's YAML; comments, order and quoting stay as they are.

Only the lines of that section are written anew, by a library that keeps comments; every other byte of the
file stays. Where they cannot be taken by themselves (flow style, anchors that other sections use) the whole
text goes through the library. Whatever comes out is read again, and must say what was meant.
"""

from __future__ import annotations

import functools
import operator
import os
from collections.abc import Callable, Iterable, Sequence
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import YAMLError
from ruamel.yaml.representer import RoundTripRepresenter
from ruamel.yaml.tokens import CommentToken

from pchem_pipeline.base.errors import ConfigError, StoreError
from pchem_pipeline.config.load import parse_config, yaml_content
from pchem_pipeline.effects.framework.settings import ModelSettings
from pchem_pipeline.store.files import write_atomic

if TYPE_CHECKING:
    from pchem_pipeline.effects.framework.effect import Effect

_SECTION = "model"


class _Representer(RoundTripRepresenter):
    """Writes ``null`` out: left empty, as the library does, it would be lost within brackets."""


_Representer.add_representer(
    type(None), lambda self, _: self.represent_scalar("tag:yaml.org,2002:null", "null")
)


def check_writable(path: Path) -> None:
    """Refuse a YAML file that cannot be changed, before hours of work that end in changing it.

    Raises:
        StoreError: the file is read-only.
    """
    # the mode counts, too: whoever may write everything still means what it says
    if not os.access(path, os.W_OK) or not path.stat().st_mode & 0o222:
        raise StoreError(
            f"{path} is read-only, but its section model must change; make it writable (chmod u+w), or keep "
            "the model (discrepancy: --no-refit, or discrepancy.add: false)"
        )


def write_model(path: Path, model: ModelSettings) -> None:
    """Replace the model in a YAML file.

    Args:
        path: of the YAML; a link stays one, and its target is written.
        model: the section.

    Raises:
        ConfigError: the file is no configuration, or cannot be edited.
        StoreError: it cannot be written.
    """
    path = path.resolve()
    try:
        text = path.read_bytes().decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from error
    changed = with_model(text, model, str(path), path.parent)
    if changed != text:
        check_writable(path)
        write_atomic(path, changed.encode())


def with_model(text: str, model: ModelSettings, name: str, folder: Path | None = None) -> str:
    """Return the YAML text with this model; all that it says beside stays.

    Args:
        text: the YAML of a run.
        model: its new section.
        name: of the file, for messages.
        folder: of the file.

    Raises:
        ConfigError: the text is no configuration, or the library cannot edit it.
    """
    content, before = yaml_content(text, name), parse_config(text, name, folder).model
    if before == model:
        return text
    for edit in (_with_lines, _with_document):
        try:
            changed = edit(text, before, model)
            if _says(changed, content, model, folder):
                return changed
        except (YAMLError, yaml.YAMLError, ConfigError, ValueError, KeyError, TypeError, AttributeError):
            continue
    line = model.model_dump(mode="json", exclude_defaults=True)
    if model.effects:  # the tag is what each has by default
        given = (effect.model_dump(mode="json", exclude_defaults=True) for effect in model.effects)
        line["effects"] = [{"tag": e.tag, **own} for e, own in zip(model.effects, given, strict=True)]
    words = yaml.safe_dump({_SECTION: line}, sort_keys=False, default_flow_style=True, width=10**6).strip()
    raise ConfigError(f"{name}: cannot edit the section model; edit it by hand: {words}")


def _says(text: str, content: dict[str, Any], model: ModelSettings, folder: Path | None) -> bool:
    """Tell whether a text says the same as before but for the model."""
    others, before = (
        {k: v for k, v in c.items() if k != _SECTION} for c in (yaml_content(text, ""), content)
    )
    return others == before and parse_config(text, folder=folder).model == model


def _with_lines(text: str, before: ModelSettings, model: ModelSettings) -> str:
    """Edit the lines of the settings that change, and no others."""
    newline = _newline(text)
    for name in ModelSettings.model_fields:
        if getattr(before, name) == getattr(model, name):
            continue
        start, stop, column = _place(text, name)
        head = f"{_SECTION}:\n" if column else ""
        lines = _edited(head + text[start:stop].replace("\r\n", "\n"), before, model, [name], column)
        lines = lines.removeprefix(head)
        if start == stop and not text[:start].endswith("\n"):
            lines = f"\n{lines}"
        text = text[:start] + lines.replace("\n", newline) + text[stop:]
    return text


def _place(text: str, name: str) -> tuple[int, int, int]:
    """Return first and end of the lines of a setting, and its column; column 0: those of the whole section.

    Where it is to be put in, there are no lines yet: first is end. Comments behind it belong to what follows.

    Raises:
        ValueError: it has no lines of its own.
    """
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    assert isinstance(root, yaml.MappingNode)
    place = _lines_of(text, root, 0, len(text), _SECTION)
    if place is None:
        return len(text), len(text), 0
    section = next(value for key, value in root.value if key.value == _SECTION)
    if not isinstance(section, yaml.MappingNode) or section.flow_style or not section.value:
        return *place, 0
    column = section.value[0][0].start_mark.column
    return *(_lines_of(text, section, column, place[1], name) or (place[1], place[1])), column


def _lines_of(text: str, node: yaml.MappingNode, column: int, end: int, name: str) -> tuple[int, int] | None:
    """Return first and end of the lines of a key of a mapping that ends at ``end``, or None."""
    marks = [key.start_mark for key, _ in node.value]
    if any(mark.column != column or text[mark.index - column : mark.index].strip() for mark in marks):
        raise ValueError("keys that share a line")
    places = [mark.index - column for mark in marks] + [end]
    number = next((i for i, (key, _) in enumerate(node.value) if key.value == name), None)
    return None if number is None else (places[number], _trimmed(text, places[number], places[number + 1]))


def _trimmed(text: str, start: int, stop: int) -> int:
    """Return the end of some lines without the blank ones and the comments that they end with."""
    lines = text[start:stop].splitlines(keepends=True)
    while lines and lines[-1].strip()[:1] in ("", "#"):
        stop -= len(lines.pop())
    return stop


def _with_document(text: str, before: ModelSettings, model: ModelSettings) -> str:
    """Edit the whole text, which keeps comments and order, and not each blank."""
    text, newline = text.replace("\r\n", "\n"), _newline(text)
    return _edited(text, before, model, ModelSettings.model_fields).replace("\n", newline)


def _newline(text: str) -> str:
    return "\r\n" if "\r\n" in text else "\n"


def _edited(
    text: str, before: ModelSettings, model: ModelSettings, names: Iterable[str], indent: int = 0
) -> str:
    """Return a YAML text, the document or a part of it, with other values of some settings of the model."""
    library = YAML()
    library.Representer = _Representer
    library.preserve_quotes = True
    library.width = 10**6
    library.indent(mapping=indent or 2, sequence=_dash(text) + 2, offset=_dash(text))
    document = library.load(text) or CommentedMap()
    section = document.get(_SECTION)
    # what has an anchor is used elsewhere as well
    if not isinstance(section, CommentedMap) or section.anchor.value is not None:
        section = document[_SECTION] = CommentedMap()
    if "effects" in names:
        _put_effects(section, before.effects, model.effects)
    if "set_aside_e" in names and (model.set_aside_e or "set_aside_e" in section):
        section["set_aside_e"] = CommentedSeq([CommentedSeq(interval) for interval in model.set_aside_e])
        section["set_aside_e"].fa.set_flow_style()
    stream = StringIO()
    library.dump(document, stream)
    return stream.getvalue()


def _put_effects(section: CommentedMap, before: Sequence[Effect], wanted: Sequence[Effect]) -> None:
    """Make a list hold other effects; entries that stay keep their comments."""
    effects = section.get("effects")
    if not isinstance(effects, CommentedSeq) or not effects or effects.anchor.value is not None:
        effects, before = CommentedSeq(), ()
    entries = _entries(effects, before, wanted)
    del effects[len(entries) :]
    for place, entry in enumerate(entries):
        if place < len(effects):
            effects[place] = entry
        else:
            effects.append(entry)
    if not effects:
        effects.fa.set_flow_style()
        _behind(section)
    section["effects"] = effects


def _behind(section: CommentedMap) -> None:
    """Move the comments between the key ``effects`` and its first entry behind the empty list."""
    *rest, beside, above = section.ca.items.get("effects", [None] * 4)
    tokens = [token for token in (beside, *(above or ())) if token is not None and token.value.strip()]
    if tokens:
        words = "".join(token.value for token in tokens)
        section.ca.items["effects"] = [*rest, CommentToken(words, tokens[0].start_mark, None), None]


def _entries(effects: CommentedSeq, before: Sequence[Effect], wanted: Sequence[Effect]) -> list[Any]:
    """Return an entry for each effect: one that is there, as it is or with other numbers, or a new one."""
    free = list(range(len(before)))

    def take(fits: Callable[[Effect], bool]) -> int | None:
        place = next((place for place in free if fits(before[place])), None)
        if place is not None:
            free.remove(place)
        return place

    places = [take(functools.partial(operator.eq, effect)) for effect in wanted]
    found = []
    for effect, same in zip(wanted, places, strict=True):
        tag = effect.tag
        place = same if same is not None else take(lambda old, tag=tag: old.tag == tag)  # type: ignore[misc]
        if place is None or (same is None and effects[place].anchor.value is not None):
            found.append(CommentedMap(effect.model_dump(mode="json", exclude_none=True)))
            continue
        if same is None:
            old = before[place].model_dump(mode="json")
            for name, value in effect.model_dump(mode="json").items():
                if old.get(name) != value:
                    effects[place][name] = value
            for name in old.keys() - effect.model_dump(mode="json").keys():
                del effects[place][name]
        found.append(effects[place])
    return found


def _dash(text: str) -> int:
    """Return how far the entries of the first list of a text stand in from its key, blanks."""
    indent = 0
    for line in text.splitlines():
        content = line.lstrip(" ")
        if content.startswith("- "):
            return max(len(line) - len(content) - indent, 0)
        if content and not content.startswith("#"):
            indent = len(line) - len(content)
    return 0
