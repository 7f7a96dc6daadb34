"""The defects of a run, from its stored maps and histograms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import Arrays, IntArray
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.model.maps.defects import MAPS, Defects, Moments, find_defects, needs_moments
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.stages.overscan import read_overscan
from pchem_pipeline.store.run_store import RunStore


def stored_defects(store: RunStore, config: RunConfig, maps: Arrays | None = None) -> Defects:
    """Return the defects of a run that has maps; give these, by name, where they are read already.

    Raises:
        StoreError: an array is missing or corrupt.
    """
    maps = {name: store.read(f"maps/{name}") for name in MAPS} if maps is None else maps
    status = store.read("fit/fit_status")
    sensor = SensorInfo.read(store).with_settings(config.input)
    limits, kind = sensor.adc_limits, str(config.input.kind)
    if kind == "unknown" and sensor.samples:
        kind = sensor.samples[sensor.shown].kind
    y, x = np.nonzero(needs_moments(status, maps["conversion_gain"]))
    high, wide = store.file_shape("histogram/counts")[:2]
    order = np.lexsort((x // wide, y // high))  # each file is read once
    y, x = y[order], x[order]
    ends = np.flatnonzero(np.diff(y // high, prepend=-1) | np.diff(x // wide, prepend=-1))
    parts = zip(np.split(y, ends), np.split(x, ends), strict=True)
    moments = [_moments(store, *part, None if limits is None else limits[1]) for part in parts]
    levels = "fit/satellite_amplitude_e"
    found = find_defects(
        maps,
        status,
        Moments(y * status.shape[1] + x, *map(np.concatenate, zip(*moments, strict=True))),
        store.read(levels) if store.has(levels) else None,
        light=kind == "light",
        sigmas=config.maps.outlier_sigmas,
    )
    if (overscan := read_overscan(store)) is None:
        return found
    listed = np.isnan(overscan.bias[found.table["y"], found.table["x"]])  # overscan is no defect
    return replace(found, table={name: values[listed] for name, values in found.table.items()})


def _moments(store: RunStore, y: IntArray, x: IntArray, top: int | None) -> list[NDArray[Any]]:
    """Return the :class:`Moments` of pixels but their places; ``top`` is the highest code, if it is known."""
    counts = store.read_pixels("histogram/counts", y, x)
    origin = store.read_pixels("histogram/origin", y, x).astype(np.int64)
    bins = np.arange(counts.shape[1], dtype=np.float64)
    n, first, second = (counts.astype(np.float64) @ np.stack([bins**0, bins, bins**2], axis=1)).T
    share, at = np.zeros(y.size), np.full(y.size, -1) if top is None else top - origin
    inside = np.flatnonzero((at >= 0) & (at < bins.size))
    share[inside] = counts[inside, at[inside]] / n[inside]
    mean = first / n
    variance = np.where(counts.max(axis=1) == n, 0.0, second / n - mean**2)
    return [n.astype(np.int64), origin + mean, variance, share]
