"""What the store says of a run, read into plain data: for the report, ``pchem view`` and notebooks."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import Arrays, FloatArray, IntArray
from pchem_pipeline.base.errors import ConfigError, quoted
from pchem_pipeline.base.variables import (
    CHARGE_RATES,
    FREE_SATELLITES,
    INTERVALS,
    PARAMETERS,
    interval_names,
    variables_of,
)
from pchem_pipeline.base.wording import short_name
from pchem_pipeline.compute.executor import call_all
from pchem_pipeline.config.load import dump_config
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.verdict import Verdict, read_verdict
from pchem_pipeline.effects.framework.compose import model_words
from pchem_pipeline.model.ensemble.components import COMPONENT_CASES
from pchem_pipeline.model.fit.status import FAILED
from pchem_pipeline.model.maps.ordered import median_of
from pchem_pipeline.planning.targets import Point, frames_needed, parse_target, precision
from pchem_pipeline.report.data import DiscrepancyData, ReportData, Sample, Samples
from pchem_pipeline.report.figures.ensemble import case_name
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.stages.fit.fitted_model import FittedModel
from pchem_pipeline.stages.maps import NO_TIME
from pchem_pipeline.stages.methods import read_methods
from pchem_pipeline.stages.samples import exposure_axis
from pchem_pipeline.store.run_store import RunStore, stored_config

#: Group to the names of the arrays that the report is made from.
_ARRAYS: dict[str, tuple[str, ...]] = {
    "maps": tuple(v.name for v in variables_of("maps") if v.name != "quality"),
    **{group: tuple(v.name for v in variables_of(group)) for group in ("ensemble", "discrepancy")},
    "fit": ("fit_status", "goodness_p", "goodness_chi2", "goodness_dof", "outlier_share"),
    "truth": (*PARAMETERS, "read_noise_e"),
    "overscan": ("bias", "read_noise_dn"),
    "samples": ("quanta_exposure", "mean", "variance", "linearity_residual", "linearity_p"),
}


@dataclass(frozen=True)
class StoredRun:
    """A run as it is stored; ``data`` is its report without single pixels and what is made of frame sums."""

    store: RunStore
    sensor: SensorInfo
    model: FittedModel
    data: ReportData

    def parameters(self, index: IntArray) -> list[FloatArray]:
        """Return (H, g, mu, sigma) of the pixels with these places ``y * nx + x``."""
        return [self.data.maps[name].reshape(-1)[index] for name in PARAMETERS]


def read_run(
    store: RunStore, config: RunConfig, stages: Sequence[Mapping[str, Any]] = (), threads: int = 1
) -> StoredRun:
    """Read all of a run but its histograms; each thread reads an array.

    Raises:
        StoreError: an array is missing or corrupt.
    """
    sensor, model, verdict = SensorInfo.read(store), FittedModel.read(store), read_verdict(store.path)
    groups = _read_arrays(store, verdict is not None, threads)
    maps, fit, ensemble = groups["maps"], groups["fit"], groups["ensemble"]
    if "goodness_q" in maps:
        fit["goodness_q"] = maps.pop("goodness_q")
    if "fit_status" in fit:
        # only what has a value can agree with its model or not
        failed = (fit["fit_status"] & int(FAILED)) != 0
        for name in (name for name in fit if name.startswith("goodness_")):
            fit[name][failed] = np.nan
    ends = {name: interval_names(name) for name in (*INTERVALS, *CHARGE_RATES)}
    intervals = {name: (maps.pop(low), maps.pop(high)) for name, (low, high) in ends.items() if low in maps}
    facts, methods = dict(store.attributes("ensemble")), read_methods(store)
    moments, _ = facts.pop("moments", []), facts.pop("missing", {})
    cases = facts.pop("component_cases", COMPONENT_CASES)
    n_frames = sensor.n_frames if sensor.kind == "frames" else None
    data = ReportData(
        title=config.run.title or store.path.name,
        shape=sensor.shape,
        kind=config.input.kind,
        n_frames=n_frames,
        integration_time=sensor.with_settings(config.input).integration_time,
        camera=sensor.camera.words(),
        maps=maps,
        fit=fit,
        misfits=store.attributes("maps").get("goodness", {}),
        intervals=intervals,
        interval_level=config.fit.interval_level,
        ensemble=ensemble,
        ensemble_facts=facts,
        component_cases=[case_name(case) for case in cases],
        moments=moments,
        truth=groups["truth"],
        overscan=groups["overscan"],
        overscan_facts=store.attributes("overscan"),
        channel_names=[short_name(name) for name in sensor.names],
        outlier_sigmas=config.maps.outlier_sigmas,
        allowed_failed=config.run.allowed_failed_pixels,
        criteria=config.report.criteria,
        # what a single command was given is no setting of the run
        config_yaml=stored_config(store.path) or dump_config(config),
        run=_run_facts(store, sensor, model, config),
        inputs=[
            {"name": file.get("name"), "size": file.get("size"), "hash": file.get("xxh3_128", "")}
            for file in sensor.identity.get("files", [])
        ],
        stages=list(stages),
        missing=_missing(store.path.name, sensor, maps, ensemble, methods is not None),
        methods=methods,
        # several samples need other frames than one: see pchem plan
        plan=None if sensor.samples else plan_section(maps, n_frames),
        discrepancy=None if verdict is None else verdict_data(verdict, groups["discrepancy"]),
        samples=samples_of(sensor, groups["samples"], config),
        regions=config.report.regions,
    )
    return StoredRun(store, sensor, model, data)


def _read_arrays(store: RunStore, searched: bool, threads: int) -> dict[str, dict[str, NDArray[Any]]]:
    """Return the arrays of the report by group; those of a search only where there is a verdict."""
    there = [
        (group, name)
        for group, names in _ARRAYS.items()
        for name in names
        if (group != "discrepancy" or searched) and store.has(f"{group}/{name}")
    ]
    arrays = call_all([functools.partial(store.read, f"{group}/{name}") for group, name in there], threads)
    groups: dict[str, dict[str, NDArray[Any]]] = {group: {} for group in _ARRAYS}
    for (group, name), values in zip(there, arrays, strict=True):
        groups[group][name] = values
    return groups


def verdict_data(found: Verdict, arrays: Arrays) -> DiscrepancyData:
    """Return a verdict with its arrays, but vectors of a search of other statistics, in another order."""
    vectors = ("z_before", "z_after")  # a number for each statistic
    known = {n: array for n, array in arrays.items() if n not in vectors or len(array) == len(STATISTICS)}
    return DiscrepancyData(found, known)


def plan_section(maps: Arrays, n_frames: int | None) -> dict[str, Any] | None:
    """Return the frames that precisions need at the median pixel, and what the frames of the run reach.

    None where no pixel has a value.
    """
    names = ("quanta_exposure", "read_noise_e", "conversion_gain")
    medians = [median_of(maps[name]) for name in names if name in maps]
    if len(medians) < len(names) or not np.isfinite(medians).all():
        return None
    exposure, noise, gain = medians
    try:
        point = Point(exposure, noise, gain)
    except ConfigError:
        return None
    targets = ("conversion_gain=1%", "read_noise_e=1%", "quanta_exposure=1%", "bias=0.02e-")
    rows = [
        {"target": str(target), "name": target.name, "frames": frames_needed(target, point)}
        for target in map(parse_target, targets)
    ]
    reached = {} if n_frames is None else precision(point, n_frames)
    return {"rows": rows, "reached": reached, "exposure": exposure, "read_noise": noise}


def samples_of(sensor: SensorInfo, arrays: Arrays, config: RunConfig) -> Samples | None:
    """Return the exposures of a run of several; None for a run of one."""
    if not sensor.samples or "quanta_exposure" not in arrays:
        return None
    x = exposure_axis(config.input, sensor.samples)
    places = [None if x is None or np.isnan(x[i]) else float(x[i]) for i in range(len(sensor.samples))]
    samples = [
        Sample(each.name, "bias" if each.bias else "exposed", place, each.n_frames)
        for each, place in zip(sensor.samples, places, strict=True)
    ]
    return Samples(tuple(samples), config.input.against, arrays, sensor.shown)


def _run_facts(store: RunStore, sensor: SensorInfo, model: FittedModel, config: RunConfig) -> dict[str, Any]:
    text = "ready-made histograms"
    if sensor.samples:
        shown = sensor.samples[sensor.shown].name
        text = f"{len(sensor.samples)} samples; maps and ensemble show {shown}"
    elif sensor.kind == "frames":
        text = f"frames, {sensor.mode}" + (f", read as {sensor.reader}" if sensor.reader else "")
    facts: dict[str, Any] = {
        "store": store.path.name,
        "input": text,
        "type of the data": sensor.dtype,
        "bit depth": sensor.bit_depth,
        "digest of the input": sensor.identity.get("digest", ""),
    }
    if config.simulate is not None:
        facts["seed of the simulation"] = config.simulate.seed
    if (version := model.version) is not None:
        if version.effects:
            facts["model"] = model_words(version.effects)
        source = "search for missing effects" if version.source == "verdict" else "configuration"
        facts["version of the model"] = f"{version.number} (from the {source})"
    if (record := store.records.read("report")) is not None:
        facts |= {"report made (UTC)": record.started, "versions": record.versions}
    return facts


def _missing(name: str, sensor: SensorInfo, maps: Arrays, ensemble: Arrays, compared: bool) -> dict[str, str]:
    found: dict[str, str] = {}
    if not {*CHARGE_RATES, "charge_per_level"} & maps.keys():
        found["charge_rate"] = "no charge rate: input.against is none" if sensor.samples else NO_TIME
    if not any(np.isfinite(values).any() for values in maps.values()):
        found["maps"] = "no pixel has a value"
    why = "no pixel has parameters" if "maps" in found else "the stage ensemble has no result"
    for part, array, what in (
        ("ensemble", "density", "no ensemble prediction"),
        ("nuced", "nuced_density", "no non-uniformity correction"),
        ("electrons", "electron_mass", "no electron numbers"),
        ("components", "component_variance", "no component widths"),
    ):
        if array not in ensemble:
            found[part] = f"{what}: {why}"
    if sensor.samples:
        found["methods"] = "compare methods in the run of one sample (pchem methods RUN --with OTHER)"
    elif not compared:
        found["methods"] = f"to compare other methods: pchem methods {quoted(Path(name))}"
    return found


@dataclass(frozen=True)
class PixelHistograms:
    """Histograms of n pixels, all of one length: DN of the first bin, frames in each bin.

    ``satellites`` are amplitude (e-) and weight of the satellite levels that the fits left free, (2, n).
    """

    origin: IntArray
    counts: list[NDArray[np.integer[Any]]]
    satellites: FloatArray

    def of(self, part: slice) -> PixelHistograms:
        """Return the histograms of successive pixels."""
        return PixelHistograms(self.origin[part], self.counts[part], self.satellites[:, part])


def read_histograms(store: RunStore, index: IntArray, shape: tuple[int, int]) -> PixelHistograms:
    """Read the histograms of the pixels with these places ``y * nx + x``.

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
