"""Results as JSON data."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic_core import to_jsonable_python


def plain(value: Any) -> Any:
    """Return JSON data: arrays become lists, NaN and infinities, which JSON has not, None."""
    return to_jsonable_python(value, inf_nan_mode="null", fallback=_known)


def _known(value: Any) -> Any:
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    return dict(value) if isinstance(value, Mapping) else str(value)
