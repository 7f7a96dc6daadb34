"""The report rests on the quick look: its answer, its remarks, its table, its JSON."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.report_material import report_data

from pchem_pipeline.discrepancy.quick.checks import Check, QuickLook, graded
from pchem_pipeline.effects.analog.row_noise import RowNoise
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.pages.next_steps import next_steps
from pchem_pipeline.report.pages.report_json import report_numbers
from pchem_pipeline.report.pages.summary import answers, flags
from pchem_pipeline.report.pages.tables import result_tables

QUICK_YES = "No problem found by the quick checks"


def looked(data: ReportData, p: float, size: float, model: tuple[Effect, ...] = ()) -> ReportData:
    rows = Check("row_noise", "row noise", p, size, "DN", limit=0.12,
                 where="most in row 3", advice="it does not average out")  # fmt: skip
    lag = Check("lag", "correlation of successive samples", 0.3, 0.001, "1", limit=0.004)
    checks = graded([rows, lag], 0.1, 3.0, model)
    look = QuickLook(checks, {"codes": "too few pixels"}, 1000, "pchem discrepancy run.zarr")
    return replace(data, quick_look=look)


@pytest.fixture(scope="module")
def data() -> ReportData:
    return replace(report_data((40, 40), failed=0.0), fit={"fit_status": np.zeros((40, 40), np.uint16)})


def test_nothing_found_is_a_check_that_passed_with_its_limit(data: ReportData) -> None:
    belief = answers(looked(data, 0.4, 0.05))[1]
    assert (belief.level, belief.word) == ("good", QUICK_YES)
    assert belief.text == (
        "3 checks of the model against the data passed. Not checked: codes. The quick checks do not detect "
        "what is the same in all frames and pixels (a nonlinearity, charge that is not Poisson distributed): "
        "run pchem discrepancy run.zarr."
    )
    assert any("row noise above 0.12 DN is excluded" in flag.text for flag in flags(looked(data, 0.4, 0.0)))


@pytest.mark.parametrize(
    ("size", "level", "word"), [(1.0, "caution", "With caution"), (2.0, "serious", "No")]
)
def test_row_noise_of_a_third_of_the_read_noise_is_not_believed(
    data: ReportData, size: float, level: str, word: str
) -> None:
    found = looked(data, 1e-30, size)
    belief = answers(found)[1]
    assert (belief.level, belief.word) == (level, word)
    share = round(100 * size / 3)
    assert belief.text == (
        f"Row noise of {size:.1f} DN ({size / 10:.2f} e⁻, {share} % of the read noise), most in row 3: "
        "it does not average out; to look closer: pchem discrepancy run.zarr."
    )


def test_what_is_small_or_in_the_model_is_a_remark(data: ReportData) -> None:
    assert answers(looked(data, 1e-30, 0.1))[1].word == QUICK_YES
    known = looked(data, 1e-30, 2.0, (RowNoise(row_noise_dn=2.0),))
    assert answers(known)[1].word == QUICK_YES
    assert any("the model includes such an effect" in flag.text for flag in flags(known))


def test_a_negative_correlation_is_no_resemblance(data: ReportData) -> None:
    lag = Check("lag", "correlation of successive samples", 1e-30, -0.2, "1", limit=0.004)
    found = replace(data, quick_look=QuickLook(graded([lag], 0.1, 3.0, ()), {}, 1000, ""))
    words = "Correlation of successive samples"
    assert any(flag.text.startswith(f"{words}: −0.2") for flag in flags(found))
    [table] = [each for each in result_tables(found) if each.id == "quick-look"]
    assert table.rows[0][0] == words


def test_several_exposures_come_first_and_are_taken_apart_next(data: ReportData) -> None:
    """Whatever else is serious follows from that: it is told first, with what to do."""
    where = "frames 0 to 299 at 201 DN; frames 300 to 599 at 220 DN"
    title, advice = "frames of several exposures", "make a run of each"
    apart = Check("levels", title, 1e-12, 19.0, "DN", where=where, advice=advice)
    look = QuickLook(graded([apart], 0.1, 3.0, ()), {}, 1000, "pchem discrepancy run.zarr")
    poor = {**data.fit, "goodness_p": np.zeros((40, 40))}
    found = replace(data, quick_look=look, fit=poor)
    assert answers(found)[1].text.startswith(
        "Frames of several exposures: 19 DN apart (frames 0 to 299 at 201 DN; frames 300 to 599 at "
        "220 DN); make a run of each."
    )
    assert [step.command.split()[1] for step in next_steps(found)] == ["run"]


def test_table_and_json_hold_all_checks(data: ReportData) -> None:
    found = looked(data, 1e-30, 1.0)
    [table] = [each for each in result_tables(found) if each.id == "quick-look"]
    assert [row[1] for row in table.rows] == ["yes", "no"]
    assert "Not tested: codes (too few pixels)." in table.caption
    numbers = report_numbers(found)["quick_look"]
    assert numbers["checks"][0]["share"] == pytest.approx(1 / 3)
    assert numbers["checks"][0]["level"] == "caution"
    assert numbers["checks"][1]["size_e"] is None
    assert report_numbers(data)["quick_look"] is None
