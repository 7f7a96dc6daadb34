"""Colours of figures by what they stand for, for light and dark paper, and scales of colours for maps.

Colours of lines: Okabe and Ito (2008), distinct for the colour-blind; maps use ``viridis``, whose lightness
rises evenly, differences a diverging scale.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

MAP_COLOURS = "viridis"
DIVERGING = "RdBu_r"

#: Colours of that scale of matplotlib at equal distances; between them they are linear, to 2 of 255.
_SHADES = (
    "440154471164482071472e7c443b843f488939558c34618d2f6c8e2a768e26818e228b8d"
    "1f958b1fa08824aa832fb47c40bd7256c66770cf578bd646a8db34c5e021e2e418fde725"
)


@dataclass(frozen=True)
class Palette:
    """Colours of one figure; those without a remark are of lines and marks."""

    ink: str = "#000000"  # main lines
    paper: str = "#FFFFFF"  # background
    edge: str = "#333333"  # axes
    faint: str = "#444444"  # small notes
    blue: str = "#0072B2"
    vermilion: str = "#D55E00"
    green: str = "#009E73"
    orange: str = "#E69F00"
    sky: str = "#56B4E9"
    purple: str = "#CC79A7"
    yellow: str = "#F0E442"
    bars: str = "#B8B8B8"  # areas of histograms
    band: str = "#E6E6E6"  # 2 sigma of sampling noise
    grid: str = "#DDDDDD"  # lines of a grid
    no_value: str = "#D9D9D9"  # pixels without a value in maps, outside the range of ``MAP_COLOURS`` in hue
    mark: str = "#F0E442"  # what the verdict points to


LIGHT = Palette()
DARK = Palette(
    ink="#F2F2F2",
    paper="#15191D",
    edge="#B0B7BE",
    faint="#C3C9CF",
    blue="#56B4E9",
    sky="#0072B2",
    bars="#66717C",
    band="#2B333B",
    grid="#39434C",
    no_value="#4A4A4A",
    mark="#7A7320",
)


def dark_rules() -> str:
    """Return a style sheet for a drawing on light paper (SVG) that makes it dark on a dark screen."""
    rules = [f"text{{fill:{DARK.ink}}}"]
    for of in ("fill", "stroke"):
        for light, dark in zip(astuple(LIGHT)[:-1], astuple(DARK)[:-1], strict=True):  # mark is yellow, too
            rules.append(f'[style*="{of}: {light.lower()}"]{{{of}:{dark}!important}}')
    return f"@media screen and (prefers-color-scheme:dark){{{''.join(rules)}}}"


def shades() -> NDArray[np.uint8]:
    """Return the colours of maps in equal steps, red, green and blue, shape (256, 3)."""
    known = np.frombuffer(bytes.fromhex(_SHADES), np.uint8).reshape(-1, 3)
    places = np.linspace(0.0, len(known) - 1.0, 256)
    colours = [np.interp(places, np.arange(len(known)), column) for column in known.T]
    return np.rint(np.stack(colours, axis=1)).astype(np.uint8)
