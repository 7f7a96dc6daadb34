"""Calibrated frames as TIFF or FITS files, streamed from the store that they were written to."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.variables import Variable, variables_of
from pchem_pipeline.frames.formats.map_files import Cube, write_fits_cube, write_tiff_cube
from pchem_pipeline.store.files import write_json
from pchem_pipeline.store.run_store import RunStore

#: File beside the images that says what they were made of.
PROVENANCE = "provenance.json"

_NOT_WRITTEN = ("frame", "y", "x")


def write_files(store: RunStore, folder: Path, kind: str, content: dict[str, Any]) -> list[Path]:
    """Write a file for each array, and what they were made of.

    Args:
        store: with the group ``applied``.
        folder: made if needed.
        kind: tiff or fits.
        content: provenance, as JSON data.

    Raises:
        StoreError: the folder cannot be written.
        MissingDependencyError: astropy is not installed.
    """
    written = []
    for variable in variables_of("applied"):
        if variable.name in _NOT_WRITTEN or not store.has(variable.path):
            continue
        path = folder / f"{variable.name}.{'tif' if kind == 'tiff' else 'fits'}"
        cube = _cube(store, variable, content, single=kind == "tiff")
        write_tiff_cube(path, cube) if kind == "tiff" else write_fits_cube(path, cube)
        written.append(path)
    write_json(folder / PROVENANCE, content)
    return [*written, folder / PROVENANCE]


def _cube(store: RunStore, variable: Variable, content: dict[str, Any], *, single: bool) -> Cube:
    array = store.array(variable.path)
    shape = array.shape if len(array.shape) == 3 or not single else (1, *array.shape)
    dtype = np.dtype(array.dtype)
    if single and dtype == np.float64:
        dtype = np.dtype(np.float32)  # the largest that ImageJ reads
    facts = {**content, **{key: array.attrs[key] for key in ("sentences", "no_number") if key in array.attrs}}
    return Cube(
        variable.name,
        _blocks(store, variable.path, len(array.shape), array.chunks[0]),
        shape,
        dtype,
        variable.unit,
        variable.long_name,
        facts,
    )


def _blocks(store: RunStore, name: str, rank: int, depth: int) -> Iterator[NDArray[Any]]:
    """Yield blocks of images."""
    if rank != 3:
        yield store.read(name)[None]
        return
    for start in range(0, store.array(name).shape[0], depth):
        yield store.read(name, (slice(start, start + depth), slice(None), slice(None)))
