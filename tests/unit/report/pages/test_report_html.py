"""The HTML report: complete in itself, readable by everyone, and safe with hostile names."""

import base64
import gzip
import hashlib
import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers.html_page import HOSTILE, Page, harmless
from helpers.report_material import report_data, with_stability

from pchem_pipeline import __version__
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.report.data import MAP_NAMES, ReportData, Sample, Samples
from pchem_pipeline.report.figures.catalogue import report_figures
from pchem_pipeline.report.figures.figure import DataTable, csv_text
from pchem_pipeline.report.inspector import text_of
from pchem_pipeline.report.pages.page import GLOSSARY, anchor_of, chart_script, explained, figure_tables
from pchem_pipeline.report.pages.report import citation, render_report
from pchem_pipeline.report.pages.summary import answers, flags, key_numbers, sentence
from pchem_pipeline.report.pages.tables import result_tables

#: Of one exposure, with nothing compared.
FIGURES = {
    *("pixel_fits", "goodness", "fit_status", "ensemble", "electron_numbers", "component_widths"),
    *("map_charge_rate", "map_conversion_gain", "map_bias", "map_read_noise_e"),
    *("frame_means", "profiles", "spatial_spectra"),
}


@pytest.fixture(scope="module")
def data() -> ReportData:
    return with_stability((24, 32))


@pytest.fixture(scope="module")
def report(data: ReportData) -> dict[str, str]:
    return render_report(data)


@pytest.fixture(scope="module")
def page(report: dict[str, str]) -> Page:
    return harmless(report["report.html"])


def test_nothing_is_loaded_from_anywhere(page: Page) -> None:
    policy = next(a for a in page.of("meta") if a.get("http-equiv") == "Content-Security-Policy")
    rules = dict(rule.strip().split(" ", 1) for rule in str(policy["content"]).split(";"))
    assert (
        rules["default-src"] == rules["connect-src"] == rules["base-uri"] == rules["form-action"] == "'none'"
    )
    assert rules["img-src"] == "data:"
    # no script but the one whose hash is in the policy; data blocks are not run
    scripts = [a for a in page.of("script") if a.get("type") not in ("application/json", "text/plain")]
    digests = [
        f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
        for text in (text_of("page.js"), chart_script(), text_of("inspector.js"))
    ]
    if not any(a.get("id") == "charts" for a in page.of("script")):
        del digests[1]
    assert rules["script-src"] == " ".join(digests[: len(scripts)])
    assert len(scripts) in (1, 2, 3)


def test_every_figure_of_the_paper_is_there_and_described(page: Page, data: ReportData) -> None:
    images = list(page.of("img"))
    shown = {str(a["id"]).removeprefix("figure-") for a in page.of("figure")}
    assert shown == FIGURES
    assert len(images) == len(shown)
    for image in images:
        alt = str(image["alt"])
        assert re.search(r"\d", alt), alt
        assert len(alt) > 40
        assert image["width"]
    median = np.nanmedian(np.where(data.flagged_in("read_noise_e"), np.nan, data.maps["read_noise_e"]))
    assert any(f"read noise: median {median:.4f}" in str(image["alt"]) for image in images)


def test_the_tables_have_headings_and_scroll_by_keyboard(page: Page) -> None:
    for words in (
        *("Estimates against the truth", "Moments of the ensemble", "Wrong estimates (truth known)"),
        *("algorithm: newton", "xxh3_128:0123456789abcdef", "45.6 s", "488 MiB", "2026-01-02T03:04:05Z"),
    ):
        assert words in page.text
    assert {a.get("scope") for a in page.of("th")} == {"col", "row"}
    regions = [(a["role"], a["tabindex"]) for a in page.of("div") if a.get("class") == "scroll"]
    assert regions == [("region", "0")] * len(list(page.of("table")))
    data = report_data((24, 32))
    part = {"quantity": "of which read noise", "unit": "DN2", "predicted": 5.552184}
    moments = replace(data, moments=[*data.moments, part])
    (table,) = [each for each in result_tables(moments) if each.id == "moments"]
    # the digits of the data that they are compared with
    assert [row["from the maps"] for row in table.rows] == ["121.340", "251.30", "5.55"]


def test_the_first_screen_has_the_numbers(page: Page, data: ReportData) -> None:
    before = page.text.index("Parameter maps", page.text.index("Is the sensor within limits?"))
    first = page.text[:before]
    for words in ("Is the sensor within limits?", "Are these results reliable?", "checks passed", "criteria"):
        assert words in first
    for number in key_numbers(data):
        assert first.count(number.value) == 1
        assert number.spread in first
    figures = [str(a["id"]) for a in page.of("figure")]
    assert set(figures[:3]) == {"figure-map_read_noise_e", "figure-map_conversion_gain", "figure-ensemble"}


def test_words_of_the_field_lead_to_the_glossary(page: Page) -> None:
    entries = {a.get("id") for a in page.of("dt")}
    links = {str(a["href"])[1:] for a in page.of("a") if a.get("class") == "term"}
    assert {"term-read-noise", "term-hot-pixels", "term-fixed-pattern-noise"} <= links <= entries
    assert {anchor_of(term[0]) for term in GLOSSARY} <= entries
    assert str(explained("Hot pixels <b>, hot pixels")) == (
        '<a class="term" href="#term-hot-pixels">Hot pixels</a> &lt;b&gt;, hot pixels'
    )
    assert "bias-free" in explained("bias-free")  # a part of another word is none
    assert "overall system gain" in page.text
    assert "DSNU_1288" in page.text


def test_figures_carry_their_numbers(page: Page, report: dict[str, str], data: ReportData) -> None:
    kept = json.loads(next(words for words in page.words if words.startswith('{"') and "ensemble" in words))
    assert set(kept) == {str(a["id"]).removeprefix("figure-") for a in page.of("figure")}
    figure = next(each for each in report_figures(data) if each.name == "profiles")
    texts = {part: gzip.decompress(base64.b64decode(content)).decode() for part, content in kept["profiles"]}
    assert texts == {table.part: csv_text(table) for table in figure.tables}
    large = replace(figure, tables=(DataTable({"x": np.zeros(10_000)}),))
    assert figure_tables([large]) == {"profiles": []}


def test_hostile_metadata_is_shown_not_run(data: ReportData) -> None:
    small = report_data((8, 8))
    pixel = replace(small.pixels[0], label=HOSTILE, status=HOSTILE)
    odd = replace(
        small,
        title=HOSTILE,
        pixels=[pixel],
        config_yaml=f"input: {HOSTILE}",
        run={HOSTILE: HOSTILE},
        inputs=[{"name": HOSTILE, "size": 1, "hash": HOSTILE}],
        stages=[{"stage": HOSTILE, "state": HOSTILE, "seconds": 1.0, "notes": [HOSTILE]}],
        missing={"components": HOSTILE},
        ensemble={},
    )
    rendered = render_report(odd)
    shown = harmless(rendered["report.html"])
    test_nothing_is_loaded_from_anywhere(shown)
    assert shown.text.count('<script>alert("x")</script>') >= 6
    assert "{{ 7*7 }}" in shown.text
    assert json.loads(rendered["report.json"])["title"] == HOSTILE


@pytest.mark.usefixtures("undrawn")
def test_names_change_nothing_around_them() -> None:
    """Text from right to left is isolated, what turns or hides others is written out, a title has an end."""
    turned, long = "\u202egpj.raw", "W" * 1_000_000
    odd = replace(
        report_data((8, 8)),
        title=long,
        camera="مستشعر",
        config_yaml=turned,
        inputs=[{"name": turned, "size": 1, "hash": "0"}],
    )
    html = render_report(odd)["report.html"]
    assert "\u202e" not in html
    assert html.count("\u200e\\u202e\u200egpj.raw") == 2
    assert "W" * 201 not in html
    assert html.count("W" * 200 + " …") == 2
    assert '<bdi dir="ltr">مستشعر</bdi>' in html


def test_cautions_are_of_pixels_with_a_value_and_failures_have_reasons() -> None:
    data = report_data((24, 24), failed=0.34)
    status = data.fit["fit_status"].copy()
    failed = data.failed
    status[failed] |= int(FitStatus.BIAS_AMBIGUOUS)
    status[~failed] = 0
    said = flags(replace(data, fit={**data.fit, "fit_status": status}))
    assert not [flag for flag in said if "bias ambiguous" in flag.text]
    lost = int(((status & int(FitStatus.TOO_FEW_BINS)) != 0).sum())
    assert f"fewer than 3 occupied bins ({lost})" in next(f.text for f in said if f.level == "serious")


NO_ENSEMBLE: dict[str, Any] = {"ensemble": {}, "ensemble_facts": {}, "moments": ()}


@pytest.mark.usefixtures("undrawn")
def test_all_pixels_failed_and_nothing_at_all() -> None:
    data, nan = report_data((8, 8)), np.full((8, 8), np.nan)
    unknown = dict.fromkeys(data.pixels[0].parameters, float("nan"))
    lost = replace(data.pixels[0], parameters=unknown, stderr={}, status="no data")
    failed = replace(
        data,
        maps=dict.fromkeys(data.maps, nan),
        fit={"fit_status": np.full((8, 8), int(FitStatus.TOO_FEW_BINS), np.uint16), "goodness_p": nan},
        pixels=[lost, lost],
        **NO_ENSEMBLE,
        missing=dict.fromkeys(("maps", "ensemble", "electrons", "components"), "no pixel has a value"),
    )
    page = Page(render_report(failed)["report.html"])
    assert "None of the 64 pixels could be fitted" in page.text
    assert "no pixel has a value" in page.text
    assert "not known" not in sentence(failed)
    assert [answer.level for answer in answers(failed)] == ["serious", "serious"]
    assert {str(a["id"]) for a in page.of("figure")} == {"figure-pixel_fits", "figure-fit_status"}
    rendered = render_report(ReportData(title="empty", shape=(4, 4)))
    assert "None of the 16 pixels" in Page(rendered["report.html"]).text
    assert json.loads(rendered["report.json"])["summary"] == {}


def test_ready_made_histograms_are_channels_and_say_what_is_left_out() -> None:
    data = report_data((1, 5))
    channels = replace(
        data,
        maps={name: values for name, values in data.maps.items() if "charge_rate" not in name},
        **NO_ENSEMBLE,
        n_frames=None,
        integration_time=None,
        truth={},
        missing={"charge_rate": "no integration time"}
        | dict.fromkeys(("ensemble", "electrons"), "no frames"),
        channel_names=("dark", "red", "green", "blue", "far <red>"),
    )
    page = Page(render_report(channels)["report.html"])
    assert "of 5 channels" in page.text
    assert "4 far <red>" in page.text
    assert "Not shown: no integration time" in page.text
    assert "Not shown: no frames" in page.text
    assert "charge_rate" not in [str(a["id"]).removeprefix("figure-map_") for a in page.of("figure")]


def test_a_large_sensor_stays_small_on_disk() -> None:
    """512 x 512 pixels of noise, the worst case for the maps: below 8 MB."""
    rng = np.random.default_rng(6)
    base = report_data((16, 16))
    shape = (512, 512)
    maps = {name: 1.0 + 0.1 * rng.standard_normal(shape) for name in MAP_NAMES}
    status = (rng.random(shape) < 0.3).astype(np.uint16) * int(FitStatus.POOR_FIT)
    large = replace(base, shape=shape, maps=maps, fit={"fit_status": status}, truth={}, pixels=())
    html = render_report(large)["report.html"]
    assert 0.5e6 < len(html.encode()) < 8e6


def test_how_to_cite_has_the_numbers_and_the_papers(page: Page, data: ReportData) -> None:
    found = citation(data)
    assert found["text"] in page.text
    median = np.nanmedian(np.where(data.flagged_in("read_noise_e"), np.nan, data.maps["read_noise_e"]))
    assert f"read noise {median:.4f}" in found["text"]
    assert f"pchem_pipeline {__version__} with numpy {np.__version__}" in found["text"]
    assert "arXiv:2302.14654" in found["bibtex"]
    assert "2403.04498" not in found["bibtex"]  # one exposure
    together = replace(data, samples=Samples((Sample("a", "exposed", 1.0, 9),), "none", {}))
    assert "arXiv:2403.04498" in citation(together)["bibtex"]
    assert found["bibtex"].count("{") == found["bibtex"].count("}")


def test_unfinished_stages_noise_coarse_steps_and_a_poor_fit_are_said(data: ReportData) -> None:
    status = data.fit["fit_status"] | np.uint16(FitStatus.COARSE_STEPS)
    odd = replace(
        data,
        stages=[{"stage": "fit", "state": "3 of 4 units"}],
        maps={**data.maps, "read_noise_e": data.maps["read_noise_e"] + 0.4},
        fit={**data.fit, "fit_status": status},
    )
    words = " ".join(flag.text for flag in flags(odd))
    assert "Stage fit is 3 of 4 units" in words
    assert "above 0.5 e⁻" in words
    assert "set fit.likelihood: auto" in words
    usual = flags(data)
    assert usual[0].level != "serious"
    assert "fit.likelihood" not in " ".join(flag.text for flag in usual)
    p = np.full(data.shape, 0.5)
    p[:4] = 1e-9
    poor = flags(replace(data, fit={**data.fit, "goodness_p": p}))
    assert [flag.level for flag in poor if "goodness-of-fit" in flag.text] == ["serious"]
