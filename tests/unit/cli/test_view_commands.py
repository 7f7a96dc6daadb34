"""The commands that look at runs translate and call once."""

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from pchem_pipeline.base.errors import ConfigError, StoreError
from pchem_pipeline.cli.app import app
from pchem_pipeline.commands import figures
from pchem_pipeline.commands.compare import compare
from pchem_pipeline.commands.compare.history import HistorySettings
from pchem_pipeline.commands.figures import figures_of_run


def invoke(*arguments: str) -> str:
    return CliRunner().invoke(app, list(arguments), catch_exceptions=False).stdout


def test_figures_are_asked_for_as_given(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[object] = []

    def call(*arguments: object, **options: object) -> list[Path]:
        seen.append((arguments, options))
        return [Path("out/ensemble.pdf")]

    monkeypatch.setattr(figures, "figures_of_run", call)
    options = ["--format", "pdf, svg", "--width", "88mm", "--dpi", "300"]
    shown = invoke("figures", "run.zarr", "-o", "out", *options, "--only", "ensemble")
    assert shown == "out/ensemble.pdf\n"
    wanted = {
        "formats": ("pdf", "svg"),
        "width": "88mm",
        "only": ("ensemble",),
        "dpi": 300,
        "progress": "auto",
    }
    assert seen == [((Path("run.zarr"), Path("out")), {**wanted, "progress": "auto"})]


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        ({"formats": ("pdf", "jpg")}, "--format: jpg cannot be drawn; choose from pdf, svg, png"),
        ({"formats": ()}, "--format: no format"),
        ({"width": "88 px"}, "--width '88 px': write a length such as 88mm"),
    ],
)
def test_what_cannot_be_drawn_is_refused_before_anything_is_read(wanted: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        figures_of_run(Path("nowhere.zarr"), Path("out"), **wanted)


@pytest.mark.parametrize("option", ["--only", "--format"])
def test_a_list_of_nothing_does_not_mean_all(option: str) -> None:
    with pytest.raises(ConfigError, match=f"{option}: ' ,' is no name"):
        invoke("figures", "run.zarr", option, " ,")


def test_a_folder_without_a_run_is_told(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="there is no run at"):
        figures_of_run(tmp_path, tmp_path / "out")


def test_runs_are_compared_as_given(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[object] = []

    def call(*arguments: object, **options: object) -> list[Path]:
        seen.append((arguments, options))
        return [Path("out/compare.html")]

    monkeypatch.setattr(compare, "compare_runs", call)
    shown = invoke("compare", "a.zarr", "b.zarr", "c.zarr", "-o", "out", "--tolerance", "1e-9")
    assert shown == "out/compare.html\n"
    history = HistorySettings()
    options = {"tolerance": 1e-9, "history": history, "progress": "auto"}
    assert seen == [(([Path("a.zarr"), Path("b.zarr"), Path("c.zarr")], Path("out")), options)]
