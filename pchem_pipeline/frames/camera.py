"""What camera files say beside their frames: camera, temperature, date, integration time, bits of the ADC."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from numbers import Integral
from typing import Any

_LONGEST = 80
_ZERO_CELSIUS = 273.15
#: names that programs give to the facts in attributes, sidecars and JSON records, the usual one first
_NAMES = ("camera", "camera_model", "camera_name")
_SERIALS = ("serial_number", "camera_serial", "serial")
_TEMPERATURES = ("sensor_temperature", "detector_temperature", "temperature")
_TIMES = ("start_time", "acquisition_date", "date")
_DURATIONS = ("integration_time", "exposure_time", "count_time")
_DEPTHS = ("bit_depth", "bit_depth_readout")
#: All of them.
FACT_NAMES = (*_NAMES, *_SERIALS, *_TEMPERATURES, *_TIMES, *_DURATIONS, *_DEPTHS)
_SECONDS = {"": 1.0, "s": 1.0, "min": 60.0, "ms": 1e-3, "us": 1e-6, "\u00b5s": 1e-6, "ns": 1e-9}


@dataclass(frozen=True)
class CameraFacts:
    """The camera as its files describe it; None where they do not.

    Attributes:
        name: make and model.
        serial: serial number.
        temperature: of the sensor, degrees Celsius.
        taken: when the first frame was taken, s since 1970-01-01 UTC (a time without a zone counts as UTC).
    """

    name: str | None = None
    serial: str | None = None
    temperature: float | None = None
    taken: float | None = None

    def words(self) -> str:
        """Return name, serial number and temperature in one line; empty where nothing is known."""
        parts = [self.name, f"serial number {self.serial}" if self.serial else None]
        parts.append(None if self.temperature is None else f"sensor at {self.temperature:.4g} °C")
        return ", ".join(part for part in parts if part)


@dataclass(frozen=True)
class StatedFacts:
    """What a file says beside its frames; None where it does not.

    Attributes:
        camera: that took the frames.
        integration_time: s.
        bit_depth: bits of the ADC.
    """

    camera: CameraFacts = CameraFacts()
    integration_time: float | None = None
    bit_depth: int | None = None


def text_of(value: Any) -> str | None:
    """Return a name as one short line of printable characters; None where there is nothing."""
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    if not isinstance(value, str | int) or isinstance(value, bool):
        return None
    text = "".join(each if each.isprintable() else " " for each in str(value).split("\0")[0])
    return " ".join(text.split())[:_LONGEST] or None


def celsius(value: Any, unit: Any = "C") -> float | None:
    """Return a temperature in degrees Celsius; None where it is no number, or no temperature of a sensor.

    Args:
        value: the number.
        unit: kelvin if it is ``K`` or begins with ``kelvin``.
    """
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    name = (text_of(unit) or "C").strip("[]()").lower()
    number -= _ZERO_CELSIUS if name == "k" or name.startswith("kelvin") else 0.0
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


def duration_of(value: Any, unit: Any = "s") -> float | None:
    """Return a duration in s; None where it is no positive number, or its unit is not known.

    Args:
        value: the number.
        unit: s, ms, us, ns or min; s where there is none.
    """
    scale = _SECONDS.get(text_of(unit) or "")
    if scale is None or isinstance(value, bool):
        return None
    try:
        seconds = float(value) * scale
    except (TypeError, ValueError, OverflowError):
        return None
    return seconds if math.isfinite(seconds) and seconds > 0 else None


def bits_of(value: Any) -> int | None:
    """Return the bits of an ADC; None where it is no whole number from 1 to 32."""
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    return int(value) if whole and 1 <= int(value) <= 32 else None


def facts_from_names(values: Mapping[str, Any], units: Mapping[str, Any] | None = None) -> StatedFacts:
    """Return the facts from values under the names that most programs use (HDF5, zarr, sidecars, JSON).

    Args:
        values: attributes.
        units: of them, by name.
    """
    stated = {**{f"{name}_units": unit for name, unit in (units or {}).items()}, **values}
    temperatures = (celsius(values.get(name), stated.get(f"{name}_units")) for name in _TEMPERATURES)
    durations = (duration_of(values.get(name), stated.get(f"{name}_units")) for name in _DURATIONS)
    camera = CameraFacts(
        first_of(text_of(values.get(name)) for name in _NAMES),
        first_of(text_of(values.get(name)) for name in _SERIALS),
        first_of(temperatures),
        first_of(seconds_of(values.get(name)) for name in _TIMES),
    )
    return StatedFacts(camera, first_of(durations), first_of(bits_of(values.get(name)) for name in _DEPTHS))


def first_of(found: Iterable[Any]) -> Any:
    """Return the first that there is."""
    return next((each for each in found if each is not None), None)


def shared_facts(each: Iterable[CameraFacts]) -> tuple[CameraFacts, str]:
    """Return what all files of a stack say alike, their mean temperature, and a remark if it moved.

    Args:
        each: of the files, in their order.
    """
    facts = list(each)
    known = [one.temperature for one in facts if one.temperature is not None]
    times = [one.taken for one in facts if one.taken is not None]
    whole = bool(facts) and len(known) == len(facts)
    shared = CameraFacts(
        _alike(one.name for one in facts),
        _alike(one.serial for one in facts),
        math.fsum(known) / len(known) if whole else None,
        min(times, default=None),
    )
    if whole and max(known) - min(known) > 1.0:
        return shared, (
            f"the sensor's temperature went from {min(known):.4g} to {max(known):.4g} °C between the files: "
            "offset, gain and dark current may have moved"
        )
    return shared, ""


def _alike(values: Iterable[str | None]) -> str | None:
    distinct = set(values)
    return distinct.pop() if len(distinct) == 1 else None
