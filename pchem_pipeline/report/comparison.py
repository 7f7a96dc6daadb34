"""What a comparison of runs is made of: plain numbers and arrays, no store."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

from pchem_pipeline.base.arrays import Arrays
from pchem_pipeline.model.checks.run_differences import MapDifference, Reasons

#: How an array of two runs compares: to the bit; within rounding; not; absent in one of them.
State = Literal["identical", "equal", "changed", "lost", "new"]


@dataclass(frozen=True)
class RunFacts:
    """One run; its summary has median, standard error and robust scatter of each map, in the map's unit."""

    label: str  # A, B, ...
    name: str
    shape: tuple[int, int]
    n_frames: int | None
    digest: str  # of the content of its input files
    summary: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    ensemble: Arrays = field(default_factory=dict)
    rmse: Mapping[str, float] = field(default_factory=dict)  # of the predictions of the ensemble
    pixels: tuple[int, int, int] = (0, 0, 0)  # with a good fit, with caution, without a value
    identity: str = ""  # digest of its frames and of how they were characterised

    @property
    def title(self) -> str:
        """Label and name."""
        return f"{self.label} ({self.name})"


@dataclass(frozen=True)
class ArrayRow:
    """One array of the store in two runs."""

    name: str  # its path in the store
    state: State
    counts: bool  # whether a change of it is a change of the results
    dtype: str  # of the first run, of the second where it is new
    shape: tuple[int, ...]  # the same
    n_values: int = 0
    n_different: int = 0  # values that differ at all
    n_beyond: int = 0  # values that differ by more than rounding
    largest: float = 0.0  # largest absolute difference, in the array's unit
    scale: float = 0.0  # largest absolute value
    sha256: tuple[str, str] = ("", "")  # digests of the values of both, empty where there are none
    why: str = ""  # in words, where shapes or types differ


@dataclass(frozen=True)
class Setting:
    """A setting or a version that differs: its name, both values in words, and the stages that read it."""

    name: str
    one: str
    other: str
    stages: tuple[str, ...] = ()


@dataclass(frozen=True)
class DefectChange:
    """A pixel whose kinds of defects differ: its place, and their names in one run and in the other."""

    y: int
    x: int
    before: str
    now: str


@dataclass(frozen=True)
class Pair:
    """A run compared with the first one, or with the one before it in the history."""

    one: RunFacts
    other: RunFacts
    since: Literal["reference", "last run"]  # what the first of them is to the second
    same_data: bool  # both come from the same frames
    arrays: Sequence[ArrayRow] = ()  # every array of the results; empty where the frames differ
    maps: Mapping[str, MapDifference] = field(default_factory=dict)  # empty where the shapes differ
    reasons: Mapping[str, Reasons] = field(default_factory=dict)  # map to why it changed
    transitions: Sequence[Sequence[int]] = ()  # pixels by the quality of one and of the other
    settings: Sequence[Setting] = ()  # those that differ
    versions: Sequence[Setting] = ()  # of programs and algorithms that differ
    changed: bool = False
    changes: Sequence[str] = ()  # what changed, one sentence each
    defects: Sequence[DefectChange] = ()  # pixels with other defects in the other run
    n_changed: int = 0  # pixels with other defects, or of which a value changed beyond its limit
    n_compared: int = 0  # these, and those with a good fit in both
    limits: Mapping[str, float | str] = field(default_factory=dict)  # of changes; empty: errors

    @property
    def key(self) -> str:
        """Labels of both, for names within a page."""
        return f"{self.other.label}-{self.one.label}"


#: A line of ``history.csv``: heading to text.
HistoryRow = Mapping[str, str]


@dataclass(frozen=True)
class Comparison:
    """Runs against the first of them."""

    runs: Sequence[RunFacts]  # the first, the others as given, and the one before the last in the history
    pairs: Sequence[Pair]  # the first with each of the others, and the one before the last with the last
    tolerance: float  # relative difference that counts as rounding
    history: Sequence[HistoryRow] = ()  # of all runs that were ever compared with the first, a row for each
    rate: float = 0.01  # false-discovery rate at which pixels count as moved

    @property
    def changed(self) -> bool:
        """Whether anything changed in any of them."""
        return any(pair.changed for pair in self.pairs)


def by_change(changes: Sequence[DefectChange]) -> dict[str, list[DefectChange]]:
    """Return the pixels with new defects, without those that they had, and with others."""
    return {
        "new": [each for each in changes if not each.before],
        "gone": [each for each in changes if not each.now],
        "of another kind": [each for each in changes if each.before and each.now],
    }
