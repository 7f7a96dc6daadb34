"""The pages of reference, made from the code that they describe: commands, settings, store, effects."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Iterator
from enum import Enum
from itertools import groupby
from pathlib import Path
from typing import Any, get_args, get_origin

import numpy as np
import yaml
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

#: Pictures of the effects, and how much stronger than typical they are drawn.
PICTURES, _VISIBLE = Path(__file__).parent / "reference" / "effects", 20.0


def write_pages(folder: Path) -> None:
    """Write ``commands.md``, ``settings.md``, ``store.md`` and ``effects.md`` where they changed."""
    pages = {"commands": commands, "settings": settings, "store": store, "effects": effects}
    for name, make in pages.items():
        path, text = folder / f"{name}.md", make()
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


# -- commands ------------------------------------------------------------------------------------


def commands() -> str:
    """Return every command with its arguments and options, as ``pchem COMMAND --help`` shows them."""
    import typer

    from pchem_pipeline.cli.app import app

    group = typer.main.get_command(app)
    lines = ["# Commands", "", "Output of `pchem --help` and `pchem COMMAND --help`.", ""]
    lines += ["| command | function |", "|---|---|"]
    named = group.commands.items()  # type: ignore[attr-defined]
    lines += [f"| [`{name}`](#pchem-{name}) | {_cell(c.get_short_help_str(200))} |" for name, c in named]
    for name, command in named:
        lines += ["", f"(pchem-{name})=", f"## pchem {name}", "", inspect.cleandoc(command.help or "")]
        rows = list(_parameters(command.params))
        if rows:
            lines += ["", "| argument or option | meaning |", "|---|---|", *rows]
    return "\n".join(lines) + "\n"


def _parameters(parameters: Iterable[Any]) -> Iterator[str]:
    for each in parameters:
        words = getattr(each, "help", "") or ""
        if each.param_type_name == "argument":
            many = " ..." if each.nargs != 1 else ""
            yield f"| `{each.name.upper()}{many}` | {_cell(words)} |"
        elif not each.hidden and each.name != "help":
            default = each.default if isinstance(each.default, str | int | float) else None
            told = f" [{default}]" if default not in (None, "", False, True) else ""
            yield f"| `{', '.join(each.opts)}` | {_cell(words + told)} |"


# -- settings ------------------------------------------------------------------------------------


def settings() -> str:
    """Return every key of the YAML with its default, limits and meaning."""
    from pchem_pipeline.config.tree import RunConfig

    lines = [
        "# Settings (YAML)",
        "",
        "A run is described by one YAML file; `pchem init` writes it with these explanations. Unknown keys",
        "are refused, missing keys have their default. `null`: the program chooses.",
    ]
    for name, field in RunConfig.model_fields.items():
        section = _section_of(field.annotation)
        if section is None:
            continue
        lines += ["", f"## {name}", "", _sentence(field.description or "")]
        lines += ["", "| key | default | meaning |", "|---|---|---|", *_keys(section)]
    return "\n".join(lines) + "\n"


def _keys(section: type[BaseModel], before: str = "") -> Iterator[str]:
    for name, field in section.model_fields.items():
        inner = _section_of(field.annotation)
        described = f"{_cell(field.description or '')}{_limits(field)}"
        if inner is not None and not _is_effect(inner):
            yield f"| `{before}{name}` | | {described} |"
            yield from _keys(inner, f"{before}{name}.")
        else:
            yield f"| `{before}{name}` | {_default(field)} | {described} |"


def _section_of(annotation: Any) -> type[BaseModel] | None:
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        return annotation
    if get_origin(annotation) in (tuple, list, dict):
        return None
    found = [_section_of(each) for each in get_args(annotation)]
    return next((each for each in found if each is not None), None)


def _is_effect(section: type[BaseModel]) -> bool:
    from pchem_pipeline.effects.framework.effect import Effect

    return issubclass(section, Effect)


def _default(field: Any) -> str:
    if field.default_factory is not None:
        value = field.default_factory()
    elif field.default is PydanticUndefined:
        return "needed"
    else:
        value = field.default
    if isinstance(value, Enum):
        value = value.value
    words = {None: "null", True: "true", False: "false"}
    if value is None or isinstance(value, bool):
        return f"`{words[value]}`"
    if isinstance(value, BaseModel):
        return ""
    if isinstance(value, tuple | list):
        return f"`[{', '.join(map(str, value))}]`"
    return f"`{value}`" if value != "" else '`""`'


def _limits(field: Any) -> str:
    choices = [a for a in get_args(field.annotation) if isinstance(a, str | int)]
    words = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
    found = [
        f"{text} {getattr(limit, name):g}"
        for limit in field.metadata
        for name, text in words.items()
        if isinstance(getattr(limit, name, None), int | float)
    ]
    if choices:
        found.append("one of " + ", ".join(f"`{c}`" for c in choices))
    return f" ({', '.join(found)})" if found else ""


# -- store ---------------------------------------------------------------------------------------


def store() -> str:
    """Return every array that a run may hold, with dimensions, type and unit."""
    from pchem_pipeline.base.variables import VARIABLES

    lines = [
        "# The store",
        "",
        "`run.zarr` is a zarr group (format 3). Every array has dimension names, `units` and `long_name`:",
        '`xarray.open_zarr("run.zarr", group="fit", consolidated=False)`; type `*`: type of the data.',
        "Arrays that a run did not need are missing. The folder also has `report.html`, `report.json` and",
        "the versions of the model (`model/0001.json`, ...).",
    ]
    variables = sorted(VARIABLES.values(), key=lambda v: list(VARIABLES).index(v.path))
    for group, members in groupby(variables, key=lambda v: v.group):
        lines += ["", f"## {group}", "", "| array | dimensions | type | unit | meaning |"]
        lines.append("|---|---|---|---|---|")
        for each in members:
            symbol = f" (${_latex(each.symbol)}$)" if each.symbol else ""
            unit = "" if each.unit == "1" else each.unit
            dims = ", ".join(each.dims)
            lines.append(
                f"| `{each.name}` | {dims} | {_cell(each.dtype)} | {unit} | {each.long_name}{symbol} |"
            )
    return "\n".join(lines) + "\n"


def _latex(symbol: str) -> str:
    named = re.sub(r"\b(mu|sigma|lambda|tau)\b", r"\\\1", symbol.replace("_e-", "_{e^-}"))
    return named.replace("sigma_", "\\sigma_").replace("\\\\", "\\")


# -- effects -------------------------------------------------------------------------------------


def effects() -> str:
    """Return every effect of this package in the order of the signal chain: what it is, settings, rivals."""
    from pchem_pipeline.effects.framework.effect import Plane
    from pchem_pipeline.effects.framework.registry import effect_classes

    own = [c for c in effect_classes().values() if c.__module__.startswith("pchem_pipeline.")]
    lines = [
        "# Effects",
        "",
        "Effects of real sensors that the plain model lacks. Each can be in `model.effects` (fitted) and in",
        "`simulate.effects` (simulated), and is a candidate of `pchem discrepancy`, unless frames of one",
        "constant exposure cannot show it, or it is an empirical description without a cause.",
        "",
        "Each can be limited to a region and a range of frames (`region`, `when`). For effects that differ",
        "by readout tap or group of columns give several entries of `frame_noise`, `bias_drift`,",
        "`gain_drift` or another, each with its strength and `region`, for example `taps=64/1`.",
        "The maps of the pixels include constant differences of bias, gain and read noise between taps.",
        "",
        "Pictures show what an effect changes in one frame, and in one row of all frames.",
    ]
    for plane in Plane:
        members = [c for c in own if c.plane is plane]
        if not members:
            continue
        lines += ["", f"## {plane.value.capitalize()}" if plane is not Plane.ADC else "## ADC"]
        for each in members:
            lines += ["", *_effect(each)]
    return "\n".join(lines) + "\n"


def _effect(effect: type[Any]) -> Iterator[str]:
    tag = effect.model_fields["tag"].default
    yield f"### {tag}"
    yield ""
    yield f"*{_escaped(effect.title)}*. {_prose(effect)}"
    yield ""
    if effect.source:
        yield f"Source: {_escaped(effect.source)}."
        yield ""
    if effect.factors:
        changes, shared_by, varies = effect.factors
        yield f"Changes: {changes}. Shared by: {shared_by}. Varies: {varies}."
        yield ""
    if effect.untestable:
        yield f"Not testable with one constant exposure: {_escaped(effect.untestable)}."
        yield ""
    if effect.signature:
        yield "Most affected statistics: " + ", ".join(f"`{s}`" for s in effect.signature) + "."
        yield ""
    yield from _example(effect)
    yield "| setting | default | meaning |"
    yield "|---|---|---|"
    shown = {name: field for name, field in effect.model_fields.items() if name != "tag"}
    for name, field in shown.items():
        yield f"| `{name}` | {_default(field)} | {_cell(field.description or '')}{_limits(field)} |"
    if effect.separate:
        yield ""
        yield "| similar effect | distinguished by |"
        yield "|---|---|"
        for rival, words in effect.separate.items():
            yield f"| `{rival}` | {_cell(words)} |"


def _example(effect: type[Any]) -> Iterator[str]:
    """Yield the YAML of an effect of typical strength, and a picture of what it changes."""
    for one in effect.typical()[:1]:
        values = one.model_dump(mode="json", exclude_defaults=True) | {"tag": one.tag}
        yield from ("```yaml", *yaml.safe_dump({"model": {"effects": [values]}}).splitlines(), "```", "")
        PICTURES.mkdir(exist_ok=True)
        if not (path := PICTURES / f"{one.tag}.png").exists():
            _draw(one.scaled(_VISIBLE) if one.strength else one, path)
        yield f"![What {one.tag} changes, {_VISIBLE:g} times as strong](effects/{one.tag}.png)"
        yield ""


def _draw(effect: Any, path: Path) -> None:
    """Draw what an effect changes: the same random numbers without it are subtracted."""
    from matplotlib.figure import Figure

    from pchem_pipeline.simulate.chain import simulate_block
    from pchem_pipeline.simulate.maps import draw_truth
    from pchem_pipeline.simulate.settings import SimulateSettings

    ny, nx, n = 24, 48, 96
    both = [
        SimulateSettings(shape=(ny, nx), n_frames=n, bit_depth=16, effects=effects)
        for effects in ((effect,), ())
    ]
    frames = [simulate_block(draw_truth(each), each, (0, n))[0].astype(float) for each in both]
    change = frames[0] - frames[1]
    changed = abs(change[change != 0])
    most = float(np.percentile(changed, 95)) if changed.size else 1.0
    frame, row = (int((change**2).sum(axis=axis).argmax()) for axis in ((1, 2), (0, 2)))
    figure = Figure(figsize=(7.0, 2.0), layout="constrained")
    shown = (
        (change[frame], f"frame {frame}", "column", "row"),
        (change[:, row].T, f"row {row}", "frame", "column"),
    )
    for axes, (image, title, x, y) in zip(figure.subplots(1, 2), shown, strict=True):
        axes.imshow(image, cmap="RdBu_r", vmin=-most, vmax=most, interpolation="nearest", aspect="auto")
        axes.set_title(f"{title} (\u00b1{most:.3g} DN)", fontsize=9)
        axes.set_xlabel(x, fontsize=8)
        axes.set_ylabel(y, fontsize=8)
        axes.tick_params(labelsize=7)
    figure.savefig(path, dpi=100)


# -- words ---------------------------------------------------------------------------------------


def _prose(described: Any) -> str:
    """Return a docstring as Markdown: double backquotes are code, roles and sections are left out."""
    text = inspect.cleandoc(described.__doc__ or "")
    text = re.split(r"\n(?:Attributes|Args|Raises|Returns):\n", text)[0]
    text = re.sub(r":\w+:`~?([^`]+)`", lambda m: f"`{m[1].rsplit('.', 1)[-1]}`", text)
    parts = re.split(r"(``[^`]+``|`[^`]+`)", text)
    return "".join(f"`{p.strip('`')}`" if p.startswith("`") else _escaped(p) for p in parts)


def _escaped(text: str) -> str:
    return re.sub(r"([*_$<>|])", r"\\\1", text)


def _cell(text: str) -> str:
    return " ".join(_escaped(text).split())


def _sentence(text: str) -> str:
    return _escaped(text[:1].upper() + text[1:].rstrip(".") + ".") if text else ""


if __name__ == "__main__":
    write_pages(Path(__file__).parent / "reference")
