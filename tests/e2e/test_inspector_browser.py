"""The inspector in a real browser: Debian's Chromium, headless, driven by Playwright."""

import base64
import gzip
import json
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from helpers.commands import served
from helpers.inspector_material import make_run
from helpers.packed_maps import unpack_map

from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.base.wording import measured, short, symbol
from pchem_pipeline.model.fit.status import MEANINGS
from pchem_pipeline.model.law.pcd import pcd
from pchem_pipeline.model.maps.maps import display_edges
from pchem_pipeline.model.maps.ordered import Ordered
from pchem_pipeline.stages.report.inspector import packed_map

NY, NX = 70, 90
PANEL = ("quanta_exposure", "charge_rate", "conversion_gain", "bias", "read_noise_dn", "read_noise_e")
HOSTILE = '<script>window.hit = 1</script><img src=x onerror="window.hit = 2">'


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """A run of 6300 pixels, of which 2400 are in the file in full."""
    return make_run(tmp_path_factory.mktemp("looked at"))


@dataclass
class Tab:
    """An open page with an inspector."""

    page: Any

    def text(self, selector):
        return re.sub(r"\s+", " ", self.page.locator(selector).inner_text()).strip()

    def wait(self, i):
        self.page.wait_for_selector(f'#inspector-app[data-pixel="{i}"]', timeout=10_000)

    def selected(self):
        found = re.match(r"([\d,]+) pixels? selected", self.text("#inspector-selection"))
        assert found, self.text("#inspector-selection")
        return int(found[1].replace(",", ""))

    def values_are_those_of(self, store, i):
        """Assert that the panel shows each value of a pixel, with its error, as the store has it."""
        for name in PANEL:
            assert self.value(f"maps/{name}") == shown_value(store, name, i), name
        counts = store.read("histogram/counts")[divmod(i, NX)]
        assert f"Gray: {counts.sum():,} frames." in self.text("#inspector-caption")

    def value(self, path):
        return self.text(f'#inspector-values tr[data-path="{path}"] td >> nth=0')

    def show(self, path):
        self.page.select_option("#inspector-map", path)
        self.page.wait_for_selector(f'#inspector-app[data-map="{path}"]', timeout=10_000)

    def position(self, y, x):
        """Where a pixel is in the window, the whole map being shown."""
        self.page.locator("#inspector-canvas").scroll_into_view_if_needed()
        box = self.page.locator("#inspector-canvas").bounding_box()
        scale = min(box["width"] / NX, box["height"] / NY)
        left, top = (box["width"] - NX * scale) / 2, (box["height"] - NY * scale) / 2
        return box["x"] + left + (x + 0.5) * scale, box["y"] + top + (y + 0.5) * scale

    def drag(self, start, end):
        """Move the pressed mouse from one place of the window to another."""
        self.page.mouse.move(*start)
        self.page.mouse.down()
        self.page.mouse.move(*end, steps=4)
        self.page.mouse.up()

    def click(self, y, x):
        self.page.mouse.click(*self.position(y, x))
        self.wait(y * NX + x)


@pytest.fixture
def open_tab(open_page):
    def open_(url, width=1280, scheme="light"):
        page = open_page(url, width, color_scheme=scheme)
        page.wait_for_selector("#inspector-app[data-ready]", timeout=20_000)
        return Tab(page)

    return open_


@pytest.fixture
def tab(open_tab, store):
    return open_tab(file_url(store))


def file_url(store):
    return (store.path / "report.html").as_uri()


def shown_value(store, name, i):
    value, error = (float(store.read(f"maps/{each}").ravel()[i]) for each in (name, f"{name}_stderr"))
    return measured(value, error, symbol(name)[2])


def in_full(tab):
    """Pixels whose histogram is in the file: those that Next visits."""
    facts, sample = (tab.page.locator(f"#inspector-{name}").text_content() for name in ("facts", "sample"))
    content = gzip.decompress(base64.b64decode(sample))
    return set(np.frombuffer(content, "<u4", json.loads(facts)["sample"]["n"]).tolist())


def test_the_policy_of_the_page_forbids_network_and_other_scripts(browser, store):
    page = browser.new_page()
    page.goto(file_url(store))
    page.evaluate(
        "() => { window.forbidden = [];"
        "document.addEventListener('securitypolicyviolation',"
        "(e) => window.forbidden.push(e.effectiveDirective)) }"
    )
    assert page.evaluate("fetch('http://127.0.0.1:9/').then(() => 'sent', () => 'refused')") == "refused"
    page.evaluate(
        "() => { const s = document.createElement('script'); s.text = 'window.hit = 1';"
        "document.body.append(s) }"
    )
    page.wait_for_function("window.forbidden.length >= 2", timeout=5000)
    assert page.evaluate("window.hit") is None
    assert set(page.evaluate("window.forbidden")) == {"connect-src", "script-src-elem"}
    page.close()


def test_it_opens_on_the_median_pixel_and_tells_what_the_mouse_is_over(tab, store):
    noise = store.read("maps/read_noise_e").ravel()
    i = int(tab.page.get_attribute("#inspector-app", "data-pixel"))
    assert i in in_full(tab)
    assert abs(noise[i] - np.nanmedian(noise)) < 0.02 * np.nanstd(noise)
    assert tab.page.evaluate("scrollY") == 0
    assert "#" not in tab.page.url
    assert f"pixel={i // NX},{i % NX}" in tab.page.get_attribute("#inspector-link", "href")
    marks = [int(each) for each in tab.page.locator("#inspector-axis-x span").all_inner_texts()]
    assert marks[0] == 0
    assert max(marks) < NX
    assert len(marks) > 2
    tab.page.mouse.move(*tab.position(10, 10))
    assert tab.page.locator("#inspector-tip").is_visible()
    tab.page.focus("#inspector-canvas")
    tab.page.keyboard.press("ArrowRight")
    assert tab.page.locator("#inspector-tip").is_hidden()
    i = min(i for i in in_full(tab) if i > 1000 and store.read("fit/fit_status").ravel()[i] == 0)
    tab.page.mouse.move(*tab.position(*divmod(i, NX)))
    noise = shown_value(store, "read_noise_e", i)
    assert tab.text("#inspector-tip") == f"pixel y = {i // NX}, x = {i % NX}: read noise {noise} · good fit"
    # colours by rank: labels are the values whose Beta(2,2) level is 0, 1/4, 1/2, 3/4 and 1
    tab.page.select_option("#inspector-colours", "beta")
    labels = [float(text) for text in tab.page.locator("#inspector-scale .ticks span").all_inner_texts()]
    known = Ordered.of(store.read("maps/read_noise_e"))
    inner = display_edges(known, [0.25, 0.5, 0.75])
    assert labels == pytest.approx([known.values[0], *inner, known.values[-1]], rel=0.01)


def test_a_click_shows_the_numbers_of_the_store(tab, store):
    status = store.read("fit/fit_status").ravel()
    full = sorted(i for i in in_full(tab) if status[i] == 0)
    assert len(full) > 1000
    for i in (full[10], full[len(full) // 2]):
        tab.click(*divmod(i, NX))
        assert tab.text("#inspector-title") == f"Pixel y = {i // NX}, x = {i % NX}"
        assert tab.text("#inspector-status").startswith("✓ good fit; goodness of fit p = ")
        tab.values_are_those_of(store, i)
    # and its table the fitted density
    tab.page.click("#inspector-counts summary")
    tab.page.wait_for_selector("#inspector-counts tbody tr")
    rows = [row.split("\t") for row in tab.page.locator("#inspector-counts tbody").inner_text().splitlines()]
    place = divmod(i, NX)
    theta = [store.read(f"maps/{name}")[place] for name in PARAMETERS]
    counts, origin = (store.read(f"histogram/{name}")[place] for name in ("counts", "origin"))
    assert len(rows) > 30
    for row in rows:
        dn = int(row[0])
        there = 0 <= dn - origin < counts.size
        assert int(row[1]) == (counts[dn - origin] if there else 0)
        expected = counts.sum() * float(pcd(dn, *theta))
        if expected > 0.01:
            assert float(row[2].replace("−", "-")) == pytest.approx(expected, rel=0.01, abs=0.01)


def test_a_pixel_that_is_not_in_full_says_so(tab, store):
    known = np.isfinite(store.read("maps/bias").ravel())
    i = next(i for i in range(2000, NX * NY) if i not in in_full(tab) and known[i])
    tab.click(*divmod(i, NX))
    assert (
        "histogram is not in the file, which holds 2,400 of 6,300. To see all: pchem view run.zarr"
        in tab.text("#inspector-note")
    )
    for name in PANEL:
        value, error = tab.value(f"maps/{name}").split(" ± ")
        exact, exact_error = (store.read(f"maps/{each}").ravel()[i] for each in (name, f"{name}_stderr"))
        # half a step of the code, and half a unit of the last digit shown
        last = 0.5 * 10.0 ** -len(value.partition(".")[2])
        typical = np.nanmedian(store.read(f"maps/{name}_stderr"))
        assert abs(float(value.replace("−", "-")) - exact) <= typical / 16 + last, name
        assert float(error.split()[0]) == pytest.approx(exact_error, rel=0.1)
    tab.page.click("#inspector-nearest")
    tab.page.wait_for_selector("#inspector-nearest", state="hidden")
    assert "frames." in tab.text("#inspector-caption")


def test_a_pixel_without_histogram_and_curve_has_no_chart(open_tab, store, tmp_path):
    """Of a model with effects the curve is stored with the histogram."""
    text = (store.path / "report.html").read_text()
    assert text.count('"model":""') == 1
    (tmp_path / "report.html").write_text(text.replace('"model":""', '"model":"PCD + rts_noise"'))
    tab = open_tab((tmp_path / "report.html").as_uri())
    known = np.isfinite(store.read("maps/bias").ravel())
    i = next(i for i in range(2000, NX * NY) if i not in in_full(tab) and known[i])
    tab.click(*divmod(i, NX))
    assert "histogram is not in the file" in tab.text("#inspector-note")
    assert tab.page.locator("#inspector-plot canvas").count() == 0


def test_keyboard_only(tab, store):
    press = tab.page.keyboard.press
    for _ in range(80):
        press("Tab")
        if tab.page.evaluate("document.activeElement.id") == "inspector-canvas":
            break
    else:
        pytest.fail("the map cannot be reached by Tab")
    tab.page.evaluate("location.hash = 'pixel=35,45'")
    centre = (NY // 2) * NX + NX // 2
    tab.wait(centre)
    for key, i in (
        ("ArrowRight", centre + 1),
        ("ArrowDown", centre + 1 + NX),
        ("Shift+ArrowLeft", centre + 1 + NX - 10),
    ):
        press(key)
        tab.wait(i)
    assert f"y = {NY // 2 + 1}, x = {NX // 2 - 9}: read noise" in tab.text("#inspector-spoken")
    press("Home")
    tab.wait((NY // 2 + 1) * NX)
    press("]")
    tab.page.wait_for_function(
        f"document.getElementById('inspector-app').dataset.pixel > {(NY // 2 + 1) * NX}"
    )
    # a rectangle of 3 x 4 pixels
    y, x = divmod(int(tab.page.get_attribute("#inspector-app", "data-pixel")), NX)
    press("s")
    for key in ("ArrowDown", "ArrowDown", "ArrowRight", "ArrowRight", "ArrowRight"):
        press(key)
    press("s")
    assert tab.selected() == 12
    assert f"y {y} to {y + 2}, x {x} to {x + 3}" in tab.text("#inspector-selection")
    press("Escape")
    assert tab.text("#inspector-selection").startswith("Nothing selected")
    press("+")
    press("0")
    for place in (12, 70):
        tab.page.fill("#inspector-y", str(place))
        tab.page.fill("#inspector-x", "34")
        press("Enter")
        if place < NY:
            tab.wait(place * NX + 34)
    assert "There is no such pixel: y is 0 to 69, x is 0 to 89." in tab.text("#inspector-spoken")


def test_rectangle_brush_ends_and_words_select_the_right_pixels(tab, store):
    tab.page.keyboard.down("Shift")
    tab.drag(tab.position(10, 20), tab.position(29, 59))
    tab.page.keyboard.up("Shift")
    assert tab.selected() == 20 * 40
    # the maps as the page has them where it has no exact values
    shown, bias = (
        unpack_map(packed_map(store.at(), f"maps/{each}"), (NY, NX)) for each in ("read_noise_e", "bias")
    )
    median = float(np.nanmedian(shown[10:30, 20:60]))
    assert f"Median read noise {short(median)[:4]}" in tab.text("#inspector-selection")
    plot = tab.page.locator("#inspector-histogram")
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    y = box["y"] + box["height"] / 2
    tab.drag((box["x"] + 0.2 * box["width"], y), (box["x"] + 0.35 * box["width"], y))
    low, high = (float(tab.page.input_value(f"#inspector-{end}")) for end in ("from", "to"))
    slack = 1e-4 * high
    least = ((shown >= low + slack) & (shown <= high - slack)).sum()
    most = ((shown >= low - slack) & (shown <= high + slack)).sum()
    assert 100 < least <= tab.selected() <= most < NX * NY
    assert most - least < 100
    assert tab.page.locator("#inspector-histogram .chosen").count() == 1
    tab.page.click("#inspector-clear")
    assert tab.text("#inspector-selection").startswith("Nothing selected")
    tab.page.fill("#inspector-from", "0.28")
    tab.page.fill("#inspector-to", "0.31")
    tab.page.keyboard.press("Enter")
    inside = (shown >= 0.28) & (shown <= 0.31)
    assert 500 < inside.sum() < 5000
    assert tab.selected() == inside.sum()
    tab.show("maps/bias")
    step = packed_map(store.at(), "maps/bias").scale.step
    found = re.search(r"Median bias ([\d.]+) DN, of all ([\d.]+)", tab.text("#inspector-selection"))
    for text, values in ((found[1], bias[inside]), (found[2], bias[np.isfinite(bias)])):
        assert float(text) == pytest.approx(np.median(values), abs=step + 0.5)
    assert tab.selected() == inside.sum()
    tab.show("fit/fit_status")
    status = store.read("fit/fit_status")
    legend = tab.page.locator("#inspector-scale button")
    bit, words = next((bit, words) for bit, words in MEANINGS.items() if ((status & int(bit)) != 0).sum() > 5)
    n = int(((status & int(bit)) != 0).sum())
    button = legend.filter(has_text=words)
    assert button.inner_text().strip() == f"{words}: {n:,} pixels"
    button.click()
    assert tab.selected() == n


def test_zoom_and_pan(tab):
    tab.page.locator("#inspector-canvas").scroll_into_view_if_needed()
    for _ in range(4):
        tab.page.click("#inspector-in")
    tab.page.locator("#inspector-canvas").scroll_into_view_if_needed()
    box = tab.page.locator("#inspector-canvas").bounding_box()
    scale = min(box["width"] / NX, box["height"] / NY) * 1.6**4
    x, y = box["x"] + box["width"] / 2 + 1, box["y"] + box["height"] / 2 + 1
    tab.page.mouse.click(x, y)
    tab.wait(NY // 2 * NX + NX // 2)
    tab.drag((x, y), (x + 3 * scale, y + 2 * scale))
    tab.page.mouse.click(x, y)
    tab.wait((NY // 2 - 2) * NX + NX // 2 - 3)
    tab.page.click("#inspector-whole")
    tab.click(3, 5)


def test_the_link_keeps_zoom_colours_and_selection(open_tab, store):
    first = open_tab(file_url(store))
    first.page.select_option("#inspector-colours", "p5")
    first.page.fill("#inspector-from", "0.3")
    first.page.press("#inspector-from", "Enter")
    first.show("maps/bias")
    first.page.click("#inspector-in")
    first.page.wait_for_url(re.compile("zoom="))
    second = open_tab(first.page.url)
    assert second.page.input_value("#inspector-colours") == "p5"
    assert second.text("#inspector-selection") == first.text("#inspector-selection")
    assert second.page.get_attribute("#inspector-app", "data-map") == "maps/bias"
    assert second.page.get_attribute("#inspector-link", "href") == first.page.evaluate("location.hash")
    box = open_tab(f"{file_url(store)}#select=box,3,4,7,9")
    assert "30 pixels selected" in box.text("#inspector-selection")


def test_a_selection_is_saved_as_csv_and_as_a_mask(tab, store, tmp_path):
    tab.page.evaluate("location.hash = 'select=box,3,4,7,9'")
    tab.page.wait_for_selector("#inspector-mask:enabled")
    for name in ("csv", "mask"):
        with tab.page.expect_download() as download:
            tab.page.click(f"#inspector-{name}")
        download.value.save_as(tmp_path / name)
    mask = np.load(tmp_path / "mask")
    expected = np.zeros((NY, NX), bool)
    expected[4:10, 3:8] = True
    assert mask.dtype == bool
    np.testing.assert_array_equal(mask, expected)
    rows = np.genfromtxt(tmp_path / "csv", delimiter=",", skip_header=1)
    np.testing.assert_array_equal(rows[:, :2], np.argwhere(expected))
    noise, error = (store.read(f"maps/{name}")[expected] for name in ("read_noise_e", "read_noise_e_stderr"))
    assert np.nanmax(np.abs(rows[:, 2] - noise) / error) < 0.1


def test_notable_pixels_are_sorted_by_a_click(tab, store):
    tab.page.click("#inspector-notables > summary")
    heads = tab.page.locator("#inspector-notables th[scope=col]")
    heads.nth(1).locator("button").click()
    places = [
        int(each.get_attribute("data-pixel")) for each in tab.page.locator("#inspector-notable button").all()
    ]
    assert places == sorted(places)
    assert heads.nth(1).get_attribute("aria-sort") == "ascending"
    heads.nth(1).locator("button").click()
    assert heads.nth(1).get_attribute("aria-sort") == "descending"
    noisiest = int(np.nanargmax(store.read("maps/read_noise_e")))
    row = tab.page.locator("#inspector-notable tr", has_text="largest read noise").filter(
        has=tab.page.locator(f'button[data-pixel="{noisiest}"]')
    )
    assert short(float(np.nanmax(store.read("maps/read_noise_e"))), 4) in row.inner_text()
    row.locator("button").click()
    tab.wait(noisiest)


def test_a_tap_on_a_phone_shows_the_pixel(browser, store):
    context = browser.new_context(viewport={"width": 390, "height": 800}, has_touch=True, is_mobile=True)
    page = context.new_page()
    page.goto(file_url(store))
    page.wait_for_selector("#inspector-app[data-ready]")
    page.locator("#inspector-canvas").tap(position={"x": 60, "y": 60})
    page.wait_for_selector("#inspector-app[data-pixel]")
    page.wait_for_timeout(1500)  # the page scrolls smoothly
    assert 0 <= page.locator("#inspector-title").bounding_box()["y"] < 200
    context.close()


def test_figures_are_saved_words_explained_and_folded_parts_opened(tab, tmp_path):
    term = tab.page.locator("a.term").first
    term.focus()
    assert len(tab.text("#term-tip")) > 30
    tab.page.keyboard.press("Escape")
    assert tab.page.locator("#term-tip").is_hidden()
    assert tab.page.locator("#glossary dl").is_hidden()
    tab.page.evaluate("location.hash = 'term-bias'")
    tab.page.locator("#term-bias").wait_for(state="visible")
    row = tab.page.locator("#figure-fit_status .downloads")
    with tab.page.expect_download() as download:
        row.get_by_text("CSV: reasons").click()
    download.value.save_as(tmp_path / "csv")
    assert (tmp_path / "csv").read_text().startswith("bit,meaning,pixels\n")


@pytest.mark.parametrize("hash_", ["#pixel=70,0&map=<script>", "#pixel=-1e3,2&colours=x", "#map=__proto__"])
def test_addresses_of_nothing_do_no_harm(open_tab, store, hash_):
    tab = open_tab(file_url(store) + hash_)
    named = hash_[1:].split("&")[0].replace("=", " ")
    assert "Not in this run" in tab.text("#inspector-trouble")
    assert named in tab.text("#inspector-trouble")
    assert tab.text("#inspector-status").startswith("✓")
    assert tab.page.get_attribute("#inspector-app", "data-map") == "maps/read_noise_e"


def test_everything_has_a_name_for_screen_readers(tab):
    tab.click(*divmod(min(i for i in in_full(tab) if i > 2000), NX))
    nameless = tab.page.evaluate(
        "() => [...document.querySelectorAll('#inspector :is(button, input, select, canvas, svg, a)')]"
        ".filter((e) => !e.closest('.chart'))"
        ".filter((e) => !(e.labels?.length || e.getAttribute('aria-label') || e.textContent.trim()))"
        ".map((e) => e.outerHTML)"
    )
    assert nameless == []
    assert re.search(
        r"Histogram of .*DN; fitted density; first limits .* DN",
        tab.page.get_attribute("#inspector-plot .chart", "aria-label"),
    )
    assert re.search(
        r"median 0\.\d+ e⁻, 5 to 95 % from", tab.page.get_attribute("#inspector-histogram", "aria-label")
    )
    assert tab.page.get_attribute("#inspector-selection", "aria-live") == "polite"


#: of files and cameras: many scripts, words without an end, marks upon marks
NAMES = (
    "äöü Ελληνικά кириллица 日本語 한국어 हिन्दी ไทย ქართული አማርኛ தமிழ் བོད་ ᏣᎳᎩ \U0001f600",
    "مستشعر الضوء (٣) abc",
    "חיישן 12 <b>",
    "\u202eunclosed",
    "w" * 200,
    "日本語" * 40,
    "Z" + "\u0301\u0327\u0352" * 60,
    HOSTILE,
)


@pytest.mark.parametrize(("width", "scheme", "channels"), [(360, "light", False), (800, "dark", True)])
def test_names_in_all_scripts_are_shown_not_run_and_keep_the_page_as_wide_as_the_window(
    open_tab, tmp_path, width, scheme, channels
):
    store = make_run(
        tmp_path, (1, len(NAMES)) if channels else (12, 16), failed=0.0 if channels else 0.3, n_frames=60,
        title=" ".join((HOSTILE, *NAMES)), camera=" ".join(NAMES), run={"store": HOSTILE, "model": NAMES[4]},
        inputs=[{"name": name, "size": 1, "hash": "0" * 32} for name in NAMES],
        channel_names=NAMES if channels else (),
    )  # fmt: skip
    tab = open_tab(file_url(store), width, scheme)
    colour = tab.page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert colour == ("rgb(255, 255, 255)" if scheme == "light" else "rgb(20, 24, 28)")
    assert tab.page.locator("#inspector-canvas").bounding_box()["width"] > 0.34 * width
    if not channels:  # a third has failed
        lost = np.flatnonzero(~np.isfinite(store.read("maps/bias")))
        assert f"{lost.size} pixels without a value" in tab.text("#inspector-scale")
        tab.page.click("#inspector-notables > summary")
        tab.page.click(f'#inspector-notable button[data-pixel="{lost[0]}"] >> nth=0')
        tab.wait(int(lost[0]))
        assert tab.text("#inspector-status").startswith("✕ ")
        assert tab.value("maps/read_noise_e") == "no value"
        assert "fitted density" not in tab.text("#inspector-caption")
    tab.page.evaluate("for (const each of document.querySelectorAll('details')) each.open = true")
    assert tab.page.evaluate("document.documentElement.scrollWidth") == width
    assert HOSTILE in tab.page.inner_text("h1")
    assert HOSTILE in tab.page.inner_text("#inputs")
    assert tab.page.locator("img[src=x]").count() == 0
    heading = tab.page.locator("h1").bounding_box()
    assert heading["height"] < 900
    cells = tab.page.locator("#inputs tbody th").evaluate_all(
        "cells => cells.map(each => [getComputedStyle(each).unicodeBidi, getComputedStyle(each).textAlign])"
    )
    assert set(map(tuple, cells)) == {("plaintext", "left")}
    if channels:
        # their numbers stand under the map
        frame = tab.page.locator(".map-frame").bounding_box()
        axis = tab.page.locator("#inspector-axis-x").bounding_box()
        assert (axis["x"], axis["width"]) == pytest.approx((frame["x"], frame["width"]), abs=2)
        assert axis["y"] >= frame["y"] + frame["height"] - 2
        tab.page.fill("#inspector-x", "1")
        tab.page.keyboard.press("Enter")
        tab.wait(1)
        assert tab.text("#inspector-title") == f"Channel 1 \u2068{NAMES[1]}\u2069"
        assert tab.page.locator("#inspector-y").is_hidden()
        assert tab.page.locator("#inspector-canvas").bounding_box()["height"] >= 40
    tab.show("fit/fit_status")
    tab.page.focus("#inspector-canvas")
    tab.page.keyboard.press("ArrowRight")
    tab.page.wait_for_selector("#inspector-app[data-pixel]")
    assert tab.page.evaluate("window.hit") is None


def test_the_server_shows_every_pixel_and_every_map(open_tab, open_page, store):
    store.write_array("fit/log_likelihood", np.arange(NX * NY, dtype=float).reshape(NY, NX))
    page = store.path / "report.html"
    text = page.read_text()
    assert '"path":"fit/log_likelihood"' not in text
    entry = json.dumps(
        {"path": "fit/log_likelihood", "group": "Fit", "label": "log likelihood", "unit": "nat"}
        | {"sentence": "", "kind": "value", "words": {}, "here": False}
    )
    page.write_text(text.replace('],"panel":[', f',{entry}],"panel":[', 1))
    with served(store.path) as (_, address):
        tab = open_tab(address)
        known = np.isfinite(store.read("maps/bias").ravel())
        i = next(i for i in range(3000, NX * NY) if i not in in_full(tab) and known[i])
        tab.click(*divmod(i, NX))
        tab.values_are_those_of(store, i)
        tab.show("fit/log_likelihood")
        words = re.search(r"median (\d+) nat", tab.text("#inspector-histogram-words"))
        assert int(words[1]) == pytest.approx(NX * NY / 2, rel=0.013)
        assert any("/api/map?path=fit%2Flog_likelihood" in url for _, url in open_page.asked)
    page.write_text(text)
    store.delete("fit/log_likelihood")
