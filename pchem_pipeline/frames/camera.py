"""What camera files say beside their frames: camera, temperature, date, integration time, bits of the ADC."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from numbers import Integral
from typing import Any, NamedTuple

_LONGEST = 80
_ZERO_CELSIUS = 273.15
#: integration times of cameras, s
SHORTEST, LONGEST = 1e-12, 1e9
#: names that programs give to the facts in attributes, sidecars and JSON records, the usual one first
_NAMES = ("camera", "camera_model", "camera_name")
_SERIALS = ("serial_number", "camera_serial", "serial")
_TEMPERATURES = ("sensor_temperature", "detector_temperature", "temperature")
_TIMES = ("start_time", "acquisition_date", "date")
_DURATIONS = ("integration_time", "exposure_time", "count_time")
_DEPTHS = ("bit_depth", "bit_depth_readout")
_SETUP = ("gain", "gain_setting", "readout_mode", "binning", "image_type")
_UNIT_SUFFIXES = ("_units", "_unit")
#: names of the unit of whatever time there is
TIME_UNIT = re.compile(r"(time|exp\w*?|integration(_?time)?|count_?time)_?units?", re.IGNORECASE)
#: durations whose name says the unit
_DURATIONS_IN = {
    f"{name}_{unit}": unit for name in ("exposure", *_DURATIONS) for unit in ("s", "ms", "us", "ns")
}
#: what differs between dark and illuminated frames of one setting, too
IMAGE_TYPES = ("image_type", "IMAGETYP")
#: All of them.
FACT_NAMES = (
    *(*_NAMES, *_SERIALS, *_TEMPERATURES, *_TIMES, *_DURATIONS, *_DEPTHS, *_DURATIONS_IN, *_SETUP),
    *(name + suffix for name in (*_DURATIONS, *_TEMPERATURES) for suffix in _UNIT_SUFFIXES),
)
#: seconds -> words for the unit; plurals, long ones and ms also count within a sentence
_UNITS = {
    1.0: "s sec secs second seconds",
    1e-3: "ms msec msecs millisec millisecs millisecond milliseconds",
    1e-6: "us usec usecs microsec microsecs microsecond microseconds",
    1e-9: "ns nsec nsecs nanosec nanosecond nanoseconds",
    60.0: "min mins minute minutes",
    3600.0: "h hr hrs hour hours",
    1e3: "ks ksec ksecs kilosec kilosecond kiloseconds",
}
_SECONDS = {word: scale for scale, words in _UNITS.items() for word in words.split()}
_IN_SENTENCES = "|".join(
    word for word in _SECONDS if word == "ms" or (len(word) > 2 and word not in ("min", "second", "hour"))
)
#: where a comment states a unit: in brackets, after "in" (no article), at the end after a comma, or in full
_STATED = re.compile(
    rf"[\[(]\s*([a-z]+)\.?\s*[\])]|\bin\s+(?:units\s+of\s+)?(?!an?\b|th)([a-z]+)|[,:/]\s*({'|'.join(_SECONDS)})\.?\s*$|\b({_IN_SENTENCES})\b",
    re.IGNORECASE,
)
_UNIT = rf"({'|'.join(_SECONDS)})\b"
#: where it states a multiple of a unit, a fraction, a rate, or counts of a clock
_SCALED = re.compile(
    rf"\d\s*/?\s*{_UNIT}|\b{_UNIT}\s*[/*x]\s*\d|\bper\s+{_UNIT}|\b(ticks?|cycles?)\b"
    rf"|(th|half|quarter)s?[\s-]+(of\s+)?(an?\s+)?{_UNIT}",
    re.IGNORECASE,
)
_NAMED_SECONDS = re.compile(r"[a-z]+sec(?:ond)?s?\b", re.IGNORECASE)
_CELSIUS = re.compile(r"(°|º|deg(rees?)?)?[ ._]*(c(el\w*|entigrade)?)?")
_NUMBER_AND_UNIT = re.compile(r"([-+.\d]+(?:e[-+]?\d+)?)\s*(.*)", re.IGNORECASE)


@dataclass(frozen=True)
class CameraFacts:
    """The camera as its files describe it; None where they do not.

    Attributes:
        name: make and model.
        temperature: of the sensor, degrees Celsius.
        taken: when the first frame was taken, s since 1970-01-01 UTC (a time without a zone counts as UTC).
        setup: how the camera was set, by the names that the file has for it (gain, readout mode, binning).
    """

    name: str | None = None
    serial: str | None = None
    temperature: float | None = None
    taken: float | None = None
    setup: Mapping[str, str] = field(default_factory=dict)

    def words(self) -> str:
        """Return all but the time in one line; empty where nothing is known."""
        parts = [self.name, f"serial number {self.serial}" if self.serial else None]
        parts.append(None if self.temperature is None else f"sensor at {self.temperature:.4g} °C")
        parts += [f"{name} {value}" for name, value in self.setup.items()]
        return ", ".join(part for part in parts if part)


def unlike(here: CameraFacts, there: CameraFacts, name: str = "the run") -> str:
    """Return in words how another camera, or another setting of it, took frames; empty: alike or not known.

    Dark and illuminated frames are alike.
    """
    if here.serial and there.serial and here.serial != there.serial:
        return f"serial number {here.serial}, but {name} has {there.serial}"
    for setting, value in here.setup.items():
        other = there.setup.get(setting, value)
        if other != value and setting not in IMAGE_TYPES:
            return f"{setting} = {value}, but {name} has {other}"
    return ""


class Duration(NamedTuple):
    """An integration time, s (None where its unit is in doubt), and how the file states it."""

    seconds: float | None
    words: str


#: What a file says beside its frames: camera, integration time, bits of the ADC; None where it does not.
Stated = tuple[CameraFacts, Duration | None, int | None]


def text_of(value: Any) -> str | None:
    """Return a name as one short line of printable characters; None where there is nothing."""
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    if not isinstance(value, str | int) or isinstance(value, bool):
        return None
    text = "".join(each if each.isprintable() else " " for each in str(value).split("\0")[0])
    return " ".join(text.split())[:_LONGEST] or None


def texts_of(values: Mapping[str, Any], names: Iterable[str]) -> dict[str, str]:
    """Return some of the values as short texts, numbers included, by name."""
    texts = {
        name: f"{value:g}" if isinstance(value, float) else text_of(value)
        for name in names
        if (value := values.get(name)) is not None
    }
    return {name: text for name, text in texts.items() if text}


def celsius(value: Any, unit: Any = "C") -> float | None:
    """Return a temperature in degrees Celsius; None where it is no number, or no temperature of a sensor.

    The unit is kelvin (``K``) or degrees Celsius, which are meant without one; any other also gives None.
    """
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    name = (text_of(unit) or "C").strip("[]()").lower()
    if name == "k" or name.startswith("kelvin"):
        number -= _ZERO_CELSIUS
    elif not _CELSIUS.fullmatch(name):
        return None
    return number if math.isfinite(number) and -_ZERO_CELSIUS <= number <= 150.0 else None


def seconds_of(value: Any) -> float | None:
    """Return an ISO 8601 time (or ``2026:01:31 12:00:00`` of TIFF) as s since 1970-01-01 UTC; else None."""
    text = text_of(value) or ""
    text = re.sub(r"^(\d{4}):(\d\d):(\d\d) ", r"\1-\2-\3 ", text)
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        return None
    seconds = (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
    return seconds if seconds > 0 else None


def duration_of(name: str, value: Any, *units: Any, comment: str = "") -> Duration | None:
    """Return a duration; None where the value is no positive number. Without a unit it is s.

    A text may have the unit behind its number, and the comment may state one. The seconds are None where
    units contradict each other, or one is not known.
    """
    if isinstance(value, bool):
        return None
    number, unit = value, ""
    if isinstance(value, str | bytes) and (parts := _NUMBER_AND_UNIT.fullmatch(text_of(value) or "")):
        number, unit = parts.groups()
    try:
        seconds = float(number)
    except (TypeError, ValueError, OverflowError):
        return None
    if not (math.isfinite(seconds) and SHORTEST <= seconds <= LONGEST / SHORTEST):
        return None
    stated = [each for each in map(text_of, (unit, *units)) if each]
    scales = {scale for text in stated for scale in _scales(text) or {None}} | _scales(comment)
    unit_words = "; ".join(filter(None, [*stated, comment])) if scales else "no unit stated, s assumed"
    words = f"{name} = {seconds:g} ({unit_words})"
    if not scales:
        return Duration(seconds, words)
    scale = scales.pop() if len(scales) == 1 else None
    if scale is not None and not SHORTEST <= seconds * scale <= LONGEST:
        return None
    return Duration(None, f"{words}, unclear unit") if scale is None else Duration(seconds * scale, words)


def _scales(text: str) -> set[float | None]:
    """Return the units that a word or comment states, in s; None stands for one that is not known."""
    text = re.sub("[\u00b5\u03bc]", "u", text)
    prefix = r"\b(mega|kilo|deca|deci|centi|milli|micro|nano|pico|[kmunp])[-_ ](?=s)"
    text = re.sub(prefix, r"\1", text, flags=re.IGNORECASE).replace("_", " ")
    if text.lower() in _SECONDS:
        return {_SECONDS[text.lower()]}
    if _SCALED.search(text) or not {each.lower() for each in _NAMED_SECONDS.findall(text)} <= _SECONDS.keys():
        return {None}  # such as "in units of 10 us" or "deciseconds"
    found = {
        _SECONDS.get(word.lower()) for match in _STATED.finditer(text) for word in match.groups() if word
    }
    return found - {None} or found


def agreed_duration(found: Iterable[Duration | None]) -> Duration | None:
    """Return the first duration that is known; unknown where there is none, or another contradicts it."""
    stated = [each for each in found if each is not None]
    known = [(each.seconds, each.words) for each in stated if each.seconds is not None]
    if not known:
        return stated[0] if stated else None
    seconds, words = known[0]
    for other, other_words in known[1:]:
        if abs(other - seconds) > 0.01 * seconds:  # times may be printed with few digits
            return Duration(None, f"{words}, but {other_words}")
    return Duration(seconds, words)


def bits_of(value: Any) -> int | None:
    """Return the bits of an ADC; None where it is no whole number from 1 to 32."""
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    return int(value) if whole and 1 <= int(value) <= 32 else None


def facts_from_names(values: Mapping[str, Any], units: Mapping[str, Any] = {}) -> Stated:
    """Return the facts from values, with their units, under the names that most programs use."""

    def units_of(name: str) -> list[Any]:
        return [units.get(name), *(values.get(name + suffix) for suffix in _UNIT_SUFFIXES)]

    temperatures = (celsius(values.get(name), first_of(units_of(name))) for name in _TEMPERATURES)
    # those first whose unit is known by their name; integration_time is in s as sidecars have it
    named = {_DURATIONS[0]: "s", **_DURATIONS_IN}
    # a plain unit may be that of the samples
    plain = (unit for name in ("unit", "units") if (unit := values.get(name)) and text_of(unit) in _SECONDS)
    of_any = [*(unit for name, unit in values.items() if TIME_UNIT.fullmatch(name)), *plain]
    durations = (
        duration_of(
            name,
            values.get(name),
            *([*filter(None, units_of(name))] or (of_any if name in _DURATIONS else []) or [named.get(name)]),
        )
        for name in dict.fromkeys((*named, *_DURATIONS))
    )
    camera = CameraFacts(
        first_of(text_of(values.get(name)) for name in _NAMES),
        first_of(text_of(values.get(name)) for name in _SERIALS),
        first_of(temperatures),
        first_of(seconds_of(values.get(name)) for name in _TIMES),
        texts_of(values, _SETUP),
    )
    return camera, agreed_duration(durations), first_of(bits_of(values.get(name)) for name in _DEPTHS)


def first_of(found: Iterable[Any]) -> Any:
    """Return the first that there is."""
    return next((each for each in found if each is not None), None)


def shared_facts(facts: Sequence[CameraFacts]) -> tuple[CameraFacts, str]:
    """Return what all files of a stack say alike, their mean temperature, and a remark if it moved."""
    known = [one.temperature for one in facts if one.temperature is not None]
    times = [one.taken for one in facts if one.taken is not None]
    whole = bool(facts) and len(known) == len(facts)
    shared = CameraFacts(
        _alike(one.name for one in facts),
        _alike(one.serial for one in facts),
        math.fsum(known) / len(known) if whole else None,
        min(times, default=None),
        {name: value for one in facts for name, value in one.setup.items()},
    )
    if not whole or max(known) - min(known) <= 1.0:
        return shared, ""
    return shared, (
        f"sensor temperature {min(known):.4g} to {max(known):.4g} °C in the files: offset, gain and dark "
        "current may have changed"
    )


def _alike(values: Iterable[str | None]) -> str | None:
    distinct = set(values)
    return distinct.pop() if len(distinct) == 1 else None
