"""Stage ``electrons``: the stack of electron numbers, any number of frames, band by band.

Each sample becomes the electron number of largest membership under its pixel's parameters (Hendrickson et al.
2023, eq. demarg_K_eqn), those of the nearest PCD where the fit held effects. It is not part of ``run``, since
the result is as large as the stack.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.frames.stream import FrameStream
from pchem_pipeline.model.electrons.electrons import LARGEST_NUMBER, NO_NUMBER, electron_numbers
from pchem_pipeline.run.frame_source import open_source
from pchem_pipeline.run.stage import StageContext, open_store
from pchem_pipeline.stages.bands import tile_bands
from pchem_pipeline.stages.fit.fitted_model import (
    deciding_maps,
    fitted_added_exposure,
    fitted_effects,
    pixel_places,
)

if TYPE_CHECKING:
    from pchem_pipeline.frames.stream import FrameSource
    from pchem_pipeline.model.maps.pixels import FloatArray
    from pchem_pipeline.stages.bands import Band

__all__ = ["electrons_tile", "run"]

#: Frames and columns of a chunk; its rows are those of a tile.
_CHUNK_FRAMES, _CHUNK_COLUMNS = 256, 128
#: Bytes of a block of frames of a band.
_BLOCK_BYTES = 64 << 20


def electrons_tile(frames: NDArray[Any], parameters: tuple[FloatArray, ...]) -> NDArray[np.uint16]:
    """Return the electron numbers of some pixels.

    Args:
        frames: DN, (frame, y, x).
        parameters: maps (H, g, mu, sigma), each (y, x); NaN where the fit failed.

    Returns:
        Electron numbers (frame, y, x); ``NO_NUMBER`` where a pixel has no parameters.
    """
    return electron_numbers(frames, *parameters)


def run(context: StageContext) -> None:
    """Write ``electrons/electron_number``.

    Raises:
        InputError: the input has no frames, or they changed.
        StoreError: the store refuses.
    """
    if context.sensor.kind != "frames":
        raise InputError(
            f"{context.store.path} was made from {context.sensor.kind}, which have no frames here; "
            "electron numbers need a run of camera files"
        )
    source = open_source(context)
    n_frames, ny, nx = source.shape
    tile = context.config.run.tile
    depth = max(1, min(_CHUNK_FRAMES, _BLOCK_BYTES // (tile * nx * 2)))
    if context.fresh or not context.store.has("electrons/electron_number"):
        context.create(
            "electrons/electron_number",
            (n_frames, ny, nx),
            chunks=(depth, tile, max(_CHUNK_COLUMNS, tile)),
            # not missing_value: xarray would turn the integers into floats
            no_number=NO_NUMBER,
            largest_number=LARGEST_NUMBER,
        )
    depth = context.store.array("electrons/electron_number").chunks[0]
    rows = _BLOCK_BYTES // (depth * nx * 2)
    bands = tile_bands(context, "fit", rows, source.rows_per_read)
    task = functools.partial(_do_band, store=context.store.path, source=source, depth=depth)
    context.run_units(bands, task, unit_name="band", needs="fit")


def _do_band(band: Band, *, store: Path, source: FrameSource, depth: int) -> dict[str, Any]:
    opened = open_store(store)
    rows = slice(band.y0, band.y1)
    maps = [opened.read(f"fit/{name}", (rows, slice(None))) for name in PARAMETERS]
    effects = fitted_effects(opened)
    added = fitted_added_exposure(opened, (rows, slice(None)))
    parameters = deciding_maps(maps, effects, added, pixel_places(opened, (rows, slice(None))))
    with FrameStream(source, [(band.y0, band.y1)], depth) as stream:
        for start, (frames,) in stream:
            region = (slice(start, start + frames.shape[0]), rows, slice(None))
            opened.write("electrons/electron_number", region, electrons_tile(frames, parameters))
    return {}
