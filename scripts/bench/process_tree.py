"""What a command takes with all its processes, as the kernel counts: ``process_tree.py pchem run ...``.

Resident sets are added over the tree five times a second: pages that processes share count in each, so this
is no less than they take. The largest of a single process comes from the kernel's own high-water marks.
"""

from __future__ import annotations

import re
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

_EVERY = 0.2


@dataclass(frozen=True)
class Took:
    """What a command took.

    Attributes:
        code: its exit code.
        words: the last of what it wrote to standard error.
        wall: seconds.
        cpu: CPU seconds of all its processes.
        tree: largest memory of all its processes together, MiB.
        largest: largest resident set of one of them, MiB.
    """

    code: int
    words: str
    wall: float
    cpu: float
    tree: float
    largest: float


def run_measured(
    command: Sequence[str],
    folder: Path | None = None,
    environment: Mapping[str, str] | None = None,
    *,
    must_succeed: bool = False,
) -> Took:
    """Run a command to its end and return what it took.

    Raises:
        SystemExit: the command failed, and ``must_succeed``.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    start = time.perf_counter()
    process = subprocess.Popen(
        command, cwd=folder, env=environment, text=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    highest = [0, 0]
    ended = threading.Event()
    watch = threading.Thread(target=_watch, args=(process.pid, highest, ended))
    watch.start()
    _, words = process.communicate()
    wall = time.perf_counter() - start
    ended.set()
    watch.join()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    if must_succeed and process.returncode:
        raise SystemExit(f"{' '.join(command)} in {folder or Path.cwd()}:\n{words[-2000:]}")
    return Took(process.returncode, words[-2000:], wall, cpu, highest[0] / 1024, highest[1] / 1024)


def _watch(root: int, highest: list[int], ended: threading.Event) -> None:
    """Keep the largest sum over the tree, and the largest resident set of a process, kB."""
    while not ended.wait(_EVERY):
        pids = tree(root)
        highest[0] = max(highest[0], sum(kilobytes(pid, "VmRSS") for pid in pids))
        highest[1] = max([highest[1], *(kilobytes(pid, "VmHWM") for pid in pids)])


def tree(root: int) -> list[int]:
    """Return a process and all that it has started, and they in turn."""
    parents: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except (OSError, IndexError):
                continue
            parents.setdefault(parent, []).append(int(entry.name))
    found = [root]
    for pid in found:
        found += parents.get(pid, ())
    return found


def kilobytes(pid: int, name: str) -> int:
    """Return an entry of ``/proc/PID/status``, kB; 0 where the process has ended."""
    try:
        match = re.search(rf"^{name}:\s+(\d+) kB", Path(f"/proc/{pid}/status").read_text(), re.M)
    except OSError:
        return 0
    return int(match[1]) if match else 0


if __name__ == "__main__":
    took = run_measured(sys.argv[1:])
    print(took.words, end="")
    print(
        f"{took.wall:.1f} s, {took.cpu:.1f} CPU s, {took.tree:.0f} MiB in all, "
        f"{took.largest:.0f} MiB the largest process, exit {took.code}"
    )
    sys.exit(took.code)
