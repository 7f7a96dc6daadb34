"""Numbers in words."""

from collections.abc import Callable

import pytest

from pchem_pipeline.base.variables import PARAMETERS, VARIABLES
from pchem_pipeline.base.wording import (
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

NAN, INF = float("nan"), float("inf")
IN_WORDS = {
    short: [
        ((0.0, 3), "0"),
        ((0.30512, 3), "0.305"),
        ((-2.5, 2), "−2.5"),
        ((1.9e-4, 2), "1.9×10⁻⁴"),
        ((9.996e-5, 3), "1.00×10⁻⁴"),
        ((0.00123, 2), "0.0012"),
        ((123456.0, 3), "1.23×10⁵"),
        ((17750.0, 3), "17750"),
        ((99.96, 3), "100"),
        ((NAN, 3), "not known"),
    ],
    # two digits of the error
    measured: [
        ((2.01344, 0.01234, "e⁻"), "2.013 ± 0.012 e⁻"),
        ((0.0953671, 0.000024, "e⁻"), "0.095367 ± 0.000024 e⁻"),
        ((100.04, 12.3, "e⁻"), "100 ± 12 e⁻"),
        ((-0.5, 0.0996, "e⁻"), "−0.50 ± 0.10 e⁻"),
        ((2.0, NAN, "e⁻"), "2.000 e⁻"),
        ((2.0, 0.0, "e⁻"), "2.000 e⁻"),
        ((NAN, 1.0, "e⁻"), "not known"),
    ],
    # a number that was chosen claims no precision
    fitted_or_chosen: [
        ((30.0, NAN, "frames"), "30 frames"),
        ((0.2, NAN), "0.2"),
        ((100.0, NAN, "DN"), "100 DN"),
        ((2.0, 0.01, "DN"), "2.000 ± 0.010 DN"),
    ],
    # some are never none or all
    percent: [
        ((0, 10), "0 %"),
        ((1, 1_000_000), "< 0.01 %"),
        ((5, 1000), "0.50 %"),
        ((1, 3), "33 %"),
        ((999, 1000), "99.9 %"),
        ((2.065, 1.0), "206 %"),
        ((999_999, 1_000_000), "> 99.99 %"),
        ((7, 7), "100 %"),
        ((0, 0), "0 %"),
    ],
    scientific: [
        ((0.00115,), "1.1×10⁻³"),
        ((9.34e-4,), "9.3×10⁻⁴"),
        ((-2.0,), "−2.0"),
        ((1234.0,), "1.2×10³"),
        ((INF,), "not known"),
    ],
    signed: [((1.24,), "+1.2"), ((-0.3,), "−0.3"), ((-0.04,), "0.0"), ((0.0,), "0.0"), ((NAN,), "not known")],
    count: [((1, "pixel"), "1 pixel"), ((17_750, "frame"), "17,750 frames")],
    unit_text: [(("e-/DN",), "e⁻/DN"), (("1",), ""), (("furlong",), "furlong")],
}


@pytest.mark.parametrize(
    ("words", "given", "text"), [(words, *case) for words, cases in IN_WORDS.items() for case in cases]
)
def test_numbers_in_words(words: Callable[..., str], given: tuple[object, ...], text: str) -> None:
    assert words(*given) == text


def test_the_units_of_maps_are_those_of_the_store() -> None:
    for name in (*PARAMETERS, "read_noise_e", "charge_rate", "dark_current"):
        assert symbol(name)[2] == unit_text(VARIABLES[f"maps/{name}"].unit), name


def test_plain_sentences_get_the_signs_of_a_page() -> None:
    plain = "5 -> 3 e-, 0.1 e-/DN: one-sided, 1e-3"
    assert typeset(plain) == "5 → 3 e⁻, 0.1 e⁻/DN: one-sided, 1e-3"
    # names of files stay as they are
    assert typeset("noise e-.tif in /data/e-/run: 2 e-.") == "noise e-.tif in /data/e-/run: 2 e⁻."


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
