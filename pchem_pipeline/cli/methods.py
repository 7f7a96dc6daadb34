"""The command ``pchem methods``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pchem_pipeline.cli.options import Target, say, takes_command

if TYPE_CHECKING:
    from pchem_pipeline.runner.session import Command


@takes_command(without=("tiles", "roi"))
def methods(
    target: Target,
    with_runs: Annotated[
        list[Path] | None,
        typer.Option(
            "--with",
            help="store of a run of the same pixels at another exposure, preferably dark (repeatable)",
        ),
    ] = None,
    pixels: Annotated[
        int | None, typer.Option(min=1, help="pixels to compare [default: methods.pixels]")
    ] = None,
    study_pixels: Annotated[
        int | None,
        typer.Option(min=0, help="simulated pixels at each read noise [default: methods.study_pixels]"),
    ] = None,
    *,
    command: Command,
) -> None:
    """Compare other characterisation methods with PCH-EM.

    Photon transfer, EMVA 1288, PCH peaks and valleys, cumulants and others, on the same pixels and simulated.
    """
    from pchem_pipeline.commands.methods import compare_methods
    from pchem_pipeline.run.target import find_run

    given = {"with_runs": with_runs, "pixels": pixels, "study_pixels": study_pixels}
    known = {name: value for name, value in given.items() if value is not None}
    text = compare_methods(find_run(target), command, known)
    if text:
        say(text)
