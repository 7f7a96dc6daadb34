"""Camera files of all formats in many layouts, damaged: the same frames, or one clear line.

Run as a program (``python -m helpers.damaged_formats FOLDER FIRST END``) it works through cases in one
process and prints a line of JSON after each: the next one is that to which a crash or a hang belongs.
"""

import contextlib
import faulthandler
import json
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from helpers.damage import damaged, frames
from helpers.layouts import LAYOUTS, tiff_pages, write

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.config.load import make_config
from pchem_pipeline.frames.histogram_files import is_histogram_input, read_histograms
from pchem_pipeline.frames.identity import content_identity
from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.run.stage import Command
from pchem_pipeline.run.target import Target
from pchem_pipeline.runner.session import run_stages

#: what a case may take: seconds, and bytes above what the undamaged files take
SECONDS, MEMORY = 10.0, 1 << 30
#: bytes of frames that are read of a case, which may claim to have any number
MOST_READ = 1 << 22
#: every how many-th case goes through stage `ingest`, too; no divisor of the number of layouts
INGESTED = 7


# -- files -------------------------------------------------------------------------------------------------


def _tiff_sequence(path):
    for number, frame in enumerate(frames(n=3)):
        tiff_pages(path / f"f{number}.tif", frame)


def _hdf5(path, **options):
    import h5py

    with h5py.File(path / "a.h5", "w", libver="latest") as file:
        file.create_dataset("entry/data", data=frames(), **options)
        file["entry/count_time"] = 0.5


def _shards(path):
    import zarr

    zarr.create_array(path / "a.zarr", data=frames(), chunks=(3, 4, 9), shards=(6, 8, 9))


def _ome_zarr(path):
    import zarr

    group = zarr.create_group(path / "a.zarr")
    group.create_array("0", data=frames(), chunks=(3, 8, 9))
    group.attrs["ome"] = {"version": "0.5", "multiscales": [{"datasets": [{"path": "0"}]}]}


def _ser(path, dtype="uint16", times=True):
    from pchem_pipeline.frames.writing import write_frames

    write_frames("ser", path / "a.ser", iter([frames(dtype=dtype)]), (6, 8, 9), dtype)
    if times:
        with (path / "a.ser").open("ab") as file:
            file.write((621_355_968_000_000_000 + np.arange(6, dtype="<i8")).tobytes())


def _raw_yaml(path):
    (path / "a.raw").write_bytes(bytes(16) + frames().tobytes())
    words = "shape: [6, 8, 9]\ndtype: uint16\nheader_bytes: 16\nintegration_time: 2.5\n"
    (path / "a.raw.yaml").write_text(words)


def _csv(path, mark=","):
    rows = [("dn", "a", "b"), *((d, 9 * d, 7) for d in range(90, 130))]
    (path / "a.csv").write_text("".join(mark.join(map(str, row)) + "\n" for row in rows))


def _npz(path):
    np.savez_compressed(path / "a.npz", dn=np.arange(40), counts=frames(n=3, shape=(8, 5)).reshape(3, 40))


#: name -> what writes the undamaged files into a folder
SEEDS = {layout: lambda p, layout=layout: write(p, layout, frames()) for layout in LAYOUTS} | {
    "tiff, 8 bit": lambda p: tiff_pages(p / "a.tif", frames(dtype="uint8")),
    "tiff, zstd": lambda p: tiff_pages(p / "a.tif", frames(), compression="zstd"),
    "tiff, jpeg": lambda p: tiff_pages(p / "a.tif", frames(dtype="uint8"), compression="jpeg"),
    "tiff, a file a frame": _tiff_sequence,
    "hdf5, newest": _hdf5,
    "hdf5, newest, checksums": lambda p: _hdf5(p, chunks=(2, 8, 9), fletcher32=True),
    "zarr, shards": _shards,
    "zarr, ome": _ome_zarr,
    "ser": _ser,
    "ser, 8 bit": lambda p: _ser(p, "uint8", times=False),
    "raw, YAML": _raw_yaml,
    "histogram, csv": _csv,
    "histogram, semicolons": lambda p: _csv(p, ";"),
    "histogram, npz": _npz,
}


# -- a case ------------------------------------------------------------------------------------------------


class TookTooLong(BaseException):
    """No Exception, so that no reader takes it for a broken file."""


@dataclass(frozen=True)
class Case:
    """What became of one damaged file.

    Attributes:
        number: of the case, from which all is drawn.
        layout: key of `SEEDS`.
        outcome: same, silent (other frames, no word), refused; or what must not be: foreign (an error that is
            not ours, or not one line), slow, greedy, crashed.
        words: the message, or the traceback's last line.
        seconds: of reading.
        memory: bytes at its peak above those before.
    """

    number: int
    layout: str
    outcome: str
    words: str = ""
    seconds: float = 0.0
    memory: int = 0

    @property
    def bad(self):
        return self.outcome not in ("same", "silent", "refused")


def layout_of(number):
    return list(SEEDS)[number % len(SEEDS)]


def make_case(seeds, number, place):
    """Write the damaged files of a case to a folder; return it."""
    rng = np.random.default_rng([14, number])
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(seeds / str(number % len(SEEDS)), place)
    files = sorted(path for path in place.rglob("*") if path.is_file())
    victim = files[int(rng.integers(len(files)))]
    victim.write_bytes(damaged(victim.read_bytes(), rng))
    return place


def input_of(place):
    """Return what a command would be told to read of a folder."""
    (only,) = [p for p in place.iterdir() if p.suffix == ".zarr"] or [place]
    names = {path.suffix for path in only.iterdir()}
    return next(only.iterdir()) if names & {".csv", ".npz"} else only


def ingest(place, store):
    """Do stage ``ingest`` on a folder, with a store of its own, as `pchem ingest` does."""
    shutil.rmtree(store, ignore_errors=True)
    config = make_config({"run": {"store": str(store)}, "input": {"files": [str(input_of(place))]}}, "a case")
    run_stages(Target(config, place, store), ["ingest"], Command(quiet=True, backend="serial"))


def read_all(place):
    """Return what a command would read of a folder: frames, or histograms."""
    settings = InputSettings(files=(str(input_of(place)),))
    if is_histogram_input(settings, place):
        found = read_histograms(settings, place)
        return np.concatenate([found.origin.ravel(), found.counts.ravel().astype(np.int64)])
    stack = open_frames(settings, place)
    content_identity(stack.paths)
    n, rows, columns = stack.shape
    step = max(1, MOST_READ // max(1, columns * stack.dtype.itemsize))
    rows = min(rows, step)
    many = min(n, max(1, step // rows), 64)
    first = stack.read(0, many, 0, rows)
    if many < n:
        stack.read(n - 1, n, 0, rows)
    return first


def peak_memory():
    return int(re.search(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text())[1]) << 10


def forget_peak():
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def outcome_of(place, expected, *, ingested=False):
    """Read a damaged case, and run `ingest` on it where asked; return the outcome and its words."""
    try:
        found = read_all(place)
        if ingested and found.size < MOST_READ:  # what claims to be more would be copied for long
            ingest(place, place.parent / "case.zarr")
    except InputError as error:
        words = str(error)
        proper = words.isprintable() and str(place) in words and len(words) < 4100
        return ("refused" if proper else "foreign"), words
    except TookTooLong:
        return "slow", f"more than {SECONDS:g} s"
    except MemoryError as error:
        return "greedy", str(error)
    except BaseException as error:
        import traceback

        where = traceback.extract_tb(error.__traceback__)[-1]
        return "foreign", f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
    same = found.shape == expected.shape and bool((found == expected).all())
    return ("same" if same else "silent"), "" if same else str(found.shape)


def _stop(*unused):
    raise TookTooLong


def run_case(seeds, number, folder, expected):
    """Make a case and read it, within its time and memory."""
    layout = layout_of(number)
    place = make_case(seeds, number, folder / "case")
    forget_peak()
    before, clock = peak_memory(), time.perf_counter()
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        outcome, words = outcome_of(place, expected[layout], ingested=number % INGESTED == 0)
    except TookTooLong:
        outcome, words = "slow", "while it was leaving"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    memory = peak_memory() - before
    if memory > MEMORY:
        outcome = "greedy"
    return Case(number, layout, outcome, words, time.perf_counter() - clock, memory)


def main(folder, first, end):
    """Work through cases ``first`` to ``end``, in this process, with lines of JSON."""
    import warnings

    warnings.simplefilter("ignore")
    signal.signal(signal.SIGALRM, _stop)
    seeds = Path(folder) / "seeds"
    expected = {name: read_all(seeds / str(i)) for i, name in enumerate(SEEDS)}
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, 2 * (size + 3 * MEMORY,))
    print("ready", flush=True)
    for number in range(int(first), int(end)):
        # a hang below Python, where no alarm is heard, ends the process
        faulthandler.dump_traceback_later(3 * SECONDS, exit=True)
        print(json.dumps(run_case(seeds, number, Path(folder), expected).__dict__), flush=True)


# -- many cases --------------------------------------------------------------------------------------------


def run_cases(folder, first, end):
    """Yield the `Case` of each number ``first`` to ``end``; a process that dies is replaced by another."""
    seeds = folder / "seeds"
    if not seeds.exists():  # each layout into a folder of its own
        for number, written in enumerate(SEEDS.values()):
            (seeds / str(number)).mkdir(parents=True)
            written(seeds / str(number))
    while first < end:
        command = [sys.executable, "-m", "helpers.damaged_formats", str(folder), str(first), str(end)]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        with subprocess.Popen(command, cwd=Path(__file__).parents[1], **pipes) as process:
            begun = process.stdout.readline() == "ready\n"
            for line in process.stdout:
                first += 1
                yield Case(**json.loads(line))
            words = process.stderr.read()
        if not begun:
            raise AssertionError(words)
        if first < end:
            yield Case(first, layout_of(first), "crashed", f"exit code {process.returncode}: {words[-300:]}")
            first += 1


if __name__ == "__main__":
    main(*sys.argv[1:])
