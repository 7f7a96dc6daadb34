"""The parts of the fit that are compiled by themselves and called by their addresses."""

from __future__ import annotations

import functools
from typing import Any

import numba
import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.kernel import callback, types_of
from pchem_pipeline.model.fit import cells_search_numba, climb_numba, search_numba, starts_numba
from pchem_pipeline.model.fit.climb_numba import Goal, Limits
from pchem_pipeline.model.law import cells_numba, density_numba
from pchem_pipeline.model.law.inputs import pack
from pchem_pipeline.model.law.pixel_numba import FACTS, LAW, Pixel, Scratch
from pchem_pipeline.model.law.sample_law import SampleLaw

_VECTOR = np.zeros(1)
_OUTCOME = numba.types.Tuple((numba.types.int64, numba.types.float64))
_RESULT = numba.from_dtype(search_numba.RESULT)
_LIMITS = Limits(0.0, 0.0, 0, 0, False, False, 0.0, 0.0, 0.0, 0.0, 0.0, False, False, False, False, False)


def _address(result: Any, arguments: tuple[Any, ...]) -> Any:
    """Return the type of the address of a function."""
    return numba.types.FunctionType(result(*types_of(arguments)))


@functools.cache
def _evaluation_arguments() -> tuple[Any, ...]:
    """Return an example of each argument of a likelihood."""
    rows, stack = np.zeros((1, 1)), np.zeros((1, 1, 1))
    pixel = Pixel(stack, np.zeros(1, FACTS), np.zeros(1, LAW), stack, stack, 0, 0.0)
    flags, evaluations, used = np.zeros((2, 1), np.bool_), np.zeros((1, 1, 1, 1)), np.zeros(1, np.int64)
    scratch = Scratch(rows, rows, rows, rows, stack, rows, rows, flags, evaluations, used)
    return pixel, _VECTOR, 0, scratch, stack


@functools.cache
def _climb_arguments() -> tuple[Any, ...]:
    pixel, _, _, scratch, _ = _evaluation_arguments()
    evaluate = _address(numba.types.float64, _evaluation_arguments())
    return pixel, evaluate, _LIMITS, Goal(False, 0.0, 0.0, 0.0, False), _VECTOR, _VECTOR, scratch


@functools.cache
def _search_arguments() -> tuple[Any, ...]:
    pixel, _, _, scratch, _ = _evaluation_arguments()
    evaluate = _address(numba.types.float64, _evaluation_arguments())
    climb_on = _address(_OUTCOME, _climb_arguments())
    tools = numba.types.NamedTuple(
        types_of((_LIMITS, evaluate, climb_on, np.zeros((1, 1)), scratch)), search_numba.Tools
    )
    task = search_numba.Task(pack([SampleLaw()], 1), 0, _VECTOR, _VECTOR, 0.0)
    return pixel, tools, task, _VECTOR, _RESULT


@functools.cache
def climb() -> Any:
    """Return the climb to the nearest maximum, :func:`.climb_numba.climb`."""
    return callback(climb_numba.climb, _OUTCOME, _climb_arguments(), borrows=True)


@functools.cache
def _likelihood(evaluate: Any) -> Any:
    return callback(evaluate, numba.types.float64, _evaluation_arguments(), borrows=True)


def likelihood(cells: bool) -> Any:
    """Return the likelihood of the cells, integrated, or of the density at whole DN."""
    return _likelihood(cells_numba.evaluate_cells if cells else density_numba.evaluate_density)


@functools.cache
def density_search() -> Any:
    """Return the search with the density, :func:`.search_numba.search_density`."""
    return callback(search_numba.search_density, numba.types.int64, _search_arguments(), borrows=True)


@functools.cache
def cells_search(satellites: bool) -> Any:
    """Return the search with the cells, and of free satellites: :func:`.cells_search_numba.search_with`."""
    return callback(cells_search_numba.search_with(satellites), numba.types.int64, _search_arguments())


@functools.cache
def regression_basis() -> FloatArray:
    """Return the basis of the regression on the characteristic function."""
    return starts_numba.regression_basis()
