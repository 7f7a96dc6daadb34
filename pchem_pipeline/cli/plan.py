"""The command ``pchem plan``, apart from those that work on a run; it takes no option of theirs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pchem_pipeline.cli.options import on_this_machine, say


def plan(
    run: Annotated[
        Path | None, typer.Argument(help="a run: its median pixel is the default of the options")
    ] = None,
    read_noise: Annotated[float | None, typer.Option(help="read noise, e⁻, quantisation included")] = None,
    exposure: Annotated[
        float | None, typer.Option(help="quanta exposure per frame, e⁻ [default: best]")
    ] = None,
    gain: Annotated[float | None, typer.Option(help="conversion gain, e⁻/DN [default: 0.09]")] = None,
    target: Annotated[
        list[str] | None,
        typer.Option(help="target precision per pixel: conversion_gain=1%, bias=0.02e-, read_noise_e=2%, …"),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=1, help="available frames: print the precision that they reach")
    ] = None,
    samples: Annotated[
        str | None, typer.Option(help="divide the frames over several exposures: 0,2,8 in e⁻, or best")
    ] = None,
    max_exposure: Annotated[float, typer.Option(min=0.01, help="largest allowed exposure, e⁻")] = 10.0,
    max_frames: Annotated[float, typer.Option(min=1, help="largest allowed number of frames")] = 1e7,
    verify: Annotated[bool, typer.Option("--verify", help="simulate the plan with other pixels")] = False,
    pixels: Annotated[int, typer.Option(min=10, help="simulated pixels of --verify")] = 1000,
    seed: Annotated[int, typer.Option(min=0, help="random seed of --verify")] = 1,
    figure: Annotated[
        Path | None,
        typer.Option(
            help="draw the frames needed over exposure and read noise: .svg, .png or .pdf",
            callback=on_this_machine,
        ),
    ] = None,
    json: Annotated[
        Path | None, typer.Option(help="write the numbers to this file", callback=on_this_machine)
    ] = None,
) -> None:
    """Compute how many frames are needed for a precision.

    From the Cramer-Rao bound and simulated pixels; --verify simulates the plan with others.
    """
    from pchem_pipeline.commands.plan import PlanRequest, make_plan

    request = PlanRequest(
        run=run, read_noise_e=read_noise, quanta_exposure=exposure, conversion_gain=gain,
        targets=tuple(target or ()), frames=frames, samples=samples, max_exposure=max_exposure,
        max_frames=max_frames, verify=verify, pixels=pixels, seed=seed, figure=figure, json=json,
    )  # fmt: skip
    say(make_plan(request))
