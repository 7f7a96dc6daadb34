"""SIF files of Andor Solis: a header of text, then frames of floating-point numbers that are whole."""

from __future__ import annotations

import io
from pathlib import Path
from typing import ClassVar

import numpy as np

from pchem_pipeline.base.errors import InputError, require
from pchem_pipeline.frames.camera import CameraFacts, celsius, duration_of, text_of, texts_of
from pchem_pipeline.frames.formats.contiguous import ContiguousReader, Layout
from pchem_pipeline.frames.settings import InputSettings


class _Ending(io.BufferedReader):
    """A file that says so where it ends: the library would read on without an end."""

    def read(self, size: int | None = -1, /) -> bytes:
        """Return bytes, at least one."""
        data = super().read(size)
        if not data and size:
            raise EOFError("it ends in its header")
        return data

    def readline(self, size: int | None = -1, /) -> bytes:
        """Return a line."""
        line = super().readline(size)
        if not line:
            raise EOFError("it ends in its header")
        return line


class SifReader(ContiguousReader):
    """SIF files with one image per frame."""

    format_name = "sif"
    library: ClassVar[str] = "sif_parser"
    suffixes: ClassVar[tuple[str, ...]] = (".sif",)
    magic: ClassVar[tuple[bytes, ...]] = (b"Andor Technology Multi-Channel File\n",)

    def _inspect(self, path: Path, settings: InputSettings) -> None:
        require("sif_parser", "sif", "SIF files")
        import sif_parser

        with _Ending(io.FileIO(path)) as stream:
            _, info = sif_parser.np_open(stream, lazy="memmap")
        if info["NumberOfSubImages"] != 1:
            raise InputError(f"{info['NumberOfSubImages']} tracks or areas; record one image per frame")
        columns, rows = info["size"]
        offsets = np.array([tile[2] for tile in info["tile"]], np.int64)
        self.set_layout(Layout(offsets, rows, columns, np.dtype("<f4")))
        taken = float(info["ExperimentTime"])
        setup = {"binning": f"{info['xbin']} x {info['ybin']}", "gain": info["GainDAC"]}
        camera = CameraFacts(
            text_of(info["DetectorType"]),
            temperature=celsius(info["DetectorTemperature"]),
            taken=taken if taken > 0 else None,
            setup=texts_of(setup, setup),
        )
        self.take_facts(camera, duration_of("ExposureTime", info["ExposureTime"], "s"))
        if (sums := info["AccumulatedCycles"]) > 1:
            self.notes = (f"each frame is the sum of {sums} exposures",)
        ticks = np.array([info[f"timestamp_of_{t}"] for t in range(len(offsets))], np.int64)  # us
        if self.camera.taken is not None and (np.diff(ticks) > 0).all():
            self.timestamps = self.camera.taken + 1e-6 * ticks.astype(np.float64)
