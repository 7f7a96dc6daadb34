"""The command ``pchem apply``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from pchem_pipeline.cli.options import Target, takes_command

if TYPE_CHECKING:
    from pchem_pipeline.runner.session import Command


@takes_command(without=("force", "dry_run", "tiles", "roi"))
def apply(
    target: Target,
    frames: Annotated[list[str], typer.Argument(help="camera files, globs or folders of the same sensor")],
    output: Annotated[Path, typer.Option("--output", "-o", help="store, or folder of files, to write")],
    what: Annotated[
        str, typer.Option(help="electrons, numbers, exposure, separated by commas, or all")
    ] = "all",
    prior: Annotated[
        str,
        typer.Option(
            help="numbers: prior exposure: frames (estimated from these frames), flat (all numbers equally "
            "likely), run (from the characterisation), a number (e⁻), or a file with a map (npy, TIFF, FITS)"
        ),
    ] = "frames",
    dataset: Annotated[
        str | None,
        typer.Option(help="dataset of an HDF5, zarr or FITS file [default: as in the run]"),
    ] = None,
    format: Annotated[Literal["zarr", "tiff", "fits"], typer.Option(help="format of the output")] = "zarr",
    keep_modes: Annotated[
        bool,
        typer.Option(
            "--keep-modes",
            help="do not subtract row, column and frame noise, drift and pickup of the model",
        ),
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="replace existing calibrated frames")] = False,
    *,
    command: Command,
) -> None:
    """Convert other frames of the sensor to electrons, electron numbers and a map of the exposure.

    With standard errors, a quality layer and provenance. Continues after an interruption.
    """
    from pchem_pipeline.commands.apply.apply import apply_to_frames
    from pchem_pipeline.commands.apply.settings import ApplySettings, kinds_of
    from pchem_pipeline.run.target import find_run

    command = replace(command, options=replace(command.options, force=force))
    wanted = ApplySettings(kinds_of(what), prior, not keep_modes, format, dataset)
    for path in apply_to_frames(find_run(target), frames, output, wanted, command):
        typer.echo(path)
