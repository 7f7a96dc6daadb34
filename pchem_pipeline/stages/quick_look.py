"""What a quick look reads of the summaries and histograms of a run, for the report and for a closer look."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from pchem_pipeline.base.arrays import Arrays, FloatArray, IntArray
from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.discrepancy.observe.observe import UNTRUSTWORTHY
from pchem_pipeline.discrepancy.quick.checks import QuickLook
from pchem_pipeline.discrepancy.quick.codes import CodeSample
from pchem_pipeline.discrepancy.quick.quick_look import quick_look
from pchem_pipeline.discrepancy.quick.sums import StackSums
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.stages.histogram.odd_frames import odd_frames_of
from pchem_pipeline.store.run_store import RunStore

if TYPE_CHECKING:
    from pchem_pipeline.stages.report.stored import StoredRun

#: Sums of pixels over blocks, of rows over frames, of columns over frames, that are read at most.
_MOST_SUMS = 1 << 22
#: Pixels whose codes are looked at, in so many pieces of the sensor, and the fewest that say anything.
_PIXELS, _PIECES, _FEWEST = 1024, 8, 16


def run_quick_look(run: StoredRun, sums: StackSums | None) -> QuickLook | None:
    """Return the quick look at a run and its sums (`read_sums`); None where no pixel has parameters.

    Raises:
        StoreError: an array is missing or corrupt.
    """
    maps = _maps(run.data.fit, run.data.maps)
    if maps is None:
        return None
    missing: dict[str, str] = {}
    if sums is None:
        why = run.store.attributes("summary").get("missing", "the stage histogram has none")
        missing["rows, columns, frames, neighbours and lags"] = str(why)
    codes = None
    if run.model.effects:
        missing["codes"] = "the model has effects; pchem discrepancy tests the codes"
    elif maps.usable.sum() < _FEWEST:
        missing["codes"] = f"fewer than {_FEWEST} pixels have a reliable fit"
    else:
        codes = _codes(run.store, maps, run.sensor)
    # the path of the run is told at the end, as it is seen from where the command was typed
    return quick_look(sums, maps, codes, run.model.effects, missing, "pchem discrepancy")


def _maps(fit: Arrays, maps: Mapping[str, FloatArray]) -> PixelMaps | None:
    status = fit.get("fit_status")
    if status is None or not all(name in maps for name in PARAMETERS):
        return None
    exposure, gain, bias, sigma = (np.asarray(maps[name], np.float64) for name in PARAMETERS)
    usable = (status & int(UNTRUSTWORTHY)) == 0
    for values in (exposure, gain, bias, sigma):
        usable &= np.isfinite(values)
    # as they are, without the copies of `PixelMaps.known`: a quick look takes the usable pixels alone
    return PixelMaps(exposure, gain, bias, sigma, usable) if usable.any() else None


def read_sums(store: RunStore) -> StackSums | None:
    """Read the summaries of a run: all covariances, and sums of blocks of frames spread over it.

    Odd frames are in none of the sums. None where the stage histogram has not made them, or frames are fewer
    than two in each block.

    Raises:
        StoreError: an array is corrupt.
    """
    if not store.has("summary/frame_mean"):
        return None
    odd, out = odd_frames_of(store)
    mean, variance = store.read("summary/frame_mean"), store.read("summary/frame_variance")
    numbers = np.setdiff1d(np.arange(mean.size), out)
    starts = store.read("summary/block_start")
    n_blocks, ny, nx = store.array("summary/block_sum").shape
    lengths = np.diff(np.append(starts, mean.size))
    known = lengths - np.bincount(np.searchsorted(starts, out, side="right") - 1, minlength=n_blocks)
    usable = np.flatnonzero(known > 1)
    if not usable.size:
        return None  # a single frame in each block
    frames = min(_MOST_SUMS // ny, mean.size)
    most = min(_MOST_SUMS // (ny * nx), frames // int(lengths[0]) if frames < mean.size else n_blocks)
    chosen = usable[_spread(usable.size, most)]
    groups = store.array("summary/column_sum").shape[1]
    some = _spread(chosen.size, _MOST_SUMS // (groups * nx * int(lengths[0])))

    def lines(name: str, of: IntArray) -> IntArray:
        first, end = starts[of], (starts + lengths)[of]
        frames_read = np.concatenate([np.arange(*each) for each in zip(first, end, strict=True)])
        return _read(store, name, first, end)[~np.isin(frames_read, out)]

    return StackSums(
        numbers,
        usable.size,
        known[chosen],
        _read(store, "block_sum", chosen, chosen + 1),
        _read(store, "block_sum_square", chosen, chosen + 1),
        lines("row_sum", chosen),
        some,
        lines("column_sum", chosen[some]),
        mean,
        variance,
        store.read("summary/lag1_covariance"),
        store.read("summary/neighbour_covariance_x"),
        store.read("summary/neighbour_covariance_y"),
        odd,
        store.attributes("summary").get("spectrum", {}),
    )


def _spread(n: int, most: int) -> IntArray:
    """Return numbers below n, all of them or at most so many, evenly spread; at least one."""
    return np.unique(np.linspace(0, n - 1, min(n, max(most, 1))).astype(np.int64))


def _read(store: RunStore, name: str, first: IntArray, end: IntArray) -> IntArray:
    """Read ranges along the first axis, those that follow each other at once."""
    cuts = np.flatnonzero(first[1:] != end[:-1]) + 1
    others = (slice(None),) * (store.array(f"summary/{name}").ndim - 1)
    parts = [
        store.read(f"summary/{name}", (slice(int(a[0]), int(b[-1])), *others))
        for a, b in zip(np.split(first, cuts), np.split(end, cuts), strict=True)
    ]
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _codes(store: RunStore, maps: PixelMaps, sensor: SensorInfo) -> CodeSample | None:
    """Read the histograms of some pixels with a fit, from pieces of whole chunks over the sensor."""
    whole = store.file_shape("histogram/counts")
    ny, nx = maps.usable.shape
    tiles = [(y, x) for y in range(0, ny, whole[0]) for x in range(0, nx, whole[1])]
    origin = store.read("histogram/origin")
    counts, origins, parameters = [], [], []
    pieces = _spread(len(tiles), _PIECES)
    for y, x in (tiles[i] for i in pieces):
        part = (slice(y, y + whole[0]), slice(x, x + whole[1]))
        inside = np.flatnonzero(maps.usable[part].ravel())
        if inside.size == 0:
            continue
        inside = inside[_spread(inside.size, -(-_PIXELS // pieces.size))]
        rows, columns = np.divmod(inside, maps.usable[part].shape[1])
        counts.append(store.read_pixels("histogram/counts", y + rows, x + columns))
        origins.append(origin[part].ravel()[inside].astype(np.int64))
        parameters.append(np.stack([each[part].ravel()[inside] for each in maps.maps], axis=1))
    if sum(part.size for part in origins) < _FEWEST:
        return None
    joined = np.concatenate(counts), np.concatenate(origins), np.concatenate(parameters)
    return CodeSample(*joined, bool(sensor.samples), sensor.adc_limits)
