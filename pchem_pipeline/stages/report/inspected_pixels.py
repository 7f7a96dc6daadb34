"""Which pixels the report holds in full: shown, flagged, worst and extreme ones, and an even sample."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.fit.status import MEANINGS
from pchem_pipeline.report.data import MAP_NAMES
from pchem_pipeline.report.style.wording import symbol

__all__ = ["ChosenPixels", "choose_inspected"]

#: Pixels for each reason: a flag, a poor fit, an extreme value, a large standard error.
_FLAGGED, _POOR, _EXTREME, _UNSURE = 40, 60, 12, 8
_SEED = 20_231


@dataclass(frozen=True)
class ChosenPixels:
    """Pixels and why they were chosen.

    Attributes:
        index: ``y * nx + x`` of each, each once, the most telling first; shape (n,).
        reasons: words and indices; the even sample is not among them.
    """

    index: NDArray[np.int64]
    reasons: tuple[tuple[str, tuple[int, ...]], ...]


def choose_inspected(
    maps: Mapping[str, NDArray[Any]],
    fit: Mapping[str, NDArray[Any]],
    shown: Sequence[tuple[int, int]],
    suspects: Sequence[tuple[int, int]] = (),
    *,
    everything: int,
    most: int,
) -> ChosenPixels:
    """Choose the pixels that are in the report in full.

    Args:
        maps: parameters and standard errors, (y, x), NaN where there is no value.
        fit: ``fit_status``, and ``goodness_p`` where it is known, (y, x).
        shown: pixels (y, x) that the report draws.
        suspects: pixels (y, x) to which the discrepancy verdict points.
        everything: a sensor of at most so many pixels is taken whole.
        most: number of pixels of a larger one.
    """
    status = np.asarray(fit["fit_status"])
    ny, nx = status.shape
    rng = np.random.default_rng(_SEED)
    reasons = [
        ("shown in the report", _places(shown, nx)),
        ("named by the discrepancy verdict", _places(suspects, nx)),
        *_poor(fit, status),
        *_flagged(status, rng),
        *_extreme(maps),
    ]
    kept = [(words, where) for words, where in reasons if where.size]
    first = np.concatenate([where for _, where in kept]) if kept else np.empty(0, np.int64)
    rest = np.arange(status.size) if status.size <= everything else _even(ny, nx, most, rng)
    index = _once(np.concatenate([first, rest]))
    if status.size > everything:
        index = index[:most]
    there = set(index.tolist())
    listed = ((words, tuple(i for i in where.tolist() if i in there)) for words, where in kept)
    return ChosenPixels(index, tuple((words, where) for words, where in listed if where))


def _places(pixels: Sequence[tuple[int, int]], nx: int) -> NDArray[np.int64]:
    return np.array([y * nx + x for y, x in pixels], dtype=np.int64)


def _once(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return each index once, where it comes first."""
    _, first = np.unique(index, return_index=True)
    return index[np.sort(first)]


def _poor(fit: Mapping[str, NDArray[Any]], status: NDArray[Any]) -> list[tuple[str, NDArray[np.int64]]]:
    p = np.asarray(fit.get("goodness_p", np.full(status.shape, np.nan)), dtype=np.float64).ravel()
    return [("poorest goodness of fit", _smallest(p, _POOR))]


def _smallest(values: NDArray[np.float64], n: int) -> NDArray[np.int64]:
    known = np.flatnonzero(np.isfinite(values))
    order = np.argsort(values[known], kind="stable")[:n]
    return np.asarray(known[order], dtype=np.int64)


def _flagged(status: NDArray[Any], rng: np.random.Generator) -> list[tuple[str, NDArray[np.int64]]]:
    """Return some pixels of each reason for caution or failure, drawn at random, in their order."""
    found = []
    for bit, words in MEANINGS.items():
        where = np.flatnonzero(status.ravel() & int(bit))
        if where.size > _FLAGGED:
            where = np.sort(rng.choice(where, _FLAGGED, replace=False))
        found.append((words, where.astype(np.int64)))
    return found


def _extreme(maps: Mapping[str, NDArray[Any]]) -> list[tuple[str, NDArray[np.int64]]]:
    found = []
    for name in MAP_NAMES:
        if name not in maps:
            continue
        words = symbol(name)[1]
        values = np.asarray(maps[name], dtype=np.float64).ravel()
        found += [
            (f"largest {words}", _smallest(-values, _EXTREME)),
            (f"smallest {words}", _smallest(values, _EXTREME)),
        ]
        if f"{name}_stderr" in maps:
            errors = np.asarray(maps[f"{name}_stderr"], dtype=np.float64).ravel()
            found.append((f"largest standard error of the {words}", _smallest(-errors, _UNSURE)))
    return found


def _even(ny: int, nx: int, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return about ``n`` pixels, one at random in each cell of a grid, in random order."""
    rows = int(np.clip(round((n * ny / nx) ** 0.5), 1, ny))
    columns = int(np.clip(round(n / rows), 1, nx))
    edges_y, edges_x = np.linspace(0, ny, rows + 1), np.linspace(0, nx, columns + 1)
    y = np.minimum(edges_y[:-1, None] + rng.random((rows, columns)) * (ny / rows), ny - 1).astype(np.int64)
    x = np.minimum(edges_x[None, :-1] + rng.random((rows, columns)) * (nx / columns), nx - 1).astype(np.int64)
    return rng.permutation((y * nx + x).ravel())
