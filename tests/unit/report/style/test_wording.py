"""Numbers in words."""

import pytest

from pchem_pipeline.base.variables import VARIABLES
from pchem_pipeline.report.style.wording import (
    count,
    fitted_or_chosen,
    measured,
    percent,
    scientific,
    short,
    short_name,
    signed,
    symbol,
    typeset,
    unit_text,
    visible,
)


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (0.0, 3, "0"),
        (0.30512, 3, "0.305"),
        (-2.5, 2, "−2.5"),
        (1.9e-4, 2, "1.9×10⁻⁴"),
        (9.996e-5, 3, "1.00×10⁻⁴"),
        (0.00123, 2, "0.0012"),
        (123456.0, 3, "1.23×10⁵"),
        (17750.0, 3, "17750"),
        (99.96, 3, "100"),
        (float("nan"), 3, "not known"),
    ],
)
def test_short(value: float, digits: int, text: str) -> None:
    assert short(value, digits) == text


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (2.01344, 0.01234, "2.013 ± 0.012 e⁻"),
        (0.0953671, 0.000024, "0.095367 ± 0.000024 e⁻"),
        (100.04, 12.3, "100 ± 12 e⁻"),
        (-0.5, 0.0996, "−0.50 ± 0.10 e⁻"),
        (2.0, float("nan"), "2.000 e⁻"),
        (2.0, 0.0, "2.000 e⁻"),
        (float("nan"), 1.0, "not known"),
    ],
)
def test_measured_rounds_to_two_digits_of_the_error(value: float, error: float, text: str) -> None:
    assert measured(value, error, "e⁻") == text


def test_a_number_that_was_chosen_claims_no_precision() -> None:
    assert fitted_or_chosen(30.0, float("nan"), "frames") == "30 frames"
    assert fitted_or_chosen(0.2, float("nan")) == "0.2"
    assert fitted_or_chosen(100.0, float("nan"), "DN") == "100 DN"
    assert fitted_or_chosen(2.0, 0.01, "DN") == "2.000 ± 0.010 DN"


@pytest.mark.parametrize(
    ("part", "whole", "text"),
    [
        (0, 10, "0 %"),
        (1, 1_000_000, "< 0.01 %"),
        (5, 1000, "0.50 %"),
        (1, 3, "33 %"),
        (999, 1000, "99.9 %"),
        (2.065, 1.0, "206 %"),
        (999_999, 1_000_000, "> 99.99 %"),
        (7, 7, "100 %"),
        (0, 0, "0 %"),
    ],
)
def test_percent_never_rounds_some_to_none_or_all(part: int, whole: int, text: str) -> None:
    assert percent(part, whole) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.00115, "1.1×10⁻³"),
        (9.34e-4, "9.3×10⁻⁴"),
        (-2.0, "−2.0"),
        (1234.0, "1.2×10³"),
        (float("inf"), "not known"),
    ],
)
def test_scientific(value: float, text: str) -> None:
    assert scientific(value) == text


def test_count_and_units() -> None:
    assert count(1, "pixel") == "1 pixel"
    assert count(17_750, "frame") == "17,750 frames"
    assert unit_text("e-/DN") == "e⁻/DN"
    assert unit_text("1") == ""
    assert unit_text("furlong") == "furlong"


def test_the_units_of_maps_are_those_of_the_store() -> None:
    for name in (
        "quanta_exposure",
        "conversion_gain",
        "bias",
        "read_noise_dn",
        "read_noise_e",
        "charge_rate",
        "dark_current",
    ):
        assert symbol(name)[2] == unit_text(VARIABLES[f"maps/{name}"].unit)


@pytest.mark.parametrize(
    ("value", "text"),
    [(1.24, "+1.2"), (-0.3, "−0.3"), (-0.04, "0.0"), (0.0, "0.0"), (float("nan"), "not known")],
)
def test_signed(value: float, text: str) -> None:
    assert signed(value) == text


def test_plain_sentences_get_the_signs_of_a_page() -> None:
    plain = "5 -> 3 e-, 0.1 e-/DN: one-sided, 1e-3"
    assert typeset(plain) == "5 → 3 e⁻, 0.1 e⁻/DN: one-sided, 1e-3"


def test_what_is_not_seen_in_a_name_is_written() -> None:
    assert visible("gpj.\u202eraw") == "gpj.\u200e\\u202e\u200eraw"
    assert visible("a\u200bb\ufeff\x1b") == "a\u200e\\u200b\u200eb\u200e\\ufeff\u200e\u200e\\u001b\u200e"
    written = "می\u200cخواهم 👩\u200d🔬 \u200fعربي µ é\n\tx"  # joiners and marks of direction are part of it
    assert visible(written) == written


def test_a_long_name_is_cut_behind_a_letter_with_its_marks() -> None:
    assert short_name("  one\ntwo ") == "one two"
    assert short_name("w" * 200) == "w" * 200
    assert short_name("w" * 1_000_000) == "w" * 200 + " …"
    assert short_name("e\u0301" * 500) == "e\u0301" * 100 + " …"
    assert short_name("x" * 199 + "e\u0301" * 9) == "x" * 199 + " …"
    assert short_name(" " * 5000 + "x").endswith("…")
    assert len(short_name("\u0301" * 5000)) == 202
