"""The verdict in the terminal: short, plain, and never an error."""

import pytest
from helpers.discrepancy_material import VERDICTS, step, verdict_of

from pchem_pipeline.discrepancy.verdict import Place
from pchem_pipeline.stages.discrepancy.summary_text import verdict_text


@pytest.mark.parametrize("verdict", VERDICTS)
def test_the_verdict_comes_first_and_lines_are_short(verdict):
    lines = verdict_text(verdict_of(verdict)).splitlines()
    assert lines[0].startswith(f"{verdict.upper().replace('_', ' ')}: ")
    assert len(lines[0]) > len(verdict) + 20
    assert all(0 < len(line) <= 100 for line in lines)
    assert "+-" not in "".join(lines)
    assert len(lines) <= 25
    assert lines[-1].startswith("not testable with such frames: charge_lag, charge_diffusion")


def words_of(verdict, **changes):
    return " ".join(verdict_text(verdict_of(verdict, **changes)).split())


def test_what_a_named_effect_is_told_with():
    text = words_of("named")
    assert (
        "disagreement: row means of the readout residuals scatter more than independent pixels (84 sigma)"
        in text
    )
    assert "148 to 152 DN" in text
    assert "disagreement: 1 more (see discrepancy.json)" in text
    assert "unexplained:" not in text
    assert "row_noise_dn = 0.3512 ± 0.0041 DN" in text
    assert (
        "gap between data and model: 477 → < 0.66 micronats per sample (sampling noise: up to 0.66)" in text
    )
    assert "DEFECT: candidate odd_plugin failed and was not compared: ValueError: boom" in text


def test_lines_end_not_between_a_number_and_its_unit_and_keep_to_the_columns():
    for length in range(60, 100):
        found = verdict_of("consistent").model_copy(update={"sentence": "x" * length + " 5.7 % and 2 DN"})
        assert "5.7 %" in verdict_text(found)
    text = verdict_text(verdict_of("named", defects={"a\nb": "x" * 300}))
    assert all(len(line) <= 100 for line in text.splitlines())


@pytest.mark.parametrize(
    ("verdict", "changes", "words"),
    [
        ("ambiguous", {}, "to distinguish periodic_pickup: a faster or slower row time"),
        ("ambiguous", {}, "score"),
        (
            "named_in_part",
            {},
            "pickup is rejected (log-likelihood lower by 17); it leaves a deviation of 9.1",
        ),
        ("unexplained", {}, "unexplained: counts of adjacent codes deviate from the model with opposite"),
        ("unexplained", {}, "with opposite signs (22 sigma)"),
        ("named", {"doubt": "the bias of 93 % of the pixels may be off"}, "no sizes in e⁻: the bias of 93 %"),
    ],
)
def test_a_verdict_says_what_would_decide_why_rivals_lost_and_what_is_left(verdict, changes, words):
    assert words in words_of(verdict, **changes)


def test_numbers_that_are_not_known_are_said_so_and_a_single_candidate_has_no_probability():
    gap = dict.fromkeys(("before", "after", "floor", "closed_fraction"))
    steps = [{**step("row_noise", "named", 477.0, 31.0), "rivals": [], "candidates": []}]
    text = verdict_text(verdict_of("named", gap=gap, steps=steps, where=[{"statistic": "code.top"}]))
    assert "gap between" not in text
    assert "code.top (sigma not known)" in text
    alone = step(None, "ambiguous", 120.0, 120.0)
    alone["candidates"] = alone["candidates"][:1]
    text = verdict_text(verdict_of("ambiguous", steps=[alone]))
    assert "row_noise: row_noise_dn = 0.3512 ± 0.0041 DN" in text
    assert "probability" not in text


def test_a_gap_that_chance_makes_is_not_said_to_be_closed():
    weak = {**step("row_noise", "named", 0.6, 0.0), "gap_floor": 1e-6}
    gap = {**verdict_of("named").gap.model_dump(), "before": 0.6e-6, "after": 0.0, "floor": 1e-6}
    gap["interval_after"] = [-2e-6, 2e-6]
    text = words_of("named", steps=[weak], gap=gap)
    assert "model: 0.6 → 0.0 ± 1.0 micronats per sample (sampling noise: up to 1)" in text
    assert "closed" not in text
    assert "instead of" not in text


def test_a_place_is_told_once():
    part = Place.of("space.x.rr@columns=10:14", z=6.6, region={"columns": [[10, 14]]})
    pixels = {"pixels": [[2, 9, 10], [8, 0, 1]]}
    few = Place.of("shape.goodness.cnt", z=7.3, region=pixels, pixels=((2, 9), (8, 0), (1, 5)))
    text = words_of("named", where=[part.model_dump(), few.model_dump()])
    assert "along x, in columns 10 to 13 (6.6 sigma)" in text
    assert "(7.3 sigma; 3 pixels listed, first (y, x) = (2, 9))" in text
