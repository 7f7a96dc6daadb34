#!/usr/bin/env python3
"""What commands take of the memory that ``--max-memory`` allows, as the kernel counts it.

``.venv/bin/python scripts/validation/memory_limits.py`` does the commands of `kills.py` on 128 x 128
pixels, first as they are (which compiles what is missing), then with each limit. A limit is kept where the
command with all its processes stays below it by 10 % more, or ends in one line that says what it would take.
"""

import argparse
import re
import sys
import tempfile
from pathlib import Path

from kills import PCHEM, WORKS, Bench

sys.path.insert(0, str(Path(__file__).parents[1] / "bench"))
from process_tree import Took, run_measured

ALLOWED = 1.1


def verdict(took: Took, limit: int) -> str:
    """Return whether a command kept to a limit, MiB."""
    if took.code in (0, 3):
        return "kept" if took.tree <= ALLOWED * limit else "NOT KEPT"
    line = took.words.strip().splitlines()[-1]
    if took.code in (2, 4) and re.search(r"\d+ MiB", line) and "Traceback" not in took.words:
        return f"refused: {line}"
    return f"WRONG: {took.code}: {line}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--side", type=int, default=128)
    parser.add_argument("--frames", type=int, default=1200)
    parser.add_argument("--limits", default="400,270", help="MiB, with commas")
    parser.add_argument("--only", help="names of commands, with commas")
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="memory_limits_"))
    bench = Bench(folder, "threads", options.side, options.frames)
    wrong = 0
    for work in WORKS:
        if options.only is not None and work.name not in options.only.split(","):
            continue
        bench.begin(work)
        bench.ok(*work.command)  # compiles
        for limit in (None, *map(int, options.limits.split(","))):
            bench.begin(work)
            allowed = [] if limit is None else ["--max-memory", str(limit)]
            took = run_measured([PCHEM, *work.command, "--quiet", *allowed], bench.case)
            words = "" if limit is None else verdict(took, limit)
            wrong += words.startswith(("NOT", "WRONG"))
            name = f"{work.name}, limit {limit or 'none'}:"
            print(f"{name:28s} {took.tree:5.0f} MiB, {took.cpu:5.1f} CPU s  {words}", flush=True)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
