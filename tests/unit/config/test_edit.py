"""A model put into a user's YAML: only its own lines change, comments, order and quoting stay."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import Any, get_args

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from pchem_pipeline.base.errors import ConfigError, StoreError
from pchem_pipeline.config.edit import check_writable, with_model, write_model
from pchem_pipeline.config.load import parse_config
from pchem_pipeline.config.template import commented_config
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.effects.framework.registry import effect_classes
from pchem_pipeline.effects.framework.settings import ModelSettings

ROW: dict[str, Any] = {"tag": "row_noise", "row_noise_dn": 1.2}
FRAME: dict[str, Any] = {"tag": "frame_noise", "frame_noise_dn": 0.3}
CLIP: dict[str, Any] = {"tag": "clipping", "high": 900}

TEXT = """# mine
input: {files: ['a.npy'], integration_time: 1.0}   # "here"
model:   # the law
  # which effects
  effects:   # found by hand
    # the rows
    - tag: row_noise   # strong
      row_noise_dn: 1.20  # DN
    # the frames
    - {tag: "frame_noise", frame_noise_dn: 3.0e-1}
  # the 0-electron peak
  set_aside_e: [[null, 0.5]]   # e-

  # end of the model

# PCH-EM
fit:
  gap_threshold: 5   # µ ≥ 0,\ttab
"""


def model(*effects: dict[str, Any], aside: Any = ()) -> ModelSettings:
    return ModelSettings.model_validate({"effects": list(effects), "set_aside_e": aside})


def comments(text: str) -> list[str]:
    return sorted(line.partition("#")[2].strip() for line in text.splitlines() if "#" in line)


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_an_effect_that_is_added_makes_new_lines_and_changes_none(newline: str) -> None:
    text = TEXT.replace("\n", newline)
    changed = with_model(text, model(ROW, FRAME, CLIP, aside=[[None, 0.5]]), "a.yaml")
    lines = text.splitlines(keepends=True)
    place = lines.index(f"  # the 0-electron peak{newline}")
    new = [f"    - tag: clipping{newline}", f"      high: 900{newline}"]
    assert changed.splitlines(keepends=True) == [*lines[:place], *new, *lines[place:]]


def test_another_strength_changes_its_number_alone() -> None:
    changed = with_model(TEXT, model({**ROW, "row_noise_dn": 2.5}, FRAME, aside=[[None, 0.5]]), "a.yaml")
    assert changed == TEXT.replace("1.20  #", "2.5   #")


def test_going_back_is_going_back_to_the_byte() -> None:
    first = commented_config("a.yaml", files=["a.npy"])
    second = with_model(first, model(ROW), "a.yaml")
    third = with_model(second, model(ROW, FRAME), "a.yaml")
    assert with_model(third, model(ROW), "a.yaml") == second
    assert with_model(second, model(), "a.yaml") == first
    assert with_model(first, model(), "a.yaml") is first


@pytest.mark.parametrize(
    "text",
    [
        "input: {files: [a]}",
        "input: {files: [a]}\nmodel:\n# c\nfit: {}\n",
        "input: {files: [a]}\nmodel: {effects: []}  # none\nfit: {}\n",
        "{input: {files: [a]}, model: {effects: []}}\n",
        "---\ninput: {files: [a]}  # x\n...\n",
        "input: {files: [a]}\nmodel:\n    set_aside_e: [[null, 0.5]]  # k\n    # z\n",
        "simulate:\n  effects: &fx\n  - {tag: clipping, high: 9}  # both\nmodel:\n  effects: *fx\n",
        "model:\n  effects: &fx\n  - &r {tag: clipping, high: 9}\nsimulate: {effects: *fx}  # same\n",
        "input: {files: [a]}\nmodel:\n  effects:\n  - tag: row_noise\n    row_noise_dn: 0.7",
    ],
)
@pytest.mark.parametrize(
    "wanted", [model(ROW, CLIP), model(), model({**ROW, "row_noise_dn": 3.0}, aside=[[2.5, None]])]
)
def test_odd_texts_say_the_same_beside_the_model(text: str, wanted: ModelSettings) -> None:
    changed = with_model(text, wanted, "a.yaml")
    before, after = yaml.safe_load(text), yaml.safe_load(changed)
    assert parse_config(changed).model == wanted
    assert {k: v for k, v in after.items() if k != "model"} == {
        k: v for k, v in before.items() if k != "model"
    }
    assert comments(changed) == comments(text)


_COMMENT = st.text(st.characters(codec="utf-8", exclude_categories=["C", "Z"]), max_size=9).map(
    lambda text: f"# {text}"
)
_STRENGTH = st.floats(0.01, 40.0)


@st.composite
def _texts(draw: st.DrawFn) -> str:
    """A YAML with comments wherever there may be some, in any indentation."""
    step, dash = draw(st.integers(2, 4)) * " ", draw(st.integers(0, 4)) * " "

    def line(text: str) -> str:
        above = [f"{draw(st.sampled_from(['', step]))}{draw(_COMMENT)}\n"] if draw(st.booleans()) else []
        return "".join([*above, text, f"  {draw(_COMMENT)}" if draw(st.booleans()) else "", "\n"])

    entries = [
        line(f"{step}{dash}- tag: {tag}") + line(f"{step}{dash}  {tag}_dn: {draw(_STRENGTH)!r}")
        for tag in draw(st.lists(st.sampled_from(["row_noise", "frame_noise"]), unique=True))
    ]
    effects = "".join([line(f"{step}effects:"), *entries]) if entries else line(f"{step}effects: []")
    section = (
        line("model:") + effects + draw(st.sampled_from(["", line(f"{step}set_aside_e: [[null, 0.5]]")]))
    )
    sections = [section, line("input: {files: ['a.npy']}"), line("fit:") + line(f"{step}gap_threshold: 5")]
    return "".join(draw(st.permutations(sections)))


@given(_texts(), _STRENGTH, st.sampled_from(["\n", "\r\n"]))
def test_comments_and_other_lines_stay_whatever_the_text(text: str, strength: float, newline: str) -> None:
    text = text.replace("\n", newline)
    old = parse_config(text).model
    new = {"tag": "column_noise", "column_noise_dn": strength}
    added = model(*old.model_dump(mode="json")["effects"], new, aside=old.set_aside_e)
    changed = with_model(text, added, "a.yaml")
    assert parse_config(changed).model == added
    kept = changed.splitlines(keepends=True)
    for line in text.splitlines(keepends=True):
        if "effects: []" not in line:
            assert line in kept
            kept.remove(line)
    assert comments(changed) == comments(text)
    # and back, to the byte
    assert with_model(changed, old, "a.yaml").split() == text.split()


def test_every_effect_can_be_written() -> None:
    shared = {"of": "row", "share": 1.0, "changes": "gain", "signal_dn": 7.5, "burst": 0.1}
    measured = {"tag": "empirical_noise", "noise_dn": 1.5, "modes": [shared], "region": {"columns": [[3, 9]]}}
    for tag, kind in effect_classes().items():
        for effect in (*kind.typical(), *(model(measured).effects if tag == "empirical_noise" else ())):
            for text in (TEXT, "input: {files: [a]}\n"):
                wanted = ModelSettings(effects=(effect,))
                assert parse_config(with_model(text, wanted, "a.yaml")).model == wanted, tag


def test_no_setting_is_called_what_yaml_takes_for_true_or_false() -> None:
    def names(kind: type[BaseModel], seen: set[type]) -> set[str]:
        seen.add(kind)
        found = set(kind.model_fields)
        for field in kind.model_fields.values():
            for part in parts(field.annotation):
                if part not in seen:
                    found |= names(part, seen)
        return found

    def parts(annotation: Any) -> list[type[BaseModel]]:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            return [annotation]
        return [part for inner in get_args(annotation) for part in parts(inner)]

    for kind in (RunConfig, *effect_classes().values()):
        for name in names(kind, set()):
            assert yaml.safe_load(name) == name, (kind, name)


def test_a_model_that_cannot_be_put_in_is_told_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> str:
        raise ValueError

    for name in ("_with_lines", "_with_document"):
        monkeypatch.setattr(f"pchem_pipeline.config.edit.{name}", refuse)
    with pytest.raises(ConfigError, match="edit it by hand") as error:
        with_model(TEXT, model(CLIP, ROW), "a.yaml")
    words = str(error.value).partition("by hand: ")[2]
    assert ModelSettings.model_validate(yaml.safe_load(words)["model"]) == model(CLIP, ROW)


def test_a_text_that_is_no_configuration_is_refused() -> None:
    for text in ("input: [", "input: {files: [a], file: b}\n"):
        with pytest.raises(ConfigError, match=r"a\.yaml"):
            with_model(text, model(ROW), "a.yaml")


def test_a_link_stays_a_link_and_the_mode_stays(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    path, link = tmp_path / "real" / "run.yaml", tmp_path / "run.yaml"
    path.write_bytes(TEXT.encode())
    path.chmod(0o640)
    link.symlink_to(path)
    write_model(link, model(ROW))
    assert link.is_symlink()
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert parse_config(path.read_text(encoding="utf-8")).model == model(ROW)
    assert [each.name for each in path.parent.iterdir()] == ["run.yaml"]


def test_a_read_only_file_is_refused_and_stays(tmp_path: Path) -> None:
    path = tmp_path / "run.yaml"
    path.write_bytes(TEXT.encode())
    path.chmod(0o444)
    with pytest.raises(StoreError, match="read-only"):
        check_writable(path)
    with pytest.raises(StoreError, match="read-only"):
        write_model(path, model())
    assert path.read_bytes() == TEXT.encode()
    write_model(path, parse_config(TEXT).model)  # nothing to write
