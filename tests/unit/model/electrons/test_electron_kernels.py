"""The compiled tables of electron numbers against the same code, not compiled."""

import numpy as np

from pchem_pipeline.model.electrons import electrons_numba
from pchem_pipeline.model.electrons.electrons import KnownPixels
from pchem_pipeline.model.law.sample_law import SampleLaw


def test_compiled_and_plain_agree() -> None:
    exposure, first, start = np.array([0.0, 0.7, 2.4]), np.array([5, 10, 15]), np.arange(4) * 40
    rest = np.array([[0.1, 0.12, 0.6], [20.0, 24.3, 21.8], [2.8, 3.1, 0.6]])
    inputs = KnownPixels([exposure, *rest], SampleLaw()).kernel_inputs()
    results = []
    for function in (electrons_numba.fill_tables, electrons_numba.fill_tables.py_func):
        rows = np.zeros(120, np.uint16), *np.zeros((2, 120)), np.zeros(120, np.float32)
        function(electrons_numba.CodeTables(first, start, *rows), 1, exposure, inputs, 9, 65535)
        results.append(rows)
    assert all(np.any(row) for row in results[0])
    for compiled, plain in zip(*results, strict=True):
        np.testing.assert_allclose(compiled, plain, rtol=1e-13, atol=1e-18)
