"""The options that the commands of a run have in common."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from pchem_pipeline.errors import ConfigError

if TYPE_CHECKING:
    from pchem_pipeline.stages.session import Command

__all__ = [
    "Backend",
    "DryRun",
    "Force",
    "LogJson",
    "MaxMemory",
    "Progress",
    "Quiet",
    "Roi",
    "Target",
    "Tiles",
    "Workers",
    "make_command",
]

Target = Annotated[Path, typer.Argument(help="a config.yaml, or the store of a run (run.zarr)")]
Force = Annotated[bool, typer.Option("--force", help="do it again even if it is up to date")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="say what would be done and why; write nothing")]
Tiles = Annotated[str | None, typer.Option(help="only these tiles, iy.ix: 0.3,2.1 or ranges 0:2.0:4")]
Roi = Annotated[
    str | None,
    typer.Option(help="region y0:y1,x0:x1 in pixels; ingest and run FILES crop to it, others do its tiles"),
]
Workers = Annotated[int | None, typer.Option(min=1, help="number of workers [default: compute.workers]")]
Backend = Annotated[
    Literal["serial", "threads", "processes", "distributed"] | None,
    typer.Option(help="who does the work [default: compute.backend]"),
]
MaxMemory = Annotated[
    int | None, typer.Option(min=64, help="memory that it may take, MiB [default: compute.max_memory]")
]
LogJson = Annotated[Path | None, typer.Option(help="append JSON lines about the run to this file")]
Progress = Annotated[
    Literal["auto", "on", "off"], typer.Option(help="progress bars; auto: only on a terminal")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="warnings and errors only")]


def _region(text: str | None) -> tuple[int, int, int, int] | None:
    if text is None:
        return None
    try:
        (y0, y1), (x0, x1) = (map(int, part.split(":")) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"--roi {text!r}: write y0:y1,x0:x1 in pixels, such as 0:128,64:192") from None
    return y0, y1, x0, x1


def make_command(
    *,
    force: bool,
    dry_run: bool,
    tiles: str | None,
    roi: str | None,
    workers: int | None,
    backend: str | None,
    log_json: Path | None,
    progress: Literal["auto", "on", "off"],
    quiet: bool,
    max_memory: int | None = None,
) -> Command:
    """Return what the options common to the commands of a run ask for."""
    from pchem_pipeline.stages.base import Options
    from pchem_pipeline.stages.session import Command

    options = Options(force=force, dry_run=dry_run, tiles=tiles, roi=_region(roi))
    return Command(
        options, workers=workers, backend=backend, max_memory=max_memory, progress=progress, quiet=quiet,
        log_json=log_json,
    )  # fmt: skip
