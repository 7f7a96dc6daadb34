"""How often is a number that is called good wrong? Random pixels and whole runs, independently judged.

1. Pixels over the whole box (H 0.001 to 60 e-, read noise 0.05 to 1 e-, 1.2 to 1,500 DN per electron, 100
   to 20,000 frames, a quarter clipped at one end), drawn by plain numpy and fitted; those that are neither
   failed nor flagged are judged by a many-start likelihood, see ``trust_pixels.py``.
2. Runs of ``pchem run`` on files of random sensors with a random mishap or none, see ``trust_runs.py``.

    python scripts/validation/trust_study.py                          # both
    python scripts/validation/trust_study.py --runs 0 --pixels 300    # some pixels alone
    python scripts/validation/trust_study.py --only 17                # one pixel again, in full
    python scripts/validation/trust_study.py --only-run 17            # one run again, its files kept
    python scripts/validation/trust_study.py --write-docs docs/trust.md
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import beta

from pchem_pipeline.compute.environment import prepare_environment

prepare_environment()

import trust_pixels  # noqa: E402
import trust_runs  # noqa: E402

from pchem_pipeline.model.fit import status  # noqa: E402

MARKS = ("<!-- trust study: begin -->", "<!-- trust study: end -->")
EDGES: dict[str, tuple[float, ...]] = {
    "H": (0.001, 0.03, 0.5, 5, 60),
    "noise": (0.05, 0.16, 0.35, 0.5, 1),
    "step": (1.2, 3, 30, 300, 1500),
    "frames": (100, 1000, 5000, 20_000),
}
TITLES = {
    "H": "H, e-",
    "noise": "read noise, e-",
    "step": "DN per electron",
    "frames": "frames",
    "clipped": "clipped",
}


def interval(hits: int, n: int) -> str:
    """Return a share with its 95 % interval (Clopper and Pearson 1934), %."""
    if n == 0:
        return "-"
    low = beta.ppf(0.025, hits, n - hits + 1) if hits else 0.0
    high = beta.ppf(0.975, hits + 1, n - hits) if hits < n else 1.0
    return f"{100 * hits / n:.2g} ({100 * low:.2g} to {100 * high:.2g})"


def study_pixels(n: int, seed: int) -> list[dict[str, Any]]:
    """Draw, fit and judge pixels; return a row for each."""
    rows: list[dict[str, Any]] = []
    first = seed * 1_000_000
    for numbers in np.array_split(np.arange(first, first + n), max(1, n // 500)):
        pixels = [trust_pixels.draw(int(number)) for number in numbers]
        fits = trust_pixels.fit(pixels)
        good = trust_pixels.good_words(fits.words)
        rows += [_row(pixel, fits, good[i], i) for i, pixel in enumerate(pixels)]
    return rows


def _row(
    pixel: trust_pixels.Pixel, fits: trust_pixels.Fits, good: NDArray[np.bool_], i: int
) -> dict[str, Any]:
    """Return what is known of the i-th pixel of a batch; ``good`` says which of its quantities are."""
    values, stderr, word = fits.values[i], fits.stderr[i], int(fits.words[i])
    right = bool((np.abs(values - pixel.truth) < 5 * stderr).all())
    row: dict[str, Any] = {"number": pixel.number, **pixel.regime, "word": word, "right": right}
    row |= {"failed": bool(word & int(status.FAILED)), "good": bool(good.all()), "part": bool(good.any())}
    if not good.any():
        return row | {"kind": "", "beyond": []}
    verdict = trust_pixels.judge(pixel, values, stderr, good)
    row |= {"kind": verdict.kind, "beyond": verdict.beyond, "best": verdict.best, "truth": verdict.truth}
    return row | {"ratio": list(values / pixel.truth), "rival": list(verdict.at / pixel.truth)}


def summary(name: str, rows: list[dict[str, Any]]) -> list[str]:
    """Return the cells of one line of the table of pixels."""
    judged = [row for row in rows if row["part"]]
    flagged = [row for row in rows if not row["good"] and not row["failed"]]
    numbers = (sum(row["good"] for row in rows), len(flagged), sum(row["failed"] for row in rows))
    shares = [f"{100 * n / max(len(rows), 1):.0f} %" for n in numbers]
    right = f"{100 * sum(row['right'] for row in flagged) / max(len(flagged), 1):.0f} %"
    wrong, beyond = (sum(bool(row[name]) for row in judged) for name in ("kind", "beyond"))
    counts = [f"{wrong} of {len(judged)}", interval(wrong, len(judged)), str(beyond)]
    return [name, str(len(rows)), *shares, right, *counts]


def within(rows: list[dict[str, Any]], key: str, low: float, high: float) -> list[dict[str, Any]]:
    """Return the rows with a number in a range."""
    return [row for row in rows if low <= row[key] < high * (1 + 1e-9)]


def pixel_tables(rows: list[dict[str, Any]]) -> str:
    """Return the tables of the pixels by regime, and the wrong ones with their numbers."""
    head = ["", "pixels", "all four good", "flagged", "failed", "flagged, but correct"]
    head += ["wrong of those with a good value", "%, 95 % interval", "beyond 5 errors"]
    lines = [summary("all", rows)]
    for key, edges in EDGES.items():
        for low, high in pairwise(edges):
            lines.append(summary(f"{TITLES[key]}: {low:g} to {high:g}", within(rows, key, low, high)))
    for end in ("", "low", "high"):
        lines.append(summary(f"clipped: {end or 'no'}", [row for row in rows if row["clipped"] == end]))
    cross = []
    for low, high in pairwise(EDGES["H"]):
        cells = [f"{low:g} to {high:g}"]
        for bottom, top in pairwise(EDGES["noise"]):
            inside = within(within(rows, "H", low, high), "noise", bottom, top)
            judged = [row for row in inside if row["part"]]
            cells.append(f"{sum(bool(row['kind']) for row in judged)} of {len(judged)} ({len(inside)})")
        cross.append(cells)
    noises = [f"{a:g} to {b:g} e-" for a, b in pairwise(EDGES["noise"])]
    text = table(head, lines) + "\nWrong of good (of all drawn), by H (e-, rows) and read noise:\n\n"
    return text + table(["H", *noises], cross)


def wrong_pixels(rows: list[dict[str, Any]]) -> str:
    """Return the wrong pixels, each with the number that draws it again."""
    head = ["--only", "kind", "H", "noise", "DN/e-", "frames", "clipped", "nats"]
    head += ["H, g, mu, sigma over truth", "beyond"]
    lines = []
    for row in rows:
        if row["kind"]:
            numbers = [f"{row[key]:.3g}" for key in ("H", "noise", "step")]
            cells = [str(row["number"]), row["kind"], *numbers, str(row["frames"]), row["clipped"]]
            ratio = " ".join(f"{each:.3f}" for each in row["ratio"])
            lines.append([*cells, f"{row['best']:.1f}", ratio, ", ".join(row["beyond"])])
    return table(head, lines)


def run_table(rows: list[dict[str, Any]]) -> str:
    """Return the table of the runs, by mishap."""
    head = ["fault", "runs", "refused", "not reliable or none", "wrong, reported as good", "not reported"]
    head += ["remedy fails", "raw exception", "values beyond 5 errors"]
    lines = [run_line("all", rows)]
    for name, (title, _) in trust_runs.MISHAPS.items():
        lines.append(run_line(title, [row for row in rows if row["mishap"] == name]))
    return table(head, lines)


def run_line(title: str, rows: list[dict[str, Any]]) -> list[str]:
    """Return the cells of one line of the table of runs; what a report calls No is not called good."""
    good = [row for row in rows if not row["no"]]
    counts = [len(rows), *(sum(row[name] for row in rows) for name in ("refused", "no"))]
    counts += [sum(bool(row["wrong"]) for row in good)]
    counts += [sum(row[name] for row in rows) for name in ("silent", "uncured", "traceback")]
    values = f"{sum(row.get('beyond', 0) for row in good)} of {sum(row.get('pixels', 0) for row in good):,}"
    return [title, *map(str, counts), values]


def odd_runs(rows: list[dict[str, Any]]) -> str:
    """Return the runs that are wrong, silent or end badly, each with the number that repeats it."""
    head = ["--only-run", "what happened", "exit code", "answer", "wrong", "further"]
    lines = []
    for row in rows:
        further = [name for name in ("silent", "uncured", "traceback") if row[name]]
        if further or (row["wrong"] and not row["no"]):
            cells = [row["number"], row["mishap"], row["code"], row["answer"], "; ".join(row["wrong"])]
            lines.append([*map(str, cells), ", ".join(further)])
    return table(head, lines)


def show_run(number: int) -> None:
    """Do one run again, print its output, and say where its files are."""
    folder = Path(tempfile.mkdtemp(prefix="trust-"))
    row = trust_runs.study_run(number, folder)
    print(row.pop("text"), json.dumps(row, default=str), f"files in {folder}", sep="\n")


def table(head: Iterable[str], lines: Iterable[Iterable[str]]) -> str:
    """Return a table in Markdown."""
    rows = [list(head), *map(list, lines)]
    rows.insert(1, ["---"] * len(rows[0]))
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def show_pixel(number: int) -> None:
    """Print what is known of one pixel."""
    pixel = trust_pixels.draw(number)
    fits = trust_pixels.fit([pixel])
    print(json.dumps(pixel.regime), status.describe(int(fits.words[0])), sep="\n")
    print("samples", pixel.samples.min(), "to", pixel.samples.max(), "mean", pixel.samples.mean())
    for name, row in zip(
        ("truth", "fit", "stderr"), (pixel.truth, fits.values[0], fits.stderr[0]), strict=True
    ):
        print(f"{name:8s}", *(f"{value:14.6g}" for value in row))
    if np.isfinite(fits.values[0]).all():
        verdict = trust_pixels.judge(pixel, fits.values[0], fits.stderr[0], np.ones(4, bool))
        print("judge   ", *(f"{value:14.6g}" for value in verdict.at))
        print(
            f"nats over the fit: truth {verdict.truth:.2f}, judge {verdict.best:.2f};",
            verdict.kind or "right",
            *verdict.beyond,
        )


def write_docs(path: Path, text: str) -> None:
    """Replace the block between the marks of a page.

    Raises:
        SystemExit: the page has no such block.
    """
    page = path.read_text()
    begin, end = (page.find(mark) for mark in MARKS)
    if begin < 0 or end < begin:
        sys.exit(f"{path}: no block between {MARKS[0]} and {MARKS[1]}")
    path.write_text(page[: begin + len(MARKS[0])] + "\n" + text + page[end:])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pixels", type=int, default=3000)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="number of one pixel, shown in full")
    parser.add_argument("--only-run", type=int, help="number of one run, shown in full")
    parser.add_argument("--json", type=Path, default=Path("trust_study.json"), help="every pixel and run")
    parser.add_argument("--write-docs", type=Path, help="page whose block of tables is replaced")
    options = parser.parse_args()
    if options.only is not None:
        show_pixel(options.only)
    if options.only_run is not None:
        show_run(options.only_run)
    if options.only is not None or options.only_run is not None:
        return
    text = ""
    record: dict[str, Any] = {"seed": options.seed}
    if options.pixels:
        begin = time.process_time()
        record["pixels"] = rows = study_pixels(options.pixels, options.seed)
        text += f"\n{len(rows):,} pixels, seed {options.seed}:\n\n{pixel_tables(rows)}"
        print(text, wrong_pixels(rows), f"{time.process_time() - begin:.0f} CPU s", sep="\n", flush=True)
    if options.runs:
        begin = time.process_time()
        with tempfile.TemporaryDirectory(prefix="trust-") as folder:
            record["runs"] = rows = trust_runs.study_runs(options.runs, options.seed, Path(folder))
        block = f"\n{len(rows)} runs, seed {options.seed}:\n\n{run_table(rows)}"
        text += block
        print(block, odd_runs(rows), f"{time.process_time() - begin:.0f} CPU s", sep="\n")
    options.json.write_text(json.dumps(record, indent=1, default=float))
    if options.write_docs:
        write_docs(options.write_docs, text)


if __name__ == "__main__":
    main()
