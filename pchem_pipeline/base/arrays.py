"""Types of arrays, by the numbers that they hold."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
IntArray = NDArray[np.int64]
#: Whole numbers of any size: counts, origins.
IntegerArray = NDArray[np.integer[Any]]
#: Places in other arrays.
IndexArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]
#: Samples of frames or their counts: unsigned, of any size.
CodeArray = NDArray[np.unsignedinteger[Any]]
#: Arrays by their names: of a group of the store, or its :class:`~pchem_pipeline.store.run_store.Part`.
Arrays = Mapping[str, NDArray[Any]]
