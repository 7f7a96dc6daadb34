"""Map of the quanta exposure of frames whose pixels are known, by maximum likelihood."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.model.law.inputs import kernel_counts, pack
from pchem_pipeline.model.law.parameters import FloatArray
from pchem_pipeline.use import exposure_numba
from pchem_pipeline.use.calibration import Calibration


@dataclass(frozen=True)
class ExposureMaps:
    """Exposure of pixels with its standard errors, e-, shape (y, x); NaN for pixels without a calibration.

    Attributes:
        exposure: H of largest likelihood; 0 where no electron is likelier than any.
        counting: standard error from the samples: numbers of electrons and read noise.
        calibration: standard error from those of g, mu and sigma; no number of frames makes it smaller.
    """

    exposure: FloatArray
    counting: FloatArray
    calibration: FloatArray

    @property
    def stderr(self) -> FloatArray:
        """Standard error of both together."""
        return np.asarray(np.hypot(self.counting, self.calibration))


def estimate_exposure(
    counts: NDArray[np.unsignedinteger[Any]],
    origin: NDArray[np.integer[Any]],
    calibration: Calibration,
    parts: int = 1,
) -> ExposureMaps:
    """Return the exposure of largest likelihood, with g, mu and sigma held at their estimates.

    ``sum_i c_i log sum_k P(k; H) P(x_i | k)``, the cells of the codes integrated exactly; effects of the
    model are in the law. It uses what a sample says of its electron number, where the mean of rounded or of
    corrected frames adds the read noise to that of the numbers.

    Args:
        counts: histograms, shape (y, x, code).
        origin: code of bin 0, shape (y, x).
        calibration: of these pixels.
        parts: codes in a DN.
    """
    n = origin.size
    out = np.full((n, 3), np.nan)
    given = np.zeros((n, 2, 4)) if calibration.rivals is None else calibration.rivals
    rivals = np.ascontiguousarray(given.reshape(n, 2, 4))
    columns = calibration.columns
    exposure_numba.estimate_exposures(
        kernel_counts(counts.reshape(n, -1)),
        np.ascontiguousarray(origin.ravel(), np.int64),
        parts,
        columns,
        np.ascontiguousarray(calibration.covariance.reshape(n, 3, 3)),
        rivals,
        calibration.own_satellites,
        pack([calibration.law], n),
        out,
    )
    return ExposureMaps(*(out[:, i].reshape(origin.shape) for i in range(3)))
