"""Pairs of pixels that share a row, a column or a frame: their sums, places that stand out, and their edges.

Where cells hold several lines, the edges are told line by line.
"""

from typing import Any

import numpy as np
import pytest
from helpers.standardised import samples_of

from pchem_pipeline.discrepancy.families import box_sums
from pchem_pipeline.discrepancy.scan_pairs import PERIOD, pairs_of, scan_pairs, shared_elsewhere
from pchem_pipeline.effects.framework.region import Region

SHAPE, FRAMES = (24, 24), 1000
WIDE, FEW = (34, 200), 200


@pytest.mark.parametrize("shape", [(6, 9), (70, 20), (20, 33)])
def test_sums_of_cells_are_those_of_all_pairs(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(sum(shape))
    usable = rng.random(shape) < 0.8
    samples = samples_of(rng.standard_normal((5, *shape)), usable)
    [[u, _]] = samples.chunks()
    flat = u.reshape(5, -1).astype(np.float64)
    y, x = (each.ravel() for each in np.mgrid[: shape[0], : shape[1]])
    products, counts = flat.T @ flat, 5.0 * np.outer(usable.ravel(), usable.ravel())
    same_row, same_column = y[:, None] == y, x[:, None] == x
    of_row, of_column, of_frame = same_row & ~same_column, same_column & ~same_row, ~same_row & ~same_column
    shared = {"row": of_row, "column": of_column, "frame": of_frame}
    for mode, pairs in pairs_of(samples)[0].items():
        rows, columns = pairs.edges
        box = np.array([[1], [rows.size - 2]]), np.array([[2], [columns.size - 1]])
        inside = (y >= rows[1]) & (y < rows[-2]) & (x >= columns[2])
        for table, full in ((pairs.sums, products), (pairs.counts, counts)):
            expected = (full * shared[mode])[np.ix_(inside, inside)].sum()
            [[found]] = box_sums(table, pairs.axes, *box)
            assert found == pytest.approx(expected, abs=1e-2)
        for axis, along in enumerate((y, x)):
            some = along % PERIOD == 3
            expected = (products * shared[mode])[np.ix_(some, some)].sum()
            # lines that the pixels share are not looked at
            expected = 0.0 if mode == ("row", "column")[axis] else expected
            assert pairs.by_number[0][axis, 3, 3] == pytest.approx(expected, abs=1e-2)
        pixels = inside.reshape(shape) & usable
        energy = samples.energies(0, mode, pixels).sum()
        expected = (products * shared[mode])[np.ix_(pixels.ravel(), pixels.ravel())].sum() / 2.0
        assert energy == pytest.approx(expected, abs=1e-2)


@pytest.mark.parametrize(
    ("mode", "axes", "place"),
    [
        ("row", (FRAMES, 24, 1), {"rows": [12, 20], "columns": [4, 16]}),
        ("column", (FRAMES, 1, 24), {"rows": [3, 11]}),
        ("frame", (FRAMES, 1, 1), {"rows": [12, 24], "columns": [0, 12]}),
        ("frame", (FRAMES, 1, 1), {"taps": {"every": 8, "which": 5}}),
    ],
)
def test_a_place_is_found_from_twelve_standard_errors_of_its_pairs_on(
    mode: str, axes: tuple[int, ...], place: dict[str, Any]
) -> None:
    rng = np.random.default_rng(5)
    region = Region.model_validate(place)
    mask = region.mask(SHAPE)
    row, column = ((mask.sum(axis=axis, dtype=float) ** 2).sum() for axis in (1, 0))
    size = float(mask.sum())
    pairs = {"row": row - size, "column": column - size, "frame": size**2 - row - column + size}[mode] / 2.0
    shared = np.sqrt(12.0 / np.sqrt(FRAMES * pairs)) * rng.standard_normal(axes)
    frames = rng.standard_normal((FRAMES, *SHAPE)) + mask * shared
    found = scan_pairs(samples_of(frames), significance=1e-3)
    assert found[0].mode == mode
    assert found[0].region.overlap(region, SHAPE) > 0.7
    # the scatter of the noise put in and the root take up to half of it, the best of all places adds
    assert 6.0 < found[0].z < 16.0


@pytest.mark.parametrize(("second", "told"), [(0.0, False), (0.1, True)])
def test_what_a_second_tap_shares_is_told_beside_the_first(second: float, told: bool) -> None:
    """Two taps of one noise each look alike outside of the first, where no contrast is left."""
    rng = np.random.default_rng(9)
    rows = rng.standard_normal((2, FRAMES, 24, 1)) * np.array([0.2, second])[:, None, None, None]
    frames = rng.standard_normal((FRAMES, *SHAPE)) + np.repeat(np.concatenate([*rows], axis=2), 12, axis=2)
    samples = samples_of(frames)
    [place] = scan_pairs(samples, most=1)
    assert place.region.columns == ((0, 12),)
    rest = shared_elsewhere(samples, place)
    assert (rest is not None) is told
    assert rest is None or rest.columns == ((12, 24),)


@pytest.mark.parametrize(
    ("mode", "lines"), [("row", [(4, 5), (11, 12), (18, 20)]), ("column", [(2, 3), (21, 22)])]
)
def test_scattered_lines_are_one_place(mode: str, lines: list[tuple[int, int]]) -> None:
    rng = np.random.default_rng(6)
    region = Region.model_validate({"rows" if mode == "row" else "columns": lines})
    mask = region.mask(SHAPE)
    axes = (FRAMES, 24, 1) if mode == "row" else (FRAMES, 1, 24)
    # each line 12 standard errors of its own pairs
    shared = np.sqrt(12.0 / np.sqrt(FRAMES * 24 * 23 / 2.0)) * rng.standard_normal(axes)
    frames = rng.standard_normal((FRAMES, *SHAPE)) + mask * shared
    [found] = scan_pairs(samples_of(frames), significance=1e-3)
    assert found.mode == mode
    assert np.array_equal(found.region.mask(SHAPE), mask)


def test_what_all_pixels_share_has_no_place_and_nothing_is_found_in_nothing() -> None:
    rng = np.random.default_rng(7)
    for row, column, frame in ((0, 0, 0), (0.5, 0, 0), (0, 0.5, 0), (0, 0, 0.5), (0.4, 0.3, 0.2)):
        frames = rng.standard_normal((FRAMES, *SHAPE)) + row * rng.standard_normal((FRAMES, 24, 1))
        frames += column * rng.standard_normal((FRAMES, 1, 24)) + frame * rng.standard_normal((FRAMES, 1, 1))
        assert scan_pairs(samples_of(frames), significance=1e-3) == []


def noisy(place: Region, axes: tuple[int, ...], size: float) -> np.ndarray:
    """Return frames in which the pixels of a place share noise, standard deviations."""
    rng = np.random.default_rng(1)
    return rng.standard_normal((FEW, *WIDE)) + place.mask(WIDE) * size * rng.standard_normal(axes)


@pytest.mark.parametrize(
    ("mode", "place"),
    [
        ("row", {"rows": [7, 23], "columns": [11, 90]}),
        ("column", {"rows": [7, 23], "columns": [11, 90]}),
        ("frame", {"rows": [7, 23], "columns": [11, 90]}),
        ("frame", {"rows": [21, 27]}),
        ("row", {"columns": [133, 200]}),
        ("column", {"columns": [51, 58]}),
    ],
)
def test_edges_within_cells_are_found(mode: str, place: dict[str, Any]) -> None:
    region = Region.model_validate(place)
    axes = {"row": (FEW, WIDE[0], 1), "column": (FEW, 1, WIDE[1]), "frame": (FEW, 1, 1)}[mode]
    found = scan_pairs(samples_of(noisy(region, axes, 0.5)), most=1)
    assert found[0].mode == mode
    assert found[0].region.overlap(region, WIDE) == 1.0


def test_dead_lines_at_an_edge_belong_to_nothing_and_do_not_end_a_place() -> None:
    region = Region.model_validate({"rows": [9, 24]})
    usable = np.ones(WIDE, np.bool_)
    usable[[7, 8, 15, 24, 25]] = False
    found = scan_pairs(samples_of(noisy(region, (FEW, 1, 1), 0.4), usable), most=1)
    assert found[0].region.mask(WIDE)[usable].sum() == region.mask(WIDE)[usable].sum()
    assert found[0].region.rows == ((9, 24),)
