"""Stage ``electrons``: the stack of electron numbers, any number of frames, band by band.

Each sample becomes the electron number of largest membership under the law of its pixel (Hendrickson et al.
2023, eq. demarg_K_eqn), the effects of the fit included. It is not part of ``run``, since the result is as
large as the stack.
"""

from __future__ import annotations

import functools

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.frames.stream import FrameSource, FrameStream
from pchem_pipeline.model.electrons.electrons import (
    LARGEST_NUMBER,
    NO_NUMBER,
    KnownPixels,
    NumberTables,
    number_tables,
)
from pchem_pipeline.run.input import open_source
from pchem_pipeline.run.stage import StageContext
from pchem_pipeline.stages.bands import BAND_BYTES, Band, tile_bands
from pchem_pipeline.stages.fit.fitted_model import FittedModel, fitted_satellites
from pchem_pipeline.store.run_store import RunStore


def read_tables(store: RunStore, rows: slice) -> NumberTables:
    """Return the electron numbers of the codes that some rows have shown, the fitted H being the prior."""
    region = rows, slice(None)
    low, high = (store.read(f"histogram/{name}", region) for name in ("minimum", "maximum"))
    maps = [store.read(f"fit/{name}", region) for name in PARAMETERS]
    law = FittedModel.read(store, region).law(maps)
    pixels = KnownPixels(maps, law, fitted_satellites(store, region))
    return number_tables(low, high, pixels.exposure, pixels)


def run(context: StageContext) -> None:
    """Write ``electrons/electron_number``.

    Raises:
        InputError: the input has no frames, or they changed.
        StoreError: the store refuses.
    """
    if context.sensor.kind != "frames":
        raise InputError(
            f"{context.store.path} was made from {context.sensor.kind}; electron numbers need a run of "
            "camera files"
        )
    source = open_source(context)
    n_frames, _, nx = source.shape
    rows_of_tile, columns_of_tile = context.tile
    depth = max(1, min(256, BAND_BYTES // (rows_of_tile * nx * 2)))
    context.create(
        "electrons/electron_number",
        lengths={"frame": n_frames},
        chunks={"frame": depth, "x": max(128, columns_of_tile)},
        # not missing_value: xarray would turn the integers into floats
        no_number=NO_NUMBER,
        largest_number=LARGEST_NUMBER,
    )
    depth = context.store.array("electrons/electron_number").chunks[0]
    bands = tile_bands(context, BAND_BYTES // (depth * nx * 2), source.rows_per_read)
    task = functools.partial(_do_band, source=source, depth=depth)
    context.run_units(bands, task, unit_name="band", needs="fit")


def _do_band(band: Band, store: RunStore, *, source: FrameSource, depth: int) -> None:
    rows = slice(band.y0, band.y1)
    tables = read_tables(store, rows)
    with FrameStream(source, [(band.y0, band.y1)], depth) as stream:
        for start, (frames,) in stream:
            region = (slice(start, start + len(frames)), rows, slice(None))
            store.write("electrons/electron_number", region, tables.convert(frames).number)
