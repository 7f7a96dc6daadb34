"""Public names, what imports bring, results as JSON data, shares in words."""

import doctest
import subprocess
import sys
from types import MappingProxyType

import numpy as np
import pytest

import pchem_pipeline
from pchem_pipeline.base.plain import plain


def test_the_public_names_are_these():
    names = {"FitResult", "FitSettings", "FitStatus", "PchEmError", "RunStore", "__version__"}
    names |= {"characterise", "fit_counts", "fit_histograms", "open_run"}
    names |= {"Drawing", "Pixel", "Run", "Twin", "Verdict"}
    assert set(pchem_pipeline.__all__) == names == set(dir(pchem_pipeline))
    for name in names:
        assert getattr(pchem_pipeline, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'offset'"):
        _ = pchem_pipeline.offset


def test_the_example_runs():
    outcome = doctest.testmod(pchem_pipeline)
    assert outcome.attempted >= 7
    assert outcome.failed == 0


@pytest.mark.parametrize(
    ("module", "light"),
    [
        ("pchem_pipeline", {"numpy", "numba", "zarr", "pydantic"}),
        ("pchem_pipeline.simulate.settings", {"numpy", "numba", "scipy"}),
        (
            "pchem_pipeline.frames.open, pchem_pipeline.frames.writing, pchem_pipeline.frames.registry as r; "
            "r.frame_suffixes()",
            {"numba", "scipy", "zarr", "matplotlib", "tifffile", "astropy", "h5py", "dask", "yaml"},
        ),
    ],
)
def test_what_is_imported_imports_nothing_heavy(module, light):
    code = f"import sys, {module}; print({light!r} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


@pytest.mark.parametrize(
    ("values", "data"),
    [
        ({"a": [1, float("nan"), (2.5, float("inf"))], "b": "x"}, {"a": [1, None, [2.5, None]], "b": "x"}),
        ({1: np.float32(0.5), "m": MappingProxyType({})}, {"1": 0.5, "m": {}}),
        ([np.array([1.0, np.nan]), np.bool_(True)], [[1.0, None], True]),
        ([np.float64("inf"), object], [None, "<class 'object'>"]),
    ],
)
def test_json_has_no_nan_and_no_arrays(values, data):
    assert plain(values) == data
