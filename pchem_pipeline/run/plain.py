"""Numbers as JSON holds them."""

from __future__ import annotations

import math
from typing import Any

__all__ = ["plain"]


def plain(value: Any) -> Any:
    """Return JSON data: NaN and infinities, which JSON has not, become None.

    Args:
        value: numbers, text, and lists and dictionaries of them.

    Returns:
        The same, with None where a number is not finite.
    """
    if isinstance(value, dict):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
