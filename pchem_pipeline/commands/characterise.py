"""From arrays in memory to a run: what ``pchem run`` does for files.

>>> import numpy as np
>>> from pchem_pipeline import characterise
>>> frames = np.load("frames.npy")                           # doctest: +SKIP
>>> run = characterise(frames, integration_time=4.87)        # doctest: +SKIP
>>> run.maps.read_noise_e.where(run.good).median()           # doctest: +SKIP
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import weakref
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import require
from pchem_pipeline.commands.in_memory import stack_of, write_stack
from pchem_pipeline.commands.new_run import settings_of, stated_run
from pchem_pipeline.commands.notebook import Run, open_run
from pchem_pipeline.config.load import dump_config, write_config
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.result import FitResult
from pchem_pipeline.run.progress import ProgressMode
from pchem_pipeline.run.stage import Command
from pchem_pipeline.run.target import Target
from pchem_pipeline.runner.session import run_stages, up_to
from pchem_pipeline.stages.table import pipeline_of


def characterise(
    frames: Any,
    *,
    store: str | os.PathLike[str] | None = None,
    integration_time: float | None = None,
    bit_depth: int | None = None,
    kind: Literal["dark", "light", "unknown"] = "unknown",
    settings: Mapping[str, Mapping[str, Any]] | None = None,
    until: str = "report",
    workers: int | None = None,
    progress: ProgressMode = "off",
) -> Run:
    """Characterise a stack of frames in memory, and return its run as :func:`open_run` does.

    The frames are written once, as ``<store>-frames.npy`` beside the store, and the run refers to them there;
    it is a run like any other (``pchem status``, ``compare``, ``discrepancy`` ...). With the same frames and
    settings nothing is done again.

    Args:
        frames: whole DN, shape (frame, y, x): a numpy array, a list of frames, a dask array (computed block
            by block) or anything whose slices along the frames become an array.
        store: folder of the run, such as ``"night.zarr"``; None: a temporary one that goes with the run.
        integration_time: of a frame, s.
        bit_depth: bits of the ADC.
        kind: what made the charge.
        settings: sections of the YAML, such as ``{"fit": {"likelihood": "auto"}}``.
        until: last stage to be done.
        workers: number of workers; None: as many as there are processors.
        progress: auto, on or off.

    Raises:
        MissingDependencyError: xarray is not installed.
        ConfigError: the frames are no whole DN of three dimensions, a setting is wrong, or the store is of a
            run with other settings.
        IncompleteRunError: more pixels have no value than the settings allow; the store has the run.
    """
    require("xarray", "notebook", "characterise")
    frames = stack_of(frames, least=2)
    with contextlib.ExitStack() as removal:
        if store is None:
            folder = tempfile.mkdtemp(prefix="pchem-")
            removal.callback(shutil.rmtree, folder, ignore_errors=True)
            store = Path(folder, "run.zarr")
        place = Path(store).resolve()
        given = {"integration_time": integration_time, "bit_depth": bit_depth, "kind": kind}
        target = _target(place, given, settings or {})
        write_stack(target.base_dir / target.config.input.files[0], frames)
        stages = up_to(until, pipeline_of(target.config))
        run_stages(target, stages, Command(workers=workers, progress=progress, quiet=progress == "off"))
        run = open_run(place)
        weakref.finalize(run, removal.pop_all().close)
    return run


def fit_counts(counts: NDArray[Any], origin: NDArray[Any] | int = 0, **options: Any) -> FitResult:
    """Fit histograms of one or many pixels.

    Args:
        counts: number of samples at each DN, shape (bin,), (n, bin) or (y, x, bin).
        origin: DN of bin 0; one for all, or one for each histogram.
        **options: of :func:`fit_histograms`.

    Returns:
        The estimates, one for each histogram, in order.

    Raises:
        ValueError: counts are negative or not whole, or the shapes disagree.
    """
    array = np.asarray(counts)
    if array.ndim < 1 or not np.issubdtype(array.dtype, np.number) or (array < 0).any() or (array % 1).any():
        raise ValueError("counts: give whole numbers of 0 or more along the last axis")
    flat = np.ascontiguousarray(array.reshape(-1, array.shape[-1]), dtype=np.uint32)
    first = np.broadcast_to(np.asarray(origin), array.shape[:-1]).reshape(-1).astype(np.int32)
    return fit_histograms(flat, first, **options)


def _target(place: Path, given: Mapping[str, Any], settings: Mapping[str, Mapping[str, Any]]) -> Target:
    """Return the run, its YAML beside the store; raise ConfigError where that has other settings."""
    path = settings_of(place)
    known: dict[str, Any] = {"files": [f"{path.stem}-frames.npy"], "mode": "reference"}
    known |= {name: value for name, value in given.items() if value is not None}
    sections = {**settings, "input": {**known, **settings.get("input", {})}}
    ways = "omit these arguments to continue with the settings in the file, or give another store"
    target = stated_run(place, sections, "characterise", ways)
    if not path.exists():
        place.parent.mkdir(parents=True, exist_ok=True)
        write_config(path, dump_config(target.config))
    return target
