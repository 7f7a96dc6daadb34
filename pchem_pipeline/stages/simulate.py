"""Stage ``simulate``: camera files of an imagined sensor, and its truth.

The frames go into ``simulate.output`` in the format asked for, with ``truth.npz`` (the parameter maps and the
names of the files) beside them; maps and the first true electron numbers go into the store.
"""

from __future__ import annotations

import functools
import math
import shutil
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import ConfigError, StoreError
from pchem_pipeline.frames.formats.map_files import read_image, write_npz
from pchem_pipeline.frames.identity import content_identity
from pchem_pipeline.frames.registry import reader_class
from pchem_pipeline.frames.writing import write_frames
from pchem_pipeline.model.histogram.summaries import ROW_GROUP
from pchem_pipeline.run.stage import Named, StageContext
from pchem_pipeline.simulate.chain import dn_dtype, frames_per_block, simulate_block, with_scene
from pchem_pipeline.simulate.maps import draw_truth
from pchem_pipeline.simulate.settings import SimulateSettings
from pchem_pipeline.simulate.truth import TruthMaps
from pchem_pipeline.store.files import in_storage
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.store.tiles import equal_rows

TRUTH_FILE = "truth.npz"
# memory for the frames in the making, over all workers
_BUDGET = 256 << 20
# true electron numbers are stored in chunks of about this size
_CHUNK = 16 << 20
_MOST_UNITS = 256

#: Frames, first and end, of the file of this name; None: whose electrons go into the store.
_Frames = tuple[str | None, int, int]
_Unit = Named[Sequence[_Frames]]


def run(context: StageContext) -> None:
    """Simulate the frames and the truth; files that are there already stay.

    Raises:
        ConfigError: the output folder holds something else.
        StoreError: the disk is too small or refuses.
    """
    settings = context.config.simulate
    if settings is None:
        raise ConfigError("no section simulate in the configuration; add one, or run: pchem ingest")
    folder = context.base_dir / settings.output
    settings = _with_places(settings, context.base_dir)
    truth = _sensor(settings.model_dump_json())[0]
    files = _files(settings)
    if context.fresh:
        _prepare(folder, settings)
        context.begin()
        for name, values in truth.arrays().items():
            context.store.write_array(f"truth/{name}", values)
    names = np.array([name for name, _, _ in files])
    facts = {"files": names, "integration_time": settings.integration_time, "seed": settings.seed}
    write_npz(folder / TRUTH_FILE, truth.arrays() | facts)
    n = min(settings.truth_frames, settings.n_frames)
    step = max(1, min(n, _CHUNK // (4 * math.prod(settings.shape))))
    electron_units: list[_Unit] = [
        Named(f"electrons-{start}-{end}", [(None, start, end)]) for start, end in equal_rows(n, step)
    ]
    if electron_units:
        rows, columns = settings.shape
        band = min(rows, ROW_GROUP)
        context.create(
            "truth/electron_number",
            lengths={"frame": n, "y": rows, "x": columns},
            # the ensemble reads them by bands
            chunks={"frame": step, "y": band},
            shards=(step, band * math.ceil(rows / band), columns),
        )
    # some hundred units at most, so that markers cost nothing
    together = math.ceil(len(files) / _MOST_UNITS)
    groups = [files[i : i + together] for i in range(0, len(files), together)]
    frame_units: list[_Unit] = [Named(f"frames-{group[0][1]}-{group[-1][2]}", group) for group in groups]
    workers = context.executor.workers
    alone = len(frame_units) == 1
    task = functools.partial(_do, settings=settings, folder=folder, workers=workers, alone=alone)
    # frames are made whole: tiles and regions mean the sensor that is read
    context.run_units([*frame_units, *electron_units], task, unit_name="part")


def _do(
    unit: _Unit, store: RunStore, *, settings: SimulateSettings, folder: Path, workers: int, alone: bool
) -> None:
    """Write the files of frames of a unit, or its true electron numbers into the store."""
    truth, settings = _sensor(settings.model_dump_json())
    step = frames_per_block(settings, settings.shape[0], _BUDGET // workers)
    for name, start, stop in unit.content:
        if name is None:
            _, electrons = simulate_block(truth, settings, (start, stop))
            store.write("truth/electron_number", (slice(start, stop), slice(None), slice(None)), electrons)
            continue
        blocks = [(first, min(first + step, stop)) for first in range(start, stop, step)]
        write_frames(
            settings.format,
            folder / name,
            # several files are shared out among the workers; a single one has them all to itself
            _in_order(
                lambda block: simulate_block(truth, settings, block, electron_frames=0)[0],
                blocks,
                workers if alone else 1,
            ),
            (stop - start, *settings.shape),
            dn_dtype(settings.bit_depth),
            integration_time=settings.integration_time,
            bit_depth=settings.bit_depth,
        )


def scene_identity(context: StageContext) -> dict[str, Any] | None:
    """Return the content hashes of the files that a simulation reads; None where it reads none."""
    settings = context.config.simulate
    if settings is None:
        return None
    settings = _with_places(settings, context.base_dir)
    places = [settings.sensor, None if settings.scene is None else Path(settings.scene)]
    files = [place for place in places if place is not None and place.is_file()]
    return content_identity(files) if files else None


def _with_places(settings: SimulateSettings, folder: Path) -> SimulateSettings:
    """Return the settings with the whole paths of what they read."""
    changes: dict[str, Any] = {}
    if settings.sensor is not None:
        changes["sensor"] = folder.resolve() / settings.sensor
    if settings.scene is not None and not _is_number(settings.scene):
        changes["scene"] = str(folder.resolve() / settings.scene)
    return settings.model_copy(update=changes)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


@functools.lru_cache(maxsize=2)
def _sensor(content: str) -> tuple[TruthMaps, SimulateSettings]:
    """Return maps and settings, made once per process; that is cheaper than sending them."""
    settings = SimulateSettings.model_validate_json(content)
    truth = draw_truth(settings) if settings.sensor is None else _stored_sensor(settings)
    if settings.scene is None:
        return truth, settings
    scene = float(settings.scene) if _is_number(settings.scene) else read_image(Path(settings.scene))
    return with_scene(truth, settings, scene)


def _stored_sensor(settings: SimulateSettings) -> TruthMaps:
    assert settings.sensor is not None
    try:
        with np.load(settings.sensor, allow_pickle=False) as stored:
            truth = TruthMaps(**{field.name: stored[field.name] for field in fields(TruthMaps)})
    except (OSError, KeyError, ValueError, BadZipFile) as error:
        raise ConfigError(
            f"simulate.sensor: {settings.sensor} has no maps of a sensor ({error}); write it with: pchem twin"
        ) from error
    if truth.shape != settings.shape:
        raise ConfigError(f"simulate.sensor has {truth.shape} pixels, simulate.shape is {settings.shape}")
    return truth


def _in_order(
    function: Callable[[tuple[int, int]], NDArray[Any]], blocks: list[tuple[int, int]], threads: int
) -> Iterator[NDArray[Any]]:
    """Yield the blocks in order while the next ones are computed (the kernels release the GIL)."""
    with ThreadPoolExecutor(threads) as pool:
        ahead: deque[Future[NDArray[Any]]] = deque()
        for block in blocks:
            ahead.append(pool.submit(function, block))
            if len(ahead) > threads:
                yield ahead.popleft().result()
        while ahead:
            yield ahead.popleft().result()


def _files(settings: SimulateSettings) -> list[tuple[str, int, int]]:
    """Return name, first frame and frame after the last of every file."""
    n, per_file = settings.n_frames, settings.frames_per_file or settings.n_frames
    suffix = reader_class(settings.format).suffixes[0]
    if per_file >= n:
        return [(f"frames{suffix}", 0, n)]
    parts = equal_rows(n, per_file)
    width = max(5, len(str(len(parts))))
    return [(f"frames_{i:0{width}d}{suffix}", *part) for i, part in enumerate(parts, 1)]


def _prepare(folder: Path, settings: SimulateSettings) -> None:
    needed = settings.n_frames * math.prod(settings.shape) * dn_dtype(settings.bit_depth).itemsize
    with in_storage(folder):
        if folder.exists() and any(folder.iterdir()):
            _remove_simulated(folder)
        folder.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(folder).free
    if needed > free:
        raise StoreError(
            f"{folder}: the frames need {needed / 1e9:.2f} GB, {free / 1e9:.2f} GB are "
            "free; free space, or lower simulate.n_frames or simulate.shape"
        )


def _remove_simulated(folder: Path) -> None:
    try:
        with (folder / TRUTH_FILE).open("rb") as stream, np.load(stream, allow_pickle=False) as truth:
            names = [str(name) for name in truth["files"]]
    except (FileNotFoundError, KeyError, ValueError, EOFError, BadZipFile):
        raise ConfigError(
            f"simulate.output: {folder} has other files (no {TRUTH_FILE} of an earlier simulation); choose "
            "another folder"
        ) from None
    for name in names:
        plain = Path(name).name
        # the frames, their sidecar, and what a killed run left of them
        for path in (folder / plain, folder / f"{plain}.json", folder / f".partial-{plain}"):
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
    (folder / TRUTH_FILE).unlink()
