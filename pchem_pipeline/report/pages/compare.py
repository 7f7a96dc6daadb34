"""The comparison of runs as one page, complete in itself, and as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

from pchem_pipeline.base.plain import plain
from pchem_pipeline.base.variables import MEASURED_MAPS
from pchem_pipeline.base.wording import count, cut, heading, measured, percent, scientific, short, symbol
from pchem_pipeline.model.fit.status import words_of
from pchem_pipeline.model.maps.defects import FAULTS
from pchem_pipeline.report.comparison import Comparison, HistoryRow, Pair, Setting, by_change
from pchem_pipeline.report.figures.compare import difference_figures, ensembles_figures, history_figures
from pchem_pipeline.report.figures.figure import Figure
from pchem_pipeline.report.pages.page import DrawAll, Finding, Section, render_page
from pchem_pipeline.report.pages.summary import Flag
from pchem_pipeline.report.pages.tables import RMSES, Table

COMPARE_PAGE, COMPARE_JSON = "compare.html", "compare.json"

#: At most so many sentences on what changed are shown; the JSON has all.
_MOST_WORDS = 12
#: At most so many places are shown in a cell; files have all.
_MOST_PLACES = 8
#: Of more runs than so many no maps are drawn pair by pair, and of the ensembles the last ones.
_MOST_DRAWN = 8


def lines_of(found: Comparison) -> list[str]:
    """Return what changed, a line each below a heading for each pair; ``no change`` where nothing did."""
    same = "no change beyond the limits" if found.pairs[0].limits else "no change"
    if not found.changed:
        return [same]
    lines = []
    for pair in found.pairs:
        head = f"{pair.other.name} since the {pair.since} {pair.one.name}:"
        lines += [head, *(f"  {each}" for each in _shown(pair))] if pair.changed else [f"{head} {same}"]
    return lines


def sentence_of(found: Comparison) -> str:
    """Return what came out, in one sentence."""
    if len(found.pairs) == 1:
        return _pair_sentence(found.pairs[0], found.tolerance)
    changed, same = (
        ", ".join(f"{pair.other.label} since {pair.one.label}" for pair in found.pairs if pair.changed is how)
        for how in (True, False)
    )
    if not changed:
        return f"No change: {same}."
    return f"Changed: {changed}." + (f" No change: {same}." if same else "")


def _shown(pair: Pair) -> list[str]:
    more = len(pair.changes) - _MOST_WORDS
    rest = [f"And {more} more; see {COMPARE_JSON}."] if more > 0 else []
    return [*pair.changes[:_MOST_WORDS], *rest]


def _pair_sentence(pair: Pair, tolerance: float) -> str:
    if pair.changed:
        return f"{pair.other.title} differs from {pair.one.title}."
    both = f"{pair.other.title} and {pair.one.title}"
    if pair.limits:
        return f"Of {both}, all that has a limit is within it: {', '.join(pair.limits)}."
    if not pair.same_data:
        pixels = count(pair.n_compared, "pixel")
        return (
            f"Nothing changed: in {pixels} all maps of {both} (different frames) agree within their errors."
        )
    rows = [row for row in pair.arrays if row.counts and row.state in ("identical", "equal")]
    values = sum(row.n_values for row in rows)
    inexact = sum(row.state == "equal" for row in rows)
    what = "are bit-identical" if not inexact else f"are equal ({inexact} arrays within {tolerance:g})"
    return f"Nothing changed: {count(len(rows), 'array')} with {values:,} values {what}."


def render_comparison(found: Comparison, draw: DrawAll) -> tuple[str, str]:
    """Return the page and the JSON of a comparison; nothing is written."""
    many = len(found.pairs) > _MOST_DRAWN
    maps = {pair.key: [] if many else difference_figures(pair) for pair in found.pairs}
    whole = list(ensembles_figures([found.runs[0], *found.runs[1:][-_MOST_DRAWN:]]))
    times = list(history_figures(found.history))
    drawn = draw([*whole, *times, *(each for figures in maps.values() for each in figures)])

    sections = [
        Section(id="verdict", title="Result", verdict=_finding(found.changed, sentence_of(found))),
        Section(id="history", title="History", figures=times, tables=[history_table(found)]),
        *(_pair_section(pair, found, maps[pair.key]) for pair in found.pairs),
        *([Section(id="ensemble", title="Ensembles", figures=whole)] if whole else []),
        Section(id="all-runs", title="Runs", tables=[run_table(found)]),
    ]
    page = render_page("compare.html.j2", sections, drawn, title=" · ".join(run.title for run in found.runs))
    numbers = json.dumps(plain(_numbers(found)), indent=2, allow_nan=False, ensure_ascii=False)
    return page, f"{numbers}\n"


def _finding(changed: bool, sentence: str, changes: Sequence[str] = ()) -> Finding:
    level, name = ("caution", "Changed") if changed else ("good", "No change")
    remarks = [Flag("caution", text) for text in changes]
    return Finding(level, name, sentence.replace(" -", " −"), remarks=remarks)


def _pair_section(pair: Pair, found: Comparison, figures: Sequence[Figure]) -> Section:
    # of a single pair it is said above
    sentence = _pair_sentence(pair, found.tolerance) if len(found.pairs) > 1 else ""
    tables = pair_tables(pair)
    return Section(
        id=f"pair-{pair.key}",
        title=f"{pair.other.title} since the {pair.since} {pair.one.title}",
        verdict=_finding(pair.changed, sentence, _shown(pair)),
        first=tables[:1],
        figures=figures,
        tables=tables[1:],
    )


def _numbers(found: Comparison) -> dict[str, Any]:
    parts = ("median", "median_stderr", "robust_sd")
    return {
        "compare_version": 1,  # of this layout
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
                "medians": {name: dict(zip(parts, row, strict=True)) for name, row in run.summary.items()},
                "pixels": dict(zip(("good", "caution", "no_value"), run.pixels, strict=True)),
                "rmse": run.rmse,
            }
            for run in found.runs
        ],
        "comparisons": [_pair_numbers(pair) for pair in found.pairs],
    }


def _pair_numbers(pair: Pair) -> dict[str, Any]:
    skipped = ("difference", "z", "margin", "changed")
    return {
        "reference": pair.one.label,
        "run": pair.other.label,
        "since": pair.since,
        "limits": pair.limits,
        "same_data": pair.same_data,
        "changed": pair.changed,
        "what": list(pair.changes),
        "maps": {
            name: {key: value for key, value in vars(each).items() if key not in skipped}
            | ({"reasons": vars(pair.reasons[name])} if name in pair.reasons else {})
            for name, each in pair.maps.items()
        },
        "pixels": {"changed": pair.n_changed, "compared": pair.n_compared},
        "quality_transitions": pair.transitions,
        "defects": {
            **{change.replace(" ", "_"): len(each) for change, each in by_change(pair.defects).items()},
            "pixels": [vars(each) for each in pair.defects],
        },
        "arrays": [vars(row) for row in pair.arrays],
        "settings": [vars(setting) for setting in pair.settings],
        "versions": [vars(version) for version in pair.versions],
    }


_GRADES = ("good fit", "use with caution", "no value")


def history_table(found: Comparison) -> Table:
    """Return a row for each run: pixels, flags, effects, and what moved since the first."""
    rows = []
    for row in found.history:
        flags = {name[5:].replace("_", " "): n for name, n in row.items() if name.startswith("flag_")}
        moved = {symbol(name)[1]: row[f"{name}_moved"] for name in MEASURED_MAPS}
        rows.append(
            {
                "label": "" if row["label"] == row["date"] else row["label"],
                "date": row["date"][:16].replace("T", " "),
                "°C": row["temperature"],
                "run": row["run"],
                "good pixels": row["pixels_good"],
                "defects": _defect_words(row),
                "flags": _nonzero_counts(flags) or "none",
                "effects": row["effects"].replace(" ", ", ") or "none",
                "changed": row["moved_pixels"] and f"{row['moved_pixels']} of {row['compared_pixels']}",
                "in": _nonzero_counts(moved),
            }
        )
    return Table(
        "history-runs",
        "Run by run",
        "Changed: pixels with other defects, or with a good fit in both runs and a value that differs from "
        f"the first run significantly (false-discovery rate {found.rate:g}) and by more than its limit. All "
        "medians: history.csv, one line per run.",
        rows,
    )


def _nonzero_counts(numbers: Mapping[str, str]) -> str:
    return ", ".join(f"{name}: {n}" for name, n in numbers.items() if n not in ("", "0"))


def _defect_words(row: HistoryRow) -> str:
    parts = [_nonzero_counts({kind: row[f"{kind}_pixels"] for kind in map(words_of, FAULTS)}) or "none"]
    for change in by_change(()):
        if places := row[f"defects_{change.replace(' ', '_')}"].split():
            shown = ", ".join(places[:_MOST_PLACES])
            more = " …" if len(places) > _MOST_PLACES else ""  # all are in history.csv
            parts.append(f"{len(places):,} {change}: {shown}{more}")
    return "; ".join(parts)


def run_table(found: Comparison) -> Table:
    """Return the runs side by side: sensor, frames, pixels, medians, RMSE."""
    runs = found.runs
    rows = {
        "pixels": [f"{run.shape[0]} × {run.shape[1]}" for run in runs],
        "frames": ["not known" if run.n_frames is None else f"{run.n_frames:,}" for run in runs],
    }
    for place, grade in enumerate(_GRADES):
        counts = [(run.pixels[place], sum(run.pixels)) for run in runs]
        rows[grade] = [f"{n:,} ({percent(n, total)})" for n, total in counts]
    for name in dict.fromkeys(each for run in runs for each in run.summary):
        medians = [run.summary.get(name, (math.nan, math.nan))[:2] for run in runs]
        rows[f"{heading(name)}, median"] = [measured(*median, symbol(name)[2]) for median in medians]
    for name in dict.fromkeys(each for run in runs for each in run.rmse):
        words, unit = RMSES.get(name, (name, "1/DN"))
        rows[f"RMSE, {words} ({unit})"] = [
            scientific(run.rmse[name]) if name in run.rmse else "not known" for run in runs
        ]
    titles = [run.title for run in runs]
    cells = [{"": words} | dict(zip(titles, row, strict=True)) for words, row in rows.items()]
    return Table("runs", "Runs", "", cells)


def pair_tables(pair: Pair) -> list[Table]:
    """Return the tables of a run against the first one; empty ones are left out."""
    settings = [
        _both("setting", pair, each) | {"read by": ", ".join(each.stages) or "no stage"}
        for each in pair.settings
    ]
    versions = [_both("program or algorithm", pair, each) for each in pair.versions]
    shown, one, other = pair.defects[:100], pair.one.label, pair.other.label
    rest = f" The first {len(shown)} of {len(pair.defects):,}." if len(shown) < len(pair.defects) else ""
    defects = [
        {"y": f"{each.y}", "x": f"{each.x}", one: each.before or "none", other: each.now or "none"}
        for each in shown
    ]
    heads = [f"{grade} in {other}" for grade in _GRADES]
    qualities = [
        {"": f"{grade} in {one}"} | dict(zip(heads, (f"{int(n):,}" for n in row), strict=True))
        for grade, row in zip(_GRADES, pair.transitions, strict=False)
    ]
    kinds = f"Kinds as in pchem export --format defects; all pixels: compare.json.{rest}"
    tables = (
        _map_table(pair),
        Table(f"defects-{pair.key}", "Defects that changed", kinds, defects),
        Table(f"quality-{pair.key}", "Pixels by quality", "", qualities),
        Table(f"settings-{pair.key}", "Settings that differ", "", settings),
        Table(f"versions-{pair.key}", "Versions that differ", "", versions),
    )
    return [table for table in tables if table.rows]


def _map_table(pair: Pair) -> Table:
    same = "within the limit" if pair.limits else "within sampling noise"
    rows = [
        {
            "map": heading(name),
            "median": measured(each.median, each.median_stderr) if each.median else "0",
            "median (σ)": f"{each.median_z:+.3f}".replace("-", "−"),
            "scatter (σ)": f"{each.spread_z:.3f}",
            "pixels changed": f"{each.n_changed:,} of {each.n_counted:,}",
            "largest (σ)": short(each.largest_z),
            "": ("changed" if pair.reasons[name] else same) if name in pair.reasons else "",
        }
        for name, each in pair.maps.items()
    ]
    unit_words = (
        "Same frames: sigma is the standard error of one fit."
        if pair.same_data
        else "Different frames: sigma is the standard error of the difference; expected from sampling noise: "
        "median 0, scatter 1."
    )
    return Table(
        f"maps-{pair.key}",
        "Differences of the maps",
        f"{pair.other.label} − {pair.one.label}, pixels with a good fit in both runs. {unit_words}",
        rows,
    )


def _both(what: str, pair: Pair, each: Setting) -> dict[str, str]:
    return {what: each.name, pair.one.label: cut(each.one, 80), pair.other.label: cut(each.other, 80)}
