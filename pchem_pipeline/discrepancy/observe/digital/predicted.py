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

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

GROUP = 4  # frames whose predictions are exchanged
#: Samples of all groups together, unless there is but one, where all frames of a group are compared with all,
#: and where they are compared two by two.
MOST_SAMPLES, MOST_PAIRED = 1 << 18, 1 << 19
_MOST_THRESHOLDS = 96
_FARTHEST = 4.0  # of the thresholds, standard deviations of the samples
_TAIL = 3e-3  # of samples above the threshold that is tested
_EQUAL = 3.0  # standard deviations by which samples equal a prediction too often for it to be looked into


def groups_of(edges: IntArray, samples_of_a_frame: int, most_samples: int = MOST_SAMPLES) -> IntArray:
    """Return positions of the first frames of groups of successive ones, evenly spread, (n,).

    Args:
        edges: positions of the blocks, (b + 1,).
        samples_of_a_frame: rows times columns.
        most_samples: of all groups together, unless there is but one.
    """
    first = np.concatenate([np.arange(a, b - GROUP + 1, GROUP) for a, b in pairwise(edges)])
    most = max(most_samples // (GROUP * samples_of_a_frame), 1)
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
        found[kind] = _compared(samples, own, step * np.arange(_MOST_THRESHOLDS), always=kind == "median")
    return found


def _compared(
    samples: NDArray[np.int32], prediction: NDArray[np.int32], thresholds: IntArray, *, always: bool
) -> PredictedSamples:
    """Compare samples (group, frame, pixel), DN, with the predictions of each frame of their group.

    Above thresholds only what equals its prediction too often is looked at, unless ``always``.
    """
    own = samples - prediction
    others = np.stack([samples - np.roll(prediction, shift, axis=1) for shift in range(1, GROUP)])
    equal = np.count_nonzero(own == 0)
    # as many pairs of a sample with itself as with each other frame, of which the mean is taken
    chance = np.count_nonzero(others == 0) / (GROUP - 1)
    z = float((equal - chance) / np.sqrt(max(chance, 1.0) * GROUP / (GROUP - 1)))
    if not always and z < _EQUAL:
        return PredictedSamples(z, thresholds[:0], np.zeros(0), np.zeros((GROUP - 1, 0)))
    first, second, third = others
    low, high = np.minimum(first, second), np.maximum(first, second)
    ordered = np.maximum(high, third), np.maximum(low, np.minimum(high, third)), np.minimum(low, third)
    at_least = np.array([_above(part, thresholds) for part in ordered])
    # of m of 3 above, one, two, three given ones are so in m, m (m - 1) / 2, ... of 3, 3, 1 choices
    exactly = at_least - np.append(at_least[1:], np.zeros((1, thresholds.size)), axis=0)
    moments = np.array([[1.0 / 3.0, 2.0 / 3.0, 1.0], [0.0, 1.0 / 3.0, 1.0], [0.0, 0.0, 1.0]])
    return PredictedSamples(z, thresholds, _above(own, thresholds), moments @ exactly)


def _above(deviations: NDArray[np.int32], thresholds: IntArray) -> FloatArray:
    """Return how many deviations are above each of evenly spaced thresholds from 0 on."""
    step = int(thresholds[1] - thresholds[0])
    positive = deviations[deviations > 0]
    # d > i step where i < ceil(d / step)
    cells = np.minimum((positive + (step - 1)) // step, thresholds.size)
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
