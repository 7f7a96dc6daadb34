"""The vector of the fit's loops, and the scalar in its place where numba cannot be taught vectors."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import norm

import pchem_pipeline

SCRIPT = """
import sys
import numba.extending as hooks
register = hooks.register_model
if sys.argv[1] == "scalar":
    def refuse(kind):
        raise AttributeError("no such hook")
    hooks.register_model = refuse
import numpy as np
from pchem_pipeline.base.kernel import kernel
import pchem_pipeline.model.arithmetic.simd_numba
hooks.register_model = register
from pchem_pipeline.model.arithmetic import simd_math_numba as functions, simd_numba as simd
from pchem_pipeline.model.arithmetic.simd_numba import (
    counting, exponent_of, fused, least, simd_load, most, nearest, scaled, simd_store,
    simd_sum, spliced
)
SIMD_WIDTH = simd.SIMD_WIDTH
exp, log = functions.simd_exp, functions.simd_log
@kernel
def fill(table):
    total = counting() * 0.0
    for i in range(0, table.shape[1], SIMD_WIDTH):
        x = simd_load(table, 0, i)
        simd_store(table, 1, i, exp(x))
        simd_store(table, 2, i, log(exp(x)))
        simd_store(table, 3, i, most(least(x, 1.0), -2.0))
        simd_store(table, 4, i, fused(x, 2.0, 1.0) / 2 - nearest(x))
        y = exp(x)
        simd_store(table, 5, i, scaled(scaled(y, 0.0 - exponent_of(y)), exponent_of(y)) - y)
        simd_store(table, 6, i, counting() + float(i))
        tail, density, by_z = functions.simd_tail(simd_load(table, 7, i))
        simd_store(table, 8, i, tail)
        simd_store(table, 9, i, density)
        simd_store(table, 10, i, by_z)
        simd_store(table, 11, i, spliced(3, x, -1.0))
        total = total + x
    return simd_sum(total)
table = np.zeros((12, 1600))
table[0] = np.random.default_rng(1).uniform(-100, 100, 1600)
table[7] = np.linspace(-37, 37, 1600)
table[7, :8] = -np.inf, np.inf, 0.0, -1e-250, 1e-250, -300.0, 300.0, 8.5
np.savez(sys.argv[2], table=table, total=fill(table), lanes=SIMD_WIDTH)
"""


@pytest.mark.parametrize(("kind", "lanes"), [("vector", 8), ("scalar", 1)])
def test_the_operations_are_what_they_are_named_after(tmp_path, kind, lanes):
    environment = {
        **os.environ,
        "PYTHONPATH": str(Path(pchem_pipeline.__file__).parents[1]),
        "NUMBA_CACHE_DIR": str(tmp_path),
    }
    (tmp_path / "script.py").write_text(SCRIPT)  # numba reads the source of what it compiles
    command = [sys.executable, str(tmp_path / "script.py"), kind, str(tmp_path / "found.npz")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert ("without vector instructions" in done.stderr) == (kind == "scalar")
    with np.load(tmp_path / "found.npz") as found:
        x, exponential, logarithm, clipped, left, zero, place, z, tail, density, by_z, first = found["table"]
        assert found["lanes"] == lanes
        assert found["total"] == pytest.approx(x.sum(), abs=1e-9)
    np.testing.assert_allclose(exponential, np.exp(x), rtol=3e-15)
    np.testing.assert_allclose(logarithm, x, rtol=1e-14, atol=1e-14)
    np.testing.assert_array_equal(clipped, np.clip(x, -2, 1))
    np.testing.assert_allclose(left, x + 0.5 - np.rint(x), atol=1e-13)
    np.testing.assert_array_equal(zero, 0.0)
    np.testing.assert_array_equal(place, np.arange(1600))
    np.testing.assert_array_equal(first, np.where(np.arange(1600) % lanes < 3, x, -1.0))
    np.testing.assert_array_equal(np.sign(tail), np.where(z <= 0.0, 1.0, -1.0))
    near = np.abs(z) < 8.0
    np.testing.assert_allclose(np.abs(tail[near]), ndtr(-np.abs(z[near])), rtol=2e-14)
    np.testing.assert_allclose(np.abs(tail), ndtr(-np.abs(z)), rtol=1e-12, atol=1e-303)
    np.testing.assert_allclose(density, norm.pdf(z), rtol=1e-12, atol=1e-303)
    np.testing.assert_allclose(by_z, np.nan_to_num(z) * norm.pdf(z), rtol=1e-12, atol=1e-300)
