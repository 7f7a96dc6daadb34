"""Figures as files: sizes, fonts, styles, and numbers beside them that are what is drawn."""

import csv
import io
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.discrepancy_material import discrepancy_data
from helpers.report_material import report_data
from matplotlib.patches import StepPatch
from PIL import Image

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.commands.figures import millimetres, paper_files
from pchem_pipeline.report.charts.on_paper import Look
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.catalogue import run_figures
from pchem_pipeline.report.figures.figure import DataTable, Figure, csv_text


@pytest.fixture(scope="module")
def data() -> ReportData:
    return replace(report_data((12, 16), failed=0.05), discrepancy=discrepancy_data("named"))


@pytest.fixture(scope="module")
def found(data: ReportData) -> dict[str, Figure]:
    return {figure.name: figure for figure in run_figures(data)}


def rows_of(content: bytes) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(content.decode())))


def numbers(rows: list[dict[str, str]], heading: str) -> np.ndarray:
    return np.array([float(row[heading] or "nan") for row in rows])


def test_every_figure_has_tables(found: dict[str, Figure]) -> None:
    assert len(found) >= 16
    for figure in found.values():
        assert figure.tables
        for table in figure.tables:
            assert len(rows_of(csv_text(table).encode())) == next(iter(table.flat().values())).size > 0
        assert len({table.part for table in figure.tables}) == len(figure.tables)


def test_tables_as_csv() -> None:
    table = DataTable({"a, b": np.array([1.5, np.nan]), "n": [1, 2]}, {"a, b": "DN"})
    assert csv_text(table) == '"a, b (DN)",n\n1.5,1\n,2\n'
    with pytest.raises(ValueError, match="different shapes"):
        csv_text(DataTable({"a": [1, 2], "b": [1]}))
    # the place of a map is that on the sensor
    placed = DataTable({"z": np.array([[1.0, 2.0], [4.0, 5.0]])}, origin=(10, 20))
    rows = [tuple(row.values()) for row in rows_of(csv_text(placed).encode())]
    assert rows[1:3] == [("10", "21", "2.0"), ("11", "20", "4.0")]


def test_the_numbers_are_those_drawn(data: ReportData, found: dict[str, Figure]) -> None:
    files = paper_files(found["map_bias"], (), Look())
    rows = rows_of(files["map_bias_histogram.csv"])
    figure = found["map_bias"].draw(Look(88.0))
    [steps] = [artist for artist in figure.axes[0].patches if isinstance(artist, StepPatch)]
    np.testing.assert_array_equal(numbers(rows, "pixels"), steps.get_data().values)
    np.testing.assert_array_equal(numbers(rows, "bias to (DN)"), steps.get_data().edges[1:])
    rows = rows_of(files["map_bias.csv"])
    place = 5 * 16 + 3
    assert (rows[place]["y (pixel)"], rows[place]["x (pixel)"]) == ("5", "3")
    np.testing.assert_array_equal(numbers(rows, "bias (DN)").reshape(12, 16), data.maps["bias"])
    np.testing.assert_array_equal(numbers(rows, "standard error (DN)"), data.maps["bias_stderr"].ravel())
    assert {rows[i]["bias (DN)"] for i in np.flatnonzero(np.isnan(data.maps["bias"]))} == {""}


@pytest.mark.parametrize(
    ("name", "part", "x", "y", "label"),
    [
        ("electron_numbers", "", "k (e-)", "electron_pmf", "predicted"),
        ("component_widths", "", "k (e-)", "sd, constant: g (DN)", "constant: g"),
        ("ensemble", "raw", "dn (DN)", "epcd_exact (1/DN)", "exact mean"),
    ],
)  # fmt: skip
def test_tables_agree_with_the_lines_of_the_figure(
    found: dict[str, Figure], name: str, part: str, x: str, y: str, label: str
) -> None:
    tables = {table.part: table.flat() for table in found[name].tables}
    columns = (np.asarray(tables[part][each], dtype=float) for each in (x, y))
    known = dict(zip(*columns, strict=True))
    axes = found[name].draw(Look(180.0)).axes[0]
    [line] = [each for each in axes.lines if str(each.get_label()).startswith(label)][:1]
    drawn = np.asarray(line.get_data(), dtype=float)
    assert drawn.shape[1] >= 4
    np.testing.assert_allclose([known[value] for value in drawn[0]], drawn[1], rtol=1e-12)


def test_residuals_of_pixels_have_the_size_that_chance_gives(
    data: ReportData, found: dict[str, Figure]
) -> None:
    residuals, parameters = found["pixel_fits"].tables
    residual = np.asarray(residuals.flat()["residual (standard deviations)"], dtype=float)
    known = residual[np.isfinite(residual)]
    assert known.size > 100
    # rounding to DN widens peaks a little: a tenth beyond five standard errors of a variance
    assert abs(np.mean(known**2) - 1) < 5 * np.sqrt(2 / known.size) + 0.1
    assert parameters.flat()["y (pixel)"].tolist() == [pixel.y for pixel in data.pixels]


def test_what_a_verdict_draws_is_in_its_tables(found: dict[str, Figure]) -> None:
    axes = found["discrepancy_codes"].draw(Look(180.0)).axes[0]
    [observed] = [each for each in axes.patches if getattr(each, "get_label", str)() == "observed"]
    np.testing.assert_array_equal(
        found["discrepancy_codes"].tables[0]["observed"], observed.get_data().values
    )
    axes = found["discrepancy_frames"].draw(Look(180.0)).axes[1]
    frames, stretches = found["discrepancy_frames"].tables
    lines = {line.get_label(): line.get_ydata() for line in axes.lines}
    np.testing.assert_array_equal(lines["named effects"], frames["readout, named effects"])
    drawn = np.asarray(lines["mean of a stretch"], dtype=float)
    np.testing.assert_array_equal(drawn[np.isfinite(drawn)], stretches["readout"])
    axes = found["discrepancy_gap"].draw(Look(180.0)).axes[0]
    gaps = found["discrepancy_gap"].tables[0]
    floor = float(gaps["floor"][0])
    assert [line.get_xdata()[0] for line in axes.lines if line.get_linewidth() == 0.9] == [floor]
    assert "z" not in gaps
    assert gaps.get("z") is None


def test_files_have_the_width_asked_for_and_fonts_inside(found: dict[str, Figure]) -> None:
    wanted = found["map_read_noise_e"], ("pdf", "png", "svg"), Look(120.0, dpi=200)
    files = paper_files(*wanted)
    assert set(files) == {
        f"map_read_noise_e{end}" for end in (".pdf", ".png", ".svg", ".csv", "_histogram.csv")
    }
    box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ", files["map_read_noise_e.pdf"])
    assert box is not None
    assert float(box[1]) == pytest.approx(120.0 / 25.4 * 72, abs=0.05)
    assert b"/FontFile2" in files["map_read_noise_e.pdf"]
    assert b"/Type3" not in files["map_read_noise_e.pdf"]
    assert b"DejaVuSerif" not in files["map_read_noise_e.pdf"]
    with Image.open(io.BytesIO(files["map_read_noise_e.png"])) as image:
        assert image.width == pytest.approx(120.0 / 25.4 * 200, abs=1)
    assert b"<text" not in files["map_read_noise_e.svg"]
    assert paper_files(*wanted) == files


def test_a_style_sheet_sets_the_fonts(found: dict[str, Figure], tmp_path: Path) -> None:
    sheet = tmp_path / "journal.mplstyle"
    sheet.write_text("font.family: DejaVu Serif")
    files = paper_files(found["map_bias"], ("pdf",), Look(style=str(sheet)))
    assert b"DejaVuSerif" in files["map_bias.pdf"]
    with pytest.raises(ConfigError, match="--style nosuch: neither a file nor a style"):
        paper_files(found["map_bias"], ("pdf",), Look(style="nosuch"))


def test_widths_and_how_to_give_them() -> None:
    for text, mm in (("88mm", 88), ("8.8 cm", 88), ("3.5in", 88.9), ("120", 120), ("252pt", 88.9)):
        assert millimetres(text) == pytest.approx(mm)
    for text in ("", "wide", "-3mm", "88 px", "1mm", "5in5", "900mm"):
        with pytest.raises(ConfigError, match="--width"):
            millimetres(text)


def test_a_saved_figure_keeps_the_style(found: dict[str, Figure], tmp_path: Path) -> None:
    figure = found["electron_numbers"].draw(Look(88.0))
    figure.savefig(tmp_path / "a.pdf")
    assert b"/FontFile2" in (tmp_path / "a.pdf").read_bytes()
    with Image.open(io.BytesIO(figure._repr_png_())) as image:
        assert image.width > 400
