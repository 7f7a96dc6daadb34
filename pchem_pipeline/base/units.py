"""Constants of the units that the package works in, and shares and units in words."""

from __future__ import annotations

import re

#: DN^2: variance of rounding to whole DN, an error uniform over 1 DN
QUANTISATION_VARIANCE = 1.0 / 12.0
#: DN per electron, below which a DN is no small part of an electron
FEW_STEP = 3.0
#: Electrons in plain text, not a word that is broken at a hyphen, nor a part of a file's name.
_PLAIN_E = re.compile(r"(?:(?<![\w./])|(?<=1/))e-(?!\w|\.\w)")


def per_cent(share: float) -> str:
    """Return a share to two digits in per cent, and never as a power of ten."""
    percent = 100.0 * share
    return f"{percent:.2g} %" if abs(percent) < 99.5 else f"{percent:.0f} %"


def typeset(text: str) -> str:
    """Return a plain sentence, as a verdict has it, with the signs of a page: ``e⁻``, ``→``."""
    return _PLAIN_E.sub("e⁻", text.replace(" -> ", " → "))
