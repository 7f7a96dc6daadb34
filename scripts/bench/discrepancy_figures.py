"""The figures of the study, from its records."""

from __future__ import annotations

import json
import math
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from discrepancy_cases import EFFECTS, twins_of

Record = dict[str, Any]
_LARGEST_SET = 3
_STRONG = 4.0  # times s95
_GOOD_SENSOR = 0.32  # e-, about the middle of the sensors that are drawn


def read_results(path: Path) -> list[Record]:
    """Return the records of a study; a last line that was cut off is left out."""
    records = []
    for line in path.read_text().splitlines() if path.exists() else []:
        try:
            records.append(json.loads(line))
        except json.JSONDecodeError:
            print(f"{path}: an incomplete line is left out", file=sys.stderr)
    return records


class Answer:
    """What the verdict of one record says, beside what was hidden."""

    def __init__(self, record: Record):
        """Read a record."""
        case, verdict = record["case"], record.get("verdict") or {}
        self.kind: str = case["kind"]
        self.level: float = case["level"]
        self.hidden = set(case["hidden"])
        self.failed = record.get("error")
        self.verdict: str = verdict.get("verdict", "error") if not self.failed else "error"
        self.named = set(verdict.get("effects", []))
        steps = verdict.get("steps", [])
        #: sets that could not be told apart; a demoted step of an unexplained stack names nobody
        self.sets = [
            {c["effect"] for c in step["candidates"]}
            for step in steps
            if step["effect"] is None and self.verdict == "ambiguous"
        ]
        self.wrong = self.named - self.hidden

    @property
    def alone(self) -> bool:
        """All that is hidden is named, and nothing else."""
        return self.named == self.hidden and not self.sets

    @property
    def within(self) -> bool:
        """Each hidden effect is named or in a small set, and none is invented."""
        small = [s for s in self.sets if len(s) <= _LARGEST_SET]
        return not self.wrong and all(
            tag in self.named or any(tag in names for names in small) for tag in self.hidden
        )

    @property
    def answered(self) -> bool:
        """Some name was given, alone or in a set."""
        return bool(self.named or self.sets)

    @property
    def silent(self) -> bool:
        """The frames were found to agree with the model."""
        return self.verdict == "consistent"

    @property
    def word(self) -> str:
        """The column of the confusion matrix."""
        if self.failed:
            return "error"
        if self.hidden and self.alone:
            return "alone"
        if self.wrong:
            return "wrong"
        if self.hidden and self.within:
            return "in set"
        words = {"named": "part", "named_in_part": "part", "ambiguous": "other set"}
        return words.get(self.verdict, self.verdict)

    @property
    def names(self) -> str:
        """What was said, in short."""
        parts = sorted(self.named) + ["|".join(sorted(s)) for s in self.sets]
        return " + ".join(parts) or self.verdict


def wilson(hits: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a fraction."""
    if n == 0:
        return 0.0, 1.0
    z, p = 1.96, hits / n
    middle, spread = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    low, high = ((middle + side * spread) / (1 + z * z / n) for side in (-1, 1))
    return max(low, 0.0), min(high, 1.0)


def _line(title: str, hits: int, n: int, target: str, reached: bool | None) -> None:
    if n == 0:
        print(f"  {title:74s}{'-':>9s}{'':>16s}   target {target}")
        return
    low, high = wilson(hits, n)
    mark = "" if reached is None else ("  reached" if reached else "  MISSED")
    print(
        f"  {title:74s}{hits:4d}/{n:<4d}{100 * hits / n:6.1f} % [{100 * low:.0f}, {100 * high:.0f}]"
        f"   target {target}{mark}"
    )


def _share(
    title: str, which: Sequence[Any], true: Callable[[Any], bool], *, least: float = 0, most: float = 1
) -> None:
    hits, n = sum(bool(true(one)) for one in which), len(which)
    target = f">= {100 * least:g} %" if least else f"<= {100 * most:g} %"
    _line(title, hits, n, target, None if n == 0 else least <= hits / n <= most)


def print_figures(records: Iterable[Record]) -> None:
    """Print the confusion matrix and every figure beside its target."""
    records = list(records)
    answers = [Answer(record) for record in records]
    _confusion(answers)
    _naming(answers)
    pairs = list(zip(records, answers, strict=True))
    single = [(r, a) for r, a in pairs if a.kind == "single"]
    _by_read_noise(single)
    _strengths(single)
    _gaps(single)
    compared = [(r, a) for r, a in pairs if r.get("bias")]
    print("\nBias of the maps by the effect, in standard errors of a pixel, mean over the pixels it touches,")
    print("against the plain fit of the same stack without the effect; without -> with the named effects")
    _biases("all", [r for r, _ in compared], 6)
    _biases("named alone", [r for r, a in compared if a.alone], 0)
    _times(records)


def _confusion(answers: Sequence[Answer]) -> None:
    columns = ("alone", "in set", "other set", "part", "wrong", "unexplained", "consistent", "error")
    print("\nHidden (rows) and what the workflow said (columns, stacks); 'said': answers other than it alone")
    print(f"{'':14s}{'hidden':26s}{'level':>6s}" + "".join(f"{c:>12s}" for c in columns) + "  said")
    rows: dict[tuple[str, str, float], list[Answer]] = defaultdict(list)
    for answer in answers:
        name = "+".join(sorted(answer.hidden)) if answer.kind != "pair" else f"{len(answer.hidden)} effects"
        rows[answer.kind, name or "nothing", answer.level].append(answer)
    order = {tag: i for i, tag in enumerate(EFFECTS)}
    for (kind, name, level), group in sorted(
        rows.items(), key=lambda row: (row[0][0], row[0][2], order.get(row[0][1], 99), row[0][1])
    ):
        words = Counter(answer.word for answer in group)
        others = Counter(a.names for a in group if a.word in ("wrong", "other set", "part", "in set"))
        said = "; ".join(f"{text} x{n}" if n > 1 else text for text, n in others.most_common(4))
        print(
            f"{kind:14s}{name:26s}{level:6g}"
            + "".join(f"{words[c] or '':>12}" for c in columns)
            + f"  {said}"
        )


def _naming(answers: Sequence[Answer]) -> None:
    print("\nNaming")
    for level in sorted({a.level for a in answers if a.kind == "single"}):
        alone, inside, wrong = (0.0, 0.85, 0.05) if level < _STRONG else (0.95, 0.98, 0.01)
        group = [a for a in answers if a.kind == "single" and a.level == level]
        if alone:
            _share(f"single effects, {level:g} s95: named alone", group, lambda a: a.alone, least=alone)
        _share(
            f"single effects, {level:g} s95: named or in a set of <= 3",
            group,
            lambda a: a.within,
            least=inside,
        )
        _share(f"single effects, {level:g} s95: a wrong name", group, lambda a: a.wrong, most=wrong)
    group = [a for a in answers if a.kind == "null"]
    _share("nothing hidden: any name", group, lambda a: a.named, most=0.02)
    _share("nothing hidden: any name, or a set", group, lambda a: a.answered, most=0.02)
    _share("nothing hidden: anything but consistent", group, lambda a: a.verdict != "consistent", most=0.05)
    group = [a for a in answers if a.kind == "untestable"]
    _share("untestable effects: any name", group, lambda a: a.answered, most=0.0)
    group = [a for a in answers if a.kind == "pair"]
    _share("two or three at once: all named or in their set", group, lambda a: a.within, least=0.9)
    _share("two or three at once: one invented", group, lambda a: a.wrong, most=0.0)
    for kind, title in (("left_out", "left out of the candidates"), ("outside", "outside the library")):
        group = [a for a in answers if a.kind == kind]
        _share(f"{title}: a wrong name", group, lambda a: a.wrong, most=0.05)
        if kind == "left_out":
            _share(
                f"{title}: a wrong name that is no near twin",
                group,
                lambda a: any(a.wrong - twins_of(tag) for tag in a.hidden),
                most=0.05,
            )
        _share(f"{title}: unexplained", group, lambda a: a.verdict == "unexplained", least=0.5)

    for kind in ("decoy", "sealed"):
        group = [a for a in answers if a.kind == kind]
        _share(f"{kind}s: any name", group, lambda a: a.answered, most=0.05)
        _share(f"{kind}s: seen", group, lambda a: not a.silent, least=0.5)


def _strengths(pairs: Sequence[tuple[Record, Answer]]) -> None:
    """Print how far named strengths lie from the truth, where both are the same number."""
    print(
        "\nStrength of effects named alone, in its standard errors from the truth (those of the same meaning)"
    )
    for level in sorted({a.level for _, a in pairs}):
        off = [pull for r, a in pairs if a.alone and a.level == level for pull in pulls(r)]
        _share(
            f"single effects, {level:g} s95: within 3 standard errors", off, lambda z: abs(z) < 3, least=0.95
        )


#: parameter of the package that is the hidden strength itself
_SAME_STRENGTH = {
    "frame_noise": "frame_noise_dn", "row_noise": "row_noise_dn", "column_noise": "column_noise_dn",
}  # fmt: skip


def pulls(record: Record) -> list[float]:
    """Return the deviation of the found strength in standard errors, none where the meanings differ."""
    [hidden], steps = record.get("hidden") or [{"tag": "", "parameters": {}}], record["verdict"]["steps"]
    name = _SAME_STRENGTH.get(hidden["tag"], "")
    if hidden["tag"] == "signal_dependent_noise" and hidden["parameters"].get("grows_with") == "root":
        name = "noise_e"
    if hidden["tag"] == "overdispersed_counts" and hidden["parameters"].get("law") == "gamma":
        name = "relative_variance"
    found = steps[0].get("parameters", {}).get(name) if steps else None
    if not found or not found["stderr"]:
        return []
    return [(found["value"] - hidden["strength"]) / found["stderr"]]


def _by_read_noise(pairs: Sequence[tuple[Record, Answer]]) -> None:
    """Print how naming depends on the sensor: the hidden strengths are those of a typical one."""
    print(f"\nSingle effects by the read noise of the sensor (above or below {_GOOD_SENSOR:g} e-)")
    for level in (4.0, 1.5):
        for title, low, high in (("below", 0.0, _GOOD_SENSOR), ("above", _GOOD_SENSOR, math.inf)):
            group = [
                a for r, a in pairs if a.level == level and low <= r.get("read_noise_e", math.nan) < high
            ]
            for words, true in (("named or in a set of <= 3", "within"), ("nothing said", "silent")):
                hits = sum(getattr(a, true) for a in group)
                _line(f"{level:g} s95, {title}: {words}", hits, len(group), "-", None)


def _gaps(pairs: Sequence[tuple[Record, Answer]]) -> None:
    print("\nGap on frames never used (single effects)")
    for level in (4.0, 1.5):
        named = [r["verdict"] for r, a in pairs if a.level == level and a.alone]
        every = [r["verdict"] for r, a in pairs if a.level == level and not a.failed]
        for title, group in (("all", every), ("named alone", named)):
            _share(f"{level:g} s95, {title}: at its floor after", group, at_floor, least=0.9)
        if named:
            closed = sorted(v["gap"]["closed_fraction"] for v in named)
            print(f"    closed fraction where named: median {median(closed):.3f}, lowest {closed[0]:.3f}")
    strong = [(r["verdict"]["steps"][0], a) for r, a in pairs if a.level == 4.0 and a.alone]
    rivals = [s for s, _ in strong if s.get("rivals") and s["gap_before"] > 0]
    _share("4 s95: the right name closes more than the runner-up", rivals, _better_than_runner_up, least=1.0)


def at_floor(verdict: dict[str, Any]) -> bool:
    """Tell whether the gap that a verdict leaves is at its floor."""
    return bool(verdict["gap"]["after"] <= verdict["gap"]["floor"])


def _better_than_runner_up(step: dict[str, Any]) -> bool:
    return bool(step["gap_after"] < step["rivals"][0]["gap_after"] or step["gap_after"] <= step["gap_floor"])


def _biases(which: str, records: Sequence[Record], most: int) -> None:
    """Print how often a bias was cut, and the largest ones."""
    for name in ("quanta_exposure", "conversion_gain", "bias", "read_noise_e"):
        rows = [(r["case"], r["bias"][name]) for r in records]
        for limit, title in ((1.0, "one s.e. of a pixel"), (None, "5 s.e. of the mean of all")):
            large = [
                (case, b)
                for case, b in rows
                if abs(b["before"]) > (limit or 5 / math.sqrt(max(b["pixels"], 1)))
            ]
            _share(
                f"{which}, {name}: beyond {title}: cut 5 times",
                [b for _, b in large],
                lambda b: abs(b["after"]) <= max(abs(b["before"]) / 5, 2 * b["chance"]),
                least=0.9,
            )
            for case, b in sorted(large, key=lambda row: -abs(row[1]["before"]))[:most]:
                tag = "+".join(case["hidden"])
                print(
                    f"      {tag:26s}{case['level']:4g} s95{b['before']:9.2f} -> {b['after']:7.2f}"
                    f" +- {b['chance']:.2f}"
                )


def _times(records: Sequence[Record]) -> None:
    seconds = sorted(r["cpu_seconds"] for r in records if "cpu_seconds" in r)
    if seconds:
        stacks = sorted(r["verdict"]["replicates"] for r in records if r.get("verdict"))
        print(f"\nCPU seconds a stack: median {median(seconds):.0f}, longest {seconds[-1]:.0f}", end="")
        print(f"; simulated stacks: median {median(stacks):g}, most {stacks[-1]}")
    errors = [r.get(kind) for r in records for kind in ("error", "bias_error")]
    failed = Counter(error[:110] for error in errors if error)
    for error, n in failed.most_common(8):
        print(f"failed x{n}: {error}")
