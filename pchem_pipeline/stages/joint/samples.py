"""The samples of a joint fit: what each run is, and whether all are one sensor at several exposures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pchem_pipeline.base.errors import ConfigError, StoreError, quoted
from pchem_pipeline.config.joint import JointConfig
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.target import Target
from pchem_pipeline.store.run_store import RunStore

__all__ = ["Sample", "check_runs", "describe_samples", "read_samples", "write_samples"]

_GROUP = "samples"


@dataclass(frozen=True)
class Sample:
    """One sample of a joint fit; kept in the attributes of the group ``samples``.

    Attributes:
        name: name of its store.
        store: where that is, absolute.
        kind: exposed, or bias (no electrons).
        x: integration time (s) or light level, None for a bias or without a line.
        n_frames: frames.
        histogram: fingerprint of its histograms.
    """

    name: str
    store: str
    kind: str
    x: float | None
    n_frames: int
    histogram: str


def check_runs(config: JointConfig, targets: Sequence[Target]) -> None:
    """Refuse a run that is listed twice, before anything is done.

    Raises:
        ConfigError: two samples are one run.
    """
    seen: dict[str, int] = {}
    for i, (sample, target) in enumerate(zip(config.samples, targets, strict=True)):
        place = str(target.store.resolve())
        if place in seen:
            raise ConfigError(
                f"samples.{i}.run: {sample.run} is the run of samples.{seen[place]} again; list each run once"
            )
        seen[place] = i


def describe_samples(config: JointConfig, targets: Sequence[Target]) -> tuple[list[Sample], SensorInfo]:
    """Return the samples and the sensor that they share, once their histograms are there.

    Raises:
        ConfigError: samples of different sensors, sizes or regions, the same frames twice, no integration
            time where one is needed, or exposures that do not increase.
        StoreError: a run has no histograms.
    """
    stores = [RunStore.open(target.store) for target in targets]
    sensors = [SensorInfo.read(store) for store in stores]
    for i in range(1, len(sensors)):
        _same_sensor(config, targets, sensors, i)
    samples: list[Sample] = []
    for i, (store, sensor, target) in enumerate(zip(stores, sensors, targets, strict=True)):
        record = store.records.read("histogram")
        if record is None or not store.has("histogram/counts"):
            raise StoreError(
                f"samples.{i}.run: {store.path} has no histograms; run: pchem histogram {quoted(store.path)}"
            )
        x = _abscissa(config, i, target, sensor)
        samples.append(
            Sample(
                store.path.name,
                str(store.path.resolve()),
                config.samples[i].kind,
                x,
                sensor.n_frames,
                record.fingerprint,
            )
        )
    _check_increasing(config, samples)
    return samples, _shared(targets, sensors)


def _same_sensor(
    config: JointConfig, targets: Sequence[Target], sensors: Sequence[SensorInfo], i: int
) -> None:
    """Compare a sample with those before it."""
    mine, first = sensors[i], sensors[0]
    names = f"samples.{i}.run: {config.samples[i].run}", f"samples.0 ({config.samples[0].run})"
    if mine.shape != first.shape:
        raise ConfigError(
            f"{names[0]} has {mine.ny} x {mine.nx} pixels, {names[1]} {first.ny} x {first.nx}; "
            "all samples must show the same region of one sensor"
        )
    depths = [_bit_depth(targets[k], sensors[k]) for k in (i, 0)]
    if None not in depths and depths[0] != depths[1]:
        raise ConfigError(
            f"{names[0]} has codes of {depths[0]} bits, {names[1]} of {depths[1]}; "
            "all samples must come from one sensor with the same settings"
        )
    regions = [targets[k].config.input.roi for k in (i, 0)]
    if regions[0] != regions[1]:
        raise ConfigError(
            f"{names[0]} is cropped to {regions[0]} (input.roi), {names[1]} to {regions[1]}; "
            "all samples must show the same region of one sensor"
        )
    for k in range(i):
        if _content(sensors[k]) == _content(mine):
            raise ConfigError(
                f"{names[0]} holds the same frames as samples.{k} ({config.samples[k].run}); "
                "list each sample once"
            )


def _bit_depth(target: Target, sensor: SensorInfo) -> int | None:
    return target.config.input.bit_depth or sensor.bit_depth


def _content(sensor: SensorInfo) -> Any:
    """Return what tells the frames of one sample from those of another."""
    files = [file.get("xxh3_128") for file in sensor.identity.get("files", [])]
    return files if files and all(files) else id(sensor)


def _abscissa(config: JointConfig, i: int, target: Target, sensor: SensorInfo) -> float | None:
    """Return the integration time or light level of a sample.

    Raises:
        ConfigError: it is needed and not known.
    """
    sample, against = config.samples[i], config.joint.against
    if sample.kind == "bias" or against == "none":
        return None
    if against == "light_level":
        if sample.light_level is None:
            raise ConfigError(
                f"samples.{i} ({sample.run}) has no light_level; give one to each sample, "
                "or set joint.against: none"
            )
        return sample.light_level
    time = sample.integration_time
    if time is None:
        time = target.config.input.integration_time or sensor.integration_time
    if time is None:
        raise ConfigError(
            f"samples.{i} ({sample.run}) has no integration time, so there is no slope for the dark current; "
            "give integration_time, s, or set joint.against: none"
        )
    return time


def _check_increasing(config: JointConfig, samples: Sequence[Sample]) -> None:
    if config.joint.against == "none":
        return
    what = "integration time" if config.joint.against == "integration_time" else "light level"
    last: tuple[int, float] | None = None
    exposed = 0
    for i, sample in enumerate(samples):
        if sample.x is None:
            continue
        exposed += 1
        if last is not None and sample.x <= last[1]:
            raise ConfigError(
                f"samples.{i} ({config.samples[i].run}): {what} {sample.x:g} is not above the {last[1]:g} of "
                f"samples.{last[0]}; list the samples in increasing order, each {what} once"
            )
        last = i, sample.x
    if exposed < 2:
        raise ConfigError(
            f"samples: a slope needs two exposures of different {what}, this has {exposed}; "
            "add a run or set joint.against: none"
        )


def _shared(targets: Sequence[Target], sensors: Sequence[SensorInfo]) -> SensorInfo:
    """Return the sensor of all samples, as the stages see it."""
    first = sensors[0]
    known = (_bit_depth(target, sensor) for target, sensor in zip(targets, sensors, strict=True))
    return SensorInfo(
        kind=first.kind,
        n_frames=sum(sensor.n_frames for sensor in sensors),
        ny=first.ny,
        nx=first.nx,
        dtype=first.dtype,
        bit_depth=next((depth for depth in known if depth is not None), None),
        integration_time=None,
        mode="reference",
        identity={},
        names=first.names,
    )


def write_samples(store: RunStore, samples: Sequence[Sample], sensor: SensorInfo, against: str) -> None:
    """Keep the samples and their sensor in the store of the joint fit."""
    sensor.write(store)
    store.set_attributes(_GROUP, {"samples": [asdict(each) for each in samples], "against": against})


def read_samples(store: RunStore) -> tuple[list[Sample], str]:
    """Return the samples of a joint fit, and what they are drawn against.

    Raises:
        StoreError: the store is not that of a joint fit.
    """
    content = store.attributes(_GROUP)
    if "samples" not in content:
        raise StoreError(f"{store.path} is not a joint fit; make one with: pchem joint RUN RUN ...")
    return [Sample(**each) for each in content["samples"]], content["against"]
