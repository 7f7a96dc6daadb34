"""Why a pixel of calibrated frames has no value, or deserves caution."""

from __future__ import annotations

from enum import IntFlag
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.fit.status import MEANINGS
from pchem_pipeline.use.calibration import PEAKS_OVERLAP_E


class QualityFlag(IntFlag):
    """Bits of ``applied/quality`` beyond those of ``fit_status``, which come first."""

    AT_ADC_LIMIT = 1 << 16
    PEAKS_OVERLAP = 1 << 17
    OUTSIDE_HISTOGRAM = 1 << 18
    BELOW_BIAS = 1 << 19


#: A sentence for every bit, those of ``fit_status`` included.
FLAG_MEANINGS: dict[str, tuple[int, str]] = {
    **{str(bit.name).lower(): (int(bit), text) for bit, text in MEANINGS.items()},
    "at_adc_limit": (int(QualityFlag.AT_ADC_LIMIT), "samples at a limit of the ADC in these frames"),
    "peaks_overlap": (
        int(QualityFlag.PEAKS_OVERLAP),
        f"read noise above {PEAKS_OVERLAP_E} e-: the most probable electron number is often wrong; use "
        "expected_number",
    ),
    "outside_histogram": (int(QualityFlag.OUTSIDE_HISTOGRAM), "outlying samples excluded from the exposure"),
    "below_bias": (
        int(QualityFlag.BELOW_BIAS),
        "mean of these frames more than 5 standard errors below the bias: the bias has changed",
    ),
}


def flag_attributes() -> dict[str, Any]:
    """Return the attributes of a quality layer by the CF conventions, and the sentences."""
    return {
        "flag_masks": [mask for mask, _ in FLAG_MEANINGS.values()],
        "flag_meanings": " ".join(FLAG_MEANINGS),
        "sentences": {name: text for name, (_, text) in FLAG_MEANINGS.items()},
    }


def flags(words: NDArray[np.uint16], **raised: NDArray[np.bool_]) -> NDArray[np.uint32]:
    """Return the quality layer.

    Args:
        words: ``fit_status`` of each pixel, shape (y, x).
        **raised: by the name of the flag, where it is raised.
    """
    found = words.astype(np.uint32)
    for name, where in raised.items():
        found |= np.where(where, np.uint32(FLAG_MEANINGS[name][0]), np.uint32(0))
    return found
