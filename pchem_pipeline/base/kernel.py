"""The one way in which loops are compiled: without the interpreter's lock, cached on disk, IEEE division."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba

__all__ = ["kernel"]


def kernel(function: Callable[..., Any] | None = None, *, inline: bool = False) -> Any:
    """Compile a loop when it is first called.

    Division by zero gives infinity or NaN as in numpy, never an exception, so that loops vectorise; no kernel
    reorders sums (``fastmath``), so that its bits do not depend on who compiled it.

    Args:
        function: of scalars and arrays.
        inline: put the code of the function into its callers, where they could not be optimised otherwise.
    """
    compiled = numba.njit(nogil=True, cache=True, error_model="numpy", inline="always" if inline else "never")
    return compiled if function is None else compiled(function)
