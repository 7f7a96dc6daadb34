"""Packed maps read back, as the inspector's script does."""

import gzip

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.report.inspector import PackedMap

#: Codes of no value, of values below the range, and of the first value in it.
_NONE, _BELOW, _FIRST = 0, 1, 2


def unpack_map(packed: PackedMap, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the values of a packed map, as the page does it."""
    content, n = gzip.decompress(packed.data), shape[0] * shape[1]
    planes = np.frombuffer(content, np.uint8, 2 * n).astype(np.uint16)
    codes = planes[:n] | planes[n:] << 8
    values = packed.scale.low + packed.scale.step * (codes.astype(np.float64) - _FIRST)
    values = 10.0**values if packed.scale.log else values
    values[codes == _NONE] = np.nan
    values[codes == _BELOW] = 0.0
    odd = np.frombuffer(content, "<u4", packed.n_odd, 2 * n)
    values[odd] = np.frombuffer(content, "<f4", packed.n_odd, 2 * n + 4 * packed.n_odd)
    return values.reshape(shape)
