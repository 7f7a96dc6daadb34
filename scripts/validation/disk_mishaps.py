#!/usr/bin/env python3
"""Let writes of real commands fail, and cut the power while they work; resume, compare with undisturbed ones.

``.venv/bin/python scripts/validation/disk_mishaps.py --cases 100`` takes the commands of `kills.py` in turn.
Of each, the operations that change files are counted. In half of the cases a drawn one of them fails once:
the command ends with one line, or does without. In the other half the power is cut behind a drawn one: what
was not synced is there, half there or not. The same command must then go on to the same bits. It prints a
line a case, and ends with 1 where one differs, cannot go on, or ended in any other way.
"""

import argparse
import errno
import hashlib
import multiprocessing
import os
import random
import re
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from kills import WORKS, Bench, Work, differences, results

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
import pytest
from helpers.disk_mishaps import FailingDisk, ForgetfulDisk, materialised

from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.cli.app import main as pchem

T = TypeVar("T")
NUMBERS = (errno.EIO, errno.ENOSPC, errno.EDQUOT, errno.EROFS)


def in_a_child(task: Callable[[], T]) -> T:
    """Return what a function returns in a forked process, which knows nothing of stores that were open."""
    fork = multiprocessing.get_context("fork")
    here, there = fork.Pipe(duplex=False)
    child = fork.Process(target=lambda: there.send(task()))
    child.start()
    there.close()
    found: T = here.recv()
    child.join()
    return found


def done(bench: Bench, work: Work) -> tuple[int, str]:
    """Do a command in this process; return its code and what it says."""
    words = bench.folder / "words"
    os.chdir(bench.case)
    with words.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    code = 0
    try:
        pchem([*work.command, "--quiet", "--backend", "serial"])
    except SystemExit as end:
        code = int(end.code or 0)
    except BaseException as error:  # an error that is no line
        return -1, repr(error)
    sys.stderr.flush()
    return code, words.read_text()


def found(bench: Bench, work: Work) -> dict[str, Any]:
    """Return the results of a command, each array as its digest; the line that refuses as ``refused``."""

    def task() -> dict[str, Any]:
        try:
            return {
                name: hashlib.sha256(repr((each.shape, each.dtype)).encode() + each.tobytes()).hexdigest()
                if isinstance(each, np.ndarray)
                else each
                for name, each in results(bench.case / work.store).items()
            }
        except StoreError as error:
            return {"refused": str(error)}

    return in_a_child(task)


def failed(bench: Bench, work: Work, at: int | None, number: int) -> tuple[int, int, str]:
    """Do a command whose operation ``at`` fails; return how many there were, its code and its words."""

    def task() -> tuple[int, int, str]:
        failing = FailingDisk(pytest.MonkeyPatch())
        failing.fail(at, number)
        code, words = done(bench, work)
        return failing.count, code, words

    return in_a_child(task)


def logged(bench: Bench, work: Work) -> list[Any]:
    """Do a command and return all that it did to the disk."""

    def task() -> list[Any]:
        forgetful = ForgetfulDisk(pytest.MonkeyPatch())
        code, words = done(bench, work)
        assert code in (0, 3), words
        return forgetful.log

    return in_a_child(task)


def fail_once(bench: Bench, work: Work, total: int, rng: random.Random) -> tuple[str, str]:
    """Let one operation fail; return what was done, and what is wrong with how it ended."""
    at, number = rng.randrange(total), rng.choice(NUMBERS)
    bench.begin(work)
    _, code, words = failed(bench, work, at, number)
    ours = [line for line in words.splitlines() if line.startswith("pchem: ")]
    proper = code in (0, 3) or (code > 0 and len(ours) == 1 and "Traceback" not in words)
    return f"{errno.errorcode[number]} at {at} of {total}, code {code}", "" if proper else f"{code}: {words}"


def cut_power(
    bench: Bench, log: list[Any], files: dict[Path, bytes], times: dict[Path, int], rng: random.Random
) -> tuple[str, str]:
    """Leave the disk as a power cut does; return what was done."""
    end = rng.randrange(len(log) + 1)
    forgetful = ForgetfulDisk.__new__(ForgetfulDisk)
    forgetful.log = log
    left = forgetful.after_power_cut(end, np.random.default_rng(rng.randrange(1 << 30)), before=files)
    shutil.rmtree(bench.case)
    materialised(left, bench.case, bench.case)
    for path, time in times.items():  # by which camera files are known
        if path.exists():
            os.utime(path, ns=(time, time))
    return f"power cut at {end} of {len(log)}", ""


def gone_on(bench: Bench, work: Work, expected: dict[str, Any]) -> str:
    """Do the same command again; return what is wrong then, or nothing."""
    again = work
    for _ in range(8):
        code, said = in_a_child(partial(done, bench, again))
        here = found(bench, work) if code in (0, 3) else {}
        # chunks are not synced: a line says which stage to do again
        cure = re.search(r"do it again: pchem (\w+) (\S+) --force", f"{said} {here.get('refused', '')}")
        last = again is work
        again = work if cure is None else replace(work, command=(*cure.groups(), "--force"))
        if cure is None and "do it again with --force" in f"{said} {here.get('refused', '')}":
            again = replace(work, command=(*work.command, "--force"))
        if code in (0, 3) and again is work and last:
            other = differences(here, expected)
            return f" differs: {len(other)}: {', '.join(other[:8])}" if other else ""
    return f" cannot go on: {code}: {said[-600:]} {here.get('refused', '')}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", help="names of commands, with commas")
    options = parser.parse_args()
    rng = random.Random(options.seed)
    bench = Bench(Path(tempfile.mkdtemp(prefix="disk_mishaps_")), "serial")
    works = [work for work in WORKS if options.only is None or work.name in options.only.split(",")]
    outcomes: Counter[str] = Counter()
    wrong = 0
    for i, work in enumerate(works):
        bench.begin(work)
        bench.ok(*work.command)  # compiles
        expected = found(bench, work)
        bench.begin(work)
        total = failed(bench, work, None, 0)[0]
        bench.begin(work)
        files = {path: path.read_bytes() for path in bench.case.rglob("*") if path.is_file()}
        times = {path: path.stat().st_mtime_ns for path in files}
        log = logged(bench, work)
        print(f"{work.name}: {total} operations, {len(expected)} results", flush=True)
        for case in range(options.cases * i // len(works), options.cases * (i + 1) // len(works)):
            if case % 2:
                what, words = fail_once(bench, work, total, rng)
            else:
                what, words = cut_power(bench, log, files, times, rng)
            words += gone_on(bench, work, expected)
            outcomes[f"{work.name}, {'write' if case % 2 else 'power'}"] += 1
            if words:
                wrong += 1
                shutil.copytree(bench.case, bench.folder / f"wrong{wrong}")
            print(f"{case:4d} {work.name}: {what}: {words or 'same'}", flush=True)
    print(f"{sum(outcomes.values())} cases ({dict(outcomes)}), {wrong} wrong; in {bench.folder}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
