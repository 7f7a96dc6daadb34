"""Whether a disagreement is so clear that few samples are enough to tell what makes it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import PchEmError
from pchem_pipeline.discrepancy.null import free_of_parameters
from pchem_pipeline.discrepancy.observe.observe import observe
from pchem_pipeline.discrepancy.quick.places import SensorPlace
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.splits import block_length
from pchem_pipeline.frames.stream import FrameSource
from pchem_pipeline.stages.discrepancy.window import choose_window, read_window

#: Standard deviations of the largest statistic. Of 60 clean sensors of all kinds none had more than 20 in
#: what is looked at here: without simulations the statistics of poor ones are not quite standard normal.
_CLEAR = 30.0
#: Share of the pixels whose bias may be off by an electron, from which on only those statistics count that do
#: not rest on the pixels' parameters.
_DOUBTFUL = 0.1


def fewer_samples(
    source: FrameSource,
    settings: DiscrepancySettings,
    roi: Sequence[int] | None,
    places: Mapping[str, SensorPlace],
) -> DiscrepancySettings:
    """Return the settings with as few samples to be compared as show the disagreement beyond any doubt.

    Args:
        source: the frames.
        settings: as configured, or as the memory allows.
        roi: rows and columns that the user asked for.
        places: where the survey found that the sensor stands out.
    """
    few = settings.model_copy(update={"max_samples": min(settings.clear_samples, settings.max_samples)})
    small, large = (choose_window(source.shape, each, roi, places) for each in (few, settings))
    if small.share(source.shape) >= large.share(source.shape):
        return settings
    length = block_length(small.numbers.size, settings.block_frames)
    clear = is_clear(read_window(source, small), small.numbers, n_run=source.shape[0], block_frames=length)
    return few if clear else settings


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
        z = z[free_of_parameters(tuple(evidence.z), evidence.maps)]
    return bool(z.max(initial=0.0) > _CLEAR)
