"""The cases of the study of the discrepancy workflow, in an order of which every beginning is balanced."""

from __future__ import annotations

import hashlib
import itertools
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

MAKE = Path(__file__).resolve().parents[2] / "tests" / "hidden" / "make.py"
EFFECTS = (
    "rts_noise", "bias_drift", "bias_jumps", "frame_noise", "row_noise", "column_noise",
    "periodic_pickup", "readout_alternation", "flicker_noise", "heavy_tailed_noise", "noise_skew",
    "signal_dependent_noise", "nonlinearity", "gain_drift", "adc_dnl", "adc_inl", "clipping",
    "interpixel_capacitance", "analog_memory", "exposure_drift", "persistence", "dark_current_rts",
    "exposure_flicker", "overdispersed_counts", "branching_counts", "optical_crosstalk", "cosmic_rays",
    "repeated_frames", "pixel_correction", "bit_errors",
    "binary_offset", "repeated_lines", "gain_stitch", "black_clamp", "glow", "read_order_noise",
    "misplaced_lines", "trapping",
)  # fmt: skip
UNTESTABLE = ("charge_lag", "charge_diffusion", "spurious_charge")
OUTSIDE = ("self_trigger_cut", "output_crosstalk", "checkerboard_offset")
#: left out of the library on purpose; those of ``SEALED`` are for the last look, when nothing changes
TRIED = (
    "temporal_filter", "row_gain", "row_droop", "distant_crosstalk", "settling_rows", "tap_gain",
    "afterpulses", "dead_time", "repelled_charge", "hysteresis", "noisy_frames", "block_mean",
)  # fmt: skip
SEALED = (
    "mains_gain", "blended_frames", "bursting_block", "row_tilt", "noisy_time",
    "empty_samples", "negative_ghost", *OUTSIDE,
)  # fmt: skip
#: what has a name since effects may act in a part: column noise in a few columns
NAMED_SINCE = ("loud_column",)
#: effects that a stationary stack hardly tells apart: the one for the other is no invention
TWINS = (
    ("overdispersed_counts", "branching_counts"),
    ("nonlinearity", "adc_inl"),
    ("gain_stitch", "adc_inl"),  # a kink without a step is a bend
    ("exposure_drift", "persistence"),
)
# the first members come from different planes, the rest are drawn
_PAIRS = (
    ("row_noise", "overdispersed_counts"),
    ("interpixel_capacitance", "row_noise"),
    ("exposure_drift", "bias_drift"),
    ("frame_noise", "exposure_flicker"),
    ("column_noise", "adc_dnl"),
    ("rts_noise", "flicker_noise"),
    ("analog_memory", "readout_alternation"),
    ("signal_dependent_noise", "periodic_pickup"),
    ("optical_crosstalk", "dark_current_rts"),
    ("nonlinearity", "clipping"),
    ("cosmic_rays", "noise_skew"),
    ("repeated_frames", "bias_jumps"),
    ("gain_drift", "branching_counts"),
    ("heavy_tailed_noise", "adc_inl"),
)


@dataclass(frozen=True)
class Case:
    """One stack with something hidden, and how to look at it.

    Attributes:
        kind: single, null, untestable, outside, decoy, sealed, pair, left_out, placed (in a part of the
            sensor or run) or range (nothing hidden, a sensor of the whole range).
        hidden: tags.
        level: times the strength that is found in 95 % of stacks.
        index: number of the repetition.
        shape: rows, columns and frames.
        exclude: candidates that the workflow goes without.
        place: of what is placed: "rows", "columns" or "frames", first and end; None: everywhere.
    """

    kind: str
    hidden: tuple[str, ...]
    level: float
    index: int
    shape: tuple[int, int, int]
    exclude: tuple[str, ...] = ()
    place: tuple[str, int, int] | None = None

    @property
    def key(self) -> str:
        """Its name in the results."""
        size = "x".join(map(str, self.shape))
        return f"{self.kind}/{'+'.join(self.hidden) or '-'}/{self.level:g}/{self.index}/{size}"

    @property
    def seed(self) -> int:
        """Of its sensor, its sub-parameters and its noise."""
        name = f"{self.kind}/{self.hidden}/{self.level}/{self.index}"
        return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=4).digest(), "little")

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON data."""
        return asdict(self) | {"key": self.key, "seed": self.seed}


@dataclass(frozen=True)
class Plan:
    """How many of what.

    Attributes:
        effects: to hide alone and to leave out.
        levels: strengths of single effects.
        seeds: repetitions of each single effect at each level, from ``first`` on.
        first: number of the first repetition; another one makes a fresh study.
        nulls: stacks with nothing hidden.
        pairs: stacks with two effects at level 4.
        triples: stacks with three.
        leave_out: repetitions of each effect, at level 4, that is not among the candidates.
        others: repetitions of each untestable effect and of each outside the library.
        decoys, sealed: repetitions of each decoy of either half.
        shape: rows, columns and frames.
    """

    effects: Sequence[str]
    levels: Sequence[float]
    seeds: int
    first: int
    nulls: int
    pairs: int
    triples: int
    leave_out: int
    others: int
    decoys: int
    sealed: int
    shape: tuple[int, int, int]

    def cases(self) -> list[Case]:
        """Return all cases; of each kind and level, every beginning holds its fair part."""

        def again(count: int) -> range:
            return range(self.first, self.first + count)

        groups = [
            [
                Case("single", (e,), level, i, self.shape)
                for i in again(self.seeds)
                for e in self._shuffled(i, level)
            ]
            for level in self.levels
        ]
        groups.append([Case("null", (), 0.0, i, self.shape) for i in again(self.nulls)])
        for size, count in ((2, self.pairs), (3, self.triples)):
            sets = self._several(size, count)
            groups.append([Case("pair", tags, 4.0, self.first, self.shape) for tags in sets])
        left_out = [(i, e) for i in again(self.leave_out) for e in self._shuffled(i, -1.0)]
        groups.append([Case("left_out", (e,), 4.0, i, self.shape, (e,)) for i, e in left_out])
        for kind, tags, levels, count in (
            ("untestable", UNTESTABLE, (4.0,), self.others),
            ("outside", OUTSIDE, (4.0,), self.others),
            ("decoy", TRIED, self.levels, self.decoys),
            ("sealed", SEALED, self.levels, self.sealed),
        ):
            for level in levels:
                groups.append([Case(kind, (e,), level, i, self.shape) for i in again(count) for e in tags])
        placed = [
            ((i + 0.5) / len(group), n, case)
            for n, group in enumerate(groups)
            for i, case in enumerate(group)
        ]
        return [case for _, _, case in sorted(placed, key=lambda item: item[:2])]

    def _shuffled(self, index: int, level: float) -> list[str]:
        return sorted(self.effects, key=lambda tag: _digest(f"{tag}/{index}/{level}"))

    def _several(self, size: int, count: int) -> list[tuple[str, ...]]:
        chosen = [] if size > 2 else [p for p in _PAIRS if set(p) <= set(self.effects)]
        number = self.first
        while len(chosen) < count and len(self.effects) >= size:
            ranked = sorted(self.effects, key=lambda tag: _digest(f"{tag}/{size}/{number}"))
            # twins together are not two effects that anyone could tell from one
            if not _has_twins(ranked[:size]) and tuple(ranked[:size]) not in chosen:
                chosen.append(tuple(ranked[:size]))
            number += 1
            if number > self.first + 100 * (count + 1):
                break
        return chosen[:count]


#: effects that can be in a part of the sensor, and of the run
_OF_REGIONS = ("row_noise", "frame_noise", "heavy_tailed_noise", "signal_dependent_noise", "rts_noise",
               "exposure_flicker", "overdispersed_counts", "noise_skew")  # fmt: skip
_OF_FRAMES = ("row_noise", "frame_noise", "heavy_tailed_noise", "exposure_flicker")


def table_cases(first: int, shape: tuple[int, int, int], *, sealed: bool) -> Iterator[Case]:
    """Yield stacks without end, one for each row of the table in turn, so that every beginning is balanced.

    Args:
        first: number of the first round; another one is another table.
        shape: rows, columns and frames of all but the null range.
        sealed: take the decoys from the sealed half.
    """
    for i in itertools.count(first):
        share = [byte / 256.0 for byte in _digest(f"table/{i}")]
        strong = round(4.0 * 7.5 ** share[0], 1)
        yield Case("range", (), 0.0, i, shape)
        yield Case("single", (_one_of(EFFECTS, f"single/{i}"),), strong, i, shape)
        yield _placed(i, shape, round(12.0 * 2.5 ** share[1], 1))
        yield Case("pair", _together(i), strong, i, shape)
        decoys = SEALED if sealed else TRIED
        yield Case("sealed" if sealed else "decoy", (_one_of(decoys, f"decoy/{i}"),), strong, i, shape)


def _placed(index: int, shape: tuple[int, int, int], level: float) -> Case:
    """Return an effect in a tenth of the rows, columns or frames."""
    axis = _one_of(("rows", "columns", "frames"), f"axis/{index}")
    tag = _one_of(_OF_FRAMES if axis == "frames" else _OF_REGIONS, f"placed/{index}")
    size = shape[("rows", "columns", "frames").index(axis)]
    length = max(round(size / 10), 2)
    begin = int.from_bytes(_digest(f"begin/{index}"), "little") % (size - length + 1)
    return Case("placed", (tag,), level, index, shape, place=(axis, begin, begin + length))


def _together(index: int) -> tuple[str, ...]:
    """Return two or three effects, no twins among them."""
    size = 3 if index % 4 == 3 else 2
    for attempt in itertools.count():
        ranked = sorted(EFFECTS, key=lambda tag: _digest(f"{tag}/{index}/{attempt}"))[:size]
        if not _has_twins(ranked):
            return tuple(ranked)
    raise AssertionError


def _has_twins(tags: Sequence[str]) -> bool:
    return any(set(twins) <= set(tags) for twins in TWINS)


def _one_of(tags: Sequence[str], text: str) -> str:
    return tags[int.from_bytes(_digest(text), "little") % len(tags)]


def _digest(text: str) -> bytes:
    return hashlib.blake2b(text.encode(), digest_size=8).digest()


def twins_of(tag: str) -> set[str]:
    """Return the near twins of an effect."""
    return {other for pair in TWINS if tag in pair for other in pair} - {tag}


def remaining(cases: Iterable[Case], done: Iterable[str]) -> list[Case]:
    """Return the cases without a result."""
    finished = set(done)
    return [case for case in cases if case.key not in finished]


def make(
    hidden: tuple[str, ...],
    level: float,
    seed: int,
    shape: tuple[int, int, int],
    out: Path,
    key: Path,
    take: int = 0,
) -> None:
    """Write a stack and its sealed key with the independent chain."""
    command = [sys.executable, str(MAKE), "--effect", ",".join(hidden) or "none", "--level", str(level)]
    command += ["--seed", str(seed), "--out", str(out), "--key", str(key), "--frames", str(shape[2])]
    command += ["--shape", str(shape[0]), str(shape[1]), "--take", str(take)]
    subprocess.run(command, check=True, capture_output=True, text=True, env=os.environ)
