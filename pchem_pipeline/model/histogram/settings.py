"""The YAML section of the histogram stage."""

from __future__ import annotations

from pydantic import Field

from pchem_pipeline.base.settings import Section


class HistogramSettings(Section):
    """How frames are turned into per-pixel histograms and summaries."""

    block_frames: int | None = Field(
        default=None,
        ge=2,
        le=16384,
        description="frames in a time block of the summaries (block sums, covariances within blocks); "
        "null: a sixteenth of the run, 32 to 512",
    )
    window_frames: int = Field(
        default=256,
        ge=1,
        le=16384,
        description="frames read at a time; the first of them set the number of bins",
    )
    max_bins: int = Field(
        default=65536,
        ge=32,
        le=65536,
        multiple_of=16,
        description="largest number of bins per pixel, DN; fewer if the first frames need fewer. Samples "
        "outside are counted as under or over",
    )
    summaries: bool = Field(
        default=True,
        description="store sums over time blocks, rows and columns, and lag-1 and neighbour covariances",
    )
    band_memory: int = Field(
        default=640,
        ge=16,
        description="memory per worker, MiB; sets the rows processed at a time, not the result",
    )

    def block_length(self, n_frames: int) -> int:
        """Return the frames in a time block of a run of ``n_frames``."""
        return self.block_frames or min(max(n_frames // 16, 32), 512)
