"""Charts: one description, and what paper and the page make of it."""

import json
import re
from dataclasses import replace
from itertools import pairwise
from urllib.parse import unquote
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
import pytest
from helpers.discrepancy_material import discrepancy_data
from helpers.report_material import with_stability

from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.base.wording import symbol, without_formulas
from pchem_pipeline.report.charts.chart import (
    COLUMN_MM,
    PAGE_MM,
    SHADES,
    Axis,
    Band,
    Bars,
    Chart,
    Image,
    Level,
    Line,
    Panel,
    Points,
    Span,
    Stack,
    Steps,
    Sticks,
    Words,
    extremes,
    fewer_steps,
    x_window,
    y_window,
)
from pchem_pipeline.report.charts.on_page import page_chart, rounded
from pchem_pipeline.report.charts.on_paper import Look, draw_chart, drawing_bytes
from pchem_pipeline.report.figures.catalogue import run_figures
from pchem_pipeline.report.figures.figure import Figure
from pchem_pipeline.report.inspector import json_for_html
from pchem_pipeline.report.pages.page import draw_figure
from pchem_pipeline.report.style.palette import DIVERGING, LIGHT, MAP_COLOURS, shades

HOSTILE = "</script><script>alert(1)</script><!-- & $\\mu$"


@pytest.fixture(scope="module")
def charts() -> dict[str, Figure]:
    data = with_stability((12, 16), discrepancy=discrepancy_data("named"))
    return {each.name: each for each in run_figures(data)}


def every_mark(label: str = "a") -> Chart:
    x = np.arange(5.0)
    y = np.array([1.0, 3.0, np.nan, 2.0, 4.0])
    marks = (
        Span(1.0, 2.0, colour="band"),
        Band(x, y - 0.5, y + 0.5, colour="band", step=True),
        Steps(np.arange(6.0), y, filled=True, colour="bars", label=label),
        Steps(np.arange(6.0), y, colour="green"),
        Bars(x, np.zeros(5), y, colour="sky"),
        Sticks(x, y),
        Line(x, y, dots=2.0, dash="--", label="curve"),
        Points(x, y, mark="x", error=np.full((2, 5), 0.2), label="points"),
        Points(x, y, mark="s"),
        Level(2.0, axis="x"),
        Words(2.0, 0.5, label),
    )
    panel = Panel(Axis(label), marks, note=label)
    return Chart((Stack((panel,), Axis("x"), label),))


def values_of(x: list[float] | dict[str, float]) -> np.ndarray:
    if isinstance(x, dict):
        return x["from"] + x["step"] * np.arange(x["n"])
    return np.array(x, dtype=np.float64)


def test_the_page_has_the_numbers_that_paper_shows(charts: dict[str, Figure]) -> None:
    for chart in (figure.chart for figure in charts.values() if not figure.chart.still):
        described = page_chart(chart)
        json.dumps(described, allow_nan=False)
        for stack_, shown in zip(chart.stacks, described["stacks"], strict=True):
            for panel, told in zip(stack_.panels, shown["panels"], strict=True):
                across, up = (np.ptp(ends) for ends in (x_window(stack_), y_window(panel)))
                for mark, numbers in zip(panel.marks, told["marks"], strict=True):
                    if not isinstance(mark, Line) or mark.x.size > 4000:
                        continue
                    x, y = values_of(numbers["x"]), np.array(numbers["y"], dtype=np.float64)
                    # logarithmic axes keep five digits
                    x_error = 1e-4 * np.abs(mark.x) if stack_.x.log else 1e-5 * across
                    y_error = 1e-4 * np.abs(mark.y) if panel.y.log else 1e-5 * up
                    assert np.all(np.abs(x - mark.x) <= x_error)
                    np.testing.assert_array_equal(np.isnan(y), ~np.isfinite(mark.y))
                    assert np.all((np.abs(y - mark.y) <= y_error) | np.isnan(y))
    axes = charts["frame_means"].draw(Look()).axes[0]
    [mean] = [mark for mark in charts["frame_means"].chart.stacks[0].panels[0].marks if mark.label == "mean"]
    assert isinstance(mean, Line)
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), mean.y)


def test_pictures_are_whole(charts: dict[str, Figure]) -> None:
    for figure in charts.values():
        drawn = draw_figure(figure)
        svg = unquote(drawn.source.partition(",")[2])
        words = " ".join("".join(ElementTree.fromstring(svg).itertext()).split())
        for stack_ in figure.chart.stacks:
            if (figure.width_mm > COLUMN_MM or not stack_.wide) and "$" not in stack_.x.label:
                assert " ".join(stack_.x.label.split()) in words
        assert 0 < drawn.height < 4 * drawn.width
    # a file of it has outlines in place of text
    assert len(svg) < len(drawing_bytes(figure.draw(Look(figure.width_mm)), "svg"))
    assert draw_figure(figure).source == drawn.source


def test_every_mark_is_drawn_everywhere() -> None:
    chart = every_mark()
    drawing = draw_chart(Look(), chart)
    axes = drawing.axes[0]
    assert len(axes.lines) + len(axes.patches) + len(axes.collections) + len(axes.texts) >= 11
    kinds = [mark["kind"] for mark in page_chart(chart)["stacks"][0]["panels"][0]["marks"]]
    assert set(kinds) == {"span", "band", "steps", "bars", "sticks", "line", "points", "level", "words"}
    y = np.array([1.0, 2.0, np.nan, 3.0, 4.0])
    gap = Chart((Stack((Panel(Axis("y"), (Line(np.arange(5.0), y),)),), Axis("x")),))
    assert page_chart(gap)["stacks"][0]["panels"][0]["marks"][0]["y"] == [1.0, 2.0, None, 3.0, 4.0]
    # numbers have the digits of a screen
    assert rounded(np.array([123.4567891, np.nan, -0.0]), (123.0, 124.0)) == [123.45679, None, 0.0]
    assert rounded(np.array([1.23456789e-7, np.inf]), (1e-9, 1.0), log=True) == [1.2346e-7, None]


def map_chart(values: np.ndarray, *, square: bool = True, **more: object) -> Chart:
    """A map of values from 0 to 1 at rows 10, 11, ... and columns 20, 21, ..."""
    rows, columns = values.shape
    x, y = (19.5, 19.5 + columns), (9.5, 9.5 + rows)
    image = Image(values, x, y, **more)  # type: ignore[arg-type]
    panel = Panel(Axis("y", *y, whole=True, down=True), (image,), square=square)
    return Chart((Stack((panel,), Axis("x", *x, whole=True)),))


def test_a_map_has_the_colours_of_its_scale() -> None:
    values = np.random.default_rng(3).random((6, 9))
    values[2, 4] = np.nan
    for scale, name in (("", MAP_COLOURS), (DIVERGING, DIVERGING)):
        [shown] = draw_chart(Look(), map_chart(values, scale=scale)).axes[0].images
        drawn = shown.to_rgba(shown.get_array(), bytes=True)[..., :3].astype(int)
        assert drawn.shape == (6, 9, 3)
        assert tuple(drawn[2, 4]) == tuple(bytes.fromhex(LIGHT.no_value[1:]))
        level = np.floor(values * SHADES) / (SHADES - 1)
        expected = 255.0 * mpl.colormaps[name](level)[..., :3]
        known = np.isfinite(values)
        assert np.abs(drawn[known] - expected[known]).max() <= 3
        assert np.ptp(drawn, axis=(0, 1)).min() > 60  # the test can fail
    # and those of the page are matplotlib's
    expected = 255.0 * mpl.colormaps[MAP_COLOURS](np.arange(256))[:, :3]
    assert np.abs(shades() - expected).max() < 2.6


def test_a_map_lies_where_its_axes_say() -> None:
    values = np.zeros((4, 8))
    axes = draw_chart(Look(), map_chart(values)).axes[0]
    assert (axes.get_xlim(), axes.get_ylim()) == ((19.5, 27.5), (13.5, 9.5))
    assert axes.images[0].get_extent() == [19.5, 27.5, 13.5, 9.5]
    assert axes.get_aspect() == 1.0
    # upwards, the first row is the lowest
    upwards = np.linspace(0.0, 1.0, 5)[:, None].repeat(3, axis=1)
    panel = Panel(Axis("y", 0.0, 5.0), (Image(upwards, (0.0, 3.0), (0.0, 5.0)),))
    chart = Chart((Stack((panel,), Axis("x", 0.0, 3.0)),))
    axes = draw_chart(Look(), chart).axes[0]
    assert axes.get_ylim() == (0.0, 5.0)
    assert axes.images[0].get_extent() == [0.0, 3.0, 5.0, 0.0]


def test_hostile_words_stay_words() -> None:
    chart = every_mark(HOSTILE)
    text = str(json_for_html(page_chart(chart)))
    assert "<" not in text
    assert json.loads(text)["stacks"][0]["title"].startswith("</script><script>")
    figure = Figure("a", "", HOSTILE, HOSTILE, HOSTILE, (), chart)
    source = draw_figure(figure).source
    assert not set(source) & set("<>&\"'")
    root = ElementTree.fromstring(unquote(source.partition(",")[2]))
    assert "</script><script>alert(1)" in "".join(root.itertext())
    assert all("script" not in each.tag for each in root.iter())
    # and no formula is left
    for name in (*PARAMETERS, "read_noise_e", "dark_current", "spurious_charge"):
        assert not set(without_formulas(symbol(name)[0])) & set("$\\{}_^")
    assert without_formulas(r"$\sigma^2 + (x - \mu)/g$") == "σ² + (x − μ)/g"
    assert without_formulas(r"costs 3 \$ and 4 \$") == "costs 3 $ and 4 $"


def test_long_curves_keep_their_extremes_and_gaps() -> None:
    rng = np.random.default_rng(4)
    x, y = np.arange(100_000.0), rng.standard_normal(100_000)
    y[70_123], y[20_001] = 50.0, -40.0
    y[30_000:40_000] = np.nan
    kept = extremes(x, y, 500)
    assert kept.size == 1000
    assert {70_123, 20_001} <= set(kept.tolist())
    assert np.isnan(y[kept[(kept > 30_200) & (kept < 39_800)]]).all()
    assert np.all(np.diff(kept) >= 0)
    np.testing.assert_array_equal(extremes(x[:900], y[:900], 500), np.arange(900))
    points = Points(x, y, error=np.ones((2, y.size)))
    [few] = page_chart(Chart((Stack((Panel(Axis("y"), (points,)),), Axis("x")),)))["stacks"][0]["panels"][0][
        "marks"
    ]
    assert 2000 <= len(few["y"]) <= 4000
    assert len(few["error"][1]) == len(few["y"])
    assert {50.0, -40.0} <= set(few["y"])
    edges, steps = fewer_steps(np.append(x, 100_000.0), np.abs(y), 3000)
    assert edges.size == steps.size + 1 <= 3001
    assert (edges[0], edges[-1], np.nanmax(steps)) == (0.0, 100_000.0, 50.0)


def test_a_title_wider_than_its_place_is_broken_and_the_panels_beside_it_stay_level() -> None:
    """The titles of three maps of a verdict ran into each other."""
    names = ("readout: alike", "readout follows the neighbour's charge, along x", "charge: alike")
    stacks = [replace(map_chart(np.ones((4, 4))).stacks[0], title=name) for name in names]
    drawing = draw_chart(Look(PAGE_MM), Chart(tuple(stacks), (1.0, 1.0, 1.0)))
    assert [axes.get_title("left").replace("\n", " ") for axes in drawing.axes] == [*names]
    boxes = [axes._left_title.get_window_extent() for axes in drawing.axes]
    assert all(one.x1 < other.x0 for one, other in pairwise(boxes))
    assert len({round(axes.get_window_extent().y1) for axes in drawing.axes}) == 1


def test_axes_end_where_they_are_told_or_beyond_the_marks() -> None:
    bars = Bars(np.arange(3.0), np.zeros(3), np.array([1.0, 2.0, 3.0]))
    assert y_window(Panel(Axis("y"), (bars,))) == (0.0, pytest.approx(3.15))
    line = Line(np.arange(3.0), np.array([1.0, np.nan, 3.0]))
    assert y_window(Panel(Axis("y"), (line,))) == (pytest.approx(0.9), pytest.approx(3.1))
    assert y_window(Panel(Axis("y", low=-2.0), (line,)))[0] == -2.0
    low, high = y_window(Panel(Axis("y", log=True), (Line(np.arange(2.0), np.array([0.0, 10.0])),)))
    assert 0 < low < 10 < high
    assert y_window(Panel(Axis("y"), ())) == (1.0 - 0.45, 10.0 + 0.45)
    # equal ends are none: the drawing follows the marks, without a warning
    same = Chart((Stack((Panel(Axis("y", low=1.0, high=1.0), (line,)),), Axis("x")),))
    assert np.diff(draw_chart(Look(), same).axes[0].get_ylim()) > 1.9


def test_the_texts_of_an_x_axis_stand_apart() -> None:
    """Six characters need 11 mm; a column has room for five of them and the space between."""
    axis = Axis("conversion gain (e⁻/DN)", 0.1163, 0.1335)
    look = Look(70.0, svg_text=True)
    drawing = draw_chart(look, Chart((Stack((Panel(Axis("pixels", 0.0, 1.0), ()),), axis),)))
    assert re.findall(r">(0\.1\d+)<", drawing_bytes(drawing, "svg").decode()) == ["0.120", "0.125", "0.130"]
