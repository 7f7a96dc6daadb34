"""Check for frames of several exposures, such as dark and light frames in one folder.

Their means form separate levels, and the variance over their pixels grows with the mean like shot noise. A
jump of the offset separates the means only.
"""

from __future__ import annotations

import numpy as np
from scipy import special

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.discrepancy.quick.checks import Check, check_of
from pchem_pipeline.model.arithmetic.significance import CERTAIN
from pchem_pipeline.model.histogram.odd_frames import FEWEST_FRAMES, frame_words

#: Frames of a level, at least, and as a share of all.
_FEWEST_OF_LEVEL, _LEAST_SHARE = 4, 0.01
#: Growth of the variance with the mean, as a share of that of shot noise; an offset has none.
_SHOT_SHARE = 0.25
_MOST_LEVELS = 8
_SHOWN = 3


def levels_check(
    mean: FloatArray, variance: FloatArray, gain: float, empty: IntArray | tuple[()] = ()
) -> Check:
    """Test whether the frames are of several exposures.

    Args:
        mean: mean of each frame over its pixels, DN, (n,).
        variance: variance of each frame over its pixels, DN^2, (n,).
        gain: median gain, e-/DN.
        empty: frames without samples of the sensor, which are no exposure.
    """
    levels, p = _parted(mean, variance, gain, np.setdiff1d(np.arange(mean.size), empty))
    levels.sort(key=lambda frames: float(mean[frames].mean()))
    several = len(levels) > 1
    centres = [float(mean[frames].mean()) for frames in levels]
    more = f" and {len(levels) - _SHOWN} more levels" if len(levels) > _SHOWN else ""
    shown = zip(levels[:_SHOWN], centres, strict=False)
    where = "; ".join(f"{frame_words(frames, 1)} at {centre:.4g} DN" for frames, centre in shown) + more
    return check_of("levels", p, centres[-1] - centres[0], where=where if several else "")


def _parted(
    mean: FloatArray, variance: FloatArray, gain: float, frames: IntArray
) -> tuple[list[IntArray], float]:
    """Return the frames of each level, and how probable the growth of the variance between any two is."""
    levels, p = [frames], 1.0
    if frames.size < FEWEST_FRAMES:  # of 16, chance leaves such a gap in one of 400 runs
        return levels, p
    fewest = max(_FEWEST_OF_LEVEL, int(np.ceil(_LEAST_SHARE * frames.size)))
    while len(levels) < _MOST_LEVELS:
        for number, frames in enumerate(levels):
            halves = _halves(frames, mean, fewest)
            if halves is not None and _shot_noise_grows(halves, mean, variance, gain):
                p = min(p, _chance(variance[halves[0]], variance[halves[1]]))
                levels[number : number + 1] = halves
                break
        else:
            break
    return levels, p


def _chance(low: FloatArray, high: FloatArray) -> float:
    """Return how probable it is that the mean of ``high`` is so much larger by chance (Student's test)."""
    n = low.size + high.size
    within = (low.size * low.var() + high.size * high.var()) / (n - 2.0)
    error = np.sqrt(max(within, 1e-300) * (1.0 / low.size + 1.0 / high.size))
    return float(special.stdtr(n - 2.0, -(high.mean() - low.mean()) / error))


def _halves(frames: IntArray, mean: FloatArray, fewest: int) -> list[IntArray] | None:
    """Return frames in two parts between which the means leave a clean gap; None where there is no such gap.

    Of all cuts through the sorted means the one with the least variance within both parts (Otsu 1979).
    """
    n = frames.size
    if n < 2 * fewest:
        return None
    ordered = frames[np.argsort(mean[frames], kind="stable")]
    values = mean[ordered] - mean[ordered].mean()
    count = np.arange(fewest, n - fewest + 1)
    below = np.cumsum(values)[count - 1]
    cut = int(count[np.argmax(below**2 / (count * (n - count)))])
    low, high = values[:cut], values[cut:]
    within = float(np.sqrt((cut * low.var() + (n - cut) * high.var()) / n))
    # the halves of a normal or a uniform distribution of n frames are some 4/n standard deviations apart
    if high[0] - low[-1] <= CERTAIN * within:
        return None
    return [np.sort(ordered[:cut]), np.sort(ordered[cut:])]


def _shot_noise_grows(halves: list[IntArray], mean: FloatArray, variance: FloatArray, gain: float) -> bool:
    """Tell whether the variance grows between two levels as the shot noise of their electrons would."""
    low, high = halves
    grown = float(np.median(variance[high]) - np.median(variance[low]))
    return grown * gain > _SHOT_SHARE * float(mean[high].mean() - mean[low].mean())
