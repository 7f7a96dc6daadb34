"""Open the camera files of the section ``input`` as one stack."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pchem_pipeline.base.arrays import BoolArray
from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.first_look import first_look
from pchem_pipeline.frames.formats.map_files import read_image
from pchem_pipeline.frames.inspect import InputReport, survey
from pchem_pipeline.frames.reader import FrameReader
from pchem_pipeline.frames.resolve import mask_path
from pchem_pipeline.frames.sequence import FrameSequence
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.frames.stamps import stamped_pixels


def open_frames(
    settings: InputSettings, base_dir: Path, *, check_duplicates: bool = True, least: int = 2
) -> FrameSequence:
    """Open all camera files as one stack, with bit shift, region of interest and frame range applied.

    With ``check_duplicates``, also look for files with the same content, and at some samples. Threads can
    share the stack, and it can be pickled; its ``report`` says what was found and left out.

    Raises:
        InputError: bad files (all in one message), too few frames, or a region outside of the frames.
        ConfigError: an unknown format, or an optional library is missing.
    """
    readers, report = survey(settings, base_dir, check_duplicates=check_duplicates)
    report.raise_if_refused(settings.on_bad_file)
    return joined(readers, report, settings, base_dir, check=check_duplicates, least=least)


def joined(
    readers: Sequence[FrameReader],
    report: InputReport,
    settings: InputSettings,
    base_dir: Path,
    *,
    check: bool = True,
    least: int = 2,
) -> FrameSequence:
    """Join the readers of a survey to one stack; ``check``: look at some samples, see `open_frames`."""
    frames = FrameSequence(readers, settings, report, least)
    bad = _bad_pixels(frames, settings, base_dir)
    for pixels in bad.values():
        frames.overscan_pixels &= ~pixels
    frames.exclude({"overscan": frames.insensitive} | bad)
    if check:
        report.notes += first_look(frames, settings)
    return frames


#: what cameras write for pixels that they mask, 32 bits
_MARKER = (1 << 32) - 1


def _bad_pixels(frames: FrameSequence, settings: InputSettings, base_dir: Path) -> dict[str, BoolArray]:
    """Return by cause the pixels (y, x) of ``input.mask``, and those with a stamp, or always a marker."""
    n, rows, columns = frames.shape
    causes: dict[str, BoolArray] = {}
    stamped = stamped_pixels(frames)
    if stamped is not None and frames.within_region(stamped).any():
        causes["stamp"] = frames.within_region(stamped)
        frames.report.notes.append(
            f"{frames.paths[0].name}: {np.count_nonzero(stamped)} pixels from the first one on hold a stamp "
            "that counts the frames, and no samples; excluded"
        )
    if frames.dtype.itemsize == 4:
        first, last = (frames.stored(t, t + 1, 0, rows)[0] for t in (0, n - 1))
        causes["marker 2^32-1"] = (first == _MARKER) & (last == _MARKER)
    path = mask_path(settings, base_dir)
    if path is None:
        return causes
    mask: BoolArray = read_image(path) != 0
    if settings.roi is not None and mask.shape != (rows, columns) and mask.ndim == 2:
        y0, y1, x0, x1 = settings.roi
        mask = mask[y0:y1, x0:x1]
    if mask.shape != (rows, columns):
        raise InputError(
            f"{path}: mask of shape {mask.shape}, frames of {(rows, columns)}; correct input.mask (--mask)"
        )
    causes["mask"] = mask
    return causes
