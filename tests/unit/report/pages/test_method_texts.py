"""The comparison of methods in words and figures, from numbers made up for it."""

import json

import pytest

from pchem_pipeline.report.charts.on_paper import Look
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.figures.figure import csv_text
from pchem_pipeline.report.figures.methods import (
    bound_crossing,
    crossing_text,
    measured_crossing,
    method_figures,
)
from pchem_pipeline.report.pages.tables import method_rows, method_tables, methods_text


def errors(rmse):
    gain = {"n": 9, "bias": 0.001, "bias_stderr": 0.0, "median": 0.0, "bound": 0.01}
    gain |= {"rmse": rmse, "robust_sd": rmse}
    return dict.fromkeys(("quanta_exposure", "conversion_gain", "bias", "read_noise_e"), gain)


def method(name, rmse, answered=10, missing=""):
    return {
        "name": name,
        "title": name.replace("_", " "),
        "source": "",
        "remark": "",
        "samples": 1,
        "missing": missing,
        "n_pixels": 10,
        "n_answered": answered,
        "reasons": {},
        "seconds_per_pixel": 1e-4,
        "medians": {"conversion_gain": 0.0909},
        "errors": {} if rmse is None else errors(rmse),
    }


def study_point(noise, ours, transfer):
    bounds = {"one sample": 0.9 * ours, "a dark and a bright sample": 0.9 * transfer}
    return {
        "read_noise_e": noise,
        "bounds": bounds | {"photon_transfer": transfer},
        "methods": {
            "pchem_em": method("pchem_em", ours),
            "photon_transfer": method("photon_transfer", transfer),
            "peak_valley": method("peak_valley", 0.3, answered=2),
        },
    }


STUDY = [study_point(0.3, 0.005, 0.03), study_point(0.5, 0.03, 0.033), study_point(0.6, 0.09, 0.035)]
RESULT = {
    "schema": 1,
    "run": "run.zarr",
    "pixels": 10,
    "reference": "truth",
    "samples": [{"run": "run.zarr", "n_frames": 4000, "quanta_exposure": 2.0}],
    "remarks": ["one sample"],
    "methods": [
        method("pchem_em", 0.011),
        method("photon_transfer", None, missing="needs a dark and a bright sample; this comparison has 1"),
    ],
    "study": STUDY,
    "study_at": {"quanta_exposure": 2.0, "conversion_gain": 0.09, "n_frames": 4000, "n_pixels": 10},
}


def test_the_crossing_is_interpolated():
    # ratio of the logarithms: 0.03/0.033 at 0.5 e- and 0.09/0.035 at 0.6 e-
    assert measured_crossing(STUDY) == pytest.approx(0.5 + 0.1 * 0.0953 / (0.0953 + 0.9445), abs=1e-3)
    assert bound_crossing(STUDY) > measured_crossing(STUDY)
    assert measured_crossing(STUDY[:2]) is None
    assert "do not cross" in crossing_text(STUDY[:1])
    assert "0.51 e- on the simulated pixels" in crossing_text(STUDY)


def test_the_text_has_a_row_for_every_method():
    text = methods_text(RESULT)
    assert "errors against the truth" in text
    assert "needs a dark and a bright sample" in text
    row = next(line for line in text.splitlines() if line.startswith("pchem em"))
    assert row.split()[2:] == ["10", "0.0909", "0.1", "1.1", "1.1", "1", "1.10", "1.1", "1.1", "100"]
    # against a fit there is no multiple of the bound
    result = {**RESULT, "reference": "fit", "methods": [method("pchem_em", None), method("cumulants", 0.2)]}
    ours, other = method_rows(result)
    assert "reference" in ours
    assert other[7] == "-"


def test_figure_and_table_of_the_report():
    data = ReportData(title="a run", shape=(8, 8), methods=json.loads(json.dumps(RESULT)))
    [figure] = method_figures(data)
    for width in (88.0, 180.0):
        assert figure.draw(Look(width)).axes
    [table] = method_tables(data)
    assert {tuple(row) for row in table.rows} == {table.head}
    assert " e-" not in table.caption
    assert "0.51 e⁻" in table.caption
    simulated, run = figure.tables
    assert csv_text(simulated).splitlines()[1].startswith("0.3,0.005,0.03,0.3")
    assert csv_text(run).splitlines()[1] == "pchem_em,0.001,0.011,0.011,0.01"
    assert not list(method_figures(ReportData(title="a run", shape=(8, 8))))
    empty = ReportData(title="a run", shape=(8, 8), methods={**RESULT, "study": [], "methods": []})
    assert not list(method_figures(empty))
