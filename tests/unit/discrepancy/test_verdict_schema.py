"""``discrepancy.json``: written and read back the same, older ones read, damaged and later ones refused."""

import json
import math
from pathlib import Path
from typing import Any, get_args, get_origin

import pytest
from helpers.discrepancy_material import VERDICTS, result, verdict_of

from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.discrepancy.verdict import (
    SCHEMA_VERSION,
    Place,
    Verdict,
    form_of,
    micronats,
    parameters_of,
    read_verdict,
)
from pchem_pipeline.effects.framework.registry import effect_class, effect_classes

OPTIONAL = {"schema_version", "set_aside"}
OPTIONAL_OF_STEP = {"gap_interval_after", "families", "size", "rivals", "moved", "separate", "pulls"}


@pytest.mark.parametrize("verdict", VERDICTS)
def test_what_is_written_is_read_back(verdict: str) -> None:
    found = verdict_of(verdict)
    text = found.to_json()
    assert json.loads(text)["schema_version"] == SCHEMA_VERSION == found.schema_version
    assert "NaN" not in text
    assert Verdict.from_json(text).to_json() == text
    again = json.loads(text)
    for key, value in result(verdict).items():
        if key == "examined":
            assert value.items() <= again[key].items()
        elif key not in ("steps", "gap", "where", "unexplained", "p_global"):
            assert again[key] == value, key
    for one in again["steps"]:
        one["placebo"] = {"effect": "flicker_noise", "gap_after": 0.0}  # in older files
    assert Verdict.from_json(json.dumps(again)).to_json() == text


def test_numbers_that_are_not_known_are_null_in_the_file() -> None:
    gap = {**result("named")["gap"], "floor": math.nan, "after": math.inf}
    content = json.loads(verdict_of("named", gap=gap).to_json())
    assert content["gap"]["floor"] is content["gap"]["after"] is None
    assert math.isnan(Verdict.from_json(json.dumps(content)).gap.floor)


def test_a_gap_has_the_standard_error_of_its_interval() -> None:
    assert micronats(15989e-6, (15645e-6, 16333e-6)) == "15,989 ± 176"
    assert micronats(-5.3e-6, (-2.13e-5, 1.07e-5)) == "−5.3 ± 8.2"
    assert (micronats(-5.3e-6), micronats(2541e-6), micronats(math.nan)) == ("0", "2,541", "not known")


@pytest.mark.parametrize("version", [1, SCHEMA_VERSION - 1, SCHEMA_VERSION + 1])
def test_a_verdict_of_another_schema_is_refused_with_the_cure(version: int) -> None:
    later = json.dumps({**result("named"), "schema_version": version, "new": 1})
    with pytest.raises(StoreError, match=r"run.zarr holds a verdict of schema \d, .*--force"):
        Verdict.from_json(later, "run.zarr")


@pytest.mark.parametrize("text", ["[1, 2", "[]", "3", "{}", '{"verdict": null}', '{"schema": "x"}'])
def test_what_is_no_verdict_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(StoreError, match="run pchem discrepancy with --force") as caught:
        Verdict.from_json(text)
    assert "\n" not in str(caught.value)


def test_every_key_is_optional_or_missed_by_name() -> None:
    whole = result("named")
    spoiled: list[tuple[str, bool, dict[str, Any]]] = [
        (key, key in OPTIONAL, {k: v for k, v in whole.items() if k != key}) for key in whole
    ]
    for key in whole["steps"][0]:
        steps = [{k: v for k, v in step.items() if k != key} for step in whole["steps"]]
        spoiled.append((f"steps.0.{key}", key in OPTIONAL_OF_STEP, {**whole, "steps": steps}))
    spoiled.append(("verdict", False, {**whole, "verdict": "unheard of"}))
    spoiled.append(("odd", False, {**whole, "odd": 1}))
    spoiled.append(("gap.before", False, {**whole, "gap": {**whole["gap"], "before": "x"}}))
    for key, optional, content in spoiled:
        if optional:
            assert Verdict.from_json(json.dumps(content)).effects == ("row_noise", "bias_drift")
        else:
            with pytest.raises(StoreError, match=rf"damaged \({key}: "):
                Verdict.from_json(json.dumps(content))


def test_a_run_without_a_verdict_has_none(tmp_path: Path) -> None:
    assert read_verdict(tmp_path) is None
    (tmp_path / "discrepancy.json").write_bytes(b"\xff\xfe")
    with pytest.raises(StoreError, match=r"discrepancy.json is damaged"):
        read_verdict(tmp_path)


def test_a_place_takes_its_words_from_the_catalogue() -> None:
    place = Place.of("code.alternating", z=-3.0, dn=(148, 152))
    assert (place.direction, place.channel, place.dn) == ("-", "digital", (148, 152))
    assert "the same sign" in place.sentence
    assert Place.of("code.smooth", z=1.0, sentence="other").sentence == "other"


@pytest.mark.parametrize("tag", effect_classes())
def test_every_number_of_an_effect_is_declared_with_its_unit(tag: str) -> None:
    kind = effect_class(tag)
    for typical in kind.typical():
        for name in parameters_of(typical, {}):
            assert kind.unit(name), name
    # also where it is null by default, and never another unit than the description has
    for name, field in kind.model_fields.items():
        kinds = () if get_origin(field.annotation) is tuple else get_args(field.annotation)
        if {float, int} & {field.annotation, *kinds}:
            assert kind.unit(name), name
        unit = kind.unit(name)
        if unit not in ("", "none") and "," in (field.description or "") and tag != "cosmic_rays":
            assert unit in field.description or unit == "1/frame", name


def test_a_parameter_has_its_unit_and_the_standard_error_that_is_known_and_is_left_out_at_its_default() -> (
    None
):
    found = parameters_of(effect_class("row_noise")(row_noise_dn=0.35), {"row_noise_dn": 0.004})
    assert found.pop("row_noise_dn").model_dump() == {"value": 0.35, "stderr": 0.004, "unit": "DN"}
    assert all(math.isnan(measured.stderr) for measured in found.values())
    afterglow = {"peak_e": 0.2, "decay_frames": 400.0}
    kind = effect_class("persistence")
    found = parameters_of(kind.model_validate(afterglow | {"image": [[0.0, 1.0]]}), {})
    assert {name: each.unit for name, each in found.items()} == {
        "peak_e": "e- per frame",
        "decay_frames": "frames",
    }
    spot = parameters_of(kind.model_validate(afterglow | {"radius": 0.1}), {"centre_y": 0.02})
    assert set(spot) == {*afterglow, "radius", "centre_y"}
    of_others = parameters_of(effect_class("cosmic_rays").typical()[0], {})["tracks_per_frame"].unit
    assert of_others == "1/frame"


def test_a_wave_along_rows_has_a_frequency_where_the_time_of_a_row_is_known() -> None:
    pickup = effect_class("periodic_pickup").model_validate({"amplitude_dn": 1.0, "cycles_per_row": -0.17})
    found = verdict_of("named")
    wave = found.steps[0].model_copy(
        update={"parameters": parameters_of(pickup, {"cycles_per_row": 0.0002, "amplitude_dn": 0.1})}
    )
    timed = found.model_copy(update={"steps": (*found.steps, wave)}).in_hertz(10e-6)
    frequency = timed.steps[-1].parameters["frequency"]
    assert (round(frequency.value), round(frequency.stderr), frequency.unit) == (17_000, 20, "Hz")
    assert timed.steps[:-1] == found.steps
    assert Verdict.from_json(timed.to_json()).steps[-1].parameters["frequency"] == frequency


@pytest.mark.parametrize(
    ("tag", "name", "words"),
    [
        ("adc_inl", "phase", "phase at 0 DN"),
        ("adc_dnl", "first_code", "code of the first of edges"),
        ("adc_dnl", "pattern", "pattern"),
        ("row_noise", "row_noise_dn", "standard deviation of the rows' offsets"),
    ],
)
def test_a_number_says_what_it_is_and_a_text_has_its_name(tag: str, name: str, words: str) -> None:
    assert effect_class(tag).meaning(name) == words


def test_the_form_of_an_effect_is_told_where_it_is_not_the_usual_one() -> None:
    bent = effect_class("nonlinearity").model_validate({"step_change": -0.01, "noise": "bent"})
    assert form_of(bent) == {"noise": "bent"}
    assert form_of(effect_class("nonlinearity").model_validate({"step_change": -0.01})) == {}
    here = {"region": {"rows": [[0, 4]]}}
    assert form_of(effect_class("row_noise").model_validate({"row_noise_dn": 1.0, **here})) == {}
