"""Missing and repeated frames by the camera's count, of any reader that has it."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.camera_files import opened
from helpers.dcimg_files import write_dcimg

from pchem_pipeline.frames.stamps import stamp_notes


def counted(*stamps):
    known = [None if np.isnan(each).any() else np.array(each) for each in stamps]
    return [SimpleNamespace(shape=(len(s), 2, 2), frame_stamps=k) for s, k in zip(stamps, known, strict=True)]


def test_missing_repeated_and_recounted_frames_are_told_with_a_part_without():
    stamps = np.r_[3:13, 15:25, 24, 25:65, 10:20]
    (note,) = stamp_notes(counted(stamps), None)
    assert "2 are missing (after frame 9)" in note
    assert "1 is repeated (frame 20)" in note
    assert "the numbers go back (after frame 60)" in note
    assert "input.frame_range: [20, 61] (--frames 20:61)" in note
    assert stamp_notes(counted(stamps), (20, 61)) == []
    assert "after frame 60" in stamp_notes(counted(stamps), (20, None))[0]


def test_frames_are_numbered_over_all_files_and_only_the_first_places_are_listed():
    one, other = np.arange(100), np.delete(np.arange(60), [10, 20, 30, 31, 40, 50])
    (note,) = stamp_notes(counted(one, [np.nan] * 7, other), None)
    assert "6 are missing (after frames 116, 125, 134, 142 and 1 more)" in note
    assert "[0, 117]" in note
    assert stamp_notes(counted(one, [np.nan] * 7, other), (0, 117)) == []


@pytest.mark.parametrize(
    "stamps",
    [
        np.arange(50) + 7,
        3 * np.arange(50),
        np.zeros(50, int),
        np.arange(50)[::-1],
        np.cumsum(np.random.default_rng(1).integers(1, 9, 50)),
        [np.nan] * 5,
        [4],
        [4, 5],
    ],
    ids=["one by one", "every third", "none", "backwards", "clock", "no stamps", "one frame", "two"],
)
def test_even_counts_and_what_is_no_count_are_not_told(stamps):
    assert stamp_notes(counted(stamps), None) == []
    assert stamp_notes(counted(stamps, stamps), None) == []


def test_the_note_comes_with_the_other_remarks_on_frames(tmp_path):
    stack = np.random.default_rng(5).integers(90, 130, (40, 8, 9), dtype=np.uint16)
    for name in ("a1", "a2"):
        write_dcimg(tmp_path / f"{name}.dcimg", stack, stamps=np.r_[:30, 35:45])
        stack = stack + 1
    assert "10 are missing (after frames 29, 69)" in opened(tmp_path).report.message()
    assert opened(tmp_path, frame_range=(30, 70)).report.notes == []
