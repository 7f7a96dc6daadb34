"""Test of the final model in other samples: what is weak, or larger than a window, shows only there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pchem_pipeline.discrepancy.by_simulation.sensor.maps import NotFittedError
from pchem_pipeline.discrepancy.by_simulation.sensor.simulations import Simulations
from pchem_pipeline.discrepancy.by_simulation.sets.refits import ENOUGH
from pchem_pipeline.discrepancy.null import Measured, NullModel, as_matrix, disagrees
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.model.arithmetic.significance import NO_CHANCE

_DETAILS = 0.1  # of what the effects do


def deviation(by: Simulations, model: Sequence[Effect]) -> str:
    """Say what of the frames ``by`` simulates deviates beyond doubt from a model found in others, if any."""
    own = by.observed.statistics()
    try:
        vectors = by.drawn(tuple(model), ENOUGH)
    except NotFittedError:
        return "almost no pixel can be fitted with it"
    names = by.observed.names([*own, *vectors])
    if not names:
        return ""
    null = NullModel.from_replicates(names, as_matrix(names, vectors), effects=bool(model))
    z, tolerance = Measured(*as_matrix(names, own)), _DETAILS * np.abs(null.mean)
    # a model that was fitted to other pixels is not quite right for these
    if not disagrees(null, z, NO_CHANCE, tolerance):
        return ""
    off = z.both - null.mean
    worst = int(np.argmax(np.abs(off) / np.hypot(null.std, tolerance)))
    return STATISTICS[names[worst]].says(float(off[worst]))
