"""The pure tile function of the stage fit."""

from __future__ import annotations

import numpy as np
from helpers.drawn_pixels import draw

from pchem_pipeline.base.variables import FREE_SATELLITES, INTERVALS, interval_names, variables_of
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.stages.fit.fit import fit_tile


def test_tile_has_every_array_in_its_place() -> None:
    pixels = draw(np.random.default_rng(6), [0.5, 2.0, 1.0, 4.0, 3.0, 0.2], 11.0, 0.3)
    histogram = {
        "counts": pixels.counts.reshape(2, 3, -1),
        "origin": pixels.origin.reshape(2, 3).astype(np.int32),
        "under": np.array([[0, 0, 0], [0, 7, 0]], np.uint32),
        "over": np.zeros((2, 3), np.uint32),
    }
    ends = {path for name in INTERVALS for path in interval_names(name)}
    absent = ends | set(FREE_SATELLITES)
    arrays = fit_tile(histogram, FitSettings(), None)
    assert set(arrays) == {variable.name for variable in variables_of("fit")} - absent
    expected = fit_histograms(
        pixels.counts, pixels.origin, histogram["under"].ravel(), histogram["over"].ravel()
    )
    np.testing.assert_array_equal(arrays["conversion_gain"].ravel(), expected.conversion_gain)
    np.testing.assert_array_equal(arrays["fit_status"].ravel(), expected.fit_status)
    np.testing.assert_array_equal(arrays["bias_stderr"][1, 0], np.sqrt(expected.covariance[3, 2, 2]))
    assert arrays["fit_status"][1, 1] == 256
    for variable in variables_of("fit"):
        if variable.name in absent:
            continue
        assert arrays[variable.name].shape[:2] == (2, 3), variable.name
        assert arrays[variable.name].dtype == np.dtype(variable.dtype), variable.name
