"""What the report shows of several exposures that were fitted together."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from pchem_pipeline.report.data import Sample, Samples
from pchem_pipeline.stages.samples import exposure_axis

if TYPE_CHECKING:
    from pchem_pipeline.frames.settings import InputSettings
    from pchem_pipeline.run.sensor import SensorInfo
    from pchem_pipeline.store.run_store import RunStore

__all__ = ["read_samples"]

_ARRAYS = ("quanta_exposure", "mean", "variance", "linearity_residual", "linearity_p")


def read_samples(store: RunStore, settings: InputSettings, sensor: SensorInfo) -> Samples | None:
    """Return the exposures of a run, or None where it has but one.

    Args:
        store: the run.
        settings: its section ``input``.
        sensor: its input.

    Raises:
        StoreError: an array cannot be read.
    """
    if not sensor.samples or not store.has("samples/quanta_exposure"):
        return None
    x = exposure_axis(settings, sensor.samples)
    places = [None if x is None or math.isnan(x[i]) else float(x[i]) for i in range(len(sensor.samples))]
    samples = [
        Sample(each.name, "bias" if each.bias else "exposed", place, each.n_frames)
        for each, place in zip(sensor.samples, places, strict=True)
    ]
    arrays = {name: store.read(f"samples/{name}") for name in _ARRAYS if store.has(f"samples/{name}")}
    return Samples(tuple(samples), settings.against, arrays)
