"""The edges of places whose pixels share noise are told line by line, where cells hold several lines."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers.standardised import samples_of

from pchem_pipeline.discrepancy.scan_pairs import Side, scan_pairs, sharpened
from pchem_pipeline.effects.framework.region import Region

SHAPE, FRAMES = (64, 200), 200


def noisy(place: Region, axes: tuple[int, ...], size: float, seed: int = 1) -> np.ndarray:
    """Return frames in which the pixels of a place share noise, standard deviations."""
    rng = np.random.default_rng(seed)
    frames = rng.standard_normal((FRAMES, *SHAPE)) + place.mask(SHAPE) * size * rng.standard_normal(axes)
    return np.clip(frames, -6, 6)


@pytest.mark.parametrize(
    ("mode", "axes"),
    [("row", (FRAMES, 64, 1)), ("column", (FRAMES, 1, 200)), ("frame", (FRAMES, 1, 1))],
)
@pytest.mark.parametrize(
    "place",
    [
        {"rows": [7, 23], "columns": [11, 90]},
        {"rows": [21, 27]},
        {"columns": [133, 200]},
        {"columns": [51, 58]},
    ],
)
def test_edges_within_cells_are_found(mode: str, axes: tuple[int, ...], place: dict[str, Any]) -> None:
    region = Region.model_validate(place)
    found = scan_pairs(samples_of(noisy(region, axes, 0.5)), most=1)
    assert found[0].mode == mode
    assert found[0].region.overlap(region, SHAPE) == 1.0


def test_without_single_lines_the_edges_of_the_cells_would_be_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    region = Region.model_validate({"rows": [7, 23], "columns": [11, 90]})
    samples = samples_of(noisy(region, (FRAMES, 1, 1), 0.5))
    monkeypatch.setattr(Side, "exact", True)
    found = scan_pairs(samples, most=1)
    assert 0.8 < found[0].region.overlap(region, SHAPE) < 1.0


def test_dead_lines_at_an_edge_belong_to_nothing_and_do_not_end_a_place() -> None:
    region = Region.model_validate({"rows": [9, 24]})
    usable = np.ones(SHAPE, np.bool_)
    usable[[7, 8, 15, 24, 25]] = False
    found = scan_pairs(samples_of(noisy(region, (FRAMES, 1, 1), 0.4), usable), most=1)
    assert found[0].region.mask(SHAPE)[usable].sum() == region.mask(SHAPE)[usable].sum()
    assert found[0].region.rows == ((9, 24),)


def test_what_single_lines_hardly_show_leaves_the_edges_as_they_are() -> None:
    edges, rng = np.arange(0, 65, 4), np.random.default_rng(2)
    lines, across = Side.of(edges, (2, 6)), Side.of(np.array([0, 200]), (0, 1))
    assert lines == Side(8, 24, 4, 28, (12, 20), sure=True)
    assert across == Side(0, 200, 0, 200, (0, 200), sure=False)
    samples = samples_of(np.clip(rng.standard_normal((FRAMES, *SHAPE)), -6, 6))
    for mode in ("row", "frame"):
        assert sharpened(samples, 0, mode, lines, across) == ((8, 24), (0, 200))
