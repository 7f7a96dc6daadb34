"""Samples beside what their neighbours predict: equal to it too often, or above it too seldom.

Without an effect a sample and its neighbours are as independent within a frame as they are between frames, so
the predictions of the next few frames say what chance does, whatever the pixels' histograms are.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.discrepancy.observe import laws
from pchem_pipeline.effects.estimators.prediction import PREDICTORS, predicted
from pchem_pipeline.effects.framework.evidence import PredictedSamples

__all__ = ["GROUP", "groups_of", "predicted_samples", "predicted_statistics"]

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

GROUP = 4  # frames whose predictions are exchanged
_MOST_SAMPLES = 1 << 19
_MOST_THRESHOLDS = 96
_FARTHEST = 4.0  # of the thresholds, standard deviations of the samples
_TAIL = 3e-3  # of samples above the threshold that is tested


def groups_of(edges: IntArray, samples_of_a_frame: int) -> IntArray:
    """Return positions of the first frames of groups of successive ones, evenly spread, (n,).

    Args:
        edges: positions of the blocks, (b + 1,).
        samples_of_a_frame: of all groups together there are not more than 2^19, or one group.
    """
    first = np.concatenate([np.arange(a, b - GROUP + 1, GROUP) for a, b in pairwise(edges)])
    most = max(_MOST_SAMPLES // (GROUP * samples_of_a_frame), 1)
    chosen = first[:: max(-(-first.size // most), 1)]
    return np.asarray(chosen, np.int64)


def predicted_samples(
    frames: NDArray[np.unsignedinteger[Any]], edges: IntArray, usable: NDArray[np.bool_]
) -> dict[str, PredictedSamples]:
    """Return how samples compare with their predictions, by kind; none where frames or pixels are too few.

    Args:
        frames: codes (frame, y, x), DN.
        edges: positions of the blocks, (b + 1,).
        usable: pixels that count, (y, x).
    """
    if min(usable.shape) < 3 or not usable[1:-1, 1:-1].any():
        return {}
    first = groups_of(edges, usable.size)
    if not first.size:
        return {}
    chosen = frames[first[:, None] + np.arange(GROUP)].reshape(-1, *usable.shape)
    inside = usable[1:-1, 1:-1]
    samples = chosen[:, 1:-1, 1:-1][:, inside].astype(np.int32).reshape(first.size, GROUP, -1)
    reach = _FARTHEST * float(samples.std(axis=(0, 1)).mean())
    step = max(1, int(np.ceil(reach / _MOST_THRESHOLDS)))
    found: dict[str, PredictedSamples] = {}
    for kind in PREDICTORS:
        own = predicted(chosen, kind)[:, inside].reshape(samples.shape)
        found[kind] = _compared(samples, own, step * np.arange(_MOST_THRESHOLDS))
    return found


def _compared(
    samples: NDArray[np.int32], prediction: NDArray[np.int32], thresholds: IntArray
) -> PredictedSamples:
    """Compare samples (group, frame, pixel), DN, with the predictions of each frame of their group."""
    own = samples - prediction
    others = np.stack([samples - np.roll(prediction, shift, axis=1) for shift in range(1, GROUP)])
    equal = np.count_nonzero(own == 0)
    # as many pairs of a sample with itself as with each other frame, of which the mean is taken
    chance = np.count_nonzero(others == 0) / (GROUP - 1)
    others.sort(axis=0)
    at_least = np.array([_above(part, thresholds) for part in others[::-1]])
    # of m of 3 above, one, two, three given ones are so in m, m (m - 1) / 2, ... of 3, 3, 1 choices
    exactly = at_least - np.append(at_least[1:], np.zeros((1, thresholds.size)), axis=0)
    moments = np.array([[1.0 / 3.0, 2.0 / 3.0, 1.0], [0.0, 1.0 / 3.0, 1.0], [0.0, 0.0, 1.0]])
    z = (equal - chance) / np.sqrt(max(chance, 1.0) * GROUP / (GROUP - 1))
    return PredictedSamples(float(z), thresholds, _above(own, thresholds), moments @ exactly)


def _above(deviations: NDArray[np.int32], thresholds: IntArray) -> FloatArray:
    """Return how many deviations are above each of evenly spaced thresholds from 0 on."""
    step = int(thresholds[1] - thresholds[0])
    # d > i step where i < ceil(d / step)
    cells = np.clip(-(-deviations.ravel() // step), 0, thresholds.size)
    counts = np.bincount(cells, minlength=thresholds.size + 1)
    return np.asarray(counts[::-1].cumsum()[::-1][1:], np.float64)


def predicted_statistics(found: Mapping[str, PredictedSamples]) -> dict[str, float]:
    """Return the statistics of samples that equal, or exceed, what their neighbours predict."""
    if not found:
        return {}
    median = found["median"]
    first, second, _ = median.above_chance
    place = min(int(np.searchsorted(-first, -_TAIL * max(first[0], 1.0))), first.size - 1)
    variance = max(first[place] - second[place], 1.0) * GROUP / (GROUP - 1)
    return {
        "space.predicted.equal": laws.best(*(each.equal_z for each in found.values())),
        "space.predicted.above": float((median.above[place] - first[place]) / np.sqrt(variance)),
    }
