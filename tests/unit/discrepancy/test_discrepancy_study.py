"""The study of the discrepancy workflow counts what it should, and its beginnings are balanced."""

import sys
from collections import Counter

import pytest
from helpers.places import ROOT

sys.path.append(str(ROOT / "scripts" / "bench"))

from bench_discrepancy import read_results
from discrepancy_cases import EFFECTS, NAMED_SINCE, OUTSIDE, SEALED, TRIED, UNTESTABLE, Plan, remaining
from discrepancy_figures import Answer
from hidden import chain

SHAPE = (64, 64, 4000)


def record(hidden, verdict, *steps, kind="single", level=4.0, **more):
    """A record: each step is a name, or a set of names that could not be told apart."""
    gap = {"after": 1e-7, "before": 1e-4, "floor": 1e-6, "closed_fraction": 0.999}
    of_step = {"rivals": [], "gap_before": 1e-4, "gap_after": 1e-7, "gap_floor": 1e-6}
    told, names = [], [step for step in steps if isinstance(step, str)]
    for step in steps:
        effect, tags = (step, [step, "other"]) if step in names else (None, step)
        told.append({"effect": effect, "candidates": [{"effect": tag} for tag in tags], **of_step})
    return {
        "case": {"kind": kind, "level": level, "hidden": list(hidden), "key": f"{kind}{hidden}{steps}"},
        "verdict": {"verdict": verdict, "effects": names, "steps": told, "gap": gap, "replicates": 90},
        "error": None,
        "cpu_seconds": 40.0,
    } | more


@pytest.mark.parametrize(
    ("hidden", "verdict", "steps", "word"),
    [
        (["row_noise"], "named", ["row_noise"], "alone"),
        (["row_noise"], "named", ["row_noise", "adc_inl"], "wrong"),
        (["row_noise"], "named", ["adc_inl"], "wrong"),
        (["row_noise"], "ambiguous", [["adc_inl", "row_noise"]], "in set"),
        (["row_noise"], "ambiguous", ["row_noise", ["adc_inl", "clipping"]], "in set"),
        (["row_noise"], "ambiguous", [["adc_inl", "clipping"]], "other set"),
        (["row_noise"], "ambiguous", [["a", "b", "c", "row_noise"]], "other set"),
        # the steps of an unexplained stack are nobody's names
        (["row_noise"], "unexplained", [["row_noise", "adc_inl"]], "unexplained"),
        (["row_noise"], "consistent", [], "consistent"),
        (["row_noise", "clipping"], "named", ["row_noise"], "part"),
        (["row_noise", "clipping"], "named", ["clipping", "row_noise"], "alone"),
        (["row_noise", "clipping"], "ambiguous", ["row_noise", ["clipping", "adc_dnl"]], "in set"),
        ([], "consistent", [], "consistent"),
        ([], "named", ["row_noise"], "wrong"),
    ],
)
def test_an_answer_lands_in_its_column(hidden, verdict, steps, word):
    assert Answer(record(hidden, verdict, *steps)).word == word


def test_every_beginning_of_the_study_is_balanced():
    cases = Plan(EFFECTS, (4.0, 1.5), 10, 0, 200, 40, 10, 2, 4, 2, 1, SHAPE).cases()
    assert len({case.key for case in cases}) == len({case.seed for case in cases}) == len(cases)
    whole = Counter((case.kind, case.level) for case in cases)
    for share in (0.1, 0.3, 0.7):
        some = Counter((case.kind, case.level) for case in cases[: round(share * len(cases))])
        for group, n in whole.items():
            assert abs(some[group] - share * n) <= 1.5
    single = [c.hidden for c in cases if c.kind == "single" and c.level == 4.0]
    assert len(set(single[: len(EFFECTS)])) == len(EFFECTS)
    assert {case.exclude for case in cases if case.kind == "left_out"} == {(tag,) for tag in EFFECTS}
    assert len(remaining(cases, [case.key for case in cases[:50]])) == len(cases) - 50


def test_the_study_knows_the_effects_of_the_hidden_chain():
    assert set(EFFECTS) == set(chain.LIBRARY)
    assert set(UNTESTABLE) == set(chain.UNTESTABLE)
    assert set(OUTSIDE) == set(chain.OUTSIDE)
    assert set(TRIED) | set(SEALED) | set(NAMED_SINCE) == set(chain.DECOYS) | set(OUTSIDE)
    assert not set(TRIED) & set(SEALED)


def test_a_result_cut_off_by_an_interruption_is_done_again(tmp_path, capsys):
    path = tmp_path / "results.jsonl"
    assert read_results(path) == []
    path.write_text('{"case": {"key": "a"}}\n{"case": {"ke')
    assert read_results(path) == [{"case": {"key": "a"}}]
    assert "incomplete" in capsys.readouterr().err
