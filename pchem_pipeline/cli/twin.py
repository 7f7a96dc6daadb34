"""The command ``pchem twin``."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.cli.options import Target, on_this_machine


def twin(
    target: Target,
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="YAML file to write; maps are written beside it", callback=on_this_machine
        ),
    ],
    scene: Annotated[
        str | None,
        typer.Option(
            help="e⁻ per frame: a number, or a file with an image or a sequence of images (npy, TIFF, FITS) "
            "[default: exposure of the run]"
        ),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=1, help="number of frames [default: as in the run]")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="random seed of the frames")] = 1,
    redraw: Annotated[
        int | None,
        typer.Option(min=0, help="random seed: draw the maps within their errors [default: fitted maps]"),
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(help="simulate another sensor of this type with rows x columns, such as 512x512"),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="replace existing files")] = False,
) -> None:
    """Write a simulated copy of the camera: a YAML for pchem simulate, with maps, effects and ADC.

    A sensor of another size has the same distributions and spatial correlations.
    """
    from pchem_pipeline.commands.twin import write_twin
    from pchem_pipeline.run.target import find_run

    written = write_twin(
        find_run(target),
        output,
        scene=scene,
        frames=frames,
        seed=seed,
        redraw=redraw,
        shape=None if size is None else _shape(size),
        force=force,
    )
    for path in written:
        typer.echo(path)


def _shape(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([1-9]\d*)\s*x\s*([1-9]\d*)", text)
    if match is None:
        raise ConfigError(f"--size {text}: write rows x columns, such as 512x512")
    return int(match[1]), int(match[2])
