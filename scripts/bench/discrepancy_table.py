"""The table of figures of the discrepancy workflow: each row with its 95 % interval and its cost."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from statistics import median
from typing import Any

import numpy as np
from discrepancy_figures import Answer, at_floor, pulls, wilson
from discrepancy_null import RIGHT

Record = dict[str, Any]
_NOISIEST = 0.35  # e-, of a sensor in which one effect must be named
_OVERLAP, _CLOSED, _ERRORS = 0.8, 0.9, 3.0


def print_table(records: Iterable[Record]) -> None:
    """Print how often each aim was reached, with Wilson's interval, and what the stacks of a row cost."""
    rows = [(record, Answer(record)) for record in records]
    columns = f"{'reached':>9s}{'share':>8s}{'95 %':>14s}   {'aim':9s}{'CPU s: median':>14s}{'longest':>9s}"
    columns += f"{'counted: med.':>14s}{'longest':>9s}"
    print(f"\n{'row':62s}{columns}")

    def of(*kinds: str) -> list[tuple[Record, Answer]]:
        return [row for row in rows if row[1].kind in kinds]

    nothing = [row for row in of("range") if row[0]["verdict"]["verdict"] != "refused"]
    _row("nothing hidden, whole range: any name, or unexplained", nothing, _alarm, "<= 1 %")
    single = [row for row in of("single") if row[0].get("read_noise_e", 0.0) <= _NOISIEST]
    _row(
        "one effect everywhere, 4 to 30 s95, s_e to 0.35: named alone",
        single,
        lambda r, a: a.alone,
        ">= 95 %",
    )
    _row("  a wrong name", single, lambda r, a: bool(a.wrong), "<= 1 %")
    strengths = [(r, a) for r, a in single if a.alone and pulls(r)]
    _row(
        "  strength within 3 standard errors (where it is the same number)",
        strengths,
        lambda r, a: all(abs(z) < _ERRORS for z in pulls(r)),
        ">= 95 %",
    )
    placed = of("placed")
    _row(
        "in a tenth of rows, columns or frames, 12 to 30 s95: named",
        placed,
        lambda r, a: a.hidden <= a.named,
        ">= 85 %",
    )
    named = [(r, a) for r, a in placed if a.hidden <= a.named]
    _row("  where named: place overlaps by 80 %", named, lambda r, a: overlap(r) >= _OVERLAP, ">= 85 %")
    several = of("pair")
    _row("two or three at once: all named", several, lambda r, a: a.hidden <= a.named, ">= 90 %")
    _row("  none invented", several, lambda r, a: not a.wrong, ">= 95 %")
    decoys = of("decoy", "sealed")
    _row("outside the library: no name", decoys, lambda r, a: not a.named, ">= 95 %")
    _row("  measured, and closes 90 % of the gap", decoys, _described, ">= 90 %")
    full = [(r, a) for r, a in single + placed + several if a.verdict == "named"]
    _row(
        "'named': the gap that is left is at its floor", full, lambda r, a: at_floor(r["verdict"]), ">= 95 %"
    )
    _row(
        "all: ended at the limit of the search",
        rows,
        lambda r, a: bool((r.get("verdict") or {}).get("limit")),
        "-",
    )
    failed = [a.failed for _, a in rows if a.failed]
    for error in dict.fromkeys(failed):
        print(f"failed x{failed.count(error)}: {error[:150]}")


def _row(
    title: str, rows: Sequence[tuple[Record, Answer]], true: Callable[[Record, Answer], bool], aim: str
) -> None:
    n = len(rows)
    hits = sum(not a.failed and true(r, a) for r, a in rows)
    low, high = wilson(hits, n)
    # by count: the same on any machine, and whatever else that does
    costs = (
        [r["cpu_seconds"] for r, _ in rows if "cpu_seconds" in r],
        [work for r, _ in rows if (work := (r.get("verdict") or {}).get("work"))],
    )
    cost = "".join(
        f"{median(each):14.0f}{max(each):9.0f}" if each else f"{'-':>14s}{'-':>9s}" for each in costs
    )
    share = f"{100 * hits / n:6.1f} %" if n else f"{'-':>8s}"
    print(
        f"{title:62s}{hits:4d}/{n:<4d}{share}{f'[{100 * low:.0f}, {100 * high:.0f}]':>14s}   {aim:9s}{cost}"
    )


def _alarm(record: Record, answer: Answer) -> bool:
    return answer.verdict not in RIGHT


def _described(record: Record, answer: Answer) -> bool:
    verdict = record["verdict"]
    return answer.verdict == "described" and verdict["gap"]["closed_fraction"] >= _CLOSED


def overlap(record: Record) -> float:
    """Return Jaccard's index of the place of the hidden effect and that of the named one."""
    from pchem_pipeline.effects.framework.region import Region, When

    case = record["case"]
    axis, begin, end = case["place"]
    rows, columns, frames = case["shape"]
    effect = next(e for e in record["verdict"]["model_effects"] if e["tag"] in case["hidden"])
    samples = [np.ones((rows, columns), np.bool_), np.ones(frames, np.bool_)]
    found = [each.copy() for each in samples]
    if effect.get("region"):
        found[0] &= Region.model_validate(effect["region"]).mask((rows, columns))
    if effect.get("when"):
        found[1] &= When.model_validate(effect["when"]).frames(np.arange(frames))
    inside = slice(begin, end)
    mask = np.zeros_like(samples[1 if axis == "frames" else 0])
    mask[inside if axis in ("rows", "frames") else (slice(None), inside)] = True
    truth = [samples[0], mask] if axis == "frames" else [mask, samples[1]]
    both = np.prod([float((a & b).sum()) for a, b in zip(truth, found, strict=True)])
    sizes = [np.prod([float(each.sum()) for each in pair]) for pair in (truth, found)]
    return float(both / (sizes[0] + sizes[1] - both))
