"""Whether a disagreement is so clear that few samples are enough to tell what makes it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import PchEmError
from pchem_pipeline.discrepancy.null import free_of_parameters
from pchem_pipeline.discrepancy.observe.observe import observe

#: Standard deviations of the largest statistic. Of 60 clean sensors of all kinds none had more than 20 in
#: what is looked at here: without simulations the statistics of poor ones are not quite standard normal.
_CLEAR = 30.0
#: Share of the pixels whose bias may be off by an electron, from which on only those statistics count that do
#: not rest on the pixels' parameters.
_DOUBTFUL = 0.1


def is_clear(
    frames: NDArray[np.unsignedinteger], numbers: NDArray[np.int64], *, n_run: int, block_frames: int
) -> bool:
    """Tell whether frames disagree with the plain model beyond any doubt, without simulating it.

    Args:
        frames: codes (frame, y, x), DN.
        numbers: of the frames in the run, increasing, shape (frame,).
        n_run: frames of the whole run.
        block_frames: frames in a block.
    """
    try:
        evidence = observe(frames, numbers, n_run=n_run, block_frames=block_frames)
    except PchEmError:  # those who compare the frames say what is wrong with them
        return False
    z = np.abs(np.array(list(evidence.z.values())))
    if evidence.ambiguous > _DOUBTFUL:
        z = z[free_of_parameters(tuple(evidence.z))]
    return bool(z.max(initial=0.0) > _CLEAR)
