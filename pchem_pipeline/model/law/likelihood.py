"""The likelihoods of the density and of the cells, compiled by themselves and called by their addresses."""

from __future__ import annotations

import functools
from typing import Any

import numba
import numpy as np

from pchem_pipeline.base.kernel import callback
from pchem_pipeline.model.law import cells_numba, density_numba
from pchem_pipeline.model.law.pixel_numba import Pixel, Scratch


@functools.cache
def evaluation_arguments() -> tuple[Any, ...]:
    """Return an example of each argument of a likelihood."""
    vector, rows, stack = np.zeros(1), np.zeros((1, 1)), np.zeros((1, 1, 1))
    pixel = Pixel(stack, rows, stack, stack, 0, 0.0)
    flags, evaluations = np.zeros((2, 1), np.bool_), np.zeros((1, 1, 1, 1))
    return pixel, vector, 0, Scratch(rows, rows, rows, rows, stack, rows, rows, flags, evaluations), stack


@functools.cache
def density_likelihood() -> Any:
    """Return the likelihood of the density at whole DN, :func:`.density_numba.evaluate_density`."""
    return callback(density_numba.evaluate_density, numba.types.float64, evaluation_arguments(), borrows=True)


@functools.cache
def cells_likelihood() -> Any:
    """Return the likelihood of the cells, integrated, :func:`.cells_numba.evaluate_cells`."""
    return callback(cells_numba.evaluate_cells, numba.types.float64, evaluation_arguments(), borrows=True)
