#!/usr/bin/env python3
"""Damage camera files of all formats in many ways, and read them: the same frames, or one clear line.

``.venv/bin/python scripts/validation/fuzz_formats.py --cases 20000`` takes some five minutes. It prints each
case that ended in any other way, and a table of the outcomes of each layout. A case is drawn from its number
alone: ``--first 4575 --cases 1`` repeats one, and leaves its files in the folder that is printed.
"""

import argparse
import sys
import tempfile
from collections import Counter, defaultdict
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
from helpers.damaged_formats import run_cases

OUTCOMES = ("same", "silent", "refused", "foreign", "slow", "greedy", "crashed")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=20_000)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="fuzz_formats_"))
    table: defaultdict[str, Counter[str]] = defaultdict(Counter)
    longest, most, bad = 0.0, 0, 0
    for case in run_cases(folder, options.first, options.first + options.cases):
        table[case.layout][case.outcome] += 1
        longest, most = max(longest, case.seconds), max(most, case.memory)
        if case.bad:
            bad += 1
            print(f"case {case.number}, {case.layout}: {case.outcome}: {case.words[:300]}", flush=True)
    print("layout".ljust(26) + "".join(name.rjust(9) for name in OUTCOMES))
    for layout, counts in table.items():
        print(layout.ljust(26) + "".join(str(counts[name]).rjust(9) for name in OUTCOMES))
    print(
        f"longest {longest:.2f} s, most memory {most >> 20} MiB above the undamaged, {bad} bad; in {folder}"
    )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
