"""A climb ends also where its steps lead out of bounds, damped or not."""

import numpy as np
import pytest

from pchem_pipeline.effects.framework.compose import pixel_maps, sample_law
from pchem_pipeline.effects.operators.noise import NoiseSkew
from pchem_pipeline.model.fit.api import fit_histograms


@pytest.mark.timeout(120)
def test_steps_out_of_bounds_end_a_climb() -> None:
    # a gain that moves from frame to frame, under a law that cannot follow it: all noise is a one-sided tail
    rng = np.random.default_rng(4)
    n, frames = 300, 990
    electrons, noise = rng.poisson(0.94, (n, frames)), 4.8 * rng.standard_normal((n, frames))
    gain = 17.0 * (1.0 + 0.15 * rng.standard_normal((1, frames)))
    samples = np.rint(200.0 + gain * electrons + noise).astype(np.int64)
    low = int(samples.min())
    counts = np.array([np.bincount(x - low, minlength=samples.max() - low + 1) for x in samples])
    near = np.tile([0.94, 1.0 / 17.0, 200.0, 4.8], (n, 1))
    law = sample_law([NoiseSkew(share=1.0)], pixel_maps(near.T, np.ones(n, np.bool_)))
    fit = fit_histograms(counts, np.full(n, low), law=law, start=near)
    assert np.all(fit.n_iterations > 0)
    assert np.all(np.isfinite(fit.log_likelihood) | (fit.fit_status > 0))
