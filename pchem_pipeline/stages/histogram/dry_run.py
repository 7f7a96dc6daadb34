"""What a run is going to read, write and hold: said before it starts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pchem_pipeline.compute.memory import BASE_BYTES
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.frames.histogram_files import is_histogram_input
from pchem_pipeline.model.histogram.count import most_bins
from pchem_pipeline.model.histogram.summaries import ROW_GROUP
from pchem_pipeline.run.stage import allowed_bytes, band_bytes
from pchem_pipeline.stages.histogram.histogram import bins_of
from pchem_pipeline.stages.histogram.memory import single_pass_bytes
from pchem_pipeline.stages.ingest import disk_words
from pchem_pipeline.store.tiles import tile_grid, tile_shape

#: the program with what the later stages hold, and that for each pixel
_REPORT_BYTES, _REPORT_PIXEL_BYTES = 400 << 20, 400


@dataclass(frozen=True)
class Plan:
    """What a run from camera files to the report takes.

    Attributes:
        shape: frames, rows, columns.
        bins: of a pixel.
        tiles: their number.
        tile: rows and columns of one.
        single_pass: the camera files are read once; else twice, by bands of rows.
        disk: where the frames are to be, and how much disk the store takes.
        held_bytes: largest resident memory of the process.
        allowed_bytes: memory that it may take.
    """

    shape: tuple[int, int, int]
    bins: int
    tiles: int
    tile: tuple[int, int]
    workers: int
    single_pass: bool
    disk: str
    held_bytes: int
    allowed_bytes: int

    def words(self) -> list[str]:
        """Return the plan as ``--dry-run`` prints it."""
        n, ny, nx = self.shape
        how = "" if self.single_pass else "; read twice, in bands of rows (once with more compute.max_memory)"
        return [
            f"plan: {n} frames of {ny} x {nx} pixels, {self.tiles} tile{'s' * (self.tiles > 1)} of "
            f"{min(self.tile[0], ny)} x {min(self.tile[1], nx)}, "
            f"{self.bins} bins, {self.workers} worker{'s' * (self.workers > 1)}",
            f"plan: {self.disk}{how}",
            f"plan: needs at most {self.held_bytes / 2**20:.0f} MiB of memory, for any number of frames; "
            f"{self.allowed_bytes / 2**20:.0f} MiB allowed",
        ]


def plan_lines(config: RunConfig, base_dir: Path, todo: Sequence[str]) -> list[str]:
    """Return what it takes to go through the camera files, where they are there; else nothing."""
    if "simulate" in todo or config.input.samples or is_histogram_input(config.input, base_dir):
        return []
    return make_plan(config, base_dir).words()


def make_plan(config: RunConfig, base_dir: Path) -> Plan:
    """Look at the camera files and at their first frames, and say what the run takes.

    Raises:
        InputError: the input is bad.
    """
    from pchem_pipeline.frames.open import open_frames

    frames = open_frames(config.input, base_dir)
    (ny, nx), workers = frames.shape[1:], config.compute.count()
    limit = most_bins(config.histogram.max_bins, frames.dtype)
    rows = min(ny, math.lcm(ROW_GROUP, min(frames.rows_per_read, ny)))
    bins = bins_of(frames, config.histogram.window_frames, limit, rows)
    whole = single_pass_bytes(config, frames.shape, frames.dtype, bins)
    allowed = allowed_bytes(config, workers)
    single_pass = whole <= allowed
    bands = BASE_BYTES + min(whole - BASE_BYTES, workers * band_bytes(config, workers))
    report = _REPORT_BYTES + _REPORT_PIXEL_BYTES * ny * nx
    return Plan(
        shape=frames.shape,
        bins=bins,
        tiles=len(tile_grid((ny, nx), config.run.tile)),
        tile=tile_shape(config.run.tile, (ny, nx)),
        workers=workers,
        single_pass=single_pass,
        disk=disk_words(config, frames),
        held_bytes=max(whole if single_pass else bands, report),
        allowed_bytes=allowed,
    )
