"""Open the camera files of the section ``input`` as one stack."""

from __future__ import annotations

from pathlib import Path

from pchem_pipeline.frames.first_look import first_look
from pchem_pipeline.frames.inspect import survey
from pchem_pipeline.frames.sequence import FrameSequence
from pchem_pipeline.frames.settings import InputSettings


def open_frames(
    settings: InputSettings, base_dir: Path, *, check_duplicates: bool = True, least: int = 2
) -> FrameSequence:
    """Open all camera files as one stack, with bit shift, region of interest and frame range applied.

    Args:
        settings: the section ``input``.
        base_dir: folder to which relative paths refer.
        check_duplicates: also look for files with the same content (reads a little of each file), and at
            some samples.
        least: frames that there must be.

    Returns:
        One reader, that can be shared by threads and pickled to other processes; its ``report`` says what
        was found and left out.

    Raises:
        InputError: bad files (all in one message), too few frames, or a region outside of the frames.
        ConfigError: an unknown format, or an optional library is missing.
    """
    readers, report = survey(settings, base_dir, check_duplicates=check_duplicates)
    report.raise_if_refused(settings.on_bad_file)
    frames = FrameSequence(readers, settings, report, least)
    if check_duplicates:
        report.notes += first_look(frames, settings)
    return frames
