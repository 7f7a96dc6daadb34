"""Colours of figures by what they stand for: for light and dark paper, and from a user's style sheet.

Colours of lines are those of Okabe and Ito (2008), which the colour-blind can tell apart; maps use
``viridis``, whose lightness rises evenly, differences a diverging scale whose ends everyone can tell apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from matplotlib.colors import to_hex, to_rgb

MAP_COLOURS = "viridis"
DIVERGING = "RdBu_r"

#: Hues in the order in which lines without a colour of their own take them.
_CYCLE = ("blue", "vermilion", "green", "orange", "sky", "purple", "yellow", "ink")


@dataclass(frozen=True)
class Palette:
    """Colours of one figure.

    Attributes:
        ink: main lines.
        paper: background.
        edge: axes.
        faint: small notes.
        blue, vermilion, green, orange, sky, purple, yellow: lines and marks.
        bars: areas of histograms.
        band: where chance puts values.
        grid: lines of a grid.
        no_value: pixels without a value in maps, outside the range of ``MAP_COLOURS`` in hue and saturation.
        mark: what the verdict points to.
        from_paper: colours of a map that begin with the paper's lightness.
    """

    ink: str = "#000000"
    paper: str = "#FFFFFF"
    edge: str = "#333333"
    faint: str = "#444444"
    blue: str = "#0072B2"
    vermilion: str = "#D55E00"
    green: str = "#009E73"
    orange: str = "#E69F00"
    sky: str = "#56B4E9"
    purple: str = "#CC79A7"
    yellow: str = "#F0E442"
    bars: str = "#B8B8B8"
    band: str = "#E6E6E6"
    grid: str = "#DDDDDD"
    no_value: str = "#D9D9D9"
    mark: str = "#F0E442"
    from_paper: str = "viridis_r"

    @property
    def cycle(self) -> tuple[str, ...]:
        """Colours of lines, in their order."""
        return tuple(getattr(self, name) for name in _CYCLE)

    def parameters(self) -> dict[str, Any]:
        """Return the parameters of matplotlib that hold colours."""
        ink = dict.fromkeys(("text.color", "axes.labelcolor", "xtick.color", "ytick.color"), self.ink)
        paper = dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), self.paper)
        return {"axes.edgecolor": self.edge, **ink, **paper}


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
    from_paper="viridis",
)


def palette_of(sheet: Mapping[str, Any]) -> Palette:
    """Return the palette of a matplotlib style sheet: its paper and text, its cycle of colours.

    Args:
        sheet: name to value; what it does not say is that of ``LIGHT``, of ``DARK`` where its paper is dark.
    """
    paper = sheet.get("axes.facecolor", sheet.get("figure.facecolor", LIGHT.paper))
    red, green, blue = to_rgb(paper)
    base = DARK if 0.3 * red + 0.59 * green + 0.11 * blue < 0.5 else LIGHT
    names = {"text.color": ("ink", "faint"), "axes.edgecolor": ("edge",)}
    found = {name: to_hex(sheet[key]) for key, names_ in names.items() if key in sheet for name in names_} | (
        {"paper": to_hex(paper)} if base is DARK or paper != LIGHT.paper else {}
    )
    cycle = sheet["axes.prop_cycle"].by_key().get("color", []) if "axes.prop_cycle" in sheet else []
    if cycle:
        found |= {name: to_hex(cycle[i % len(cycle)]) for i, name in enumerate(_CYCLE[:-1])}
    return replace(base, **found)
