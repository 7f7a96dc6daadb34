"""What can be read, which effects are known, and what given files or a given run are."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

from pchem_pipeline import __version__
from pchem_pipeline.base.kernel_cache import cache_folder
from pchem_pipeline.effects.framework.registry import effect_classes
from pchem_pipeline.frames.histogram_files import is_histogram_input, read_histograms
from pchem_pipeline.frames.inspect import survey
from pchem_pipeline.frames.reader import FrameReader, described
from pchem_pipeline.frames.registry import reader_class, reader_names
from pchem_pipeline.frames.resolve import HISTOGRAM_SUFFIXES
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.target import find_run
from pchem_pipeline.runner.session import run_status
from pchem_pipeline.store.remote_path import place_of
from pchem_pipeline.store.run_store import RunStore

_SHOWN = 20  # files


def is_run(place: Path) -> bool:
    """Tell whether a path is a YAML file or the store of a run, and no camera file."""
    place = place_of(place)
    return place.suffix.lower() in (".yaml", ".yml") or (place / ".pchem").is_dir()


def about_program() -> list[str]:
    """Return the version, the formats with their libraries, the effects by tag, and the cache of kernels."""
    lines = [f"pchem {__version__}", "", "formats:"]
    for name in reader_names():
        reader = reader_class(name)
        own = "built in" if reader.__module__.startswith("pchem_pipeline.") else "plug-in"
        missing = "" if not reader.library or find_spec(reader.library) else ", not installed"
        lines.append(f"  {name:10}{' '.join(reader.suffixes):32}{reader.library or own}{missing}")
    lines += [f"  {'histogram':10}{' '.join(HISTOGRAM_SUFFIXES):32}built in", "", "effects:"]
    lines += [f"  {tag:28} {effect.title or tag}" for tag, effect in effect_classes().items()]
    return [*lines, "", f"compiled kernels: {os.environ.get('NUMBA_CACHE_DIR') or cache_folder()}"]


def about_files(places: Sequence[Path]) -> list[str]:
    """Return a line for each camera file: reader, frames, what its metadata say, or why it cannot be read.

    Raises:
        InputError: files are missing, or a folder has none.
    """
    return list(_files(InputSettings(files=tuple(map(str, places))), Path.cwd()))


def about_run(place: Path) -> list[str]:
    """Return the reader and the stages of a run, and where its input was not read yet, the camera files.

    Raises:
        ConfigError: the YAML is wrong.
        StoreError: the store is damaged.
    """
    run = find_run(place)
    lines = [f"{run.store}:"]
    states = run_status(run)
    if all(state.state == "missing" for state in states):
        return [*lines, "  no stage was run yet", *_files(run.config.input, run.base_dir)]
    store = RunStore.open(run.store)
    if "sensor" in store.attributes("frames"):
        sensor = SensorInfo.read(store)
        size = f"{sensor.n_frames} frames of {sensor.ny} x {sensor.nx} {sensor.dtype}"
        lines.append(f"  {sensor.kind}, reader {sensor.reader or 'not recorded'}, {size}, mode {sensor.mode}")
    return [*lines, *(f"  {state.stage:12}{state.words()}" for state in states)]


def _files(settings: InputSettings, base_dir: Path) -> Iterator[str]:
    """Yield what is found of the files of a section ``input``, a line each, and remarks on all."""
    if not settings.files:
        yield "  no camera files are named"
        return
    if is_histogram_input(settings, base_dir):
        given = read_histograms(settings, base_dir)
        yield f"histogram: {given.shape[0] * given.shape[1]} channels of {given.counts.shape[2]} bins"
        return
    readers, report = survey(settings, base_dir)
    by_path = {reader.paths[0]: reader for reader in readers}
    for entry in report.files[:_SHOWN]:
        reader = by_path.get(entry.path)
        found = entry.problem if reader is None or entry.problem else _reader_words(reader)
        yield f"{entry.path}: {found}"
    if len(report.files) > _SHOWN:
        yield f"{len(report.files) - _SHOWN} more, {len(report.bad)} of all cannot be used"
    first = next(iter(report.bad), None)
    yield "first problem: " + (f"{first.path}: {first.problem}" if first else "none")
    yield from report.notes


def _reader_words(reader: FrameReader) -> str:
    """Return format, shape, type, bit depth and exposure time of a file, as far as it says."""
    n, rows, columns = reader.shape
    depth = "bit depth not stated" if reader.bit_depth is None else f"{reader.bit_depth} bits"
    seconds = reader.integration_time
    time = "no exposure time" if seconds is None else f"exposure {seconds:g} s ({reader.time_words})"
    return f"{described(type(reader))}, {n} frames of {rows} x {columns}, {reader.dtype}, {depth}, {time}"
