"""The inspector: maps and histograms in few bytes, its data as plain values, and its part of the page.

A map becomes one code of 16 bits per pixel: 0 for no value, 2 to 65534 for ``low + step * (code - 2)`` (its
power of ten where the map is logarithmic), and 1 and 65535 for the few values below and above that range,
which follow as they are; a 1 of a logarithmic map that does not follow is 0. The order of the codes is the
order of the values, so that ranks and percentiles can be counted on codes. Histograms are stored without
their empty ends, small counts in one byte.
"""

from __future__ import annotations

import base64
import hashlib
import importlib.resources
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.wording import unit_text
from pchem_pipeline.model.fit.status import FAILED, MEANINGS
from pchem_pipeline.model.maps.ordered import Ordered
from pchem_pipeline.report.data import ReportData
from pchem_pipeline.report.style.palette import shades
from pchem_pipeline.report.style.ranges import DECADES

#: Codes with a meaning of their own, and the last one of the regular range.
_NONE, _BELOW, _FIRST, _LAST, _ABOVE = 0, 1, 2, 65534, 65535
#: Quantiles between which a value is surely inside the range; the range is three times wider on each side.
_TAIL = 1e-3


@dataclass(frozen=True)
class Scale:
    """How codes stand for values: ``low + step * (code - 2)``, a power of ten of it where ``log``."""

    low: float
    step: float
    log: bool = False


@dataclass(frozen=True)
class PackedMap:
    """A map in few bytes."""

    scale: Scale  # how codes stand for values
    n_odd: int  # values outside the range of the codes, at the end of ``data`` as indices and float32
    data: bytes  # gzip of low bytes, high bytes, ``n_odd`` uint32 and ``n_odd`` float32, little-endian
    bars: dict[str, Any] | None = None  # see `_bars`; None where the codes are fine enough


def choose_scale(values: NDArray[Any], *, step: float = 0.0, coarse: float = 1.0) -> Scale:
    """Choose the range and the step of a map's codes; NaN and infinities are left out.

    The wanted step is in the unit of the map (0: a 64th of the robust standard deviation; of integers it is
    1), ``coarse`` a factor on it, for maps that must be smaller.
    """
    flat = np.asarray(values).ravel()
    if flat.dtype.kind in "iub" and flat.size:
        low, high = float(flat.min()), float(flat.max())
        return Scale(low, max(1.0, np.ceil((high - low) / (_LAST - _FIRST))))
    known = Ordered.of(some_of(flat))
    if known.size == 0:
        return Scale(0.0, 1.0)
    log = False
    if known.values[0] >= 0 and known.values[-1] > 0:
        above = Ordered(known.values[known.size - known.n_above(0.0) :])
        bulk = above.quantiles([0.01, 0.99])
        log = bool(bulk[1] > DECADES * bulk[0]) or bool(known.values[0] == 0 and bulk[1] > bulk[0])
        known = Ordered(np.log10(above.values)) if log else known
    low, q25, middle, q75, high = known.quantiles([_TAIL, 0.25, 0.5, 0.75, 1.0 - _TAIL]).tolist()
    margin = 3.0 * (high - low)
    first, last = max(float(known.values[0]), low - margin), min(float(known.values[-1]), high + margin)
    fine = 0.01 if log else step or float(q75 - q25) / 1.35 / 64.0
    smallest = max((last - first) / (_LAST - _FIRST - 257), abs(float(middle)) * 1e-9, 1e-300)
    wide = float(max(fine * coarse, smallest))
    # the median in the middle of 256 codes: where these hold the bulk, the high bytes cost next to nothing
    shift = (128 - _FIRST - round((float(middle) - first) / wide)) % 256
    return Scale(float(first) - shift * wide, wide, log)


def some_of(values: NDArray[Any]) -> NDArray[Any]:
    """Return the values of a flat array, of many every k-th: enough for a quantile that only sets a scale.

    k is odd: no column of a sensor is left out for good.
    """
    return values[:: max(values.size // 65_537, 1) | 1]


def pack_map(values: NDArray[Any], scale: Scale) -> PackedMap:
    """Return a map (y, x) in few bytes; values are kept to half a step, those outside the range to 1e-7."""
    flat = np.asarray(values).ravel()
    place = _places(flat, scale)
    bars = None if flat.dtype.kind in "iub" else _bars(place)
    np.rint(place, out=place)
    place += _FIRST
    np.clip(place, _BELOW, _ABOVE, out=place)
    place[~np.isfinite(flat) | np.isnan(place)] = _NONE
    codes = place.astype("<u2")
    outside = (codes == _BELOW) | (codes == _ABOVE)
    if scale.log:  # zeros, which may be many, need no place in the list
        outside &= flat != 0
    odd = np.flatnonzero(outside)
    content = b"".join((codes >> shift).astype(np.uint8).tobytes() for shift in (0, 8))
    content += odd.astype("<u4").tobytes() + flat[odd].astype("<f4").tobytes()
    return PackedMap(scale, int(odd.size), _zipped(content), bars)


def _zipped(content: bytes) -> bytes:
    """Return gzip of numbers: runs of equal bytes are all that repeats in them."""
    zipped = zlib.compressobj(6, zlib.DEFLATED, 16 + zlib.MAX_WBITS, 9, zlib.Z_RLE)
    return zipped.compress(content) + zipped.flush()


def _places(values: NDArray[Any], scale: Scale) -> FloatArray:
    """Return the place of each value on the scale, in steps: 0 for the first code."""
    with np.errstate(divide="ignore", invalid="ignore"):
        place: FloatArray = np.log10(values, dtype=np.float64) if scale.log else values.astype(np.float64)
        place -= scale.low
        place /= scale.step
    return place


def _bars(place: FloatArray) -> dict[str, Any] | None:
    """Return the histogram over the bulk of a map's places; None where codes are narrow enough to be bars.

    It has the ``counts`` of ``parts`` bars a code, from the code ``first`` on. Its axis is the script's: from
    the 1st to the 99th percentile, and 0.3 of it beyond where values are.
    """
    known = Ordered.of(some_of(place))
    if known.size < 2:
        return None
    low, high = known.quantiles([0.01, 0.99])
    margin = 0.3 * (high - low)
    ends = max(low - margin, known.values[0], 0.0), min(high + margin, known.values[-1])
    first, last = np.rint(ends).astype(int)
    wanted = np.clip(2.0 * np.cbrt(place.size), 8, 96)
    parts = round(float(wanted) / max(int(last - first) + 1, 1))
    if parts < 2 or not high > low:
        return None
    n, bar = int(last - first + 1) * parts, (place - (first - 0.5)) * parts
    inside = bar[(bar >= 0.0) & (bar < n)].astype(np.int64)
    return {"first": int(first) + _FIRST, "parts": parts, "counts": np.bincount(inside, minlength=n).tolist()}


def varints(values: NDArray[Any]) -> bytes:
    """Return whole numbers >= 0 with seven bits to a byte, the lowest first; the last byte is below 128."""
    rest = np.asarray(values, dtype=np.uint64).reshape(-1, 1)
    bits = max(int(rest.max(initial=0)).bit_length(), 1)
    digits = rest >> np.arange(0, bits, 7, dtype=np.uint64)
    used = digits > 0
    used[:, 0] = True
    digits &= np.uint64(127)
    digits[:, :-1] |= used[:, 1:].astype(np.uint64) << np.uint64(7)
    return digits[used].astype(np.uint8).tobytes()


def pack_counts(
    origin: NDArray[np.integer[Any]], counts: Sequence[NDArray[np.integer[Any]]]
) -> tuple[NDArray[np.int32], NDArray[np.uint32], bytes]:
    """Cut the empty ends off n histograms, which begin at the DN of ``origin``, and join them.

    Returns:
        DN of the first occupied bin, number of bins from there to the last occupied one, and all counts one
        after the other as variable-length numbers.
    """
    first = np.zeros(len(counts), dtype=np.int32)
    size = np.zeros(len(counts), dtype=np.uint32)
    kept = []
    for i, each in enumerate(counts):
        occupied = np.flatnonzero(each)
        if occupied.size:
            first[i], size[i] = origin[i] + occupied[0], occupied[-1] - occupied[0] + 1
            # one by one: of all bins at once, those of wide histograms would take GiB
            kept.append(varints(each[occupied[0] : occupied[-1] + 1]))
    return first, size, b"".join(kept)


@dataclass(frozen=True)
class MapEntry:
    """A map that the inspector can show."""

    path: str  # ``group/name`` of the stored array
    label: str  # words for the list of maps
    unit: str  # as the store writes it
    sentence: str  # the array's own sentence
    kind: str = "value"  # value, stderr, bits (each bit has a word) or words (each number has one)
    words: Mapping[int, str] = field(default_factory=dict)  # number or bit to words
    packed: PackedMap | None = None  # None where it is not in the file or ``same_as`` says it all
    same_as: tuple[str, float] | None = None  # path of a map that this one is a multiple of, and factor


class Notable(NamedTuple):
    """Why pixels are in the file: in words, which (``y * nx + x``), and the map whose value it is, if one."""

    words: str
    pixels: tuple[int, ...]
    path: str = ""


@dataclass(frozen=True)
class PixelSample:
    """Pixels that are in the file in full."""

    index: IntArray  # ``y * nx + x`` of each, (n,)
    exact: Mapping[str, FloatArray]  # path of a map to its values at these pixels, (n,)
    origin: IntArray  # DN of the first bin of each histogram, (n,)
    counts: list[NDArray[np.integer[Any]]]  # their histograms
    deciding: FloatArray | None = None  # parameters (4, n) that decide numbers, if not the fitted ones
    masses: list[FloatArray] = field(default_factory=list)  # of bins, with effects, of the first pixels
    reasons: Sequence[Notable] = ()  # why pixels are here, those of the even sample excepted


@dataclass(frozen=True)
class InspectorData:
    """All that the inspector holds: maps in the order of the list, and pixels in full."""

    maps: tuple[MapEntry, ...]  # those not packed are shown by ``pchem view`` only
    sample: PixelSample
    kept_to: str  # how true the packed maps are: a part of a standard error, in words
    command: str  # what shows every pixel


#: The part of the policy that forbids every connection.
_CONNECT_NOWHERE = "connect-src 'none'"

#: Values in the table of a pixel, in its order; the others follow below.
PANEL_MAPS = (
    "maps/quanta_exposure",
    "maps/charge_rate",
    "maps/dark_current",
    "maps/conversion_gain",
    "maps/bias",
    "maps/read_noise_dn",
    "maps/read_noise_e",
    "maps/analog_read_noise_e",
)

#: Heading of each group of maps in the list; others have the name of their group.
_GROUPS = {
    "maps": "Parameters",
    "stderr": "Standard errors",
    "fit": "Fit",
    "summary": "Time and neighbours",
    "histogram": "Range of the data",
    "discrepancy": "What the model is missing",
    "truth": "Truth of the simulation",
}


def embedded(data: ReportData) -> dict[str, Any] | None:
    """Return the inspector's ``facts`` as JSON, ``blobs`` of data by id, and ``script``; None without."""
    if data.inspector is None:
        return None
    shown = data.inspector()
    content = {f"map-{i}": each.packed.data for i, each in enumerate(shown.maps) if each.packed is not None}
    content["inspector-sample"] = _sample_bytes(shown.sample)
    sample = shown.sample
    facts = {
        "shape": list(data.shape),
        "noun": data.noun,
        "channels": list(data.channel_names),
        "samples": "samples" if data.shape[0] == 1 else "frames",
        "statusWords": {str(int(bit)): text for bit, text in MEANINGS.items()},
        "failedMask": int(FAILED),
        "model": data.run.get("model", ""),
        "command": shown.command,
        "keptTo": shown.kept_to,
        "colours": shades().tobytes().hex(),
        "maps": [map_facts(entry) for entry in shown.maps],
        "panel": list(PANEL_MAPS),
        "sample": {
            "n": int(sample.index.size),
            "exact": list(sample.exact),
            "deciding": sample.deciding is not None,
            "masses": len(sample.masses),
        },
        "notable": [each._asdict() for each in sample.reasons],
    }
    return {
        "facts": json_for_html(facts),
        "blobs": {name: Markup(_base64(each)) for name, each in content.items()},
        "script": Markup(text_of("inspector.js")),
    }


def text_of(name: str, folder: str = "templates") -> str:
    """Return a file of the pages' templates, or of another folder of the report."""
    whole = importlib.resources.files("pchem_pipeline.report") / folder / name
    return whole.read_text(encoding="utf-8")


def content_policy(*texts: str) -> str:
    """Return the page's content security policy: no network at all, and no script but these."""
    scripts = " ".join(f"'sha256-{_base64(hashlib.sha256(text.encode()).digest())}'" for text in texts)
    return (
        f"default-src 'none'; script-src {scripts}; {_CONNECT_NOWHERE}; img-src data:; "
        "style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
    )


def served_page(page: str) -> str | None:
    """Return a ``report.html`` as ``pchem view`` serves it: it may ask its own server, and knows of it.

    None where the page holds no inspector of this version.
    """
    before, found, after = page.partition(str(escape(_CONNECT_NOWHERE)))
    if not found or 'id="inspector-app"' not in after:
        return None
    mark, served = '<meta name="color-scheme"', '<meta name="pchem-view" content="yes">'
    here = escape("connect-src 'self'")
    return f"{before}{here}{after}".replace(mark, f"{served}\n{mark}", 1)


def json_for_html(content: Any) -> Markup:
    """Return JSON that may stand inside a ``script`` element: it cannot end it, nor begin a comment."""
    text = json.dumps(content, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    for sign in "<>&\u2028\u2029":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return Markup(text)


def map_facts(entry: MapEntry) -> dict[str, Any]:
    """Return what the script must know of a map."""
    group = entry.path.split("/", 1)[0]
    found: dict[str, Any] = {
        "path": entry.path,
        "group": _GROUPS["stderr"] if entry.kind == "stderr" else _GROUPS.get(group, group),
        "label": entry.label,
        "unit": unit_text(entry.unit),
        "sentence": entry.sentence,
        "kind": entry.kind,
        "words": {str(key): text for key, text in entry.words.items()},
        "here": entry.packed is not None or entry.same_as is not None,
    }
    if entry.same_as is not None:
        found |= {"sameAs": entry.same_as[0], "factor": entry.same_as[1]}
    if entry.packed is not None:
        found |= packed_facts(entry.packed)
    return found


def packed_facts(packed: PackedMap) -> dict[str, Any]:
    """Return what the script must know to read a packed map."""
    found: dict[str, Any] = vars(packed.scale) | {"nOdd": packed.n_odd}
    return found if packed.bars is None else found | {"bars": packed.bars}


def _sample_bytes(sample: PixelSample) -> bytes:
    """Return gzip of: index, origin, bins (4 bytes each), exact maps, deciding parameters, masses, counts."""
    origin, bins, counts = pack_counts(sample.origin, sample.counts)
    columns = [*sample.exact.values(), *(sample.deciding if sample.deciding is not None else ())]
    # a mass runs over the bins of the cut histogram, as the square root of its value in 16 bits
    roots = [
        np.rint(65535.0 * np.sqrt(np.clip(np.nan_to_num(mass), 0.0, 1.0)))[first : first + int(n)]
        for mass, first, n in zip(sample.masses, origin - sample.origin, bins, strict=False)
    ]
    parts = [
        sample.index.astype("<u4").tobytes(),
        origin.astype("<i4").tobytes(),
        bins.astype("<u4").tobytes(),
        *(np.asarray(column).astype("<f4").tobytes() for column in columns),
        *(root.astype("<u2").tobytes() for root in roots),
        counts,
    ]
    return _zipped(b"".join(parts))


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")
