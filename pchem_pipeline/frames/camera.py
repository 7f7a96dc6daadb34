"""What camera files say of the camera itself: its name, its serial number, its temperature, the date."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

__all__ = [
    "CAMERA_NAMES",
    "CameraFacts",
    "camera_from_names",
    "celsius",
    "seconds_of",
    "shared_facts",
    "text_of",
]

_LONGEST = 80
_ZERO_CELSIUS = 273.15
#: names that programs give to the facts in attributes, sidecars and JSON records, the usual one first
_NAMES = ("camera", "camera_model", "camera_name")
_SERIALS = ("serial_number", "camera_serial", "serial")
_TEMPERATURES = ("sensor_temperature", "detector_temperature", "temperature")
_TIMES = ("start_time", "acquisition_date", "date")
#: All of them.
CAMERA_NAMES = (*_NAMES, *_SERIALS, *_TEMPERATURES, *_TIMES)


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


def camera_from_names(values: Mapping[str, Any], units: Mapping[str, Any] | None = None) -> CameraFacts:
    """Return the facts from values under the names that most programs use (HDF5, zarr, sidecars, JSON).

    Args:
        values: attributes.
        units: of them, by name.
    """
    stated = {**{f"{name}_units": unit for name, unit in (units or {}).items()}, **values}
    temperatures = {name: celsius(values.get(name), stated.get(f"{name}_units")) for name in _TEMPERATURES}
    return CameraFacts(
        _first(values, _NAMES, text_of),
        _first(values, _SERIALS, text_of),
        _first(temperatures, _TEMPERATURES, lambda degrees: degrees),
        _first(values, _TIMES, seconds_of),
    )


def _first(values: Mapping[str, Any], names: Iterable[str], read: Callable[[Any], Any]) -> Any:
    """Return the first value that can be read under one of the names."""
    return next((found for name in names if (found := read(values.get(name))) is not None), None)


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
