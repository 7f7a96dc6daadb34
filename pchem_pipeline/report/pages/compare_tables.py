"""Tables of a comparison of runs."""

from __future__ import annotations

from pchem_pipeline.model.checks.run_differences import FAR
from pchem_pipeline.report.pages.compare_data import ArrayRow, Comparison, Pair, Setting
from pchem_pipeline.report.pages.tables import Table
from pchem_pipeline.report.style.wording import measured, percent, scientific, short, symbol

__all__ = ["pair_tables", "run_table"]

_GRADES = ("good fit", "use with caution", "no value")
_STATES = {
    "identical": "identical to the bit",
    "equal": "equal within rounding",
    "changed": "changed",
    "lost": "not there any more",
    "new": "new",
}


def run_table(found: Comparison) -> Table:
    """Return the runs side by side: sensor, frames, pixels, medians, RMSE."""
    runs = found.runs
    rows: list[tuple[str, ...]] = [
        ("pixels", *(f"{run.shape[0]} × {run.shape[1]}" for run in runs)),
        ("frames", *("not known" if run.n_frames is None else f"{run.n_frames:,}" for run in runs)),
    ]
    for place, grade in enumerate(_GRADES):
        rows.append(
            (
                grade,
                *(f"{run.pixels[place]:,} ({percent(run.pixels[place], sum(run.pixels))})" for run in runs),
            )
        )
    for name in dict.fromkeys(each for run in runs for each in run.summary):
        nan = (float("nan"),) * 3
        cells = [measured(*run.summary.get(name, nan)[:2], symbol(name)[2]) for run in runs]
        rows.append((f"{symbol(name)[1]} ({symbol(name)[2]}), median", *cells))
    for name in dict.fromkeys(each for run in runs for each in run.rmse):
        cells = [scientific(run.rmse[name]) if name in run.rmse else "not known" for run in runs]
        rows.append((f"RMSE, {name.replace('_', ' ')}", *cells))
    return Table("runs", "The runs", "", ("", *(run.words for run in runs)), tuple(rows))


def pair_tables(pair: Pair, tolerance: float) -> list[Table]:
    """Return the tables of a run against the first one; empty ones are left out."""
    tables = (_maps(pair), _transitions(pair), _settings(pair), _versions(pair), _arrays(pair, tolerance))
    return [table for table in tables if table.rows]


def _maps(pair: Pair) -> Table:
    rows = []
    for name, each in pair.maps.items():
        _, words, unit = symbol(name)
        reason = pair.reasons.get(name)
        verdict = "" if reason is None else "changed" if reason else "as chance allows"
        rows.append(
            (
                f"{words} ({unit})",
                measured(each.median, each.median_stderr) if each.median else "0",
                f"{each.median_z:+.3f}".replace("-", "−"),
                f"{each.spread_z:.3f}",
                f"{each.n_far:,} of {each.n_counted:,}",
                short(each.largest_z),
                verdict,
            )
        )
    unit_words = (
        "Both runs come from the same frames: the unit is the standard error of one fit."
        if pair.same_data
        else "Different frames: the unit is the standard error of the difference; chance gives a median of 0 "
        "and a scatter of 1."
    )
    return Table(
        f"maps-{pair.other.label}",
        "Differences of the maps",
        f"{pair.other.label} − {pair.one.label}, over pixels with a good fit in both. {unit_words}",
        ("map", "median", "median (std. errors)", "scatter (std. errors)", f"beyond ±{FAR:g}", "largest", ""),
        tuple(rows),
    )


def _transitions(pair: Pair) -> Table:
    rows = tuple(
        (f"{_GRADES[i]} in {pair.one.label}", *(f"{int(n):,}" for n in row))
        for i, row in enumerate(pair.transitions)
    )
    heads = tuple(f"{grade} in {pair.other.label}" for grade in _GRADES)
    return Table(f"quality-{pair.other.label}", "Pixels by quality", "", ("", *heads), rows)


def _settings(pair: Pair) -> Table:
    return Table(
        f"settings-{pair.other.label}",
        "Settings that differ",
        "A setting that no stage reads changes no result.",
        ("setting", pair.one.label, pair.other.label, "read by"),
        tuple((*_both(each), ", ".join(each.stages) or "no stage") for each in pair.settings),
    )


def _versions(pair: Pair) -> Table:
    return Table(
        f"versions-{pair.other.label}",
        "Versions that differ",
        "",
        ("program or algorithm", pair.one.label, pair.other.label),
        tuple(_both(each) for each in pair.versions),
    )


def _both(each: Setting) -> tuple[str, str, str]:
    return each.name, _cut(each.one), _cut(each.other)


def _cut(text: str, most: int = 80) -> str:
    return text if len(text) <= most else f"{text[: most - 1]}…"


def _arrays(pair: Pair, tolerance: float) -> Table:
    order = {"changed": 0, "lost": 1, "new": 2, "equal": 3, "identical": 4}
    rows = sorted(pair.arrays, key=lambda row: order[row.state])
    return Table(
        f"arrays-{pair.other.label}",
        "Every array of the results",
        f"Rounding is a difference below {tolerance:g} of the largest value of the array. The digests of all "
        "values (SHA-256) are in compare.json in full.",
        ("array", "state", "values", "differ", "beyond rounding", "largest difference", "SHA-256"),
        tuple(_array_cells(row) for row in rows),
    )


def _array_cells(row: ArrayRow) -> tuple[str, ...]:
    state = row.why or _STATES[row.state]
    if not row.counts:
        state += "; no result, not counted"
    digests = dict.fromkeys(digest[:12] for digest in row.sha256 if digest)
    if row.state in ("lost", "new"):
        return row.name, state, "", "", "", "", ""
    return (
        row.name,
        state,
        f"{row.n_values:,}",
        f"{row.n_different:,}",
        f"{row.n_beyond:,}",
        short(row.largest) if row.largest else "0",
        ", ".join(digests),
    )
