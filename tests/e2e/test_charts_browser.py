"""The charts of a report in a real browser: Debian's Chromium, headless, driven by Playwright."""

import functools
import json

import PIL.Image
import pytest
from helpers.discrepancy_material import discrepancy_data
from helpers.report_material import with_stability
from helpers.without_pictures import DOT

from pchem_pipeline.report.figures.catalogue import discrepancy_figures, report_figures
from pchem_pipeline.report.pages.page import draw_figure
from pchem_pipeline.report.pages.report import render_report

#: What a canvas shows, as text; its number of different colours.
SHOWN = "(canvas) => canvas.toDataURL()"
COLOURS = """(canvas) => new Set(new Uint32Array(
    canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data.buffer)).size"""
#: Figures whose pictures are looked at: the others need none where charts are drawn.
LOOKED_AT = ("ensemble", "map_bias")
OPEN = "() => { for (const each of document.querySelectorAll('details.folded')) each.open = true; }"


@pytest.fixture(scope="module")
def data():
    title = "<img src=x onerror=alert(1)>"
    return with_stability((24, 32), title=title, discrepancy=discrepancy_data("named"))


@pytest.fixture(scope="module")
def page_url(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("charts")

    def some(figures):
        return {each.name: draw_figure(each) if each.name in LOOKED_AT else DOT for each in figures}

    for name, text in render_report(data, some).items():
        (folder / name).write_text(text)
    return (folder / "report.html").as_uri()


@pytest.fixture(scope="module")
def names(data):
    pages = {"report": report_figures(data), "discrepancy": discrepancy_figures(data.discrepancy)}
    return {
        page: sorted(each.name for each in figures if not each.chart.still and each.section)
        for page, figures in pages.items()
    }


@pytest.fixture
def report(open_page, page_url):
    """Open the report, with options of the browser."""
    return functools.partial(open_page, page_url)


def chart(page, name):
    """Return a figure whose chart is drawn."""
    page.evaluate(OPEN)
    for part in page.locator("details.part").all():
        part.evaluate("(each) => { each.open = true; }")
    figure = page.locator(f"#figure-{name}")
    figure.scroll_into_view_if_needed()
    page.wait_for_selector(f"#figure-{name}.drawn canvas", timeout=10_000)
    return figure


def drag(page, over, start, end):
    box = over.bounding_box()
    start, end = ((box["x"] + u * box["width"], box["y"] + v * box["height"]) for u, v in (start, end))
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(*end, steps=2)
    page.mouse.up()
    page.mouse.move(5, 5)


@pytest.mark.parametrize(("width", "scheme"), [(1200, "light"), (400, "dark")])
def test_every_chart_is_drawn(report, names, width, scheme):
    page = report(width, color_scheme=scheme)
    assert names["discrepancy"]
    for file, name in [(file, name) for file, shown in names.items() for name in shown]:
        if not page.url.endswith(f"{file}.html"):
            page.goto(page.url.replace("report.html", f"{file}.html"))
        figure = chart(page, name)
        canvases = figure.locator("canvas").all()
        assert canvases
        assert all(canvas.evaluate(COLOURS) > 5 for canvas in canvases), name
        assert not figure.locator("img").is_visible()
        room = page.evaluate("() => document.documentElement.clientWidth")
        assert all(0 < canvas.bounding_box()["width"] <= room for canvas in canvases)
        assert figure.locator(".chart").get_attribute("aria-label") == figure.locator("img").get_attribute(
            "alt"
        )
    assert page.evaluate("() => document.scrollingElement.scrollWidth") <= width


def test_mouse_and_keys_zoom_and_read_values(report):
    page = report()
    figure = chart(page, "ensemble")
    top, strip = (figure.locator("canvas").nth(i) for i in (0, 1))
    before = [each.evaluate(SHOWN) for each in (top, strip)]
    over = figure.locator(".u-over").nth(0)
    drag(page, over, (0.3, 0.2), (0.5, 0.8))
    page.wait_for_timeout(50)
    # both panels of a stack go along
    assert all(each.evaluate(SHOWN) != old for each, old in zip((top, strip), before, strict=True))
    over.dblclick()
    page.mouse.move(5, 5)
    page.wait_for_timeout(50)
    assert [each.evaluate(SHOWN) for each in (top, strip)] == before
    figure = chart(page, "frame_means")
    panel, canvas = figure.locator(".panel").nth(0), figure.locator("canvas").nth(0)
    before = canvas.evaluate(SHOWN)
    panel.focus()
    page.keyboard.press("ArrowRight")
    assert "frame: " in figure.locator(".spoken").nth(0).inner_text()
    assert "mean" in figure.locator(".spoken").nth(0).inner_text()
    page.keyboard.press("+")
    page.wait_for_timeout(50)
    assert canvas.evaluate(SHOWN) != before
    page.keyboard.press("0")
    page.wait_for_timeout(50)
    assert canvas.evaluate(SHOWN) == before


def test_the_legend_has_values_and_hides_what_it_names(report, data):
    page = report()
    figure = chart(page, "electron_numbers")
    button = figure.get_by_role("button", name="estimated electron numbers")
    box = figure.locator(".u-over").nth(0).bounding_box()
    kept = json.loads(page.locator("#charts").text_content())
    low, high = kept["charts"]["electron_numbers"]["stacks"][0]["x"]["ends"]
    for k in (1, 3):
        at = box["x"] + box["width"] * (k - low) / (high - low)
        page.mouse.move(at, box["y"] + box["height"] / 2)
        value = button.locator("xpath=..").locator(".value")
        assert float(value.inner_text()) == pytest.approx(float(data.ensemble["electron_mass"][k]), rel=1e-3)
    canvas = figure.locator("canvas").nth(0)
    page.mouse.move(5, 5)
    before = canvas.evaluate(SHOWN)
    button.click()
    assert button.get_attribute("aria-pressed") == "false"
    page.wait_for_timeout(50)
    assert canvas.evaluate(SHOWN) != before
    button.press("Enter")
    page.wait_for_timeout(50)
    assert (button.get_attribute("aria-pressed"), canvas.evaluate(SHOWN)) == ("true", before)


def test_paper_and_readers_without_scripts_get_the_plain_picture(report):
    page = report()
    figure = chart(page, "ensemble")
    page.emulate_media(media="print")
    assert figure.locator("img").is_visible()
    assert not figure.locator(".chart").is_visible()
    page = report(java_script_enabled=False)
    image = page.locator("#figure-ensemble img")
    assert image.is_visible()
    assert image.bounding_box()["height"] > 200


def test_a_chart_follows_the_width_of_the_window(report):
    page = report()
    figure = chart(page, "pixel_fits")
    wide = figure.locator("canvas").nth(0).bounding_box()["width"]
    page.set_viewport_size({"width": 420, "height": 900})
    page.wait_for_timeout(200)
    narrow = [each.bounding_box()["width"] for each in figure.locator("canvas").all()]
    assert max(narrow) <= 420
    assert max(narrow) != wide
    assert page.evaluate("() => document.scrollingElement.scrollWidth") <= 420


def test_pictures_are_dark_on_a_dark_screen_and_light_as_files(report, tmp_path):
    page = report(1200, color_scheme="dark")
    figure = page.locator("#figure-map_bias")
    path = tmp_path / "shown.png"
    figure.locator("img").screenshot(path=path)
    with PIL.Image.open(path) as shown:
        assert max(shown.convert("RGB").getpixel((20, 20))) < 60
    for kind in ("SVG", "PNG"):
        with page.expect_download() as download:
            figure.get_by_role("button", name=f"Save map_bias as {kind}").click()
        download.value.save_as(tmp_path / kind)
    svg = (tmp_path / "SVG").read_text()
    assert "<svg" in svg
    assert "prefers-color-scheme" not in svg
    with PIL.Image.open(tmp_path / "PNG") as saved:
        assert min(saved.convert("RGB").getpixel((20, 20))) > 250
