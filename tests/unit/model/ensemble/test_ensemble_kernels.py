"""The compiled loops of the ensemble and the electron numbers against the same code, not compiled."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest

from pchem_pipeline.model.electrons import electrons_numba
from pchem_pipeline.model.electrons.electrons import KnownPixels
from pchem_pipeline.model.ensemble import ensemble_numba
from pchem_pipeline.model.law.sample_law import SampleLaw

H = np.array([0.0, 0.7, 2.4])
G = np.array([0.1, 0.12, 0.6])
MU = np.array([20.0, 24.3, 21.8])
SIGMA = np.array([2.8, 3.1, 0.6])
SHARE = np.array([0.2, 0.5, 0.3])
MASS = np.array([0.5, 0.3, 0.2])
COUNTS = np.random.default_rng(1).poisson(1.5, size=(3, 40)).astype(np.uint16)
ORIGIN = np.array([5, 10, 15])
NUMBERS = np.array([[0, 3, 65535], [2, 2, 9]], dtype=np.uint16)
TRUE = np.array([[0, 2, 1], [2, 5, 1]], dtype=np.uint32)
TABLE = np.random.default_rng(2).integers(0, 9, 120).astype(np.uint16)
PIXELS = KnownPixels([H, G, MU, SIGMA], SampleLaw()).kernel_inputs()
EMPTY_TABLES = electrons_numba.CodeTables(
    ORIGIN,
    np.arange(4) * 40,
    np.zeros(120, np.uint16),
    np.zeros(120),
    np.zeros(120),
    np.zeros(120, np.float32),
)
NUMBER_TABLES = EMPTY_TABLES._replace(number=TABLE)

ENSEMBLE: dict[str, tuple[Any, ...]] = {
    "sum_poisson": (SHARE, H, np.zeros(12)),
    "tally_counts": (
        COUNTS,
        ORIGIN,
        G,
        MU,
        ensemble_numba.AxisCounts(12, 1.0, np.zeros(30, dtype=np.int64)),
        ensemble_numba.AxisCounts(-8, 0.1, np.zeros(50, dtype=np.int64)),
        np.zeros((3, 2)),
    ),
}
ELECTRONS: dict[str, tuple[Any, ...]] = {
    "count_errors": (NUMBERS, TRUE, 65535, np.zeros(4, dtype=np.int64)),
    "tally_numbers": (COUNTS, ORIGIN, NUMBER_TABLES, 65535, np.zeros(5, dtype=np.int64)),
    "fill_tables": (EMPTY_TABLES, 1, H, PIXELS, 9, 65535),
}


@pytest.mark.parametrize(
    ("kernel", "arguments"),
    [
        *((getattr(ensemble_numba, name), arguments) for name, arguments in ENSEMBLE.items()),
        *((getattr(electrons_numba, name), arguments) for name, arguments in ELECTRONS.items()),
    ],
    ids=[*ENSEMBLE, *ELECTRONS],
)
def test_compiled_and_plain_agree(kernel: Any, arguments: tuple[Any, ...]) -> None:
    results = []
    for function in (kernel, kernel.py_func):
        copies = copy.deepcopy(arguments)
        returned = function(*copies)
        # something was written, and nothing but the outputs
        changed = [
            (now, before)
            for now, before in zip(arrays_in(copies), arrays_in(arguments), strict=True)
            if not np.array_equal(now, before)
        ]
        assert changed
        assert not any(np.any(before) for _, before in changed)
        results.append((returned, [now for now, _ in changed]))
    assert results[0][0] == results[1][0]
    for compiled, plain in zip(results[0][1], results[1][1], strict=True):
        np.testing.assert_allclose(compiled, plain, rtol=1e-13, atol=1e-18)


def arrays_in(value: Any) -> list[np.ndarray]:
    """Return the arrays of arguments, those in tuples too."""
    if isinstance(value, tuple):
        return [array for each in value for array in arrays_in(each)]
    return [value] if isinstance(value, np.ndarray) else []
