"""What can go wrong for the whole run, each kind with the exit code that the shell sees.

A message is one line that says what happened, where, and the cure. A single bad
pixel is never an exception: it gets a word in ``fit_status``.
"""

from __future__ import annotations

import shlex
from enum import IntEnum
from pathlib import Path

__all__ = [
    "ChangedError",
    "ConfigError",
    "ExitCode",
    "IncompleteRunError",
    "InputError",
    "LockedError",
    "MissingDependencyError",
    "NotBelievedError",
    "PchEmError",
    "StoreError",
    "quoted",
]


def quoted(path: Path) -> str:
    """Return a path as it must be typed in a command that a message recommends."""
    return shlex.quote(str(path))


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


class ConfigError(PchEmError):
    """A setting or an option is wrong, unknown, or contradicts another."""

    exit_code = ExitCode.USAGE


class MissingDependencyError(ConfigError):
    """An optional library is needed that is not installed."""


class IncompleteRunError(PchEmError):
    """The run ended with failed tiles, or with more failed pixels than allowed."""

    exit_code = ExitCode.INCOMPLETE


class NotBelievedError(PchEmError):
    """With ``--strict``: the report says that the results cannot be believed as they are."""

    exit_code = ExitCode.INCOMPLETE


class ChangedError(PchEmError):
    """A comparison of runs found that something changed."""

    exit_code = ExitCode.INCOMPLETE


class InputError(PchEmError):
    """The camera files are missing, unreadable, truncated or of the wrong kind."""

    exit_code = ExitCode.INPUT


class StoreError(PchEmError):
    """The run's store is missing, damaged, unwritable, or of another schema version."""

    exit_code = ExitCode.INPUT


class LockedError(PchEmError):
    """Another process is working on the same run."""

    exit_code = ExitCode.LOCKED
