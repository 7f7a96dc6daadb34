"""The comparison of runs as one page, complete in itself, and as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pchem_pipeline.model.checks.run_differences import FAR
from pchem_pipeline.report.figures import compare_figures
from pchem_pipeline.report.figures.exhibits import Exhibit, drawing
from pchem_pipeline.report.pages.compare_data import Comparison, Pair
from pchem_pipeline.report.pages.compare_tables import pair_tables, run_table
from pchem_pipeline.report.pages.report import template
from pchem_pipeline.report.pages.tables import Table
from pchem_pipeline.report.settings import ReportSettings
from pchem_pipeline.report.style.pictures import DrawAll, Picture, draw_picture, ready_picture
from pchem_pipeline.report.style.style import PAGE_MM
from pchem_pipeline.report.style.wording import count, short, symbol

__all__ = ["COMPARE_JSON", "COMPARE_PAGE", "COMPARE_VERSION", "render_comparison", "sentence_of"]

#: Names of the files.
COMPARE_PAGE, COMPARE_JSON = "compare.html", "compare.json"
#: Version of the layout of ``compare.json``.
COMPARE_VERSION = 1

_SETTINGS = ReportSettings(figure_formats=(), dpi=200)
#: At most so many sentences on what changed are shown; the JSON has all.
_MOST_WORDS = 12


@dataclass(frozen=True)
class _Part:
    """One pair as the page shows it."""

    id: str
    title: str
    level: str
    name: str
    sentence: str
    words: tuple[str, ...]
    pictures: list[Picture]
    tables: list[Table]


def sentence_of(found: Comparison) -> str:
    """Return what came out, in one sentence or one for each pair."""
    if len(found.pairs) == 1:
        return _pair_sentence(found.pairs[0], found.tolerance)
    changed = [pair.other.label for pair in found.pairs if pair.changed]
    if not changed:
        return f"Nothing changed in any of the {len(found.pairs)} runs against {found.runs[0].words}."
    same = [pair.other.label for pair in found.pairs if not pair.changed]
    rest = f"; {', '.join(same)} did not" if same else ""
    return f"Against {found.runs[0].words}, {', '.join(changed)} changed{rest}."


def _pair_sentence(pair: Pair, tolerance: float) -> str:
    if pair.changed:
        more = "" if len(pair.words) == 1 else f" (and {len(pair.words) - 1} more)"
        first = f"{pair.other.words} differs from {pair.one.words}: {pair.words[0].rstrip('.')}{more}."
        return f"{first}{_largest_words(pair)}"
    if not pair.same_data:
        return (
            f"Nothing changed: on different frames, all maps of {pair.other.words} agree with those of "
            f"{pair.one.words} within their standard errors."
        )
    rows = [row for row in pair.arrays if row.counts and row.state in ("identical", "equal")]
    values = sum(row.n_values for row in rows)
    inexact = sum(row.state == "equal" for row in rows)
    what = "are identical to the bit" if not inexact else f"are equal ({inexact} arrays within {tolerance:g})"
    return f"Nothing changed: {count(len(rows), 'array')} with {values:,} values {what}."


def _largest_words(pair: Pair) -> str:
    """Say by how many standard errors maps of the same frames moved at most."""
    counted = {name: each for name, each in pair.maps.items() if each.n_counted}
    if not pair.same_data or not counted:
        return ""
    name, most = max(counted.items(), key=lambda item: item[1].largest_z)
    return (
        f" No good pixel moved by more than {short(most.largest_z, 2)} standard errors ({symbol(name)[1]})."
    )


def render_comparison(found: Comparison, draw: DrawAll | None = None) -> tuple[str, str]:
    """Return the page and the JSON of a comparison; nothing is written.

    Args:
        found: the comparison.
        draw: draws all figures at once; None: one after the other, here.
    """
    exhibits = {pair.other.label: _maps(pair) for pair in found.pairs}
    whole = _ensembles(found)
    drawn = (
        {} if draw is None else draw([*whole, *(e for each in exhibits.values() for e in each)], _SETTINGS)
    )

    def picture(exhibit: Exhibit) -> Picture:
        if exhibit.name in drawn:
            return ready_picture(exhibit, drawn[exhibit.name], {})
        return draw_picture(exhibit, _SETTINGS, {})

    parts = [_part(pair, found, [picture(e) for e in exhibits[pair.other.label]]) for pair in found.pairs]
    page = template("compare.html.j2").render(
        title=" · ".join(run.words for run in found.runs),
        level="caution" if found.changed else "good",
        name="Changed" if found.changed else "Nothing changed",
        sentence=sentence_of(found),
        parts=parts,
        runs=run_table(found),
        pictures=[picture(exhibit) for exhibit in whole],
        sign="▲" if found.changed else "✓",
    )
    return page, json.dumps(_numbers(found), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def _part(pair: Pair, found: Comparison, pictures: list[Picture]) -> _Part:
    more = len(pair.words) - _MOST_WORDS
    words = (*pair.words[:_MOST_WORDS], *((f"And {more} more; see compare.json.",) if more > 0 else ()))
    return _Part(
        f"pair-{pair.other.label}",
        f"{pair.other.words} against {pair.one.words}",
        "caution" if pair.changed else "good",
        "Changed" if pair.changed else "Nothing changed",
        _pair_sentence(pair, found.tolerance),
        words,
        pictures,
        pair_tables(pair, found.tolerance),
    )


def _maps(pair: Pair) -> list[Exhibit]:
    """Return the maps of differences, those that are not zero throughout."""
    shown = []
    for name, each in pair.maps.items():
        if not np.nan_to_num(each.difference).any():
            continue
        _, words, unit = symbol(name)
        label = f"{words} ({unit})" if name.startswith("read_noise") else words
        alt = (
            f"Map and histogram of the difference of the {label} in standard errors: median "
            f"{short(each.median)} ± {short(each.median_stderr)} {unit}, which is {each.median_z:+.3g} "
            f"standard errors of a pixel; scatter {each.spread_z:.3g}; "
            f"{count(each.n_far, 'good pixel')} beyond {FAR:g}."
        )
        caption = (
            "The line is N(0, 1), what chance alone gives."
            if not pair.same_data
            else "Both runs come from the same frames, so that chance plays no part."
        )
        shown.append(
            Exhibit(
                f"difference_{name}_{pair.other.label}",
                "",
                f"{label[0].upper()}{label[1:]}",
                f"{pair.other.label} − {pair.one.label}, each pixel in its own standard errors. {caption}",
                alt,
                drawing(
                    compare_figures.difference_map,
                    each,
                    f"{label}: {pair.other.label} − {pair.one.label}",
                    same_data=pair.same_data,
                ),
                raster=True,
            )
        )
    return shown


def _ensembles(found: Comparison) -> list[Exhibit]:
    runs = [run for run in found.runs if "density" in run.ensemble]
    if len(runs) < 2:
        return []
    highest = (run.ensemble["dn"][int(np.argmax(run.ensemble["density"]))] for run in runs)
    peaks = ", ".join(f"{run.words}: {int(dn)} DN" for run, dn in zip(runs, highest, strict=True))
    return [
        Exhibit(
            "ensembles",
            "",
            "Ensemble histograms over each other",
            "All pixels of each run together, raw and after two-point non-uniformity correction. Strips: "
            f"difference to {runs[0].label} in standard errors of counting; the gray band is ±2.",
            f"Ensemble histograms of the runs; their highest points lie at {peaks}.",
            drawing(compare_figures.ensembles, runs),
            PAGE_MM,
        )
    ]


def _numbers(found: Comparison) -> dict[str, Any]:
    numbers: dict[str, Any] = _plain(
        {
            "compare_version": COMPARE_VERSION,
            "changed": found.changed,
            "sentence": sentence_of(found),
            "tolerance": found.tolerance,
            "runs": [
                {
                    "label": run.label,
                    "name": run.name,
                    "shape": run.shape,
                    "n_frames": run.n_frames,
                    "data": run.digest,
                    "medians": {k: dict(zip(_MEDIAN, v, strict=True)) for k, v in run.summary.items()},
                    "pixels": dict(zip(("good", "caution", "no_value"), run.pixels, strict=True)),
                    "rmse": run.rmse,
                }
                for run in found.runs
            ],
            "comparisons": [_pair_numbers(pair) for pair in found.pairs],
        }
    )
    return numbers


_MEDIAN = ("median", "median_stderr", "robust_sd")


def _pair_numbers(pair: Pair) -> dict[str, Any]:
    skipped = ("difference", "z")
    return {
        "reference": pair.one.label,
        "run": pair.other.label,
        "same_data": pair.same_data,
        "changed": pair.changed,
        "what": list(pair.words),
        "maps": {
            name: {key: value for key, value in vars(each).items() if key not in skipped}
            | ({"reasons": vars(pair.reasons[name])} if name in pair.reasons else {})
            for name, each in pair.maps.items()
        },
        "quality_transitions": pair.transitions,
        "arrays": [vars(row) for row in pair.arrays],
        "settings": [vars(setting) for setting in pair.settings],
        "versions": [vars(version) for version in pair.versions],
    }


def _plain(value: Any) -> Any:
    """Turn numpy numbers into what JSON knows; NaN into None."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(item) for item in value]
    return value
