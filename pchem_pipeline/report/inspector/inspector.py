"""The inspector: its data as plain values, and its part of the page, with its hash for the policy."""

from __future__ import annotations

import base64
import gzip
import hashlib
import importlib.resources
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

from pchem_pipeline.report.data import MAP_NAMES, ReportData
from pchem_pipeline.report.inspector.packing import PackedMap, pack_counts
from pchem_pipeline.report.style.palette import shades
from pchem_pipeline.report.style.wording import symbol, unit_text


@dataclass(frozen=True)
class MapEntry:
    """A map that the inspector can show.

    Attributes:
        path: ``group/name`` of the stored array.
        label: words for the list of maps.
        unit: unit as the store writes it.
        sentence: the array's own sentence.
        kind: ``value``, ``stderr``, ``bits`` (each bit has a word) or ``words`` (each number has one).
        words: number or bit to words, for the last two.
        packed: the map; None where it is not in the file or where ``same_as`` says it all.
        same_as: path of a map that this one is a multiple of, and the factor.
    """

    path: str
    label: str
    unit: str
    sentence: str
    kind: str = "value"
    words: Mapping[int, str] = field(default_factory=dict)
    packed: PackedMap | None = None
    same_as: tuple[str, float] | None = None


@dataclass(frozen=True)
class PixelSample:
    """Pixels that are in the file in full.

    Attributes:
        index: ``y * nx + x`` of each, shape (n,).
        exact: path of a map to its values at these pixels, shape (n,).
        origin: DN of the first bin of each histogram, shape (n,).
        counts: their histograms.
        deciding: parameters that decide electron numbers, where these are not the fitted ones: (4, n).
        masses: probability of each bin under a model with effects, of as many of the first pixels.
        reasons: why pixels are here, with their indices, e.g. ``"poorest goodness of fit"``.
    """

    index: NDArray[np.int64]
    exact: Mapping[str, NDArray[np.float64]]
    origin: NDArray[np.int64]
    counts: list[NDArray[np.integer[Any]]]
    deciding: NDArray[np.float64] | None = None
    masses: list[NDArray[np.float64]] = field(default_factory=list)
    reasons: tuple[tuple[str, tuple[int, ...]], ...] = ()


@dataclass(frozen=True)
class InspectorData:
    """All that the inspector holds.

    Attributes:
        maps: in the order of the list; those not packed are shown by ``pchem view`` only.
        sample: the pixels in full.
        kept_to: how true the packed maps are: a part of a standard error, in words.
        command: what shows every pixel.
    """

    maps: tuple[MapEntry, ...]
    sample: PixelSample
    kept_to: str
    command: str


#: The part of the policy that forbids every connection, and that of a page which ``pchem view`` serves.
_CONNECT_NOWHERE, _CONNECT_HERE = "connect-src 'none'", "connect-src 'self'"

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


@dataclass(frozen=True)
class Embedded:
    """What the page holds for the inspector, ready to stand in it: facts as JSON, data by id, the script."""

    facts: Markup
    blobs: list[tuple[str, Markup]]
    script: Markup


def embedded(data: ReportData) -> Embedded | None:
    """Return the inspector's part of the page; None where the run has nothing to inspect."""
    if data.inspector is None:
        return None
    shown = data.inspector()
    parts = [(name, Markup(text)) for name, text in _blobs(shown)]
    return Embedded(json_for_html(_facts(data, shown)), parts, Markup(script()))


def script() -> str:
    """Return the inspector's script."""
    return text_of("inspector.js")


def text_of(name: str, folder: str = "templates") -> str:
    """Return a file of the pages' templates, or of another folder of the report."""
    whole = importlib.resources.files("pchem_pipeline.report") / folder / name
    return whole.read_text(encoding="utf-8")


def content_policy(*texts: str) -> str:
    """Return the page's content security policy: no network at all, and no script but these."""
    digests = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii") for text in texts]
    scripts = "script-src " + " ".join(f"'sha256-{each}'" for each in digests) + "; "
    return (
        f"default-src 'none'; {scripts}{_CONNECT_NOWHERE}; img-src data:; style-src 'unsafe-inline'; "
        "base-uri 'none'; form-action 'none'"
    )


def served_page(page: str) -> str | None:
    """Return a report as ``pchem view`` serves it: it may ask its own server, and knows that there is one.

    Args:
        page: a ``report.html``.

    Returns:
        The page; None where it holds no inspector of this version.
    """
    before, found, after = page.partition(str(escape(_CONNECT_NOWHERE)))
    if not found or 'id="inspector-app"' not in after:
        return None
    mark, told = '<meta name="color-scheme"', '<meta name="pchem-view" content="yes">'
    return f"{before}{escape(_CONNECT_HERE)}{after}".replace(mark, f"{told}\n{mark}", 1)


def json_for_html(content: Any) -> Markup:
    """Return JSON that may stand inside a ``script`` element: it cannot end it, nor begin a comment."""
    text = json.dumps(content, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    for sign in "<>&\u2028\u2029":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return Markup(text)


def _facts(data: ReportData, shown: InspectorData) -> dict[str, Any]:
    """Return what the script must know beside the maps."""
    sample = shown.sample
    return {
        "shape": list(data.shape),
        "noun": data.noun,
        "channels": list(data.channel_names),
        "samples": "samples" if data.shape[0] == 1 else "frames",
        "statusWords": {str(bit): text for bit, text in data.status_words.items()},
        "failedMask": data.failed_mask,
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
        "notable": [
            {"words": words, "pixels": list(where), "path": _shown_value(words)}
            for words, where in sample.reasons
        ],
    }


def _shown_value(reason: str) -> str:
    """Return the path of the map whose value makes a pixel notable; empty where it is no value."""
    if reason == "poorest goodness of fit":
        return "fit/goodness_p"
    for name in MAP_NAMES:
        words = symbol(name)[1]
        if reason.endswith(f"standard error of the {words}"):
            return f"maps/{name}_stderr"
        if reason in (f"largest {words}", f"smallest {words}"):
            return f"maps/{name}"
    return ""


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
    scale, bars = packed.scale, packed.bars
    found: dict[str, Any] = {"low": scale.low, "step": scale.step, "log": scale.log, "nOdd": packed.n_odd}
    if bars is not None:
        found["bars"] = {"first": bars.first, "parts": bars.parts, "counts": bars.counts.tolist()}
    return found


def _blobs(shown: InspectorData) -> list[tuple[str, str]]:
    """Return the data of the page: element id and base64 of each."""
    found = [
        (f"map-{i}", _base64(entry.packed.data))
        for i, entry in enumerate(shown.maps)
        if entry.packed is not None
    ]
    return [*found, ("inspector-sample", _base64(_sample_bytes(shown.sample)))]


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
    return gzip.compress(b"".join(parts), 6, mtime=0)


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")
