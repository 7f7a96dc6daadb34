"""``discrepancy.json`` as typed values: what is missing or odd in it becomes empty, never an error.

Everything that shows a verdict, page and terminal alike, reads it through :func:`findings`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

__all__ = [
    "Candidate",
    "Findings",
    "Gap",
    "Measured",
    "Moved",
    "Place",
    "Pull",
    "Rival",
    "Step",
    "findings",
    "headline",
]

_NAN = float("nan")


@dataclass(frozen=True)
class Measured:
    """A value with its standard error; NaN where either is not known."""

    name: str
    value: float
    stderr: float = _NAN
    unit: str = ""


@dataclass(frozen=True)
class Candidate:
    """One effect, or set of effects, and its held-out score (nats; larger is better)."""

    effect: str
    score: float
    stderr: float
    probability: float
    parameters: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Moved:
    """How far the median of a delivered parameter moved, in its unit and in standard errors of a pixel."""

    name: str
    median: float
    in_stderr: float
    unit: str


@dataclass(frozen=True)
class Rival:
    """Another effect added in the place of the named one, and the gap that it leaves (nats/sample)."""

    effect: str
    gap_after: float
    interval: tuple[float, float] = (_NAN, _NAN)


@dataclass(frozen=True)
class Pull:
    """A statistic before and after the model grew, in standard deviations of chance."""

    statistic: str
    sentence: str
    before: float
    after: float


@dataclass(frozen=True)
class Place:
    """Where model and data disagree: a statistic with what it points to."""

    statistic: str
    sentence: str
    channel: str
    direction: str
    z: float
    p: float
    pixels: tuple[tuple[int, int], ...] = ()
    dn: tuple[float, float] | None = None
    frames: tuple[int, ...] = ()


@dataclass(frozen=True)
class Gap:
    """Distance between data and model, nats per sample, on frames that no fit has seen."""

    before: float = _NAN
    after: float = _NAN
    floor: float = _NAN
    closed_fraction: float = _NAN
    interval_after: tuple[float, float] = (_NAN, _NAN)
    interval_before: tuple[float, float] = (_NAN, _NAN)


@dataclass(frozen=True)
class Step:
    """One round: what was asked, what was named, and what adding it did; ``effect`` is empty if not one."""

    effect: str
    verdict: str
    candidates: tuple[Candidate, ...]
    parameters: tuple[Measured, ...]
    gap: Gap
    families_before: Mapping[str, float]
    families_after: Mapping[str, float]
    runner_up: Rival | None
    placebo: Rival | None
    moved: tuple[Moved, ...]
    separate: Mapping[str, str]
    pulls: tuple[Pull, ...]


@dataclass(frozen=True)
class Findings:
    """The whole verdict; the names are those of ``discrepancy.json``."""

    verdict: str
    sentence: str = ""
    effects: tuple[str, ...] = ()
    steps: tuple[Step, ...] = ()
    gap: Gap = field(default_factory=Gap)
    where: tuple[Place, ...] = ()
    untestable: Mapping[str, str] = field(default_factory=dict)
    unexplained: tuple[Place, ...] = ()
    examined: Mapping[str, Any] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    p_before: float = _NAN
    p_after: float = _NAN
    replicates: int = 0
    versions: Mapping[str, str] = field(default_factory=dict)

    @property
    def origin(self) -> tuple[int, int]:
        """First row and column of the part of the sensor that was looked at."""
        firsts = []
        for axis in ("rows", "columns"):
            ends = _integers(_list(self.examined.get(axis)))
            firsts.append(max(ends[0], 0) if ends else 0)
        return firsts[0], firsts[1]

    def added(self, step: Step) -> str:
        """Return what a step added to the model for its gap: an effect, or the likeliest of several."""
        if step.effect:
            return step.effect
        rivals = list(dict.fromkeys(c.effect for c in step.candidates))[:3]
        if not rivals or self.verdict == "consistent":
            return ""
        return f"nearest: {rivals[0]}" if self.verdict == "unexplained" else " or ".join(rivals)


def findings(result: Mapping[str, Any]) -> Findings:
    """Read ``discrepancy.json``.

    Args:
        result: its content; keys may lack, be null or hold something else.

    Returns:
        The same as typed values, with empty ones for what is not there.
    """
    reasons = _mapping(result.get("untestable_reasons"))
    untestable = [_text(tag) for tag in _list(result.get("untestable"))]
    p_global, replicates = _mapping(result.get("p_global")), _number(result.get("replicates"))
    return Findings(
        verdict=_text(result.get("verdict")) or "unknown",
        sentence=_text(result.get("sentence")),
        effects=tuple(_text(tag) for tag in _list(result.get("effects"))),
        steps=tuple(_step(_mapping(step)) for step in _list(result.get("steps"))),
        gap=_gap(_mapping(result.get("gap"))),
        where=_places(result.get("where")),
        untestable={tag: _text(reasons.get(tag)) for tag in untestable},
        unexplained=_places(result.get("unexplained")),
        examined=_mapping(result.get("examined")),
        left_out=_texts(result.get("left_out")),
        p_before=_number(p_global.get("before")),
        p_after=_number(p_global.get("after")),
        replicates=int(replicates) if math.isfinite(replicates) else 0,
        versions=_texts(result.get("versions")),
    )


def headline(found: Findings) -> str:
    """Return the verdict in one sentence: its own, or one made of what is known."""
    if found.sentence:
        return found.sentence
    if found.verdict == "consistent":
        return "The data agree with the model within chance."
    if found.verdict == "named":
        return f"The data disagree with the plain model, and {' and '.join(found.effects)} explains it."
    if found.verdict == "ambiguous":
        rivals = list(dict.fromkeys(c.effect for step in found.steps[-1:] for c in step.candidates))
        return f"The data disagree with the model; they cannot tell which it is of {', '.join(rivals)}."
    if found.verdict == "unexplained":
        return "The data disagree with the model, and no effect of the library explains how."
    return "No verdict was reached."


def _step(step: Mapping[str, Any]) -> Step:
    families = _mapping(step.get("families"))
    return Step(
        effect=_text(step.get("effect")),
        verdict=_text(step.get("verdict")),
        candidates=tuple(
            Candidate(
                _text(each.get("effect")),
                _number(each.get("score")),
                _number(each.get("stderr")),
                _number(each.get("probability")),
                tuple((str(k), _value_text(v)) for k, v in _mapping(each.get("parameters")).items()),
            )
            for each in map(_mapping, _list(step.get("candidates")))
        ),
        parameters=tuple(
            Measured(
                str(name), _number(each.get("value")), _number(each.get("stderr")), _text(each.get("unit"))
            )
            for name, each in _pairs(step.get("parameters"))
        ),
        gap=Gap(
            _number(step.get("gap_before")),
            _number(step.get("gap_after")),
            _number(step.get("gap_floor")),
            interval_after=_interval(step.get("gap_interval_after")),
        ),
        families_before=_numbers(families.get("before")),
        families_after=_numbers(families.get("after")),
        runner_up=_rival(step.get("runner_up")),
        placebo=_rival(step.get("placebo")),
        moved=tuple(
            Moved(
                str(name),
                _number(each.get("median")),
                _number(each.get("in_stderr")),
                _text(each.get("unit")),
            )
            for name, each in _pairs(step.get("moved"))
        ),
        separate=_texts(step.get("separate")),
        pulls=tuple(
            Pull(
                _text(each.get("statistic")),
                _text(each.get("sentence")),
                _number(each.get("before")),
                _number(each.get("after")),
            )
            for each in map(_mapping, _list(step.get("pulls")))
        ),
    )


def _gap(gap: Mapping[str, Any]) -> Gap:
    before, after, floor, closed = (
        _number(gap.get(key)) for key in ("before", "after", "floor", "closed_fraction")
    )
    intervals = _interval(gap.get("interval_after")), _interval(gap.get("interval_before"))
    return Gap(before, after, floor, closed, *intervals)


def _rival(value: Any) -> Rival | None:
    rival = _mapping(value)
    if not _text(rival.get("effect")):
        return None
    return Rival(_text(rival["effect"]), _number(rival.get("gap_after")), _interval(rival.get("interval")))


def _places(value: Any) -> tuple[Place, ...]:
    found = []
    for each in map(_mapping, _list(value)):
        pixels = [_list(pixel) for pixel in _list(each.get("pixels"))]
        dn = _interval(each.get("dn"))
        found.append(
            Place(
                _text(each.get("statistic")),
                _text(each.get("sentence")),
                _text(each.get("channel")),
                _text(each.get("direction")),
                _number(each.get("z")),
                _number(each.get("p")),
                tuple((y, x) for pixel in pixels if len(pixel) == 2 for y, x in [_integers(pixel)] if y >= 0),
                dn if math.isfinite(dn[0]) else None,
                tuple(f for f in _integers(_list(each.get("frames"))) if f >= 0),
            )
        )
    return tuple(found)


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return _NAN
    return float(value) if math.isfinite(value) else _NAN


def _integers(values: list[Any]) -> list[int]:
    """Return whole numbers, -1 in the place of anything else."""
    return [-1 if math.isnan(_number(value)) else int(value) for value in values]


def _text(value: Any) -> str:
    return "" if value is None or isinstance(value, list | dict) else str(value)


def _value_text(value: Any) -> str:
    number = _number(_mapping(value).get("value")) if isinstance(value, Mapping) else _number(value)
    return f"{number:.4g}" if math.isfinite(number) else _text(value)


def _list(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list | tuple) else []


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _pairs(value: Any) -> list[tuple[str, Mapping[str, Any]]]:
    """Return the entries of a mapping of mappings; a bare number counts as its ``value``."""
    return [
        (name, each if isinstance(each, Mapping) else {"value": each})
        for name, each in _mapping(value).items()
    ]


def _numbers(value: Any) -> dict[str, float]:
    return {str(name): _number(each) for name, each in _mapping(value).items()}


def _texts(value: Any) -> dict[str, str]:
    return {str(name): _text(each) for name, each in _mapping(value).items()}


def _interval(value: Any) -> tuple[float, float]:
    ends = [_number(end) for end in _list(value)]
    return (ends[0], ends[1]) if len(ends) == 2 else (_NAN, _NAN)
