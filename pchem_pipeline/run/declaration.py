"""What a stage declares about itself: a row of the table in :mod:`pchem_pipeline.stages.table`.

Rows import nothing that computes: functions are named as ``"module:function"`` and imported when called, by
:func:`pkgutil.resolve_name`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pchem_pipeline.config.tree import RunConfig


@dataclass(frozen=True)
class Stage:
    """A stage of a run.

    Attributes:
        name: what commands, records and messages call it.
        version: of its algorithm; raised when that changes, which makes old results stale.
        upstream: the stages whose results it needs.
        settings: dotted config keys that it reads; a change of any makes its results stale.
        writes: arrays or whole groups of the store (``"fit"`` or ``"fit/bias"``); what it writes is removed
            when it starts anew.
        files: what it writes beside arrays, in the folder of the run, all or some of them; one that is
            missing or was changed makes the stage stale.
        run: ``"module:function"`` that takes the context and does the stage.
        identity: likewise; returns JSON data that joins its fingerprint (the content of the camera files).
        summary: help of its command; empty where the command line gives it options of its own.
        applies: tells from the configuration whether a run has the stage.
        on_demand: done only where it is asked for by name.
        may_write_nothing: it may be complete without the first of what it ``writes``.
        follows: stages that write the files which this one reads as input.
        reads_input: it looks at the camera files, or at the runs of the samples, as they are now.
        single_pass: ``"module:function"`` that takes the context and, where that is possible, does its work
            and that of its upstream stages in one pass over the input; it sets ``context.prepared``.
        plan: ``"module:function"`` that takes (configuration, folder, stages to be done) and returns lines
            which say what the stage will take.
        status_words: array of status words that it writes; too many failed pixels end a command in an error.
    """

    name: str
    version: int
    upstream: tuple[str, ...]
    settings: tuple[str, ...]
    writes: tuple[str, ...]
    run: str
    identity: str | None = None
    files: tuple[str, ...] = ()
    summary: str = ""
    applies: Callable[[RunConfig], bool] = lambda _: True
    on_demand: bool = False
    may_write_nothing: bool = False
    follows: tuple[str, ...] = ()
    reads_input: bool = False
    single_pass: str | None = None
    plan: str | None = None
    status_words: str | None = None
