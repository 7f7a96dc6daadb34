"""What can be read, which effects are known, and what camera files are."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from itertools import groupby
from pathlib import Path

import numpy as np

from pchem_pipeline import __version__
from pchem_pipeline.base.errors import InputError
from pchem_pipeline.base.kernel_cache import cache_folder
from pchem_pipeline.base.wording import count
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.effects.framework.registry import effect_classes
from pchem_pipeline.frames.histogram_files import is_histogram_input, read_histograms
from pchem_pipeline.frames.inspect import survey
from pchem_pipeline.frames.open import joined
from pchem_pipeline.frames.reader import FrameReader, described
from pchem_pipeline.frames.registry import readers
from pchem_pipeline.frames.resolve import HISTOGRAM_SUFFIXES
from pchem_pipeline.frames.sequence import FrameSequence
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.stages.ingest import disk_words


def about_program() -> list[str]:
    """Return the version, the formats with their libraries, the effects by tag, and the cache of kernels."""
    lines = [f"pchem {__version__}", "", "formats:"]
    for reader in readers():
        own = "built in" if reader.__module__.startswith("pchem_pipeline.") else "plug-in"
        missing = "" if not reader.library or find_spec(reader.library) else ", not installed"
        lines.append(
            f"  {reader.format_name:10}{' '.join(reader.suffixes):32}{reader.library or own}{missing}"
        )
    lines += [f"  {'histogram':10}{' '.join(HISTOGRAM_SUFFIXES):32}built in", "", "effects:"]
    lines += [f"  {tag:28} {effect.title or tag}" for tag, effect in effect_classes().items()]
    return [*lines, "", f"compiled kernels: {os.environ.get('NUMBA_CACHE_DIR') or cache_folder()}"]


def about_files(places: Sequence[Path]) -> Iterator[str]:
    """Yield a line for each camera file, or successive ones that are alike: what it is, or why it is unread.

    Raises:
        InputError: files are missing or unread, a folder has none, or they are together no stack.
    """
    settings, here = InputSettings(files=tuple(map(str, places))), Path.cwd()
    if is_histogram_input(settings, here):
        given = read_histograms(settings, here)
        yield f"histograms of {len(given.names)} channels, {given.counts.shape[2]} bins"
        return
    readers, report = survey(settings, here)
    by_path = {reader.paths[0]: reader for reader in readers}
    words = {entry.path: entry.problem or _reader_words(by_path[entry.path]) for entry in report.files}
    for said, alike in groupby(words, key=words.__getitem__):
        first, *others = alike
        more = f" to {others[-1].name} ({1 + len(others)} files, each)" if others else ""
        yield f"{first}{more}: {said}"
    if report.good:
        frames = joined(readers, report, settings, here, least=1)
        yield _stack_words(frames)
        yield f"in a run, {disk_words(RunConfig(input=settings), frames)}"
    yield from dict.fromkeys(report.notes)
    if report.bad:
        raise InputError(f"{count(len(report.bad), 'file')} cannot be used")


def _stack_words(frames: FrameSequence) -> str:
    """Return what the frames of all files are together."""
    n, rows, columns = frames.shape
    some = np.concatenate([frames.read(t, t + 1) for t in sorted({0, n // 2, n - 1})])
    codes = np.unique(some.ravel()[:: 1 + some.size // 4_000_000]).size
    parts = [f"together {n} frames of {rows} x {columns}", f"DN {some.min()} to {some.max()} ({codes} codes)"]
    parts += [frames.camera.words()] if frames.camera.words() else []
    return ", ".join(parts)


def _reader_words(reader: FrameReader) -> str:
    """Return format, shape, type, bit depth, exposure time and stamps of a file, as far as it says."""
    n, rows, columns = reader.shape
    depth = "bit depth not stated" if reader.bit_depth is None else f"{reader.bit_depth} bits"
    seconds = reader.integration_time
    time = "no exposure time" if seconds is None else f"exposure {seconds:g} s ({reader.time_words})"
    size = f"{n} frame{'s' * (n != 1)} of {rows} x {columns}"
    for words, area in (("light-sensitive", reader.active), ("overscan", reader.overscan)):
        if area is not None:
            y0, y1, x0, x1 = area
            size += f" ({words}: rows {y0} to {y1 - 1}, columns {x0} to {x1 - 1})"
    stamped = {"frame stamps": reader.frame_stamps, "time stamps": reader.timestamps}
    names = [name for name, stamps in stamped.items() if stamps is not None]
    return ", ".join([described(type(reader)), size, str(reader.dtype), depth, time, *names])
