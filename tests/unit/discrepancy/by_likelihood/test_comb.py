"""Places on the comb where a model has too many or too few samples."""

import numpy as np

from pchem_pipeline.discrepancy.by_likelihood.comb import find_residuals
from pchem_pipeline.model.law.mass import sample_mass
from pchem_pipeline.model.law.sample_law import SampleLaw

PARAMETERS = np.array([[2.0, 1 / 14, 100.0, 2.0], [1.5, 1 / 14, 108.0, 2.0]])


def histograms():
    """Expected samples of two pixels of different bias, shape (2, B), and DN of bin 0."""
    origin, codes = np.array([80, 88]), np.arange(160)
    rows = [
        sample_mass(SampleLaw(), [np.array([v]) for v in row], first + codes)[0]
        for row, first in zip(PARAMETERS, origin, strict=True)
    ]
    return 1e5 * np.array(rows), origin


def test_chance_leaves_nothing_and_what_is_added_is_found_in_its_place():
    rng = np.random.default_rng(3)
    expected, origin = histograms()
    seen = rng.poisson(expected).astype(float)
    assert find_residuals(seen, expected, origin, PARAMETERS) == []
    between = (np.arange(160) + origin[:, None] - PARAMETERS[:, 2:3]) / 14
    seen += rng.poisson(np.where((between > 1.4) & (between < 1.6), 60.0, 0.0))
    first = find_residuals(seen, expected, origin, PARAMETERS)[0]
    assert first.sentence.startswith("more samples than expected between the 1- and the 2-electron peak")
    assert 100 + 14 < first.dn[0] <= first.dn[1] < 108 + 28


def test_a_peak_that_was_set_aside_comes_first():
    expected, origin = histograms()
    electrons = (np.arange(160) + origin[:, None] - PARAMETERS[:, 2:3]) / 14
    seen = np.where(electrons < 0.5, 0.1, 1.0) * expected
    [peak] = find_residuals(seen, expected, origin, PARAMETERS, [(None, 0.5)])
    assert peak.sentence.startswith("fewer samples than expected at the 0-electron peak")
    assert peak.direction == "-"
