"""The first screen: criteria, flagged pixels, what to type next, and what the quick look adds."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from helpers.report_material import defects_of, report_data

from pchem_pipeline.discrepancy.quick.checks import Check, QuickLook, graded
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.operators.offsets import RowNoise
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.report.data import ReportData, Sample, Samples
from pchem_pipeline.report.pages.report_json import report_json, report_numbers
from pchem_pipeline.report.pages.summary import (
    Flag,
    answers,
    criteria,
    flags,
    key_numbers,
    next_steps,
    sentence,
)
from pchem_pipeline.report.pages.tables import result_tables
from pchem_pipeline.report.settings import Criteria


def flagged(share: float, bit: FitStatus = FitStatus.GAIN_AMBIGUOUS, read_noise: float = 0.9) -> ReportData:
    """A sensor of which the first rows are flagged and read far from their truth."""
    data = report_data((40, 50), failed=0.0)
    mask = np.arange(2000).reshape(40, 50) < round(share * 2000)
    status = np.where(mask, int(bit), 0).astype(np.uint16)
    maps = {**data.maps, "read_noise_e": np.where(mask, read_noise, data.maps["read_noise_e"])}
    return replace(data, maps=maps, fit={**data.fit, "fit_status": status})


def table(data: ReportData, name: str):
    return next((table for table in result_tables(data) if table.id == name), None)


def test_where_most_pixels_are_flagged_the_answer_is_no_and_just_below_half_a_caution() -> None:
    most, half = flagged(0.6), flagged(0.45)
    found = [(each.level, each.word) for each in (*answers(most), *answers(half))]
    assert found[:3] == [("serious", "Unknown"), ("serious", "No"), ("caution", "Partly known")]
    assert found[3][0] == "caution"
    assert "pchem joint" in answers(most)[1].text
    assert key_numbers(most) == []
    assert len(key_numbers(most, with_flagged=True)) == 5
    assert "±" not in sentence(most).split("RMSE")[0]
    assert next_steps(most)[0].of("a.yaml").startswith("pchem joint a.yaml ")
    assert any("a biased selection" in flag.text for flag in flags(half))
    assert key_numbers(half)[0].label == "read noise of unflagged pixels"
    assert next_steps(half)[0].command.startswith("pchem joint")


def test_a_bias_an_electron_off_leaves_gain_and_read_noise() -> None:
    data = flagged(0.9, FitStatus.BIAS_AMBIGUOUS)
    names = [each.name for each in key_numbers(data)]
    assert "read_noise_e" in names
    assert "conversion_gain" in names
    assert not {"quanta_exposure", "charge_rate", "dark_current"} & set(names)
    assert data.summary("conversion_gain").n_left_out == 0
    assert data.summary("quanta_exposure").n_left_out == 1800
    assert any("gain and read noise are known" in flag.text for flag in flags(data))
    row = next(row for row in table(data, "flagged").rows if row["parameter"].startswith("quanta exposure"))
    assert list(row.values())[-1] == "1,800"
    assert not [row for row in table(data, "flagged").rows if row["parameter"].startswith("read noise")]


@pytest.mark.parametrize(
    ("step", "words"), [(4, "input.bit_shift: 2"), (3, "multiplied after the ADC"), (1, "")]
)
def test_codes_that_never_occur_are_told_first(step: int, words: str) -> None:
    data = report_data((8, 8), failed=0.0)
    dn = np.arange(400, 480)
    ensemble = {**data.ensemble, "dn": dn, "counts": np.where(dn % step == 0, 10, 0)}
    text = answers(replace(data, ensemble=ensemble))[1].text
    assert words in text
    assert text.startswith("Only every") == (step > 1)
    steps = next_steps(replace(data, ensemble=ensemble))
    assert ("bit_shift" in steps[0].why) == (step == 4)


def test_frames_without_electrons_are_a_bias_for_others() -> None:
    dark = flagged(1.0, FitStatus.GAIN_NOT_IDENTIFIED)
    assert "one Gaussian fits as well" in answers(dark)[0].text
    assert (
        next_steps(dark)[0].of("dark.yaml") == "pchem joint EXPOSED.yaml --bias dark.yaml --store joint.zarr"
    )


@pytest.mark.parametrize(
    ("bit", "left_out"),
    [
        (FitStatus.GAIN_AMBIGUOUS, True),
        (FitStatus.NOT_INFORMATIVE, True),
        (FitStatus.WEAKLY_IDENTIFIED, True),
        (FitStatus.OUTSIDE_WINDOW, False),
    ],
)
def test_flagged_pixels_leave_medians_maxima_and_the_truth_table(bit: FitStatus, left_out: bool) -> None:
    data = flagged(0.05, bit)
    numbers = json.loads(report_json(data))
    noise = numbers["summary"]["read_noise_e"]
    assert noise["n_flagged"] == (100 if left_out else 0)
    assert (noise["maximum"] < 0.9) == left_out
    assert (numbers["truth"]["read_noise_e"]["rmse"] < 0.01) == left_out
    assert (table(data, "flagged") is not None) == left_out
    assert ("100 flagged pixels excluded" in table(data, "parameters").caption) == left_out
    if left_out:
        row = next(row for row in table(data, "flagged").rows if row["parameter"] == "read noise (e⁻)")
        assert list(row.values())[1:] == ["0.9000"] * 5 + ["100"]


def test_criteria_stand_with_their_numbers_and_limits() -> None:
    found = {each.setting: each for each in criteria(flagged(0.2))}
    assert set(found) == set(Criteria.model_fields) - {"medians"}
    assert (found["flagged_pixels"].found, found["flagged_pixels"].limit) == ("20 %", "≤ 10 %")
    assert not found["flagged_pixels"].met
    data = flagged(0.2)
    data.status[0] = FitStatus.EXCLUDED  # of the others the share stays
    share = int(data.flagged.sum()) / (data.status.size - data.status.shape[1])
    assert criteria(data)[2].found == f"{100 * share:.2g} %"
    assert found["read_noise_e"].met
    assert found["gain_nonuniformity"].found == "2 %"  # what the gains were drawn with
    # hot pixels are counted though they are flagged
    data = flagged(0.03)
    hot = np.where(data.flagged, 60.0, data.maps["quanta_exposure"])
    maps = {**data.maps, "quanta_exposure": hot}
    data = replace(data, maps=maps, defects=defects_of(maps, data.status))
    share = next(each for each in criteria(data) if each.setting == "hot_pixels")
    assert (share.found[0], share.met) == ("3", False)
    assert any(re.match(r"Defects: \d+ hot, .* As a list: pchem export ", flag.text) for flag in flags(data))


@pytest.mark.parametrize(
    ("limits", "word"),
    [
        (Criteria(), "Yes"),
        (Criteria(read_noise_e=0.2), "Too noisy"),
        (Criteria(gain_nonuniformity=0.01), "Mostly"),
        (Criteria(**dict.fromkeys(set(Criteria.model_fields) - {"medians"})), "Yes"),
        (Criteria(medians={"bias": (0.0, 1e4)}), "Yes"),
        (Criteria(medians={"bias": (0.0, 1.0)}), "Mostly"),
    ],
)
def test_limits_decide(limits: Criteria, word: str) -> None:
    data = replace(flagged(0.0), criteria=limits)
    sensor = answers(data)[0]
    assert sensor.word == word
    assert all(f"{each.found} (limit" in sensor.text for each in sensor.criteria if not each.met)


def test_the_range_of_a_median_is_told_with_what_was_found() -> None:
    data = replace(flagged(0.0), criteria=Criteria(medians={"bias": (1.0, 2.0)}))
    [bias] = [each for each in criteria(data) if each.setting == "medians.bias"]
    assert (bias.limit, bias.met) == ("1 to 2 DN", False)
    assert float(bias.found.removesuffix(" DN")) == pytest.approx(data.summary("bias").median, rel=1e-3)
    assert "median bias" in answers(data)[0].text
    with pytest.raises(ValueError, match="voltage is no map; choose from quanta_exposure"):
        Criteria(medians={"voltage": (1.0, 2.0)})
    with pytest.raises(ValueError, match="2 to 1 is no range"):
        Criteria(medians={"bias": (2.0, 1.0)})


def test_a_third_failed_and_noise_that_hides_the_electrons_are_not_all_right() -> None:
    sensor, belief = answers(report_data((40, 40), failed=0.34))
    assert (sensor.level, sensor.word) == ("serious", "No")
    assert (belief.level, belief.word) == ("caution", "For the pixels with a value")
    data = report_data((40, 40), failed=0.0)
    noisy = {**data.maps, "read_noise_e": data.maps["read_noise_e"] + 0.4}
    assert answers(replace(data, maps=noisy))[0].word == "Too noisy to count electrons"


def test_where_results_are_not_reliable_no_limit_is_known_to_be_kept_or_missed() -> None:
    """It was 'Mostly' where a limit is missed, and 'Unknown' where none is."""
    serious = [Flag("serious", "The model does not describe this sensor.")]
    for limits in (Criteria(), Criteria(gain_nonuniformity=1e-6)):
        sensor, belief = answers(replace(report_data(), criteria=limits), serious)
        assert (sensor.word, sensor.level, belief.word) == ("Unknown", "caution", "No")
        assert sensor.text.endswith(", but the results are not reliable.")


def test_the_exposure_of_several_samples_says_whose_it_is() -> None:
    exposures = tuple(Sample(f"{name}.zarr", "exposed", float(time), 9) for time, name in enumerate("abc", 1))
    data = replace(report_data(), samples=Samples(exposures, "integration_time", {}, shown=2))
    labels = {number.name: number.label for number in key_numbers(data)}
    assert labels["quanta_exposure"] == "quanta exposure in c.zarr"
    assert labels["bias"] == "bias"


def test_next_is_what_the_run_lacks() -> None:
    data = flagged(0.0)
    assert next_steps(data)[0].of("run.yaml") == "pchem discrepancy run.yaml"
    assert next_steps(replace(data, n_frames=500))[0].command == "pchem view RUN"
    unfinished = replace(data, stages=[{"stage": "fit", "state": "3 of 4 units"}])
    assert [step.command for step in next_steps(unfinished)] == ["pchem run RUN"]


def test_two_taps_are_said_with_the_medians_of_both() -> None:
    data = report_data((40, 64), failed=0.0)
    noise = np.random.default_rng(6).standard_normal((40, 64))
    gain = np.where(np.arange(64) < 32, 0.100, 0.115) * (1.0 + 0.01 * noise)
    data = replace(data, maps={**data.maps, "conversion_gain": gain})
    (found,) = (flag for flag in flags(data) if flag.text.startswith("Conversion gain has a step"))
    assert found.level == "caution"
    assert "columns 0 to 31: 0.1" in found.text
    assert "columns 32 to 63: 0.115" in found.text


@pytest.mark.parametrize(
    ("ratio", "p", "level", "words"),
    [
        (1.5, 0.2, "good", ""),
        (1.2, 1e-9, "good", ""),
        (1.5, 1e-9, "caution", ""),
        (4.0, 1e-9, "serious", ""),
        (1.1, None, "good", "describes the data"),
        (2.0, None, "caution", "small differences"),
        (5.0, None, "serious", "does not describe"),
    ],
)
def test_a_difference_counts_where_it_is_large_and_no_chance(
    ratio: float, p: float | None, level: str, words: str
) -> None:
    facts = {"rmse": {"epcd_exact": ratio, "noise_floor": 1.0}}
    facts |= {} if p is None else {"chi_square": {"p": p}}
    data = replace(report_data((8, 8), failed=0.0), ensemble_facts=facts)
    (found,) = (flag for flag in flags(data) if flag.text.startswith("The RMSE of the predicted raw"))
    assert (found.level, words in found.text) == (level, True)


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
    sensor, belief = answers(data)
    assert sensor.text == "All 1,600 pixels have a value; all 6 criteria pass."
    assert belief.text.endswith("Missing effects were not searched for.")


def test_row_noise_of_a_third_of_the_read_noise_is_not_believed_unless_it_is_in_the_model(
    data: ReportData,
) -> None:
    for size, expected in ((1.0, ("caution", "With caution")), (2.0, ("serious", "No"))):
        belief = answers(looked(data, 1e-30, size))[1]
        assert (belief.level, belief.word) == expected
        share = round(100 * size / 3)
        assert belief.text == (
            f"Row noise of {size:.1f} DN ({size / 10:.2f} e⁻, {share} % of the read noise), most in row 3: "
            "it does not average out; to look closer: pchem discrepancy run.zarr."
        )
    assert answers(looked(data, 1e-30, 0.1))[1].word == QUICK_YES
    known = looked(data, 1e-30, 2.0, (RowNoise(row_noise_dn=2.0),))
    assert answers(known)[1].word == QUICK_YES
    assert any("the model includes such an effect" in flag.text for flag in flags(known))


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
    assert [row["found"] for row in table.rows] == ["yes", "no"]
    assert "Not tested: codes (too few pixels)." in table.caption
    numbers = report_numbers(found)["quick_look"]
    assert numbers["checks"][0]["share"] == pytest.approx(1 / 3)
    assert numbers["checks"][0]["level"] == "caution"
    assert numbers["checks"][1]["size_e"] is None
    # a negative correlation is no resemblance
    lag = Check("lag", "correlation of successive samples", 1e-30, -0.2, "1", limit=0.004)
    found = replace(data, quick_look=QuickLook(graded([lag], 0.1, 3.0, ()), {}, 1000, ""))
    words = "Correlation of successive samples"
    assert any(flag.text.startswith(f"{words}: −0.2") for flag in flags(found))
    [table] = [each for each in result_tables(found) if each.id == "quick-look"]
    assert table.rows[0]["check"] == words
    assert report_numbers(data)["quick_look"] is None
