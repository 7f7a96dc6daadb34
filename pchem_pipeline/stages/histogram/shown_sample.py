"""The histograms of a run of several samples: those of the sample that is shown, taken from its own run."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pchem_pipeline.run.stage import StageContext, open_store
from pchem_pipeline.stages.histogram.arrays import create_counts
from pchem_pipeline.stages.samples import sample_targets
from pchem_pipeline.store.run_store import RunStore

if TYPE_CHECKING:
    from pchem_pipeline.store.tiles import Tile

_MAPS = ("origin", "under", "over", "minimum", "maximum")


def copy_shown_sample(context: StageContext) -> None:
    """Copy the histograms of the shown sample, so that report and ensemble stand without its run.

    The fit reads the histograms of all samples in their own runs.

    Raises:
        StoreError: the run of the sample is gone, or the store refuses.
    """
    place = sample_targets(context.config, context.base_dir)[context.sensor.shown].store
    counts = RunStore.open(place).array("histogram/counts")
    create_counts(context, counts.shape[2], counts.dtype)
    context.create_maps([f"histogram/{name}" for name in _MAPS])
    context.store.set_attributes("summary", {"missing": "the samples keep their own"})
    context.run_units(context.tiles(), functools.partial(_copy_tile, store=context.store.path, sample=place))


def _copy_tile(tile: Tile, *, store: Path, sample: Path) -> dict[str, Any]:
    source, target = RunStore.open(sample), open_store(store)
    for name in ("counts", *_MAPS):
        target.write(f"histogram/{name}", tile.region, source.read(f"histogram/{name}", tile.region))
    return {}
