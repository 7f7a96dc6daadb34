"""What the inspector is given: which maps, which pixels, and how much of a large sensor."""

import numpy as np
import pytest
from helpers.inspector_material import inspector_of, write_run
from helpers.report_material import report_data
from helpers.without_pictures import page_without_pictures

from pchem_pipeline.base import variables
from pchem_pipeline.base.variables import Variable
from pchem_pipeline.model.fit.status import MEANINGS
from pchem_pipeline.report.pages import report as page_report
from pchem_pipeline.report.pages.page import Section
from pchem_pipeline.stages.report import inspector
from pchem_pipeline.stages.report.inspector import listed_maps
from pchem_pipeline.stages.report.pixels import choose_inspected

SHAPE = (12, 16)


@pytest.fixture(scope="module")
def data():
    return report_data(SHAPE, failed=0.1)


@pytest.fixture
def store(tmp_path, data):
    return write_run(tmp_path, data, n_frames=30)


def test_the_list_is_that_of_the_store(store):
    store.write_array("summary/lag1_covariance", np.zeros(SHAPE))
    store.write_array("discrepancy/goodness", np.zeros((4, 4), np.float32))
    store.write_array("fit/bias", np.zeros(SHAPE))
    paths = [each.path for each in listed_maps(store, SHAPE)]
    assert paths[0] == "maps/quanta_exposure"
    assert "maps/bias" in paths
    assert "fit/bias" not in paths, "a repetition of maps/bias"
    assert "discrepancy/goodness" not in paths, "of a window, not of the sensor"
    assert "summary/lag1_covariance" in paths
    assert len(paths) == len(set(paths)) >= 14


@pytest.mark.parametrize("group", ["fit", "samples"])
def test_a_new_array_appears_by_itself(store, data, monkeypatch, group):
    new = Variable(f"{group}/far_share", ("y", "x"), "float64", "DN", "share of samples far away")
    monkeypatch.setitem(variables.VARIABLES, new.path, new)
    store.write_array(new.path, np.full(SHAPE, 0.25))
    shown = inspector_of(store, data.maps, data.fit)
    [entry] = [each for each in shown.maps if each.path == new.path]
    assert (entry.label, entry.unit, entry.sentence) == ("far share", "DN", "share of samples far away")
    assert entry.packed is not None
    assert (shown.sample.exact[new.path] == 0.25).all()
    # the charge rate costs nothing
    [entry] = [each for each in shown.maps if each.path == "maps/charge_rate"]
    assert (entry.packed, entry.same_as) == (None, ("maps/quanta_exposure", pytest.approx(1 / 4.87)))


def test_words_and_kinds(store):
    store.write_array("maps/quality", np.zeros(SHAPE, np.uint8))
    store.write_array("truth/defect", np.zeros(SHAPE, np.uint8))
    entries = {each.path: each for each in listed_maps(store, SHAPE)}
    assert entries["maps/bias"].label == "bias"
    assert entries["maps/bias_stderr"].kind == "stderr"
    assert entries["maps/bias_stderr"].label == "standard error of the bias"
    assert entries["fit/fit_status"].words == {int(bit): text for bit, text in MEANINGS.items()}
    assert entries["maps/quality"].words == {0: "good", 1: "use with caution", 2: "no value"}
    assert entries["truth/defect"].words == {0: "normal", 1: "hot", 2: "dead", 3: "stuck"}
    assert entries["fit/goodness_p"].label == "goodness of fit p"


def test_what_does_not_fit_is_left_to_the_server(store, data, monkeypatch):
    monkeypatch.setattr(inspector, "_MAPS_BUDGET", 1500.0)
    shown = inspector_of(store, data.maps, data.fit)
    here = [each.path for each in shown.maps if each.packed is not None]
    assert 4 * sum(len(each.packed.data) for each in shown.maps if each.packed) / 3 <= 1500
    assert here[-1] == "fit/fit_status"
    assert set(here) <= {"fit/fit_status", *inspector._FIRST[1:]}
    assert len(here) < len(shown.maps)
    alike = [each.path for each in shown.maps if each.same_as]
    assert {each.same_as[0] for each in shown.maps if each.same_as} <= set(here)
    assert set(shown.sample.exact) == {*here, *alike}


def test_of_many_pixels_a_page_holds_few_megabytes_and_little_is_tried(store, data, monkeypatch):
    monkeypatch.setattr(inspector, "_MOST_BYTES", 1500.0)
    monkeypatch.setattr(inspector, "_MANY_PIXELS", 0)
    tried = []
    pack = inspector.packed_map
    monkeypatch.setattr(inspector, "packed_map", lambda *a: tried.append(a[1]) or pack(*a))
    shown = inspector_of(store, data.maps, data.fit)
    here = [each.path for each in shown.maps if each.packed is not None]
    assert "fit/fit_status" in here
    assert len(tried) == len(here) + 1
    assert 4 * sum(len(each.packed.data) for each in shown.maps if each.packed) / 3 <= 1500
    assert inspector._coarse(4096 * 2304) == (16.0, "a standard error")
    assert inspector._coarse(512 * 512)[1].startswith("a sixteenth")


def test_a_small_sensor_is_there_whole_of_wide_histograms_fewer_pixels(data):
    index, _ = choose_inspected(data.maps, data.fit, [(3, 4)], everything=4096, most=100)
    assert index[0] == 3 * 16 + 4
    assert sorted(index.tolist()) == list(range(12 * 16))
    data = report_data((60, 60))
    for bins, n_pixels in ((2048, 3600), (16384, 512)):
        assert choose_inspected(data.maps, data.fit, [], bins=bins)[0].size == n_pixels


def test_of_a_large_sensor_the_telling_pixels_and_an_even_sample():
    data = report_data((100, 120), failed=0.01)
    p = np.array(data.fit["goodness_p"])
    p[40, 50] = 1e-12
    index, found = choose_inspected(
        data.maps, {**data.fit, "goodness_p": p}, [(1, 2)], [(5, 6)], everything=4096, most=1500
    )
    reasons = {each.words: each.pixels for each in found}
    assert index.size == np.unique(index).size == 1500
    assert reasons["shown in the report"] == (1 * 120 + 2,)
    assert reasons["from the search for missing effects"] == (5 * 120 + 6,)
    assert reasons["poorest goodness of fit"][0] == 40 * 120 + 50
    known = np.where(np.isfinite(data.maps["bias"]), data.maps["bias"], -np.inf)
    assert reasons["largest bias"][0] == known.argmax()
    status = data.fit["fit_status"].ravel()
    for bit, words in MEANINGS.items():
        where = set(np.flatnonzero(status & int(bit)).tolist())
        flagged = reasons.get(words, ())
        assert set(flagged) <= where
        assert len(flagged) == min(len(where), 40)
    assert {i for where in reasons.values() for i in where} <= set(index.tolist())
    assert {each.path for each in found if "bias" in each.words} >= {"maps/bias", "maps/bias_stderr"}
    # every tenth of the rows and columns has its share of the sample
    for line, n in ((index // 120, 100), (index % 120, 120)):
        parts = np.histogram(line, bins=10, range=(0, n))[0]
        assert parts.min() > 100


def test_a_new_section_is_one_entry_in_one_list(data, monkeypatch):
    mine, empty = Section("mine", "My <section>", kind="text"), Section("without", "content", empty="")
    monkeypatch.setattr(page_report, "PAGE", (*page_report.PAGE, mine, empty))
    monkeypatch.setitem(page_report.CONTENT, "text", lambda data: f"{data.title} & more")
    page = page_without_pictures(data)
    assert '<li><a href="#mine">My &lt;section&gt;</a></li>' in page
    assert '<h2 id="mine-heading">My &lt;section&gt;</h2>' in page
    assert "demo sensor &amp; more" in page
    assert 'id="without"' not in page
