"""What can go wrong for the whole run, each kind with the exit code that the shell sees.

A message is one line that says what happened, where, and the cure. A single bad pixel is never an exception:
it gets a word in ``fit_status``.
"""

from __future__ import annotations

import importlib
import shlex
from enum import IntEnum
from pathlib import Path

#: Extra to the libraries that it installs, as ``pyproject.toml`` has them.
EXTRAS = {
    "fits": ("astropy>=6.1",),
    "hdf5": ("h5py>=3.11", "hdf5plugin>=5.0"),
    "sif": ("sif-parser>=0.3.5",),
    "nd2": ("nd2>=0.10",),
    "cluster": ("distributed>=2025.1",),
    "s3": ("s3fs>=2025.2",),
    "notebook": ("xarray>=2024.9",),
}


def install_hint(extra: str) -> str:
    """Return the command that installs the libraries of an extra, wherever this package came from."""
    return f"pip install {' '.join(shlex.quote(library) for library in EXTRAS[extra])}"


#: characters of a message
_LONGEST = 4000


def quoted(path: Path) -> str:
    """Return a path as it must be typed in a command that a message recommends."""
    return shlex.quote(str(path))


def one_line(text: str) -> str:
    """Return a text as one line that a terminal can show: control characters escaped, not above 4,000 long.

    Of a longer one the beginning (what and where) and the end (the cure) stay.
    """
    line = " ".join(text.split())
    if not line.isprintable():
        line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in line)
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST // 2]} ... {line[-_LONGEST // 2 :]}"


class ExitCode(IntEnum):
    """Exit codes of the ``pchem`` command."""

    OK = 0
    INTERNAL = 1
    USAGE = 2
    INCOMPLETE = 3
    INPUT = 4
    LOCKED = 75
    SIGINT = 130
    SIGTERM = 143


class PchEmError(Exception):
    """Base of all errors of this package; ``str(error)`` is one line for the user."""

    exit_code: ExitCode = ExitCode.INTERNAL

    def __str__(self) -> str:
        """Return the message as one line, whatever a file name or a library's words bring along."""
        return one_line(str(self.args[0])) if self.args else ""


def error_words(error: BaseException) -> str:
    """Return an error in one line: ours as it is, of settings the first complaint, others with their kind."""
    from pydantic_core import ValidationError  # a tenth of the start of the program

    if isinstance(error, ValidationError):
        first = error.errors()[0]
        words = first["msg"].removeprefix("Value error, ")
        return one_line(f"{'.'.join(map(str, first['loc']))}: {words}".removeprefix(": "))
    return str(error) if isinstance(error, PchEmError) else one_line(f"{type(error).__name__}: {error}")


class ConfigError(PchEmError):
    """A setting or an option is wrong, unknown, or contradicts another."""

    exit_code = ExitCode.USAGE


class MissingDependencyError(ConfigError):
    """An optional library is needed that is not installed."""


class IncompleteRunError(PchEmError):
    """The run ended with failed tiles, or with more failed pixels than allowed."""

    exit_code = ExitCode.INCOMPLETE


class NotBelievedError(PchEmError):
    """With ``--strict``: the results are not reliable."""

    exit_code = ExitCode.INCOMPLETE


class ChangedError(PchEmError):
    """A comparison of runs found that something changed."""

    exit_code = ExitCode.INCOMPLETE


def require(module: str, extra: str, what: str) -> None:
    """Check that an optional library can be imported.

    Raises:
        MissingDependencyError: it cannot; the message names the libraries to install.
    """
    try:
        importlib.import_module(module)
    except ImportError as error:
        raise MissingDependencyError(f"{what}: {module} is needed; {install_hint(extra)}") from error


class InputError(PchEmError):
    """The camera files are missing, unreadable, truncated or of the wrong kind."""

    exit_code = ExitCode.INPUT


def unreadable(path: Path, error: OSError) -> InputError:
    """Return the error for a file that the file system does not give."""
    return InputError(
        f"{path}: cannot be read ({error.strerror or error}); check the path and its permissions"
    )


class StoreError(PchEmError):
    """The run's store is missing, damaged, unwritable, or of another schema version."""

    exit_code = ExitCode.INPUT


class LockedError(PchEmError):
    """Another process is working on the same run."""

    exit_code = ExitCode.LOCKED
