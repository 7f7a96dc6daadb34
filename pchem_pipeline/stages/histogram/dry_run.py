"""What a run is going to read, write and hold: said before it starts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from pchem_pipeline.compute.memory import BASE_BYTES
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.frames.histogram_files import is_histogram_input
from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.model.histogram.count import most_bins
from pchem_pipeline.model.histogram.summaries import ROW_GROUP
from pchem_pipeline.run.stage import allowed_bytes, band_bytes
from pchem_pipeline.stages.histogram.arrays import single_pass_bytes
from pchem_pipeline.stages.histogram.histogram import bins_of
from pchem_pipeline.stages.ingest import disk_words
from pchem_pipeline.store.tiles import tile_grid, tile_shape


class Plan(NamedTuple):
    """What a run from camera files to the report takes."""

    bins: int  # of a pixel
    single_pass: bool  # the camera files are read once; else twice, by bands of rows
    held_bytes: int  # largest resident memory of the process
    lines: list[str]  # as ``--dry-run`` prints it


def plan_lines(config: RunConfig, base_dir: Path, todo: Sequence[str]) -> list[str]:
    """Return what it takes to go through the camera files, where they are there; else nothing."""
    if "simulate" in todo or config.input.samples or is_histogram_input(config.input, base_dir):
        return []
    return make_plan(config, base_dir).lines


def make_plan(config: RunConfig, base_dir: Path) -> Plan:
    """Look at the camera files and at their first frames, and say what the run takes.

    Raises:
        InputError: the input is bad.
    """
    frames = open_frames(config.input, base_dir)
    (n, ny, nx), workers = frames.shape, config.compute.count()
    limit = most_bins(config.histogram.max_bins, frames.dtype)
    bins = bins_of(
        frames,
        config.histogram.window_frames,
        limit,
        min(ny, math.lcm(ROW_GROUP, min(frames.rows_per_read, ny))),
    )
    whole, allowed = (
        single_pass_bytes(config, frames.shape, frames.dtype, bins),
        allowed_bytes(config, workers),
    )
    single_pass = whole <= allowed
    bands = BASE_BYTES + min(whole - BASE_BYTES, workers * band_bytes(config, workers))
    later = (400 << 20) + 400 * ny * nx  # what the later stages hold, with the program
    held = max(whole if single_pass else bands, later)
    tiles, (rows, columns) = len(tile_grid((ny, nx), config.run.tile)), tile_shape(config.run.tile, (ny, nx))
    how = "" if single_pass else "; read twice, in bands of rows (once with more compute.max_memory)"
    lines = [
        f"plan: {n} frames of {ny} x {nx} pixels, {tiles} tile{'s' * (tiles > 1)} of "
        f"{min(rows, ny)} x {min(columns, nx)}, {bins} bins, {workers} worker{'s' * (workers > 1)}",
        f"plan: {disk_words(config, frames)}{how}",
        f"plan: needs at most {held / 2**20:.0f} MiB of memory, for any number of frames; "
        f"{allowed / 2**20:.0f} MiB allowed",
    ]
    return Plan(bins, single_pass, held, lines)
