"""The PCD that comes nearest to an extended law: thresholds of a drawing, and the width of peaks."""

from __future__ import annotations

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.model.law.parameters import Parameters, columns_of
from pchem_pipeline.model.law.sample_law import SampleLaw


def nearest_pcd(parameters: Parameters, model: SampleLaw) -> tuple[FloatArray, ...]:
    """Return (H, g, mu, sigma) of the PCD whose peaks lie and widen as the extended law's do near k = H.

    Unlike the fitted read noise it has the whole width of the peaks, that of the named effects included. Free
    satellites are levels beside the peaks, not part of their width. Each of the four is of shape (n,).
    """
    exposure, gain, bias, sigma = columns_of(parameters).T
    exposure = exposure + (model.added_weights * model.added_exposure).sum(axis=1)
    step, analog = 1.0 / gain, np.sqrt(np.maximum(sigma**2 - QUANTISATION_VARIANCE, 0.0))
    weights = model.satellite_weights
    shift = (
        step[:, None] * model.satellite_shift_e
        + model.satellite_shift_dn
        + model.satellite_shift_sigma * analog[:, None]
    )
    centre = (weights * shift).sum(axis=1)
    own = (weights * ((model.satellite_width * analog[:, None]) ** 2 + shift**2)).sum(axis=1) - centre**2
    charge = model.extra_variance_e2 + model.variance_per_electron * exposure
    charge = charge + model.variance_per_electron2 * exposure**2
    variance = own + step**2 * charge + model.extra_variance_dn2 + QUANTISATION_VARIANCE
    level = model.level_scale * exposure * (1.0 + 0.5 * model.curvature * (exposure - 1.0))
    slope = step * model.level_scale * (1.0 + model.curvature * (exposure - 0.5))
    middle = bias + step * (level + model.level_shift_e) + centre
    return exposure, 1.0 / slope, middle - slope * exposure, np.sqrt(variance)
