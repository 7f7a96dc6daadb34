"""ND2 files of Nikon's NIS-Elements, with the library nd2."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError, require
from pchem_pipeline.frames.camera import CameraFacts, bits_of, duration_of, text_of
from pchem_pipeline.frames.formats.contiguous import ContiguousReader
from pchem_pipeline.frames.formats.kinds import check_coded
from pchem_pipeline.frames.settings import InputSettings


class Nd2Reader(ContiguousReader):
    """ND2 files of one channel."""

    format_name = "nd2"
    library: ClassVar[str] = "nd2"
    suffixes: ClassVar[tuple[str, ...]] = (".nd2",)
    magic: ClassVar[tuple[bytes, ...]] = (b"\xda\xce\xbe\x0a", b"\0\0\0\x0cjP  ")

    def _inspect(self, path: Path, settings: InputSettings) -> None:
        require("nd2", "nd2", "ND2 files")
        import nd2

        # the warnings are of metadata that are not used here
        with warnings.catch_warnings(action="ignore"), nd2.ND2File(path) as file:
            if file.is_legacy:
                raise InputError("ND2 of the old kind (JPEG 2000); export it as TIFF")
            about, axes, dtype = file.attributes, dict(file.sizes), np.dtype(file.dtype)
            words = file.text_info.get("capturing", "")
        if about.componentCount != 1:
            raise InputError(f"{about.componentCount} channels or colours; export one channel as TIFF")
        shape = about.sequenceCount, about.heightPx, about.widthPx or 0
        self.set_stack(shape, dtype, settings, "stack")
        check_coded(self.shape, shape[1:], dtype.itemsize, self.size)
        camera = re.match(r"([^\r\n,]+)(?:, *SN: *([\w-]+))?", words)
        exposure = re.search(r"Exposure: *([\d.]+ *\w+)", words)
        self.take_facts(
            CameraFacts(text_of(camera[1]), text_of(camera[2])) if camera else CameraFacts(),
            duration_of("Exposure", exposure[1]) if exposure else None,
            bits_of(about.bitsPerComponentSignificant),
        )
        if about.compressionType == "lossy":
            self.notes += ("lossy compression; noise and histograms are altered",)
        if others := [axis for axis in axes if axis not in "TYX"]:
            self.notes += (f"its frames differ in {', '.join(others)}; read in turn",)

    def _decode_into(self, buffer: NDArray[Any], t0: int, t1: int, y0: int, y1: int) -> None:
        import nd2

        with nd2.ND2File(self.paths[0]) as file:
            for t, frame in enumerate(buffer, t0):
                frame[...] = file.read_frame(t).reshape(self.shape[1:])[y0:y1]
