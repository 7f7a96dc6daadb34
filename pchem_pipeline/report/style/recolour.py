"""The colours of a finished figure replaced by those of another palette."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.artist import Artist
from matplotlib.cm import ScalarMappable
from matplotlib.collections import Collection
from matplotlib.colors import ListedColormap, to_rgb, to_rgba, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text

__all__ = ["recolour"]

_Rgb = tuple[float, float, float]


def recolour(figure: Figure, old: Sequence[str], new: Sequence[str]) -> None:
    """Replace colours of lines, areas, texts and legends of a figure in place; opacity stays.

    Args:
        figure: not yet laid out.
        old: colours of the palette that it was drawn with.
        new: colours in their place, in this order; repeated where they are fewer. Nothing changes without
            any.
    """
    if not new:
        return
    table = {to_rgb(colour): to_rgb(new[i % len(new)]) for i, colour in enumerate(old)}
    for artist in figure.findobj(include_self=False):
        _one(artist, table)


def _one(artist: Artist, table: dict[_Rgb, _Rgb]) -> None:
    if isinstance(artist, Line2D):
        artist.set_color(_swapped(artist.get_color(), table))
        artist.set_markerfacecolor(_swapped(artist.get_markerfacecolor(), table))
        artist.set_markeredgecolor(_swapped(artist.get_markeredgecolor(), table))
    elif isinstance(artist, Patch):
        artist.set_facecolor(_swapped(artist.get_facecolor(), table))
        artist.set_edgecolor(_swapped(artist.get_edgecolor(), table))
    elif isinstance(artist, Text):
        artist.set_color(_swapped(artist.get_color(), table))
    elif isinstance(artist, ScalarMappable) and isinstance(classes := artist.get_cmap(), ListedColormap):
        colours: Any = classes.colors
        if len(colours) < 64:  # classes, not a scale
            artist.set_cmap(ListedColormap([_swapped(colour, table) for colour in colours]))
    elif isinstance(artist, Collection) and artist.get_array() is None:
        artist.set_facecolor([_swapped(colour, table) for colour in to_rgba_array(artist.get_facecolor())])
        artist.set_edgecolor([_swapped(colour, table) for colour in to_rgba_array(artist.get_edgecolor())])


def _swapped(colour: Any, table: dict[_Rgb, _Rgb]) -> Any:
    red, green, blue, alpha = to_rgba(colour)
    known = table.get((red, green, blue))
    return colour if known is None or alpha == 0 else (*known, alpha)
