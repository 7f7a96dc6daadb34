"""The options that the commands of a run have in common."""

from __future__ import annotations

import functools
import inspect
import re
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from pchem_pipeline.base.errors import ConfigError


def on_this_machine(path: Path | None) -> Path | None:
    """Return a path that a command writes to, as typer's callback; a URL or a pipe is refused."""
    from pchem_pipeline.store.remote_path import local_path

    if path is None:
        return None
    path = local_path(path)
    if Path.is_fifo(path) or Path.is_socket(path):
        raise ConfigError(f"{path} is not a regular file; choose another name")
    return path


#: An option below the heading that all commands of a run have.
_common = functools.partial(typer.Option, rich_help_panel="Common options")

Target = Annotated[Path, typer.Argument(help="a config.yaml, or the store of a run (run.zarr)")]
Output = Annotated[Path, typer.Option("--output", "-o", help="folder to write to", callback=on_this_machine)]
Strict = Annotated[bool, typer.Option("--strict", help="exit code 3 if the results are not reliable")]


def _common_options(
    *,
    force: Annotated[bool, _common("--force", help="run again even if up to date")] = False,
    dry_run: Annotated[bool, _common("--dry-run", help="print what would be done; write nothing")] = False,
    roi: Annotated[
        str | None,
        _common(
            help="region y0:y1,x0:x1 in pixels; ingest and run FILES crop to it, other commands process "
            "only its tiles"
        ),
    ] = None,
    workers: Annotated[
        int | None, _common(min=1, help="number of workers [default: compute.workers]")
    ] = None,
    backend: Annotated[
        Literal["serial", "threads", "processes", "distributed"] | None,
        _common(help="where the workers run [default: compute.backend]"),
    ] = None,
    max_memory: Annotated[
        int | None, _common(help="memory limit, MiB, at least 300 [default: compute.max_memory]")
    ] = None,
    log_json: Annotated[
        Path | None, _common(help="append events as JSON lines to this file", callback=on_this_machine)
    ] = None,
    progress: Annotated[
        Literal["auto", "on", "off"], _common(help="progress bars; auto: only on a terminal")
    ] = "auto",
    quiet: Annotated[bool, _common("--quiet", "-q", help="warnings and errors only")] = False,
) -> None:
    """Declare the common options, in the order of ``--help``; it is never called."""


_COMMON = inspect.signature(_common_options, eval_str=True).parameters
#: Settings of the section ``input`` that have an option: name, type, help.
_INPUT: tuple[tuple[str, Any, str], ...] = (
    ("integration_time", float, "integration time per frame, s"),
    ("bit_depth", int, "bits of the ADC"),
    ("bit_shift", int, "bits to shift right (left-justified samples)"),
    (
        "dtype",
        Literal["uint8", "uint16", "uint32"],
        "raw: sample type; other formats: unsigned type for signed samples",
    ),
    ("offset", int, "DN to add to signed samples, such as 32768"),
    ("byte_order", Literal["little", "big"], "raw and SER: byte order"),
    ("frames", str, "range of frames first:end, end excluded, such as 5: or :1000"),
    ("mask", Path, "image (npy, TIFF, FITS): pixels other than 0 are excluded"),
    ("dataset", str, "dataset of an HDF5, zarr or FITS file"),
    (
        "kind",
        Literal["dark", "light", "unknown"],
        "source of the charge; only with dark the charge rate is a dark current",
    ),
    ("mode", Literal["copy", "reference"], "copy frames into the store, or leave them in their files"),
)


def takes_command(
    *, without: tuple[str, ...] = (), reads_files: bool = False
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorate a command of a run: it takes the common options, too, as one argument ``command``.

    Common options ``without`` which it goes, or which it words differently, are left out. A command that
    ``reads_files`` also takes the options of camera files, as one argument ``given``.
    """
    keyword = inspect.Parameter.KEYWORD_ONLY
    common = [option for name, option in _COMMON.items() if name not in without]
    of_input = [
        inspect.Parameter(
            name,
            keyword,
            default=None,
            annotation=Annotated[kind | None, typer.Option(help=words, rich_help_panel="Camera files")],
        )
        for name, kind, words in (_INPUT if reads_files else ())
    ]

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(function)
        def wrapper(**given: Any) -> None:
            from pchem_pipeline.run.stage import Command

            options = {each.name: given.pop(each.name) for each in common}
            if reads_files:
                given["given"] = _settings_of_input({each.name: given.pop(each.name) for each in of_input})
            command = Command(**{**options, "roi": region_of(options.get("roi"))})
            function(**given, command=command)

        hints = typing.get_type_hints(function, localns={"Command": object}, include_extras=True)
        own = [
            parameter.replace(annotation=hints[name], kind=keyword)
            for name, parameter in inspect.signature(function).parameters.items()
            if name not in ("command", "given")
        ]
        options = [*own, *of_input, *common]
        signature: Any = wrapper
        signature.__signature__ = inspect.Signature(options)
        wrapper.__annotations__ = {each.name: each.annotation for each in options}
        del signature.__wrapped__  # or the signature of the function itself would be read
        return wrapper

    return decorate


#: Of a command that only reads runs: the options of what it says.
only_reads = takes_command(without=("force", "dry_run", "roi", "workers", "backend", "max_memory"))


def _settings_of_input(options: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of the section ``input`` that options state."""
    given = {name: value for name, value in options.items() if value is not None}
    if (text := given.pop("frames", None)) is not None:
        found = re.fullmatch(r"(\d{0,18}):(\d{0,18})", text)
        if found is None:
            raise ConfigError(f"--frames {text!r}: write first:end, end excluded, such as 5: or 5:1000")
        given["frame_range"] = int(found[1] or 0), int(found[2]) if found[2] else None
    if "mask" in given:
        given["mask"] = str(given["mask"].absolute())
    return given


def region_of(text: str | None) -> tuple[int, int, int, int] | None:
    """Return the region of ``--roi``; raise ConfigError unless it is written as y0:y1,x0:x1."""
    if text is None:
        return None
    try:
        (y0, y1), (x0, x1) = (map(int, part.split(":")) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"--roi {text!r}: write y0:y1,x0:x1 in pixels, such as 0:128,64:192") from None
    for name, first, end in (("y", y0, y1), ("x", x0, x1)):
        if not 0 <= first < end:
            raise ConfigError(
                f"--roi {text}: {name} from {first} to {end} contains no pixel; write y0:y1,x0:x1 with 0 <= "
                "y0 < y1 and 0 <= x0 < x1, ends excluded, such as 0:128,64:192"
            )
    return y0, y1, x0, x1


def say(text: str) -> None:
    """Print sentences with the signs of a page: ``e⁻``, ``→``."""
    from pchem_pipeline.base.wording import typeset

    typer.echo(typeset(text))
