"""Results as JSON data."""

from types import MappingProxyType

import numpy as np

from pchem_pipeline.base.plain import plain


def test_json_has_no_nan_and_no_arrays():
    values = {
        "a": [1, float("nan"), (2.5, float("inf"))],
        "b": "x",
        1: np.float32(0.5),
        "m": MappingProxyType({}),
    }
    assert plain(values) == {"a": [1, None, [2.5, None]], "b": "x", "1": 0.5, "m": {}}
    assert plain([np.array([1.0, np.nan]), np.bool_(True), np.float64("inf"), object]) == [
        [1.0, None],
        True,
        None,
        "<class 'object'>",
    ]
