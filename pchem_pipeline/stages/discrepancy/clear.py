"""Whether a disagreement is so clear that few samples are enough to tell what makes it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import PchEmError
from pchem_pipeline.discrepancy.null import free_of_parameters
from pchem_pipeline.discrepancy.observe.observe import observe
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.splits import block_length
from pchem_pipeline.frames.stream import FrameSource
from pchem_pipeline.stages.discrepancy.survey import Survey
from pchem_pipeline.stages.discrepancy.window import read_window

#: Standard deviations of the largest statistic. Some poor sensors have as many without any effect (of 60 of
#: all kinds none more than 20), as without simulations their statistics are not quite standard normal: of
#: these less is compared, with simulations that tell.
_CLEAR = 15.0
#: Replicates that are enough where much is wrong, of the plain model and of one with effects.
_REPLICATES, _EXTENDED = 24, 12
#: Share of the pixels whose bias may be off by an electron, from which on only those statistics count that do
#: not rest on the pixels' parameters.
_DOUBTFUL = 0.1


def fewer_samples(
    source: FrameSource,
    settings: DiscrepancySettings,
    roi: Sequence[int] | None,
    seen: Survey,
) -> DiscrepancySettings:
    """Return the settings with as few samples to be compared as show the disagreement beyond any doubt.

    Those of ``clear_samples``, or twice as many, and so on; and fewer replicates.

    Args:
        source: the frames.
        settings: as configured, or as the memory allows.
        roi: rows and columns that the user asked for.
        seen: what the survey found.
    """
    most = seen.window(source.shape, settings, roi).share(source.shape)
    samples = settings.clear_samples
    while samples < settings.max_samples:
        few = settings.model_copy(update={"max_samples": samples})
        window = seen.window(source.shape, few, roi)
        if window.share(source.shape) >= most:
            break
        length = block_length(window.numbers.size, settings.block_frames)
        frames = read_window(source, window)
        if is_clear(frames, window.numbers, n_run=source.shape[0], block_frames=length):
            lower = {
                "replicates": min(settings.replicates, _REPLICATES),
                "extended_replicates": min(settings.extended_replicates, _EXTENDED),
            }
            return few.model_copy(update=lower)
        samples *= 2
    return settings


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
