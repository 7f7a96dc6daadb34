"""The commands ``pchem apply``, ``twin``, ``methods`` and ``plan``; the last takes no option of a run's."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.cli.options import Target, on_this_machine, say, takes_command

if TYPE_CHECKING:
    from pchem_pipeline.run.stage import Command


@takes_command(without=("force", "dry_run", "roi"))
def apply(
    target: Annotated[
        Path,
        typer.Argument(
            help="a config.yaml, the store of a run (run.zarr), or a folder of runs, of which the one of the "
            "camera, setting and date of the frames is taken"
        ),
    ],
    frames: Annotated[list[str], typer.Argument(help="camera files, globs or folders of the same sensor")],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="store, or folder of files, to write [default: calibrated.zarr, or calibrated]",
        ),
    ] = None,
    what: Annotated[
        str, typer.Option(help="electrons, numbers, exposure, separated by commas, or all")
    ] = "all",
    prior: Annotated[
        Literal["frames", "flat", "run"],
        typer.Option(
            help="numbers: prior exposure: frames (estimated from these frames), flat (all numbers equally "
            "likely) or run (from the characterisation)"
        ),
    ] = "frames",
    dataset: Annotated[
        str | None, typer.Option(help="dataset of an HDF5, zarr or FITS file [default: as in the run]")
    ] = None,
    format: Annotated[
        Literal["zarr", "tiff", "fits"],
        typer.Option(help="format of the output; fits: a file for each input file, with SCI, ERR and DQ"),
    ] = "zarr",
    max_age: Annotated[
        float | None, typer.Option(min=0, help="folder of runs: days between run and frames at most")
    ] = None,
    reference: Annotated[
        Literal["pixels", "overscan", "none"],
        typer.Option(
            help="what tells the offsets of rows, columns and frames that are subtracted: pixels (all, the "
            "offsets in the model of the run), overscan (these, else those of rows and frames), none"
        ),
    ] = "pixels",
    force: Annotated[bool, typer.Option("--force", help="replace existing calibrated frames")] = False,
    *,
    command: Command,
) -> None:
    """Convert other frames of the sensor to electrons.

    Writes electrons, electron numbers and an exposure map, with errors, quality and provenance. Continues
    after an interruption.
    """
    from pchem_pipeline.commands.apply.apply import apply_to_frames
    from pchem_pipeline.commands.apply.registry import run_for
    from pchem_pipeline.commands.apply.settings import ApplySettings, kinds_of
    from pchem_pipeline.run.target import find_run

    target, why = run_for(target, frames, max_age)
    if why:
        typer.echo(f"apply: calibrated with {target}, {why}", err=True)
    output = output or Path("calibrated.zarr" if format == "zarr" else "calibrated")
    wanted = ApplySettings(kinds_of(what), prior, reference, format, dataset)
    for path in apply_to_frames(find_run(target), frames, output, wanted, replace(command, force=force)):
        typer.echo(path)


def twin(
    target: Target,
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="YAML file to write; maps are written beside it", callback=on_this_machine
        ),
    ] = Path("camera.yaml"),
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
    """Write a simulated copy of the camera.

    A YAML file for pchem simulate, with maps, effects and ADC. Another size keeps the distributions and
    spatial correlations.
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


@takes_command(without=("roi",))
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
    json: Annotated[
        Path | None, typer.Option(help="write the numbers to this file", callback=on_this_machine)
    ] = None,
) -> None:
    """Compute how many frames are needed for a precision.

    From the Cramer-Rao bound and simulated pixels.
    """
    from pchem_pipeline.commands.plan import make_plan

    text = make_plan(
        run, read_noise=read_noise, exposure=exposure, gain=gain, target=target or (), frames=frames,
        samples=samples, max_exposure=max_exposure, max_frames=max_frames, json=json,
    )  # fmt: skip
    say(text)
