"""The ``pchem`` command: it translates the command line and calls the library once.

Heavy libraries are imported inside the commands, so that ``--help`` answers at once.
"""

from __future__ import annotations

import errno
import os
import resource
import sys
import threading
import traceback
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

import typer

from pchem_pipeline import __version__
from pchem_pipeline.base.errors import ConfigError, ExitCode, PchEmError
from pchem_pipeline.cli.commands import apply, methods, plan, twin
from pchem_pipeline.cli.help import PlainCommand, PlainGroup
from pchem_pipeline.cli.options import (
    Output,
    Strict,
    Target,
    on_this_machine,
    only_reads,
    region_of,
    say,
    takes_command,
)
from pchem_pipeline.stages.table import STAGES, pipeline, pipeline_of

if TYPE_CHECKING:
    from pchem_pipeline.run.stage import Command

app = typer.Typer(
    cls=PlainGroup,
    name="pchem",
    help="Characterise deep sub-electron read noise image sensors, pixel by pixel, with PCH-EM.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _command(heading: str, name: str | None = None) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Add a command below a heading of ``pchem --help``."""
    return app.command(name, cls=PlainCommand, rich_help_panel=heading)


@_command("Run")
@takes_command(without=("force", "dry_run", "roi"))
def demo(
    output: Output = Path("pchem-demo"),
    size: Annotated[int, typer.Option(min=8, help="rows and columns of the simulated sensor")] = 64,
    frames: Annotated[int, typer.Option(min=16, help="number of frames")] = 4000,
    seed: Annotated[int, typer.Option(min=0, help="random seed")] = 1,
    hidden: Annotated[
        str | None,
        typer.Option(
            help="hide this effect and search for it, such as row_noise, or row_noise@columns=40:50 in a "
            "part of the sensor or run"
        ),
    ] = None,
    *,
    command: Command,
) -> None:
    """Run all stages on a small simulated sensor.

    Prints estimated and true parameters, and the path of the report.
    """
    from pchem_pipeline.commands.demo import run_demo

    say(run_demo(output, command, size=size, n_frames=frames, seed=seed, hidden=hidden))


@_command("Run")
def init(
    path: Annotated[Path, typer.Argument(help="YAML file to write", callback=on_this_machine)] = Path(
        "config.yaml"
    ),
    files: Annotated[list[str] | None, typer.Argument(help="camera files, globs or folders")] = None,
    simulated: Annotated[bool, typer.Option("--simulated", help="include a simulated camera")] = False,
    schema: Annotated[
        bool, typer.Option("--schema", help="also write the JSON schema of the YAML, for editors")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="replace an existing file")] = False,
) -> None:
    """Write a YAML file with every setting explained.

    With --schema an editor completes and checks its keys.
    """
    from pchem_pipeline.commands.new_run import write_template

    for written in write_template(path, files or [], simulated=simulated, schema=schema, force=force):
        typer.echo(written)


@_command("Run")
@takes_command(reads_files=True)
def run(
    targets: Annotated[
        list[Path], typer.Argument(help="a config.yaml, a store, or camera files and folders")
    ],
    store: Annotated[Path | None, typer.Option(help="store of a new run [default: run.zarr]")] = None,
    until: Annotated[
        str, typer.Option(help="last stage to run", metavar=f"[{'|'.join(pipeline())}]")
    ] = pipeline()[-1],
    strict: Strict = False,
    *,
    given: dict[str, Any],
    command: Command,
) -> None:
    """Run all stages, from camera files to report.

    Stages that are up to date are skipped. stdout has the path of the report, stderr the rest.
    """
    from pchem_pipeline.commands.first_screen import run_to_first_screen
    from pchem_pipeline.commands.new_run import find_or_start
    from pchem_pipeline.runner.session import cropped, up_to

    target, is_new = find_or_start(targets, store, given, command.roi)
    if is_new:
        target, command = cropped(target, command)
    stages = up_to(until, pipeline_of(target.config))
    run_to_first_screen(target, stages, command, typer.echo, is_new=is_new, strict=strict)


@_command("Run")
@takes_command(without=("roi",))
def joint(
    targets: Annotated[
        list[Path],
        typer.Argument(help="a joint.yaml, or the runs (YAML or store) in increasing order of exposure"),
    ],
    bias: Annotated[
        list[Path] | None, typer.Option(help="run of bias frames, without any charge (repeatable)")
    ] = None,
    store: Annotated[Path | None, typer.Option(help="store of the fit [default: joint.zarr]")] = None,
    against: Annotated[
        Literal["integration_time", "light_level", "none"] | None,
        typer.Option(help="quantity on the x axis of H; none: no charge rate [default: integration_time]"),
    ] = None,
    level: Annotated[
        str | None, typer.Option(help="light level of each run in any unit, such as 0,1,2.4: H against it")
    ] = None,
    strict: Strict = False,
    *,
    command: Command,
) -> None:
    """Fit several exposures of one sensor jointly.

    One gain, bias and read noise per pixel; charge rate from the slope of H. Missing histograms are made.
    """
    from pchem_pipeline.commands.first_screen import run_to_first_screen
    from pchem_pipeline.commands.new_run import find_joint

    target, is_new = find_joint(targets, bias or [], store, against, _listed(level or "", "--level"))
    stages = pipeline_of(target.config)
    run_to_first_screen(target, stages, command, typer.echo, is_new=is_new, strict=strict)


@_command("Run")
@takes_command(without=("roi",))
def discrepancy(
    target: Target,
    refit: Annotated[
        bool,
        typer.Option(
            "--refit/--no-refit",
            help="add named effects to the model and run fit, maps, ensemble and report again",
        ),
    ] = True,
    roi: Annotated[
        str | None, typer.Option(help="search only in the pixels y0:y1,x0:x1 [default: all, or a window]")
    ] = None,
    effort: Annotated[
        float | None, typer.Option(help="factor on the search budget [default: discrepancy.effort]")
    ] = None,
    *,
    command: Command,
) -> None:
    """Search for effects missing from the model.

    Compares the data with simulations of the fitted model. Effects found make a new version of the model.
    """
    from pchem_pipeline.commands.discrepancy import find_and_add
    from pchem_pipeline.run.target import find_run

    command = replace(command, roi=region_of(roi))
    text = find_and_add(find_run(target), command, refit=refit, effort=effort)
    if text:
        say(text)


@_command("Look at results")
def status(
    target: Target,
    watch: Annotated[bool, typer.Option("--watch", help="update until the running command ends")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object per line")] = False,
) -> None:
    """Print the state of each stage, and why it is stale."""
    from pchem_pipeline.commands.watch import watch as follow
    from pchem_pipeline.run.target import find_run

    terminal = sys.stdout.isatty()
    write = typer.echo if as_json else say
    follow(find_run(target), write, follow=watch, as_json=as_json, terminal=terminal)


@_command("Look at results")
def info(
    places: Annotated[list[Path] | None, typer.Argument(help="camera files and folders")] = None,
) -> None:
    """List formats and effects, or describe camera files."""
    from pchem_pipeline.commands.info import about_files, about_program

    for line in about_files(places) if places else about_program():
        say(line)


@_command("Look at results")
def model(
    target: Target,
    use: Annotated[int | None, typer.Option(min=1, help="use this version")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="one line of JSON")] = False,
) -> None:
    """List the versions of the model, or go back to one.

    A version comes from the section model of the YAML or from pchem discrepancy.
    """
    from pchem_pipeline.commands.model import model_lines, models_json, use_model
    from pchem_pipeline.run.target import find_run

    run = find_run(target)
    if use is not None:
        say(use_model(run, use))
    elif as_json:
        typer.echo(models_json(run))
    else:
        say("\n".join(model_lines(run)))


@_command("Look at results")
def view(
    target: Target,
    port: Annotated[int, typer.Option(min=0, max=65535, help="port to listen on; 0: any free port")] = 0,
    show: Annotated[bool, typer.Option("--open/--no-open", help="open the browser")] = False,
) -> None:
    """Show the report with every pixel in the browser.

    A server on this computer, which only reads the run. End it with Ctrl-C.
    """
    from pchem_pipeline.commands.view import serve

    def ready(address: str) -> None:
        typer.echo(address)
        if show:
            typer.launch(address)

    serve(target, port, ready)


@_command("Look at results")
@only_reads
def compare(
    runs: Annotated[list[Path], typer.Argument(help="two runs or more; the first is the reference")],
    output: Output = Path("compare"),
    tolerance: Annotated[
        float, typer.Option(help="same frames: relative difference counted as rounding")
    ] = 1e-12,
    label: Annotated[
        list[str] | None,
        typer.Option(
            help="label of a run in the history, such as a setpoint; once per run, in the same order: its "
            "number is the axis [default: dates of the files]"
        ),
    ] = None,
    fdr: Annotated[float, typer.Option(help="false-discovery rate for pixels that changed")] = 0.01,
    limit: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="exit code 3 only for a median that changed by significantly more: bias=0.5 (in the map's "
            "unit), read_noise_e=5%; or for more changed pixels: pixels=10, pixels=1% (repeatable) [default: "
            "section compare of the reference; none there: any significant change]",
        ),
    ] = None,
    *,
    command: Command,
) -> None:
    """Compare runs and write their history.

    Prints what changed since the first run, and in the last since the one before it in the history. Runs on
    the same frames are compared value by value, others in standard errors. Exit code 3: changed.
    """
    from pchem_pipeline.commands.compare.compare import compare_runs

    compare_runs(
        runs,
        output,
        command,
        tolerance=tolerance,
        labels=label or (),
        rate=fdr,
        limits=limit or (),
        write=say,
    )


_command("Look at results")(methods)
_command("Use results")(apply)


@_command("Use results")
@only_reads
def export(
    target: Target,
    output: Output = Path("export"),
    formats: Annotated[
        str,
        typer.Option(
            "--format",
            help="fits, tiff, npz, csv (summary), emva (table of EMVA 1288 quantities), defects (table, DS9 "
            "regions and mask of the pixels that are not ordinary), pyme, navigate, decode, picasso, "
            "smap, banzai, pyxel, getframes",
        ),
    ] = "fits,csv",
    *,
    command: Command,
) -> None:
    """Write maps, tables and files for other programs."""
    from pchem_pipeline.commands.export import export_run

    for path in export_run(target, output, _listed(formats.lower(), "--format"), command.reporter()):
        typer.echo(path)


@_command("Use results")
@only_reads
def figures(
    target: Target,
    output: Output = Path("figures"),
    formats: Annotated[str, typer.Option("--format", help="pdf, svg and png, separated by commas")] = "pdf",
    width: Annotated[
        str | None, typer.Option(help="width such as 88mm, 18cm or 3.5in [default: each figure's own]")
    ] = None,
    only: Annotated[str, typer.Option(help="names of figures, separated by commas [default: all]")] = "",
    dpi: Annotated[
        int, typer.Option(min=72, max=1200, help="resolution of PNG and of maps, dots per inch")
    ] = 600,
    style: Annotated[
        str, typer.Option(help="style sheet of matplotlib (fonts, sizes, lines): a name or a file")
    ] = "",
    *,
    command: Command,
) -> None:
    """Write figures for a paper, with their numbers as CSV."""
    from pchem_pipeline.commands.figures import figures_of_run

    for path in figures_of_run(
        target,
        output,
        command.reporter(),
        formats=_listed(formats, "--format"),
        width=width,
        only=_listed(only, "--only"),
        dpi=dpi,
        style=style,
    ):
        typer.echo(path)


def _listed(text: str, option: str) -> tuple[str, ...]:
    names = tuple(part.strip() for part in text.split(",") if part.strip())
    if text and not names:
        raise ConfigError(f"{option}: {text!r} is no name; separate names by commas")
    return names


_command("Use results")(twin)
_command("Plan")(plan)


def _stage_command(name: str, summary: str) -> None:
    """Add the command of one stage; all stages take the same options."""

    @takes_command()
    def stage(target: Target, *, command: Command) -> None:
        from pchem_pipeline.run.target import find_run
        from pchem_pipeline.runner.session import run_stages

        run_stages(find_run(target), [name], command)

    stage.__doc__ = summary
    _command("Stages of a run", name)(stage)


@_command("Stages of a run")
@takes_command(reads_files=True)
def ingest(
    target: Target,
    append: Annotated[
        bool, typer.Option("--append", help="add new files to a finished run; reads only these")
    ] = False,
    *,
    given: dict[str, Any],
    command: Command,
) -> None:
    """Check the camera files; copy or reference their frames."""
    from pchem_pipeline.run.target import find_run
    from pchem_pipeline.runner.session import cropped, run_stages

    run = find_run(target)
    if append and given:
        raise ConfigError("--append: new files are read like the others; omit the options")
    if append:
        from pchem_pipeline.commands.append import append_frames

        append_frames(run, command)
    else:
        run, command = cropped(run.changed("input", **given) if given else run, command)
        run_stages(run, ["ingest"], command)


for _stage in STAGES.values():
    if _stage.summary:
        _stage_command(_stage.name, _stage.summary)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"pchem {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="print the version")
    ] = False,
) -> None:
    """Characterise deep sub-electron read noise image sensors, pixel by pixel, with PCH-EM."""


def _fail(message: str, code: int) -> NoReturn:
    from pchem_pipeline.base.wording import typeset

    typer.echo(f"pchem: {typeset(' '.join(message.split()))}", err=True)
    begun = any(each.name.startswith("tile") for each in threading.enumerate())
    if begun and code in (ExitCode.SIGINT, ExitCode.SIGTERM):
        os._exit(code)  # nobody waits for what these threads do
    sys.exit(code)


def _not_imported(error: Exception) -> str:
    """Return the name of the library at whose import an error came up; empty for other errors."""
    own, found = __name__.partition(".")[0], ""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        package = frame.f_globals.get("__name__", "").partition(".")[0]
        if package == own:
            found = ""
        elif not found and frame.f_code.co_name == "<module>":
            found = package
    return found


#: Bytes of addresses that the libraries and threads of a small run take: 1.1 GiB on two processors.
_ADDRESSES = 1200 << 20
#: What a full or broken disk answers.
_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; ends the process with the exit codes of :class:`ExitCode`."""
    from pchem_pipeline.compute.environment import keep_standard_streams, prepare_environment

    keep_standard_streams()
    if sys.flags.optimize:
        _fail(
            "Python runs without assertions, which libraries need; unset PYTHONOPTIMIZE or omit -O",
            ExitCode.USAGE,
        )
    if sys.getfilesystemencoding() != "utf-8":  # names of files would be wrong: begin anew
        os.environ["PYTHONUTF8"] = "1"
        os.execv(sys.executable, [sys.executable, "-P", "-m", "pchem_pipeline", *(arguments or sys.argv[1:])])
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if 0 <= limit < _ADDRESSES:
        _fail(f"ulimit -v {limit >> 10}: {_ADDRESSES >> 10} or more are needed; raise it", ExitCode.USAGE)
    prepare_environment()
    os.environ["MPLBACKEND"] = "Agg"  # figures go into files
    warnings.filterwarnings("error", module="numba.core.config")  # it would go on
    call: Any = app
    try:
        call(args=arguments, prog_name="pchem")
    except PchEmError as error:
        _fail(str(error), error.exit_code)
    except OSError as error:
        if error.errno not in _DISK or error.filename is not None:
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # the rest of the results goes nowhere
        _fail(f"cannot write to stdout ({error.strerror}); check where it goes", ExitCode.INPUT)
    except MemoryError:
        _fail("out of memory; use fewer --workers or --max-memory", ExitCode.INTERNAL)
    except KeyboardInterrupt:
        _fail(
            "stopped by SIGINT; finished tiles are kept, run the same command again to continue",
            ExitCode.SIGINT,
        )
    except Exception as error:
        if not (library := _not_imported(error)):
            raise
        reason = str(error).partition("\nThe parse failed")[0]
        _fail(
            f"{library} cannot be imported ({reason}); correct the configuration file or the variable of the "
            "environment that it reads, or install it again",
            ExitCode.USAGE,
        )


if __name__ == "__main__":
    main()
