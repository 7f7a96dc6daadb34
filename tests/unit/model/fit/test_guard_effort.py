"""What the tail guard costs: of a misfit, and of outliers, no histogram is searched twice."""

from dataclasses import fields

import numpy as np
import pytest
from numpy.typing import NDArray

from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import FitStatus

N_FRAMES, REPEATS = 4000, 5
#: A search after the first that starts anew from everywhere takes as many evaluations as the first.
MOST_EVALUATIONS = 1.5


@pytest.fixture(scope="module")
def histograms() -> tuple[NDArray[np.uint16], NDArray[np.int64]]:
    """Pixels whose frames come five times each: no law of single frames fits them."""
    rng = np.random.default_rng(90210)
    values = []
    for _ in range(40):
        signal = rng.poisson(rng.uniform(0.5, 6.0), N_FRAMES // REPEATS) + rng.normal(
            0.0, rng.uniform(0.2, 0.5), N_FRAMES // REPEATS
        )
        values.append(np.repeat(np.rint(100.0 + 11.0 * signal).astype(np.int64), REPEATS))
    first = np.array([each.min() - 1 for each in values])
    width = max(int(each.max() - low) for each, low in zip(values, first, strict=True)) + 2
    counts = [np.bincount(each - low, minlength=width) for each, low in zip(values, first, strict=True)]
    return np.array(counts, np.uint16), first


def test_a_misfit_without_outliers_has_the_fit_of_all_samples_and_costs_little_more(
    histograms: tuple[NDArray[np.uint16], NDArray[np.int64]],
) -> None:
    counts, origin = histograms
    guarded = fit_histograms(counts, origin)
    plain = fit_histograms(counts, origin, settings=FitSettings(tail_guard=0.0))
    whole = guarded.outlier_share == 0.0
    poor = (plain.fit_status & int(FitStatus.POOR_FIT)) != 0
    assert poor.mean() > 0.9
    assert (whole & poor).mean() > 0.8
    for each in fields(plain):
        if each.name not in ("n_iterations", "intervals"):
            left, right = getattr(guarded, each.name)[whole], getattr(plain, each.name)[whole]
            np.testing.assert_array_equal(left, right, each.name)
    # the histogram without its ends is fitted too, once and from the first start
    assert guarded.n_iterations[whole].mean() < MOST_EVALUATIONS * plain.n_iterations[whole].mean()
    assert guarded.n_iterations[whole & poor].min() > plain.n_iterations[whole & poor].min()


def test_outliers_of_a_misfit_are_still_left_out(
    histograms: tuple[NDArray[np.uint16], NDArray[np.int64]],
) -> None:
    counts, origin = histograms
    struck = np.concatenate([counts, np.zeros((counts.shape[0], 400), np.uint16)], axis=1)
    struck[:, -20] = 3
    found, plain = fit_histograms(struck, origin), fit_histograms(counts, origin)
    total = struck.sum(axis=1)
    np.testing.assert_array_less(2.5 / total, found.outlier_share)
    np.testing.assert_allclose(found.bias, plain.bias, atol=1e-3 * 11.0)
