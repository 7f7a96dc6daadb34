"""The parts of the fit that are compiled by themselves: climb and searches, called by their addresses."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.kernel import callback, types_of
from pchem_pipeline.base.kernel_cache import in_any_order
from pchem_pipeline.model.errors import rounding_numba
from pchem_pipeline.model.fit import (
    cells_search_numba,
    climb_numba,
    guard_numba,
    search_numba,
    starts_numba,
    tile_numba,
)
from pchem_pipeline.model.fit.climb_numba import Goal, Limits
from pchem_pipeline.model.law.inputs import pack
from pchem_pipeline.model.law.likelihood import cells_likelihood, density_likelihood, evaluation_arguments
from pchem_pipeline.model.law.sample_law import SampleLaw

_VECTOR = np.zeros(1)
_OUTCOME = numba.types.Tuple((numba.types.int64, numba.types.float64, numba.types.int64))
_FOUND = numba.types.UniTuple(numba.types.int64, 3)
_LIMITS = Limits(0.0, 0.0, 0, 0, False, False, 0.0, 0.0, 0.0, 0.0, 0.0, False, False, False, False, False)
_GOAL = Goal(False, 0.0, 0.0, 0.0, False)


def _address(result: Any, arguments: tuple[Any, ...]) -> Any:
    """Return the type of the address of a function."""
    return numba.types.FunctionType(result(*types_of(arguments)))


@functools.cache
def _climb_arguments() -> tuple[Any, ...]:
    pixel, _, _, scratch, _ = evaluation_arguments()
    evaluate = _address(numba.types.float64, evaluation_arguments())
    return pixel, evaluate, _LIMITS, _GOAL, _VECTOR, _VECTOR, scratch


@functools.cache
def _search_arguments() -> tuple[Any, ...]:
    pixel, _, _, scratch, _ = evaluation_arguments()
    evaluate = _address(numba.types.float64, evaluation_arguments())
    climb_on = _address(_OUTCOME, _climb_arguments())
    tools = numba.types.NamedTuple(
        types_of((_LIMITS, evaluate, climb_on, np.zeros((1, 1)), scratch)), search_numba.Tools
    )
    task = search_numba.Task(pack([SampleLaw()], 1), 0, _VECTOR, _VECTOR, 0.0)
    return pixel, tools, task, _VECTOR, _VECTOR


@functools.cache
def compile_fit(given: Any, cells: bool) -> None:
    """Compile what a fit of tiles calls; of several processes each compiles a share.

    Args:
        given: type (of numba) of the :class:`.tile_numba.Histograms`.
        cells: with the mass of cells; else with the density.
    """
    in_any_order(compilations(given, cells))


def compilations(given: Any, cells: bool) -> list[Callable[[], Any]]:
    """Return what compiles a fit, kernel by kernel, the longest first; see :func:`compile_fit`."""
    if numba.config.DISABLE_JIT:
        return []
    evaluate = _address(numba.types.float64, evaluation_arguments())
    climb_on = _address(_OUTCOME, _climb_arguments())
    search = _address(_FOUND, _search_arguments())
    law, pixels, rows = pack([SampleLaw()], 1), np.zeros(1, np.int64), np.zeros((1, 1))
    starts = tile_numba.Starts(rows, _VECTOR, _VECTOR, np.zeros(1, np.bool_))
    stack, words, mask = np.zeros((1, 1, 1)), np.zeros((1, 1), np.int64), np.zeros((1, 1), np.uint8)
    answers = tile_numba.Answers(rows, stack, stack, rows, words)
    fit = (given, pixels, law, starts, _LIMITS, evaluate, climb_on, search, rows, answers)
    leave_out = (given, pixels, law, _LIMITS, evaluate, answers, _VECTOR, np.zeros(1, np.bool_))
    kernels = [
        (tile_numba.fit_tile, fit),
        (guard_numba.leave_out_tile, leave_out),
        (guard_numba.cut_tile, (given, pixels, 0.0, mask, _VECTOR)),
    ]
    if not cells:
        kernels.insert(1, (rounding_numba.rounding_tile, (rows, _VECTOR, evaluate, rows)))
    first, *others = (functools.partial(each.compile, tuple(types_of(of))) for each, of in kernels)
    addressed = (cells_search, cells_likelihood) if cells else (density_search, density_likelihood)
    return [first, *addressed, climb, *others]


@functools.cache
def climb() -> Any:
    """Return the climb to the nearest maximum, :func:`.climb_numba.climb`."""
    return callback(climb_numba.climb, _OUTCOME, _climb_arguments(), borrows=True)


@functools.cache
def density_search() -> Any:
    """Return the search with the density, :func:`.search_numba.search_density`."""
    return callback(search_numba.search_density, _FOUND, _search_arguments(), borrows=True)


@functools.cache
def cells_search() -> Any:
    """Return the search with the cells, :func:`.cells_search_numba.search_cells`."""
    return callback(cells_search_numba.search_cells, _FOUND, _search_arguments())


@functools.cache
def regression_basis() -> NDArray[np.float64]:
    """Return the basis of the regression on the characteristic function."""
    return starts_numba.regression_basis()
