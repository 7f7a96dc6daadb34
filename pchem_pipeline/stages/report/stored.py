"""What the store says of a run, read into plain data: for the report, ``pchem view`` and notebooks."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.variables import (
    CHARGE_RATES,
    FREE_SATELLITES,
    INTERVALS,
    PARAMETERS,
    interval_names,
    variables_of,
)
from pchem_pipeline.compute.executor import call_all
from pchem_pipeline.discrepancy.verdict import Verdict, read_verdict
from pchem_pipeline.model.fit.status import FAILED
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.stages.fit.fitted_model import FittedModel
from pchem_pipeline.stages.methods import read_methods

if TYPE_CHECKING:
    from pchem_pipeline.store.records import StageRecord
    from pchem_pipeline.store.run_store import RunStore

#: Group to the names of the arrays that the report is made from.
_ARRAYS: dict[str, tuple[str, ...]] = {
    "maps": tuple(v.name for v in variables_of("maps") if v.name != "quality"),
    **{group: tuple(v.name for v in variables_of(group)) for group in ("ensemble", "discrepancy")},
    "fit": ("fit_status", "goodness_p", "goodness_chi2", "goodness_dof", "outlier_share"),
    "truth": (*PARAMETERS, "read_noise_e"),
    "samples": ("quanta_exposure", "mean", "variance", "linearity_residual", "linearity_p"),
}


@dataclass(frozen=True)
class PixelHistograms:
    """Histograms of n pixels.

    Attributes:
        origin: DN of the first bin of each.
        counts: frames in each bin, all of one length.
        satellites: amplitude (e-) and weight of the satellite levels that their fits left free; (2, n).
    """

    origin: IntArray
    counts: list[NDArray[np.integer[Any]]]
    satellites: FloatArray

    def of(self, part: slice) -> PixelHistograms:
        """Return the histograms of successive pixels."""
        return PixelHistograms(self.origin[part], self.counts[part], self.satellites[:, part])


@dataclass(frozen=True)
class StoredRun:
    """All of a run but its histograms.

    Attributes:
        name: of the store.
        sensor: its input.
        maps: parameters, what is derived from them, and standard errors, (y, x).
        fit: ``fit_status``, and of pixels with a value ``goodness_p``, ``goodness_q``, ... (y, x).
        intervals: by quantity the ends of its profile intervals.
        ensemble: group ``ensemble``.
        truth: true maps of simulated data.
        facts: group to its attributes, of ``maps`` and ``ensemble``.
        model: of the fit.
        verdict: on what the model is missing, or None.
        discrepancy: group ``discrepancy``, the arrays that go with it.
        samples: group ``samples``, of a run of several exposures.
        methods: content of ``methods.json``, or None.
        record: of the report that is being made, or None.
    """

    name: str
    sensor: SensorInfo
    maps: Mapping[str, NDArray[Any]]
    fit: Mapping[str, NDArray[Any]]
    intervals: Mapping[str, tuple[FloatArray, FloatArray]] = field(default_factory=dict)
    ensemble: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    truth: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    facts: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    model: FittedModel = field(default_factory=FittedModel)
    verdict: Verdict | None = None
    discrepancy: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    samples: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    methods: Mapping[str, Any] | None = None
    record: StageRecord | None = None


def read_run(store: RunStore, threads: int = 1) -> StoredRun:
    """Read all of a run but its histograms.

    Args:
        store: the run.
        threads: that read an array each.

    Raises:
        StoreError: an array is missing or corrupt.
    """
    verdict, methods, model = read_verdict(store.path), read_methods(store), FittedModel.read(store)
    sensor, record = SensorInfo.read(store), store.records.read("report")
    there = [
        (group, name)
        for group, names in _ARRAYS.items()
        for name in names
        if (group != "discrepancy" or verdict is not None) and store.has(f"{group}/{name}")
    ]
    arrays = call_all([functools.partial(store.read, f"{group}/{name}") for group, name in there], threads)
    groups: dict[str, dict[str, NDArray[Any]]] = {group: {} for group in _ARRAYS}
    for (group, name), values in zip(there, arrays, strict=True):
        groups[group][name] = values
    facts = {group: store.attributes(group) for group in ("maps", "ensemble")}
    maps, fit = groups.pop("maps"), groups["fit"]
    if "goodness_q" in maps:
        fit["goodness_q"] = maps.pop("goodness_q")
    if "fit_status" in fit:
        # only what has a value can agree with its model or not
        failed = (fit["fit_status"] & int(FAILED)) != 0
        for name in (name for name in fit if name.startswith("goodness_")):
            fit[name][failed] = np.nan
    ends = {name: interval_names(name) for name in (*INTERVALS, *CHARGE_RATES)}
    found = {name: (maps[low], maps[high]) for name, (low, high) in ends.items() if low in maps}
    shown = {name: values for name, values in maps.items() if not any(name in pair for pair in ends.values())}
    return StoredRun(
        store.path.name, sensor, shown, intervals=found, facts=facts, model=model, verdict=verdict,
        methods=methods, record=record, **groups,
    )  # fmt: skip


def read_histograms(store: RunStore, index: IntArray, shape: tuple[int, int]) -> PixelHistograms:
    """Read the histograms of pixels.

    Args:
        store: the run.
        index: ``y * nx + x`` of each.
        shape: of the sensor.

    Raises:
        StoreError: an array is missing or corrupt.
    """
    y, x = np.divmod(index, shape[1])
    satellites = np.zeros((2, index.size))
    for which, name in enumerate(FREE_SATELLITES):
        if store.has(f"fit/{name}"):
            satellites[which] = store.read_pixels(f"fit/{name}", y, x)
    counts = store.read_pixels("histogram/counts", y, x)
    origin = store.read_pixels("histogram/origin", y, x).astype(np.int64)
    return PixelHistograms(origin, list(counts), satellites)
