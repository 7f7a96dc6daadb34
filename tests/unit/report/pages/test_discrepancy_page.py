"""The discrepancy verdict in the report and on its own page."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.discrepancy_material import (
    UNTESTABLE,
    VERDICTS,
    discrepancy_data,
    evidence,
    result,
    step,
    verdict_of,
)
from helpers.html_page import HOSTILE, Page, harmless

from pchem_pipeline.base.variables import variables_of
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.verdict import Place, Verdict
from pchem_pipeline.effects.framework.registry import effect_class
from pchem_pipeline.report.charts.chart import PAGE_MM
from pchem_pipeline.report.charts.on_paper import Look
from pchem_pipeline.report.data import DiscrepancyData, ReportData
from pchem_pipeline.report.figures import discrepancy_gap, discrepancy_where
from pchem_pipeline.report.figures.catalogue import discrepancy_figures
from pchem_pipeline.report.figures.discrepancy_gap import largest_pulls
from pchem_pipeline.report.figures.discrepancy_where import largest_maps, regions_of
from pchem_pipeline.report.figures.figure import Figure
from pchem_pipeline.report.pages.discrepancy import discrepancy_tables, key_facts, place_text, remarks
from pchem_pipeline.report.pages.report import render_report
from pchem_pipeline.report.pages.summary import flags
from pchem_pipeline.report.style.palette import LIGHT
from pchem_pipeline.stages.discrepancy.arrays import evidence_arrays, path_arrays
from pchem_pipeline.stages.discrepancy.summary_text import verdict_text

DISCREPANCY_NAMES = [f"discrepancy_{name}" for name in ("maps", "codes", "frames", "lines", "gap", "pulls")]


@pytest.fixture(scope="module")
def base() -> ReportData:
    return ReportData(title="my sensor", shape=(8, 8), run={"store": "run.zarr"})


def rendered(base: ReportData, data: DiscrepancyData | None) -> dict[str, str]:
    return render_report(replace(base, discrepancy=data))


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("verdict", "level"), [*zip(VERDICTS, ("note", "caution", "caution", "serious", "good"), strict=True)]
)
def test_the_verdict_comes_first(base: ReportData, verdict: str, level: str) -> None:
    data = discrepancy_data(verdict)
    report = rendered(base, data)
    own = harmless(report["discrepancy.html"])
    first = own.text.index(data.found.sentence)
    assert first < own.text.index("Light and charge show mainly")
    terms = {str(a["href"])[1:] for tag, a in own.tags if a.get("class") == "term"}
    assert {"term-gap", "term-micronat", "term-readout-and-charge"} <= terms  # explained where they stand
    # what nothing disagrees with has no signature
    assert ("Largest disagreement, before" in own.text) == (verdict != "consistent")
    assert own.text[:first].rstrip().endswith(verdict.replace("_", " ").capitalize())
    page = harmless(report["report.html"])
    assert page.text.count(data.found.sentence) >= 2
    assert ("a", "discrepancy.html") in [(tag, a.get("href")) for tag, a in page.tags]
    for tag, why in UNTESTABLE.items():
        assert tag in own.text
        assert why in own.text
    assert json.loads(report["report.json"])["discrepancy"]["verdict"] == verdict
    classes = [a["class"] for _, a in own.tags if str(a.get("class")).startswith("verdict ")]
    assert classes == [f"verdict {level}"]
    told = [flag for flag in flags(replace(base, discrepancy=data)) if data.found.sentence in flag.text]
    assert [flag.level for flag in told] == [level]
    for tables in discrepancy_tables(data).values():
        for table in tables:
            assert {tuple(row) for row in table.rows} == {table.head}, table.id


@pytest.mark.usefixtures("undrawn")
def test_a_named_effect_has_all_its_evidence(base: ReportData) -> None:
    text = Page(rendered(base, discrepancy_data("named"))["discrepancy.html"]).text
    for words in (
        "0.35 DN",
        "10 % of the",
        "samples change by 0.35 DN rms",
        "standard deviation of the rows' offsets",
        "477 → < 0.66",
        "sampling noise up to 0.66",
        "0.3512 ± 0.0041 DN",
        "it leaves a deviation of 9.1 sigma: row means",
        "−16.8 ± 3.3",
        "0.985",
        "pixels (y, x) (3, 4), (10, 20), (30, 39)",
        "148 to 152 DN",
        "candidate odd_plugin failed and was not compared: ValueError: boom",
        "largest change: read noise",
        "standard errors of one pixel",
        "a faster or slower row time moves the line of a pickup",
        "training frames",
        "Gow et al. 2007",
    ):
        assert words in text, words


@pytest.mark.usefixtures("undrawn")
def test_what_is_measured_has_its_numbers_and_no_rivals(base: ReportData) -> None:
    measured = step(None, "described", 120.0, 0.4)
    measured["candidates"] = [{**measured["candidates"][0], "effect": "empirical_noise"}]
    measured["separate"] = {}
    measured["parameters"] = {"noise_dn": {"value": 0.784, "stderr": 0.021, "unit": "DN"}}
    measured["form"] = {"spectrum": "one_over_f"}
    drawn = discrepancy_data("unexplained", steps=[measured], unexplained=[])
    data = replace(drawn, found=drawn.found.model_copy(update={"verdict": "described"}))
    tables = {table.id: table for part in discrepancy_tables(data).values() for table in part}
    assert not [name for name in tables if name.startswith("discrepancy-candidates")]
    row, form = tables["discrepancy-parameters"].rows
    assert (form["parameter"], form["value"]) == ("empirical_noise: spectrum", "one_over_f")
    assert (row["parameter"], row["value"]) == ("empirical_noise: noise_dn", "0.784 ± 0.021 DN")
    assert row["effect"].endswith("(empirical)")
    text = Page(rendered(base, data)["discrepancy.html"]).text
    assert "No effect in the library explains the disagreement." in text


def test_the_legend_over_the_scatter_of_lines_covers_no_point() -> None:
    data = discrepancy_data("named")
    (figure,) = [each for each in discrepancy_figures(data) if each.name == "discrepancy_lines"]
    drawn = [axes for axes in figure.draw(Look(PAGE_MM)).axes if axes.get_legend() is not None]
    assert drawn
    for axes in drawn:
        low, high = axes.get_ylim()
        top = max(float(np.nanmax(line.get_ydata())) for line in axes.lines)
        assert (top - low) / (high - low) < 0.8


@pytest.mark.parametrize(
    ("examined", "words"),
    [
        ({}, ""),
        ({"frames": 1000}, "; 40 unused."),
        (
            {"elsewhere": {"rows": [8, 16], "columns": [0, 8]}},
            " The final model was tested again in rows 8 to 15, columns 0 to 7: the model holds.",
        ),
        ({"compared": 31}, "; 31 of the known effects compared."),
        ({"unfitted": 7}, " Not compared: 7 pixels without a reliable fit."),
        (
            {"unfitted": 7, "places": [{"map": "unfitted", "region": {"columns": [[2, 5]]}, "p": 1e-6}]},
            ", clustered in columns 2 to 4.",
        ),
    ],
)
def test_what_was_looked_at_is_told(examined: dict[str, Any], words: str) -> None:
    seen = {"frames": 960, "rows": [0, 8], "columns": [0, 8], "train": 320, "test": 320, "final": 320}
    found = discrepancy_data("named", examined={**seen, **examined}).found
    assert found.examined.words().endswith(words)
    assert ("unused" in found.examined.words()) == ("frames" in examined)
    assert words in " ".join(verdict_text(found).split())


@pytest.mark.usefixtures("undrawn")
def test_without_a_search_the_report_says_how_to_start_one(base: ReportData) -> None:
    report = rendered(base, None)
    assert "discrepancy.html" not in report
    text = Page(report["report.html"]).text
    assert text.count("pchem discrepancy run.zarr") == 1
    assert json.loads(report["report.json"])["discrepancy"] is None
    assert not [flag for flag in flags(base) if "model agrees" in flag.text]


def test_every_figure_is_drawn_and_described_with_numbers(base: ReportData) -> None:
    report = render_report(replace(base, discrepancy=discrepancy_data("named")))
    page = harmless(report["discrepancy.html"])
    shown = [str(a["id"]).removeprefix("figure-") for tag, a in page.tags if tag == "figure"]
    # the picture of what the named effect moves most comes first, then all statistics before and after
    assert shown[:2] == ["discrepancy_lines", "discrepancy_pulls"]
    assert sorted(shown) == sorted(DISCREPANCY_NAMES)
    kept = json.loads(next(words for words in page.words if words.startswith('{"discrepancy_')))
    assert set(kept) == set(shown)  # each with its numbers, to save
    alts = [str(a["alt"]) for tag, a in page.tags if tag == "img"]
    assert all(re.search(r"\d", alt) and len(alt) > 60 for alt in alts)
    assert any("+21.8 at 150 DN" in alt or "at 150 DN" in alt for alt in alts)
    assert any("plain model 477" in alt and "floor 0.66" in alt for alt in alts)


@pytest.mark.usefixtures("undrawn")
def test_hostile_words_are_shown_not_run(base: ReportData) -> None:
    def spoiled(value: Any) -> Any:
        if isinstance(value, dict):
            return {
                HOSTILE if k in ("row_noise_dn", "odd_plugin") else k: spoiled(v) for k, v in value.items()
            }
        if isinstance(value, list):
            return [spoiled(each) for each in value]
        return HOSTILE if isinstance(value, str) else value

    found = spoiled(result("unexplained"))
    # a verdict that is none of those known is refused, and never shown
    for each in (found, *found["steps"]):
        each["verdict"] = "unexplained"
    report = rendered(base, DiscrepancyData(Verdict.model_validate(found)))
    for html, least in ((report["report.html"], 2), (report["discrepancy.html"], 18)):
        page = harmless(html)
        assert page.text.count('<script>alert("x")</script>') >= least
        assert "{{ 7*7 }}" in page.text


def test_each_array_may_be_missing() -> None:
    whole = discrepancy_data("named")
    names = [figure.name for figure in discrepancy_figures(whole)]
    assert names == DISCREPANCY_NAMES
    for key in whole.arrays:
        arrays = {k: v for k, v in whole.arrays.items() if k != key}
        for figure in discrepancy_figures(replace(whole, arrays=arrays)):
            assert figure.alt
    assert [e.name for e in discrepancy_figures(replace(whole, arrays={}))] == [
        "discrepancy_gap",
        "discrepancy_pulls",
    ]


@pytest.mark.parametrize("shape", [(1, 6), (2, 90)])
def test_odd_sensors_are_drawn(shape: tuple[int, int]) -> None:
    arrays = evidence_arrays(evidence(shape, n_frames=40))
    for figure in discrepancy_figures(DiscrepancyData(verdict_of("named"), arrays)):
        figure.draw(Look())


def test_ready_made_histograms_have_no_pictures_of_time() -> None:
    arrays = evidence_arrays(replace(evidence((1, 5)), time=None))
    names = {e.name for e in discrepancy_figures(DiscrepancyData(verdict_of("consistent"), arrays))}
    assert names & {f"discrepancy_{name}" for name in ("frames", "lines", "codes")} == {"discrepancy_codes"}


def test_the_arrays_are_those_of_the_registry() -> None:
    seen = evidence()
    z_after = dict.fromkeys(seen.z, 0.0)
    drift = effect_class("exposure_drift")(drift=0.02)
    arrays = evidence_arrays(seen, after=z_after, effects=[drift], code_extended=seen.code.expected)
    # what is added to single pixels is not in the evidence
    known = {v.name: v for v in variables_of("discrepancy") if not v.name.startswith("added_")}
    assert set(arrays) == set(known)
    sizes: dict[str, int] = {}
    for name, array in arrays.items():
        assert array.dtype == np.dtype(known[name].dtype), name
        for dim, size in zip(known[name].dims, array.shape, strict=True):
            assert sizes.setdefault(dim, size) == size, (name, dim)
    assert sizes["statistic"] == len(STATISTICS)
    assert sum(array.nbytes for array in arrays.values()) < 2e6


def test_arrays_divided_by_chance_have_unit_spread() -> None:
    """Lines without stripes scatter as chance has it, within five standard errors; striped ones do not."""
    seen = evidence(n_frames=2000)
    arrays = evidence_arrays(seen)
    error = 1.0 / np.sqrt(2 * 2000 * arrays["column_rms"].shape[1])
    assert np.mean(arrays["column_rms"] ** 2, axis=1) == pytest.approx(np.ones(2), abs=5 * 2 * error)
    # the stripes of the material have an amplitude of 1.6 standard deviations
    assert np.mean(arrays["row_rms"][1] ** 2) == pytest.approx(1 + 1.6**2 / 2, rel=0.05)
    spread = arrays["block_spread"][:, seen.maps.usable]
    assert np.abs(spread.mean(axis=1)).max() < 5 / np.sqrt(spread.shape[1]) + 0.02
    assert spread.std(axis=1) == pytest.approx(np.ones(2), abs=5 / np.sqrt(2 * spread.shape[1]))


def test_the_path_of_a_drift_is_what_the_frames_show() -> None:
    seen = evidence()
    time = seen.time
    assert time is not None
    paths = path_arrays(seen, [effect_class("exposure_drift")(drift=0.02)])
    position = time.frames / (time.n_run - 1)
    variance, h = seen.charge_std**2, seen.maps.quanta_exposure
    share = np.nansum(variance) / np.nansum(h)
    slope = np.polyfit(position, paths["frame_charge_model"], 1)[0]
    assert slope == pytest.approx(0.02 * share, rel=1e-6)
    assert path_arrays(seen, [effect_class("row_noise")(row_noise_dn=0.3)]) == {}
    assert path_arrays(replace(seen, time=None), [effect_class("exposure_drift")(drift=0.02)]) == {}


def outlined(figure: Figure) -> int:
    """Return how many edges of pixels the first map of a figure outlines, as drawn on paper."""
    [outline] = [line for line in figure.draw(Look(180.0)).axes[0].lines if line.get_color() == LIGHT.ink
                 and line.get_linestyle() == "-"]  # fmt: skip
    return int(np.isnan(np.asarray(outline.get_ydata(), dtype=float)).sum())


@pytest.mark.parametrize("end", [7, 500])  # far beyond the part examined it is drawn as far as that goes
def test_a_map_with_a_place_comes_first_with_its_outline(end: int) -> None:
    data = discrepancy_data("named")
    usual = [each.title for each in largest_maps(data.arrays)[:2]]
    assert (usual[0].startswith("goodness of fit"), usual[1]) == (True, "readout: heavy tails")
    assert largest_maps({}) == []
    _, x = data.found.examined.origin
    place = Place.of("space.x.rr", 20.0, region={"columns": [[x + 3, x + end]]}, region_p=1e-30)
    found = data.found.model_copy(update={"where": (place, *data.found.where)})
    placed = replace(data, found=found)
    first = largest_maps(placed.arrays, regions_of(placed))[0]
    assert first.title == "readout: neighbours correlated, along x"
    figure = next(each for each in discrepancy_figures(placed) if each.name == "discrepancy_maps")
    assert place_text(place) == f"mainly in columns {x + 3} to {x + end - 1}"
    assert place_text(place) in figure.alt
    part = Place.of("space.x.rr@columns=3:7", 20.0, region={"columns": [[3, 7]]})  # not tested to stand out
    shown = regions_of(replace(data, found=found.model_copy(update={"where": (part,)})))
    assert shown == {"x.rr": None}  # drawn without its outline
    # two edges of each row and two of each column
    rows, columns = first.z.shape
    assert outlined(figure) == 2 * rows + 2 * (min(end, columns) - 3)


def test_noisy_frames_are_seen_where_their_noise_is_known() -> None:
    data = discrepancy_data()
    arrays = {name: array for name, array in data.arrays.items() if name != "frame_noise"}
    number = arrays["frame_number"]
    noisy = np.where(number == number[7], 9.0, 0.0)
    data, known = replace(data, arrays=arrays), replace(data, arrays=arrays | {"frame_noise": noisy})
    (before,), (after,) = (discrepancy_where.frame_figures(each) for each in (data, known))
    assert [len(each.chart.stacks[0].panels) for each in (before, after)] == [2, 3]
    assert after.tables[0]["noise"].max() == 9.0
    assert "noise: standard deviation" in after.alt


def test_a_comb_a_pile_up_and_an_alternation_are_in_the_numbers() -> None:
    arrays = discrepancy_data().arrays
    table = discrepancy_where.code_table(arrays)
    dn, residual = table["dn"], table["residual"]
    assert dn[np.argmax(residual)] == 150
    number = np.arange(400)
    noise = np.random.default_rng(1).standard_normal(400)
    assert abs(discrepancy_where.parity_difference(number, noise, 1.0)) < 5
    assert discrepancy_where.parity_difference(number, noise + number % 2, 1.0) < -5
    centre, mean, n = discrepancy_where.trends(number, 0.5 * number)
    assert n.sum() == 400
    assert mean == pytest.approx(0.5 * centre)


def test_the_gap_has_a_line_for_every_model() -> None:
    bars = discrepancy_gap.gap_bars(verdict_of("named"))
    assert [(bar.label, bar.role, round(bar.gap, 1)) for bar in bars] == [
        ("plain model", "before", 477.0),
        ("with row_noise", "after", 31.0),
        ("… and bias_drift", "after", 0.4),
        ("next best: periodic_pickup", "runner-up", 120.0),
    ]
    doubt = [bar.label for bar in discrepancy_gap.gap_bars(verdict_of("ambiguous"))]
    assert doubt[1] == "with row_noise or periodic_pickup or interpixel_capacitance"
    assert [bar.label for bar in discrepancy_gap.gap_bars(verdict_of("consistent"))] == ["plain model"]
    unmeasured = dict.fromkeys(("before", "after", "floor", "closed_fraction"))
    assert discrepancy_gap.gap_bars(verdict_of("consistent", gap=unmeasured)) == []
    rows = discrepancy_gap.families(verdict_of("named"))
    assert rows[0][0] == "rows, columns, neighbours"
    assert [round(v, 1) for v in rows[0][1:]] == [401.0, 0.7]


def test_pulls_come_from_the_steps_or_from_the_vectors() -> None:
    data = discrepancy_data("named")
    assert [round(p.before, 1) for p in largest_pulls(data)[:2]] == [84.0, -31.2]
    kept = {name: array for name, array in data.arrays.items() if not name.startswith("z_")}
    assert [round(p.before, 1) for p in largest_pulls(replace(data, arrays=kept))[:2]] == [84.0, -31.2]
    pulls = largest_pulls(discrepancy_data("named_in_part"))
    assert len(pulls) == 12
    assert pulls[0].sentence == STATISTICS[pulls[0].statistic].sentence
    largest = max(np.nanmax(np.abs(data.arrays[name])) for name in ("z_before", "z_after"))
    assert max(abs(pulls[0].before), abs(pulls[0].after)) == pytest.approx(largest)
    # the vectors are of the whole sensor
    placed = step("row_noise", "named", 477.0, 31.0)
    part = {"statistic": "space.x.rr@columns=3:9", "sentence": "in a part", "before": 900.0, "after": 1.0}
    placed["pulls"] = [part, *placed["pulls"]]
    assert largest_pulls(discrepancy_data("named", steps=[placed]))[0].sentence == "in a part"


def test_a_gap_that_is_left_has_its_error_and_one_that_chance_makes_is_not_said_to_be_closed() -> None:
    gap = result("named")["gap"]
    part = {fact.label: fact for fact in key_facts(discrepancy_data("named_in_part"))}["of the gap closed"]
    # half of 1.6 - 0.5 times the gap, 95 % of its values, is 1.96 standard errors
    assert (part.value, part.more[0]) == ("94 %", "477 → 31.0 ± 8.7 micronats per sample")
    weak = {**step("row_noise", "named", 0.6, 0.0), "gap_floor": 1e-6}
    ends = {"interval_before": [-1e-6, 2.2e-6], "interval_after": [-2e-6, 2e-6]}
    chance = {**gap, **ends, "before": 0.6e-6, "after": 0.0, "floor": 1e-6}
    data = discrepancy_data("named", steps=[weak], gap=chance, doubt="the bias of 93 % may be off")
    told = {flag.text: flag.level for flag in remarks(data)}
    assert not any("leaves a gap" in text for text in told)
    assert any("is rejected, since it leaves a deviation" in text for text in told)
    assert [level for text, level in told.items() if "93 %" in text] == ["caution"]
    assert not any("no size is given" in text for text in told)
    facts = {fact.label: fact for fact in key_facts(data)}
    assert "of the gap closed" not in facts
    assert facts["gap between data and model"].value == "0.60 ± 0.82 → 0.0 ± 1.0"


def test_a_named_effect_says_why_no_other_one_and_where_it_is() -> None:
    placed = {**step("row_noise", "named", 477.0, 31.0), "place": "columns 3 to 8"}
    data = discrepancy_data("named", steps=[placed])
    tables = {table.id: table for part in discrepancy_tables(data).values() for table in part}
    rows = tables["discrepancy-rivals"].rows
    assert [(row["effect"], row["instead of"], row["log-likelihood lower by"]) for row in rows] == [
        ("periodic_pickup", "row_noise", "16.8"),
        ("interpixel_capacitance", "row_noise", "262"),
    ]
    assert all(row["reason"] for row in rows)
    assert key_facts(data)[0].more[-1] == "in columns 3 to 8"
    unsized = key_facts(discrepancy_data("named", steps=[{**placed, "size": None}]))[0]
    assert (unsized.value, unsized.more[0]) == (
        "0.3512 ± 0.0041 DN",
        "standard deviation of the rows' offsets",
    )
    alone = step(None, "ambiguous", 120.0, 120.0)
    alone["candidates"] = alone["candidates"][:1]
    shown = discrepancy_tables(discrepancy_data("ambiguous", steps=[alone]))["evidence"]
    assert "discrepancy-candidates-1" not in [table.id for table in shown]  # nothing to compare


def test_places_of_a_window_are_places_of_the_sensor() -> None:
    found = verdict_of("named")
    moved = found.on_sensor((512, 512), (100, 164), (200, 264), lambda y, x: (y + 100, x + 200))
    assert moved.examined.origin == (100, 200)
    assert moved.examined.frames == found.examined.frames
    assert moved.where[2].pixels == ((103, 204), (110, 220), (130, 239))
    assert moved.where[1] == found.where[1]


def test_the_page_of_a_run(tmp_path: Path) -> None:
    """From the files of a run: JSON and arrays written, read back, and the same."""
    from pchem_pipeline.config.tree import RunConfig
    from pchem_pipeline.run.sensor import SensorInfo
    from pchem_pipeline.stages.identities import discrepancy_state
    from pchem_pipeline.stages.report.stored import read_run
    from pchem_pipeline.store.run_store import RunStore

    store = RunStore.create(tmp_path / "run.zarr")
    SensorInfo("frames", 400, 32, 41, "uint16", 14, None, "copy", {"files": [], "digest": ""}).write(store)
    config = RunConfig.model_validate({"input": {"files": ["frames.npy"]}})
    assert read_run(store, config).data.discrepancy is None
    assert discrepancy_state(store) is None
    arrays = evidence_arrays(evidence())
    for name, array in arrays.items():
        store.write_array(f"discrepancy/{name}", array)
    store.write_file("discrepancy.json", json.dumps(result("named")).encode())
    data = read_run(store, config).data.discrepancy
    assert data is not None
    assert set(data.arrays) == set(arrays)
    np.testing.assert_array_equal(data.arrays["score"], arrays["score"])
    assert data.found.effects == ("row_noise", "bias_drift")
    assert discrepancy_state(store) == "named"


def test_a_statistic_of_the_report_says_what_its_sign_says() -> None:
    from pchem_pipeline.stages.report.stored import verdict_data

    found = discrepancy_data("named").found
    names = list(verdict_data(found, {}).statistics)
    before = np.where(np.array(names) == "shape.He3.mean", -5.0, 5.0)
    words = verdict_data(found, {"z_before": before}).statistics
    assert "skewed to low DN" in words["shape.He3.mean"][1]
    assert "have heavy tails" in words["shape.He4.mean"][1]
    fewer = verdict_data(found, {"z_before": before[:-4], "score": before})
    assert set(fewer.arrays) == {"score"}  # of a search with other statistics
