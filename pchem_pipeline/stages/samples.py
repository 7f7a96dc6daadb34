"""The samples of a run of several exposures: which runs they are, and whether all show one sensor."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.errors import ConfigError, StoreError, quoted
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.frames.camera import shared_facts, unlike
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.run.input import LISTED_FILES
from pchem_pipeline.run.sensor import Sample, SensorInfo
from pchem_pipeline.run.target import Target, find_run
from pchem_pipeline.store.run_store import RunStore


@dataclass(frozen=True)
class OpenSample:
    """The run of a sample, with the fingerprint of its histograms; messages call it ``where``.

    ``sensor`` has the bit depth and integration time of the configuration of the sample's run.
    """

    where: str
    target: Target
    store: RunStore
    sensor: SensorInfo
    histogram: str

    def shares_frames(self, other: OpenSample) -> bool:
        """Return whether it has frames of the same files, and of the same dataset in them, as another."""
        hashes = self._hashes()
        if not hashes or not all(hashes) or hashes != other._hashes():
            return False
        mine, others = self.target.config.input, other.target.config.input
        (first, end), (start, last) = (each.frame_range or (0, None) for each in (mine, others))
        apart = (end is not None and end <= start) or (last is not None and last <= first)
        return mine.dataset == others.dataset and not apart

    def _hashes(self) -> list[Any]:
        return [file.get("xxh3_128") for file in self.sensor.identity.get("files", [])]


def find_runs(names: Sequence[Path | str], base_dir: Path, setting: str, *first: Target) -> list[Target]:
    """Return the ``first`` runs and those of a setting, below a folder.

    Raises:
        ConfigError: two are one run, or a run cannot be found.
    """
    targets = list(first)
    for target, name in ((find_run(base_dir / name), name) for name in names):
        if target.store.resolve() in [each.store.resolve() for each in targets]:
            raise ConfigError(
                f"{setting}: {name} is the run of {target.store.name} again; list each run once"
            )
        targets.append(target)
    return targets


def sample_targets(config: RunConfig, base_dir: Path) -> list[Target]:
    """Return the runs of the samples; see `find_runs`."""
    return find_runs([sample.run for sample in config.input.samples], base_dir, "input.samples")


def open_samples(config: RunConfig, base_dir: Path) -> list[OpenSample]:
    """Return the runs of the samples with their histograms.

    Raises:
        ConfigError: two samples are one run, or a run cannot be found.
        StoreError: a run has no histograms.
    """
    samples = zip(config.input.samples, sample_targets(config, base_dir), strict=True)
    return [open_sample(target, f"sample {given.run}") for given, target in samples]


def open_sample(target: Target, where: str) -> OpenSample:
    """Return a run with its histograms.

    Raises:
        StoreError: it has none.
    """
    store = RunStore.open(target.store)
    record = store.records.read("histogram")
    if record is None or not store.has("histogram/counts"):
        raise StoreError(
            f"{where}: {store.path} has no histograms; run: pchem histogram {quoted(store.path)}"
        )
    return OpenSample(where, target, store, target.sensor(store), record.fingerprint)


def check_samples(config: RunConfig, base_dir: Path) -> list[OpenSample]:
    """Return the runs of the samples, if they belong together.

    Raises:
        ConfigError: samples of different sensors, sizes or regions, the same frames twice, no integration
            time where one is needed, or exposures that do not increase.
        StoreError: a run has no histograms.
    """
    samples = open_samples(config, base_dir)
    same_sensor(samples)
    _check_increasing(config.input, samples)
    return samples


def same_sensor(samples: Sequence[OpenSample]) -> None:
    """Check that samples have different frames of the same pixels.

    Raises:
        ConfigError: they have not.
    """
    region = "all samples must show the same region of one sensor"
    sensor = "all samples must come from one sensor with the same settings"
    first = samples[0]
    for i, mine in enumerate(samples[1:], 1):
        here, there = mine.sensor, first.sensor
        sizes = [f"{each.ny} x {each.nx}" for each in (here, there)]
        regions = [str(each.target.config.input.roi) for each in (mine, first)]
        for facts, words, rule in (
            (sizes, "has {} pixels, {} {}", region),
            ((here.bit_depth, there.bit_depth), "has {} bits, {} {}", sensor),
            (regions, "is cropped to {} (input.roi), {} to {}", region),
        ):
            if None not in facts and facts[0] != facts[1]:
                found = words.format(facts[0], first.where, facts[1])
                raise ConfigError(f"{mine.where} {found}; {rule}")
        if found := unlike(here.camera, there.camera, first.where):
            raise ConfigError(f"{mine.where}: {found}; {sensor}")
        for other in samples[:i]:
            if mine.shares_frames(other):
                raise ConfigError(f"{mine.where} has the same frames as {other.where}; list each sample once")


def exposure_axis(settings: InputSettings, samples: Sequence[Sample]) -> FloatArray | None:
    """Return the integration time (s) or light level of each sample, NaN for a bias; None without a line.

    Raises:
        ConfigError: one is needed and not known.
    """
    if settings.against == "none":
        return None
    found = np.full(len(samples), np.nan)
    for i, (given, sample) in enumerate(zip(settings.samples, samples, strict=True)):
        if given.bias:
            continue
        if settings.against == "light_level":
            exposure = given.light_level
            missing = "light_level; give one for each: pchem joint RUNS --level 0,1,2.4"
        else:
            exposure = sample.integration_time if given.integration_time is None else given.integration_time
            missing = (
                "integration time, needed for the charge rate; set input.integration_time of this run, s, or "
                "fit without: pchem joint RUNS --against none (in the YAML of a joint run: input.against: "
                "none)"
            )
        if exposure is None:
            raise ConfigError(f"sample {given.run} has no {missing}")
        found[i] = exposure
    return found


def _check_increasing(settings: InputSettings, samples: Sequence[OpenSample]) -> None:
    """Refuse exposures that do not increase, or too few of them for a line."""
    exposures = _exposures(settings, samples)
    x = exposure_axis(settings, exposures)
    if x is None:
        return
    what = settings.against.replace("_", " ")
    exposed = np.flatnonzero(np.isfinite(x)).tolist()
    if settings.against == "integration_time" and len({exposures[i].kind == "dark" for i in exposed}) > 1:
        raise ConfigError(
            "input.samples: some are dark and some are not (input.kind of the runs), so H does not grow with "
            "time alone; give the levels of the lamp (pchem joint RUNS --level 0,1) or fit without a slope "
            "(--against none)"
        )
    for last, i in itertools.pairwise(exposed):
        if x[i] <= x[last]:
            raise ConfigError(
                f"{samples[i].where}: {what} {x[i]:g} is not above {x[last]:g} of {samples[last].where}; "
                f"list the samples in increasing order of {what}; of equal ones give the levels of the lamp "
                "(pchem joint RUNS --level 0,1) or fit without a slope (--against none)"
            )
    if len(exposed) < 2:
        raise ConfigError(
            f"input.samples: a slope needs two exposures of different {what}, but there is {len(exposed)}; "
            "add a run or set input.against: none"
        )


def _exposures(settings: InputSettings, samples: Sequence[OpenSample]) -> tuple[Sample, ...]:
    return tuple(
        Sample(
            found.store.path.name,
            given.bias,
            found.sensor.n_frames,
            found.sensor.integration_time,
            found.target.config.input.kind,
        )
        for given, found in zip(settings.samples, samples, strict=True)
    )


def shown_sample(settings: InputSettings) -> int:
    """Return the place of the sample whose histograms, H and ensemble are shown."""
    if settings.shown_sample is not None:
        return settings.shown_sample
    return max(i for i, sample in enumerate(settings.samples) if not sample.bias)


def sample_sensor(config: RunConfig, samples: Sequence[OpenSample]) -> SensorInfo:
    """Return the sensor that all samples share, as the stages see it."""
    first = samples[0].sensor
    files = [file for each in samples for file in each.sensor.identity.get("files", [])]
    digests = " ".join(str(each.sensor.identity.get("digest", each.store.path)) for each in samples)
    low, high = zip(*(each.sensor.seen_limits for each in samples), strict=True)
    return SensorInfo(
        kind="samples",
        n_frames=sum(each.sensor.n_frames for each in samples),
        ny=first.ny,
        nx=first.nx,
        dtype=first.dtype,
        bit_depth=next((depth for each in samples if (depth := each.sensor.bit_depth) is not None), None),
        # the outermost codes at which any of them pile up
        seen_limits=(
            min((code for code in low if code is not None), default=None),
            max((code for code in high if code is not None), default=None),
        ),
        integration_time=None,
        mode="reference",
        identity={
            "files": files[:LISTED_FILES],
            "n_files": len(files),
            "digest": hashlib.sha256(digests.encode()).hexdigest(),
        },
        names=first.names,
        samples=_exposures(config.input, samples),
        shown=shown_sample(config.input),
        camera=shared_facts([each.sensor.camera for each in samples])[0],
        whole=first.whole,
    )


def sample_facts(config: RunConfig, base_dir: Path) -> dict[str, Any]:
    """Return what decides the histograms of the samples, as JSON data.

    Raises:
        ConfigError: a run cannot be found.
        StoreError: a run has no histograms.
    """
    samples = zip(open_samples(config, base_dir), config.input.samples, strict=True)
    histograms = [[found.histogram, given.bias] for found, given in samples]
    return {"samples": histograms, "shown_sample": shown_sample(config.input)}
