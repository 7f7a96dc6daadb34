"""The types in the signatures of effects and of their estimators, in one place."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.effects.framework.context import EffectContext as EffectContext
from pchem_pipeline.effects.framework.evidence import Evidence as Evidence
from pchem_pipeline.effects.framework.evidence import PixelMaps as PixelMaps
from pchem_pipeline.effects.framework.evidence import TimeSeries as TimeSeries
from pchem_pipeline.model.law.sample_law import SampleLaw as SampleLaw

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
#: Samples of a plane of the signal chain, or any other numbers.
AnyArray = NDArray[Any]
