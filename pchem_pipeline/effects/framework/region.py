"""Where on the sensor and when in the run something is: an effect, or a disagreement.

A :class:`Region` is a set of pixels and a :class:`When` a set of frames, both written as a lab would say it:
ranges of rows and columns, readout taps, a quadrant, a list of pixels; ranges of frames, a period, single
frames. Of several conditions all must hold. Ranges are (first, last + 1), counted from 0.

In a YAML either is a mapping or the same in one line, as ``pchem demo --hidden EFFECT@...`` takes it::

    region: {columns: [120, 160]}          region: columns=120:160
    region: {taps: {width: 40, which: 3}}  region: taps=40/3
    region: {taps: {every: 8, which: 5}}   region: every=8/5
    region: {quadrant: top left}           region: quadrant=top-left
    region: {mask: glow.npy}               (bool, the sensor's shape; read once, with the YAML)
    when: {range: [200, 400]}              when: frames=200:400
    when: {every: 10, phase: 3}            when: period=10/3
    when: {single: [7, 99]}                when: frames=7|99
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    model_serializer,
    model_validator,
)

from pchem_pipeline.base.settings import Section
from pchem_pipeline.base.wording import first_few

if TYPE_CHECKING:
    from pchem_pipeline.base.arrays import BoolArray, IntArray

Quadrant = Literal["top left", "top right", "bottom left", "bottom right"]

#: The syntax of a place and a time in one line, for messages.
GRAMMAR = (
    "rows=A:B, columns=A:B|C:D, taps=WIDTH/NUMBER, every=N/PHASE, quadrant=top-left, frames=A:B, "
    "frames=A|B|C, period=N/PHASE, joined by commas (A:B ends before B; columns=40:50 are 40 to 49)"
)
_FEW = 6  # numbers that are listed in words


def _span(value: Any) -> Any:
    """Read ``"3:9"`` and a single number."""
    if isinstance(value, str):
        first, colon, last = value.partition(":")
        value = [int(first), int(last)] if colon else int(first)
    return [value, value + 1] if isinstance(value, int) and not isinstance(value, bool) else value


def _spans(value: Any) -> Any:
    """Read one range or several."""
    if isinstance(value, str):
        return [_span(part) for part in value.split("|")]
    if isinstance(value, int):
        return [_span(value)]
    if isinstance(value, Sequence) and len(value) == 2 and all(isinstance(each, int) for each in value):
        return [value]
    return [_span(each) for each in value] if isinstance(value, Sequence) else value


def _ascending(spans: tuple[tuple[int, int], ...]) -> tuple[tuple[int, int], ...]:
    for first, last in spans:
        if not 0 <= first < last:
            raise ValueError(f"{first}:{last} is no range; give [first, last + 1], counted from 0")
    return tuple(sorted(spans))


#: A range: first and last + 1.
Span = tuple[int, int]
Spans = Annotated[tuple[Span, ...], BeforeValidator(_spans), AfterValidator(_ascending)]
Numbers = Annotated[tuple[int, ...], BeforeValidator(lambda v: (v,) if isinstance(v, int) else v)]


class _Place(Section):
    """A section whose keys that are not given are not written either."""

    @model_serializer(mode="wrap")
    def _given(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return {name: value for name, value in handler(self).items() if value not in (None, (), [])}

    def numbers(self) -> dict[str, Any]:
        """Return it as JSON data, from which ``model_validate`` makes it again."""
        return self.model_dump(mode="json")


class Taps(_Place):
    """Columns (or rows) in groups of ``width``, each read by an amplifier, numbered anew after ``every``.

    Column c belongs to group ``(c - first) // width``, modulo ``every`` where that is given.
    """

    which: Numbers = Field(min_length=1, description="numbers of the groups, counted from 0")
    width: int = Field(default=1, ge=1, description="columns of a group")
    every: int | None = Field(default=None, ge=1, description="groups after which numbering restarts")
    first: int = Field(default=0, description="first column of group 0")
    along: Literal["columns", "rows"] = Field(default="columns", description="what is grouped")

    @model_validator(mode="after")
    def _numbered(self) -> Self:
        most = self.every
        if min(self.which) < 0 or (most is not None and max(self.which) >= most):
            raise ValueError(f"which: there is no group {list(self.which)} of {most or 'them'}; count from 0")
        if most is None and self.width == 1:
            raise ValueError("groups of one column without a period; give width, or every")
        return self

    def describe(self) -> str:
        """Return them in words: ``columns of tap 3 (40 each)``, ``every 8th column from 5``."""
        which = _listed(self.which)
        if self.every is None:
            return f"tap {which} ({self.width} {self.along} each)"
        if self.width == 1:
            return " and ".join(f"every {_nth(self.every)} {self.along[:-1]} from {w}" for w in self.which)
        return f"tap {which} of every {self.every} ({self.width} {self.along} each)"


class Region(_Place):
    """A set of pixels; of several conditions all must hold."""

    rows: Spans = Field(default=(), description="range or ranges of rows")
    columns: Spans = Field(default=(), description="range or ranges of columns")
    taps: Taps | None = Field(default=None, description="readout taps")
    quadrant: Quadrant | None = Field(default=None, description="a quarter of the sensor")
    pixels: tuple[tuple[int, int, int], ...] = Field(
        default=(), description="runs of pixels: row, first column, last column + 1 (also made from a mask)"
    )

    @model_validator(mode="before")
    @classmethod
    def _read(cls, value: Any, info: ValidationInfo) -> Any:
        """Read the grammar of one line, and a mask file (relative to the YAML)."""
        if isinstance(value, str):
            place, when = parse_place(value)
            if place is None or when is not None:
                raise ValueError(f"{value!r} is no place; write {GRAMMAR}")
            return place.numbers()
        if not isinstance(value, Mapping) or value.get("mask") is None:
            return value
        folder = (info.context or {}).get("folder")
        rest = {name: each for name, each in value.items() if name != "mask"}
        if rest.get("pixels"):
            raise ValueError("mask and pixels together; give one of them")
        from pchem_pipeline.effects.framework.pixel_sets import mask_file, runs_of

        return {**rest, "pixels": runs_of(mask_file(Path(folder or ".") / str(value["mask"])))}

    @model_validator(mode="after")
    def _somewhere(self) -> Self:
        if not (self.rows or self.columns or self.taps or self.quadrant or self.pixels):
            raise ValueError(f"no place is given; write {GRAMMAR}; or leave it out for the whole sensor")
        if any(not (row >= 0 and 0 <= first < last) for row, first, last in self.pixels):
            raise ValueError("pixels: each is [row, first column, last column + 1], counted from 0")
        return self

    @classmethod
    def of_mask(cls, mask: BoolArray) -> Region:
        """Return the simplest region of a map of pixels; ConfigError: no pixel, or too many runs of them."""
        from pchem_pipeline.effects.framework.pixel_sets import simplest_region

        return cls.model_validate(simplest_region(mask))

    def mask(self, shape: tuple[int, ...], rows: IntArray | None = None) -> BoolArray:
        """Return its pixels in a sensor, or in some rows of it, (y, x); ConfigError: it reaches beyond."""
        from pchem_pipeline.effects.framework.pixel_sets import region_mask

        return region_mask(self, shape, rows)

    def overlap(self, other: Region, shape: tuple[int, int]) -> float:
        """Return the pixels of both over those of either (Jaccard's index), 0 to 1."""
        from pchem_pipeline.effects.framework.pixel_sets import overlap

        return overlap(self.mask(shape), other.mask(shape))

    def describe(self) -> str:
        """Return it in words: ``rows 3 to 9, columns 120 to 159``."""
        parts = [_range_words("row", self.rows), _range_words("column", self.columns)]
        parts += [self.taps.describe()] if self.taps is not None else []
        parts += [f"the {self.quadrant} quadrant"] if self.quadrant is not None else []
        parts += [_pixel_words(self.pixels)] if self.pixels else []
        return ", ".join(part for part in parts if part)

    def text(self) -> str:
        """Return it in one line, as :func:`parse_place` reads it; as JSON where that has no words for it."""
        taps = self.taps
        wordless = taps is not None and (
            taps.first or taps.along == "rows" or (taps.every is not None and taps.width > 1)
        )
        if self.pixels or wordless:
            return json.dumps(self.numbers(), separators=(",", ":"))
        parts = [f"{name}={_text(spans)}" for name in ("rows", "columns") if (spans := getattr(self, name))]
        if taps is not None:
            which = "|".join(map(str, taps.which))
            parts += [f"taps={taps.width}/{which}" if taps.every is None else f"every={taps.every}/{which}"]
        parts += [f"quadrant={self.quadrant.replace(' ', '-')}"] if self.quadrant is not None else []
        return ",".join(parts)


class When(_Place):
    """A set of frames; of several conditions all must hold."""

    range: Spans = Field(default=(), description="range or ranges of frames")
    every: int | None = Field(default=None, ge=2, description="period, frames")
    phase: int = Field(default=0, ge=0, description="first frame within the period")
    length: int = Field(default=1, ge=1, description="number of successive frames in each period")
    single: Numbers = Field(default=(), description="numbers of single frames")

    @model_validator(mode="before")
    @classmethod
    def _read(cls, value: Any) -> Any:
        """Read the grammar of one line."""
        if not isinstance(value, str):
            return value
        place, when = parse_place(value)
        if when is None or place is not None:
            raise ValueError(f"{value!r} is no time; write {GRAMMAR}")
        return when.numbers()

    @model_validator(mode="after")
    def _sometime(self) -> Self:
        if not (self.range or self.every or self.single):
            raise ValueError(f"no frames are given; write {GRAMMAR}; or leave it out for the whole run")
        if self.every is not None and not max(self.phase, self.length) < self.every:
            raise ValueError(f"phase and length must be below the period of {self.every} frames")
        return self

    @model_serializer(mode="wrap")
    def _given(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        found = {name: value for name, value in handler(self).items() if value not in (None, (), [])}
        if self.every is None:
            del found["phase"], found["length"]
        return found

    def frames(self, numbers: IntArray) -> BoolArray:
        """Return which of these frames are meant, shape of ``numbers``; those before the run never are."""
        from pchem_pipeline.effects.framework.pixel_sets import frames_of

        return frames_of(self, numbers)

    def share(self, numbers: IntArray) -> float:
        """Return the share of these frames that are meant."""
        return float(self.frames(numbers).mean()) if numbers.size else 0.0

    def overlap(self, other: When, n_frames: int) -> float:
        """Return the frames of both over those of either (Jaccard's index), 0 to 1."""
        import numpy as np

        from pchem_pipeline.effects.framework.pixel_sets import overlap

        numbers = np.arange(n_frames)
        return overlap(self.frames(numbers), other.frames(numbers))

    def describe(self) -> str:
        """Return it in words: ``frames 200 to 399``, ``every 10th frame from 3``, ``frames 7 and 99``."""
        parts = [_range_words("frame", self.range)]
        if self.every is not None:
            every = f"every {_nth(self.every)} frame"
            if self.length > 1:
                every = f"{self.length} of every {self.every} frames"
            parts += [f"{every} from {self.phase}"]
        if self.single:
            parts += [f"frame{'s' if len(self.single) > 1 else ''} {_listed(self.single)}"]
        return ", ".join(part for part in parts if part)

    def text(self) -> str:
        """Return it in one line, as :func:`parse_place` reads it."""
        parts = [f"frames={_text(self.range)}"] if self.range else []
        parts += [f"period={self.every}/{self.phase}"] if self.every is not None else []
        parts += [f"frames={'|'.join(map(str, self.single))}"] if self.single else []
        return ",".join(parts)


def parse_place(text: str) -> tuple[Region | None, When | None]:
    """Return place and time of one line, as ``columns=40:50,frames=200:400``; ValueError: another grammar."""
    region: dict[str, Any] = {}
    when: dict[str, Any] = {}
    if text.startswith("{"):  # as :meth:`Region.text` writes what the grammar has no words for
        region, end = json.JSONDecoder().raw_decode(text)
        text = text[end:].removeprefix(",")
    for part in text.split(",") if text or not region else ():
        name, equals, value = (piece.strip() for piece in part.partition("="))
        try:
            if not equals or name not in _KEYS or not value:
                raise ValueError
            into, given = (when if name in ("frames", "period") else region), _KEYS[name](value)
        except ValueError:
            raise ValueError(f"{part.strip()!r} in {text!r} is no place or time; write {GRAMMAR}") from None
        if given.keys() & into.keys():
            raise ValueError(f"{name} is given twice in {text!r}; join ranges: {name}=0:8|16:24")
        into |= given
    return (Region.model_validate(region) if region else None), (When.model_validate(when) if when else None)


def _taps(value: str, name: str) -> dict[str, Any]:
    number, slash, which = value.partition("/")
    if not slash:
        raise ValueError
    return {"taps": {name: int(number), "which": [int(each) for each in which.split("|")]}}


def _frames(value: str) -> dict[str, Any]:
    return {"range": _spans(value)} if ":" in value else {"single": [int(each) for each in value.split("|")]}


def _period(value: str) -> dict[str, Any]:
    every, _, phase = value.partition("/")
    return {"every": int(every), "phase": int(phase or 0)}


_KEYS = {
    "rows": lambda value: {"rows": _spans(value)},
    "columns": lambda value: {"columns": _spans(value)},
    "taps": lambda value: _taps(value, "width"),
    "every": lambda value: _taps(value, "every"),
    "quadrant": lambda value: {"quadrant": value.replace("-", " ")},
    "frames": _frames,
    "period": _period,
}


def _listed(numbers: Sequence[int]) -> str:
    if len(numbers) > _FEW or len(numbers) == 1:
        return first_few(numbers, _FEW)
    return f"{', '.join(map(str, numbers[:-1]))} and {numbers[-1]}"


def _range_words(noun: str, spans: tuple[Span, ...]) -> str:
    if not spans:
        return ""
    one = len(spans) == 1 and spans[0][1] - spans[0][0] == 1
    words = [str(a) if b - a == 1 else f"{a} to {b - 1}" for a, b in spans[:_FEW]]
    more = f" and {len(spans) - _FEW} more" if len(spans) > _FEW else ""
    joined = words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
    return f"{noun}{'' if one else 's'} {joined}{more}"


def _pixel_words(runs: tuple[tuple[int, int, int], ...]) -> str:
    count = sum(last - first for _, first, last in runs)
    if count == 1:
        return f"pixel (row {runs[0][0]}, column {runs[0][1]})"
    rows, first, last = [r for r, _, _ in runs], min(f for _, f, _ in runs), max(b for _, _, b in runs)
    return f"{count:,} pixels of rows {min(rows)} to {max(rows)} and columns {first} to {last - 1}"


def _nth(number: int) -> str:
    ending = "th" if number % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{ending}"


def _text(spans: tuple[Span, ...]) -> str:
    return "|".join(f"{first}:{last}" for first, last in spans)
