"""Numbers in words: a value with its uncertainty and unit, rounded to what is known; and names as shown."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable

from pchem_pipeline.base.variables import PARAMETER_WORDS

#: All maps in the order of tables.
MAPS = tuple(PARAMETER_WORDS)

#: Digits and signs to their superscripts.
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


#: Electrons in plain text, not a word that is broken at a hyphen, nor a part of a file's name.
_PLAIN_E = re.compile(r"(?:(?<![\w./])|(?<=1/))e-(?!\w|\.\w)")


def typeset(text: str) -> str:
    """Return a plain sentence, as a verdict has it, with the signs of a page: ``e⁻``, ``→``."""
    return _PLAIN_E.sub("e⁻", text.replace(" -> ", " → "))


#: Formulas of mathtext as characters, the longer ones first; what is left of them loses its marks.
_CHARACTERS = (
    (r"\mathrm{e}^-", "ₑ"),
    (r"\sigma", "σ"),
    (r"\mu", "μ"),
    (r"\ell", "ℓ"),
    (r"\mathrm", ""),
    ("^2", "²"),
    ("^-", "⁻"),
    ("_0", "₀"),
    ("_{K_e}", "(k)"),
)
_FORMULA = re.compile(r"(?<!\\)\$([^$]*)\$")


def without_formulas(text: str) -> str:
    """Return a text with its formulas (mathtext) as characters, for where no formula can be drawn."""

    def characters(found: re.Match[str]) -> str:
        formula = found[1]
        for marks, sign in _CHARACTERS:
            formula = formula.replace(marks, sign)
        return re.sub(r"[\\{}_ ]", "", formula).replace("+", " + ").replace("-", " − ")

    return _FORMULA.sub(characters, text).replace(r"\$", "$")


def plain(text: str) -> str:
    """Return a text of others so that it is shown as it is, not read as a formula."""
    return text.replace("$", r"\$")


def unit_text(unit: str) -> str:
    """Return a stored unit as people write it, e.g. ``e-/DN`` as ``e⁻/DN``; ``1`` as nothing."""
    return "" if unit == "1" else unit.replace("DN2", "DN²").replace("e-2", "e⁻²").replace("e-", "e⁻")


def symbol(name: str) -> tuple[str, str, str]:
    """Return ``(symbol in mathtext, words, unit as people write it)`` of a map.

    Raises:
        KeyError: if no such map exists.
    """
    unit, sentence, _, math_symbol = PARAMETER_WORDS[name]
    return math_symbol, re.split("[:,]", sentence)[0], unit_text(unit)


def heading(name: str) -> str:
    """Return the words of a map with its unit, e.g. ``bias (DN)``."""
    _, words, unit = symbol(name)
    return f"{words} ({unit})"


def stored_unit(name: str) -> str:
    """Return the unit of a map as the store writes it."""
    return PARAMETER_WORDS[name][0]


def short(value: float, digits: int = 3) -> str:
    """Return a number with so many significant digits, as ``1.9×10⁻⁴`` where decimals would be long."""
    if not math.isfinite(value):
        return "not known"
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(float(f"{value:.{digits - 1}e}"))))
    if -4 < exponent < max(digits, 5):
        return f"{value:.{max(digits - 1 - exponent, 0)}f}".replace("-", "−")
    return scientific(value, digits)


def signed(value: float) -> str:
    """Return a number with its sign and one decimal, as ``+1.2`` or ``−0.3``; ``0.0`` has no sign."""
    if not math.isfinite(value):
        return "not known"
    text = f"{value:+.1f}".replace("-", "−")
    return text[1:] if text[1:] == "0.0" else text


def scientific(value: float, digits: int = 2) -> str:
    """Return a number as ``1.9×10⁻⁴``, for numbers that are compared over powers of ten."""
    if not math.isfinite(value):
        return "not known"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    if int(exponent) == 0:
        return mantissa.replace("-", "−")
    return f"{mantissa}×10{str(int(exponent)).translate(_SUPERSCRIPT)}".replace("-", "−")


def power_of_ten(exponent: int) -> str:
    """Return ``10⁻⁴``, or nothing for the power 0."""
    return f"10{str(exponent).translate(_SUPERSCRIPT)}" if exponent else ""


def measured(value: float, error: float, unit: str = "") -> str:
    """Return ``value ± error unit``, rounded to two digits of the error; one of NaN or 0 is left out."""
    tail = f" {unit}" if unit else ""
    if not math.isfinite(value):
        return "not known"
    if not math.isfinite(error) or error <= 0:
        return short(value, 4) + tail
    exponent = math.floor(math.log10(float(f"{error:.1e}")))
    if exponent < -6 or exponent > 5:
        return f"{short(value, 6)} ± {short(error, 2)}{tail}"
    decimals = max(1 - exponent, 0)
    return f"{value:.{decimals}f} ± {error:.{decimals}f}{tail}".replace("-", "−")


def fitted_or_chosen(value: float, error: float, unit: str = "") -> str:
    """Return a number as :func:`measured`; one without an error was chosen, and has no zeros at its end."""
    text = measured(value, error, unit)
    number, space, rest = text.partition(" ")
    if "." in number and "×" not in number and not (math.isfinite(error) and error > 0):
        number = number.rstrip("0").rstrip(".")
    return number + space + rest


def capitalised(text: str) -> str:
    """Return a text with its first letter as a capital, the others as they are."""
    return text[:1].upper() + text[1:]


def count(number: int, noun: str) -> str:
    """Return ``1 pixel``, ``2 pixels``, ``17,750 frames``."""
    plural = "" if number == 1 else "s"
    return f"{number:,} {noun}{plural}"


def first_few(parts: Iterable[object], most: int = 4) -> str:
    """Return the first of some parts in words, and how many more there are.

    Example:
        >>> first_few(range(6))
        '0, 1, 2, 3 and 2 more'
    """
    words = [str(part) for part in parts]
    return ", ".join(words[:most]) + (f" and {len(words) - most:,} more" if len(words) > most else "")


def probability_text(p: float) -> str:
    """Return ``< 0.001``, ``0.034`` or ``> 0.99``; nothing where it is not known."""
    if not math.isfinite(p):
        return ""
    return "< 0.001" if p < 0.001 else "> 0.99" if p > 0.99 else short(p, 2)


def p_value_text(p: float) -> str:
    """Return ``p < 0.001`` or ``p = 0.034``."""
    text = probability_text(p)
    return f"p {text}" if text[:1] in ("<", ">") else f"p = {text}"


def percent(part: float, whole: float = 1.0) -> str:
    """Return a share as ``12 %``, ``0.4 %`` or ``< 0.01 %``; ``0 %`` only for none."""
    if whole <= 0:
        return "0 %"
    share = 100.0 * part / whole
    if share == 0:
        return "0 %"
    if share < 0.01:
        return "< 0.01 %"
    if 99.99 < share < 100:
        return "> 99.99 %"
    digits = 2 if share < 1 else 1 if share < 10 or 99 < share < 100 else 0
    return f"{share:.{digits}f} %".replace(".0 %", " %")


#: Characters that are not seen, or change how others are shown: those that turn the direction of a text,
#: ends of lines, widths of nothing, controls. Joiners and direction marks stay, which scripts need.
_UNSEEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b\u2028\u2029\u202a-\u202e\u2060\ufeff]")
#: Characters of a name at most.
_LONGEST_NAME = 200


def visible(text: str) -> str:
    """Return a text with unseen characters written as their code, so that no name can look like another."""
    return _UNSEEN.sub(lambda found: f"\u200e\\u{ord(found[0]):04x}\u200e", text)  # from left to right


def short_name(text: str) -> str:
    """Return a name of at most 200 characters, visible and in one line; a longer one ends with dots."""
    line = " ".join(text[: 4 * _LONGEST_NAME].split())
    if len(text) <= 4 * _LONGEST_NAME and len(line) <= _LONGEST_NAME:
        return visible(line)
    end = _LONGEST_NAME
    while end > 0 and line[end : end + 1] and unicodedata.category(line[end])[0] == "M":
        end -= 1  # marks stay with their letter
    return f"{visible(line[: end or _LONGEST_NAME].rstrip())} …"


def cut(text: str, most: int) -> str:
    """Return a text of at most ``most`` characters; an ellipsis ends one that was longer."""
    return text if len(text) <= most else f"{text[: most - 1]}…"
