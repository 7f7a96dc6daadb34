"""The first screen: criteria with their numbers, flagged pixels apart, and what to type next."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.report_material import report_data

from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.report.data import ReportData, Sample, Samples
from pchem_pipeline.report.pages.criteria import criteria
from pchem_pipeline.report.pages.next_steps import next_steps
from pchem_pipeline.report.pages.report_json import report_json
from pchem_pipeline.report.pages.summary import Flag, answers, flags, key_numbers, sentence
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


def test_where_most_pixels_are_flagged_the_answer_is_no() -> None:
    data = flagged(0.6)
    sensor, belief = answers(data)
    assert (sensor.level, sensor.word) == ("serious", "Unknown")
    assert (belief.level, belief.word) == ("serious", "No")
    assert "pchem joint" in belief.text
    assert key_numbers(data) == []
    assert len(key_numbers(data, with_flagged=True)) == 5
    assert "±" not in sentence(data).split("RMSE")[0]
    assert next_steps(data)[0].of("a.yaml").startswith("pchem joint a.yaml ")


def test_a_bias_an_electron_off_leaves_gain_and_read_noise() -> None:
    data = flagged(0.9, FitStatus.BIAS_AMBIGUOUS)
    names = [each.name for each in key_numbers(data)]
    assert "read_noise_e" in names
    assert "conversion_gain" in names
    assert not {"quanta_exposure", "charge_rate", "dark_current"} & set(names)
    assert data.summary("conversion_gain").n_left_out == 0
    assert data.summary("quanta_exposure").n_left_out == 1800
    assert any("gain and read noise are known" in flag.text for flag in flags(data))
    row = next(row for row in table(data, "flagged").rows if row[0].startswith("quanta exposure"))
    assert row[-1] == "1,800"
    assert not [row for row in table(data, "flagged").rows if row[0].startswith("read noise")]


def test_just_below_half_is_a_caution_and_says_that_the_rest_is_a_selection() -> None:
    data = flagged(0.45)
    sensor, belief = answers(data)
    assert (sensor.level, sensor.word) == ("caution", "Partly known")
    assert belief.level == "caution"
    assert any("a biased selection" in flag.text for flag in flags(data))
    assert key_numbers(data)[0].label == "read noise of unflagged pixels"
    assert next_steps(data)[0].command.startswith("pchem joint")


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
    data = report_data((8, 8), failed=0.0)
    status = np.full((8, 8), int(FitStatus.GAIN_NOT_IDENTIFIED), np.uint16)
    dark = replace(data, fit={**data.fit, "fit_status": status})
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
        row = next(row for row in table(data, "flagged").rows if row[0] == "read noise (e⁻)")
        assert row[1:] == ("0.9000",) * 5 + ("100",)


def test_criteria_stand_with_their_numbers_and_limits() -> None:
    found = {each.setting: each for each in criteria(flagged(0.2))}
    assert set(found) == set(Criteria.model_fields)
    assert (found["flagged_pixels"].found, found["flagged_pixels"].limit) == ("20 %", "≤ 10 %")
    assert not found["flagged_pixels"].met
    assert found["read_noise_e"].met
    assert found["gain_nonuniformity"].found == "2 %"  # what the gains were drawn with


@pytest.mark.parametrize(
    ("limits", "word"),
    [
        (Criteria(), "Yes"),
        (Criteria(read_noise_e=0.2), "Too noisy"),
        (Criteria(gain_nonuniformity=0.01), "Mostly"),
        (Criteria(**dict.fromkeys(Criteria.model_fields)), "Yes"),
    ],
)
def test_limits_decide(limits: Criteria, word: str) -> None:
    data = replace(flagged(0.0), criteria=limits)
    sensor = answers(data)[0]
    assert sensor.word == word
    assert all(f"{each.found} (limit" in sensor.text for each in sensor.criteria if not each.met)


@pytest.mark.parametrize("limits", [Criteria(), Criteria(gain_nonuniformity=1e-6)])
def test_where_results_are_not_reliable_no_limit_is_known_to_be_kept_or_missed(limits: Criteria) -> None:
    """It was 'Mostly' where a limit is missed, and 'Unknown' where none is."""
    serious = [Flag("serious", "The model does not describe this sensor.")]
    sensor, belief = answers(replace(report_data(), criteria=limits), serious)
    assert (sensor.word, sensor.level, belief.word) == ("Unknown", "caution", "No")
    assert sensor.text.endswith(", but the results are not reliable.")


def test_the_exposure_of_several_samples_says_whose_it_is() -> None:
    exposures = tuple(Sample(f"{name}.zarr", "exposed", float(time), 9) for time, name in enumerate("abc", 1))
    data = replace(report_data(), samples=Samples(exposures, "integration_time", {}, shown=2))
    labels = {number.name: number.label for number in key_numbers(data)}
    assert labels["quanta_exposure"] == "quanta exposure in c.zarr"
    assert labels["bias"] == "bias"


def test_hot_pixels_are_counted_though_they_are_flagged() -> None:
    data = flagged(0.03)
    hot = np.where(data.flagged, 60.0, data.maps["quanta_exposure"])
    found = criteria(replace(data, maps={**data.maps, "quanta_exposure": hot}))
    share = next(each for each in found if each.setting == "hot_pixels")
    assert share.found.startswith("3")
    assert not share.met


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
