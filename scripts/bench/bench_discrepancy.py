"""The discrepancy workflow on stacks in which something is hidden: how often it finds what, and at what cost.

Each stack is made by a process of its own (``tests/hidden/make.py``, which shares no code with the package)
with a random sensor and random details of the effect; its key is opened when the verdict stands. Results go,
one line a stack, into ``results.jsonl`` of the folder: an interrupted study goes on where it was, and a
longer one takes over what is there. Every beginning of the study is balanced.

    python scripts/bench/bench_discrepancy.py FOLDER --minutes 30    # as far as it gets, and the figures
    python scripts/bench/bench_discrepancy.py FOLDER --report        # the figures of what is there
    python scripts/bench/bench_discrepancy.py FOLDER --table --minutes 60    # all rows of the table in turn
    python scripts/bench/bench_discrepancy.py FOLDER --table --installed    # of the installed command
    python scripts/bench/bench_discrepancy.py FOLDER --command 3     # what the installed command costs
    python scripts/bench/bench_discrepancy.py FOLDER --null-range --minutes 30    # nothing hidden, any sensor
    python scripts/bench/bench_discrepancy.py FOLDER --null-tails --minutes 15    # only its p-values
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import time
import zlib
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from pathlib import Path
from typing import Any

from discrepancy_cases import EFFECTS, Case, Plan, remaining, table_cases
from discrepancy_command import run_commands
from discrepancy_figures import Answer, print_figures, read_results
from discrepancy_null import MOST_SAMPLES, run_null_range
from discrepancy_table import print_table
from discrepancy_tails import run_null_tails
from discrepancy_worker import run_case

from pchem_pipeline.compute.environment import prepare_environment

RESULTS = "results.jsonl"


def source_state() -> str:
    """Return a name for the present state of the package's source."""
    import pchem_pipeline

    state = 0
    for path in sorted(Path(pchem_pipeline.__file__).parent.rglob("*.py")):
        state = zlib.crc32(path.read_bytes(), state)
    return f"{state:08x}"


def run_study(cases: Iterable[Case], options: argparse.Namespace, path: Path, many: str) -> None:
    """Run cases in a pool of processes, and keep each result as soon as it is there; ``many`` are there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists() and not path.read_bytes().endswith(b"\n") and path.stat().st_size:
        with path.open("a") as file:
            file.write("\n")
    start, state = time.monotonic(), source_state()
    with (
        ProcessPoolExecutor(options.processes, multiprocessing.get_context("spawn")) as pool,
        path.open("a") as file,
    ):
        for number, record in enumerate(_results(pool, cases, options, start), 1):
            file.write(json.dumps(record | {"state": state}) + "\n")
            file.flush()
            answer = Answer(record)
            took = f"{record.get('cpu_seconds', 0):.0f} s" if not answer.failed else answer.failed[:80]
            minutes = (time.monotonic() - start) / 60
            print(
                f"{minutes:6.1f} min {number:5d}/{many}  {record['case']['key']:60s} {answer.word:12s}"
                f" {answer.names}  ({took})",
                flush=True,
            )


def _results(
    pool: ProcessPoolExecutor, cases: Iterable[Case], options: argparse.Namespace, start: float
) -> Iterator[dict[str, Any]]:
    waiting = iter(cases)
    running: set[Future[dict[str, Any]]] = set()
    while True:
        while len(running) < options.processes and time.monotonic() - start < 60 * options.minutes:
            case = next(waiting, None)
            if case is None:
                break
            bias = not (options.no_bias or options.table or options.installed) and case.kind == "single"
            running.add(pool.submit(run_case, case, options.settings, bias, options.installed))
        if not running:
            return
        done, running = wait(running, return_when=FIRST_COMPLETED)
        yield from (future.result() for future in done)


def _settings(text: str) -> dict[str, Any]:
    """Read ``replicates=40,certainty=0.95``."""
    pairs = (item.split("=", 1) for item in text.split(",") if item)
    return {name: json.loads(value) for name, value in pairs}


def parse() -> argparse.Namespace:
    """Read the command line."""
    layout = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=layout)
    parser.add_argument("folder", type=Path, help="of the results")
    parser.add_argument("--effects", nargs="+", choices=EFFECTS, default=list(EFFECTS), metavar="TAG")
    parser.add_argument("--levels", nargs="+", type=float, default=[4.0, 1.5])
    parser.add_argument("--seeds", type=int, default=10, help="stacks of each effect at each level")
    parser.add_argument(
        "--first", type=int, default=0, help="number of the first seed: another one, another study"
    )
    parser.add_argument("--nulls", type=int, default=200)
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--triples", type=int, default=10)
    parser.add_argument("--leave-out", type=int, default=2, help="stacks of each effect that is no candidate")
    parser.add_argument(
        "--others", type=int, default=4, help="of each untestable effect, and of each outside"
    )
    parser.add_argument("--decoys", type=int, default=2, help="of each decoy, at each level")
    parser.add_argument("--sealed", type=int, default=0, help="of each decoy of the sealed half")
    parser.add_argument(
        "--shape", nargs=3, type=int, default=(64, 64, 4000), metavar=("ROWS", "COLUMNS", "FRAMES")
    )
    parser.add_argument("--minutes", type=float, default=1e9, help="start no more stacks after so long")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--no-bias", action="store_true", help="leave out the fits before and after")
    parser.add_argument(
        "--settings", type=_settings, default={}, help="of the workflow: replicates=40,seed=3"
    )
    parser.add_argument("--report", action="store_true", help="only print the figures")
    parser.add_argument(
        "--command", type=int, default=0, metavar="N", help="N stacks through the installed command"
    )
    parser.add_argument(
        "--table",
        action="store_true",
        help="a stack for each row of the table of figures in turn, and the table",
    )
    parser.add_argument("--sealed-decoys", action="store_true", help="in --table: those of the sealed half")
    parser.add_argument(
        "--installed", action="store_true", help="each stack through the installed command, from its file on"
    )
    parser.add_argument(
        "--null-range", action="store_true", help="nothing hidden, sensors of the whole range, in one process"
    )
    parser.add_argument(
        "--null-tails", action="store_true", help="the same small, and only how rare its p-values are"
    )
    parser.add_argument(
        "--most-samples", type=float, default=MOST_SAMPLES, help="frames x pixels of a stack of --null-range"
    )
    return parser.parse_args()


def main() -> None:
    prepare_environment()
    options = parse()
    path = options.folder / RESULTS
    shape = (options.shape[0], options.shape[1], options.shape[2])
    if options.null_range:
        run_null_range(options.folder, options.first, options.minutes, options.most_samples)
        return
    if options.null_tails:
        run_null_tails(options.folder, options.first, options.minutes)
        return
    if options.command:
        run_commands(options.command, options.first, shape, options.folder, options.processes)
        return
    if options.table:
        path = options.folder / "table.jsonl"
        if not options.report:
            done = {r["case"]["key"] for r in read_results(path)}
            cases = table_cases(options.first, shape, sealed=options.sealed_decoys)
            run_study((case for case in cases if case.key not in done), options, path, "")
        print_table({r["case"]["key"]: r for r in read_results(path)}.values())
        return
    names = ("effects", "levels", "seeds", "first", "nulls", "pairs", "triples", "leave_out", "others")
    names += ("decoys", "sealed")
    cases = Plan(**{name: getattr(options, name) for name in names}, shape=shape).cases()
    if not options.report:
        done = {r["case"]["key"] for r in read_results(path)}
        todo = remaining(cases, done)
        print(f"{len(cases)} stacks, {len(cases) - len(todo)} of them done already")
        run_study(todo, options, path, str(len(todo)))
    # of a stack that was done twice, the last one
    records = {r["case"]["key"]: r for r in read_results(path)}
    states = {r["state"] for r in records.values()}
    if len(states) > 1:
        print(f"\nThe results come from {len(states)} states of the source; delete {path} to begin anew.")
    print(f"\n{len(records)} stacks")
    print_figures(records.values())


if __name__ == "__main__":
    main()
