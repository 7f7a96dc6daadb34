"""What is listed, and what is said of files and runs."""

import numpy as np
import pytest
import tifffile
from helpers.dcimg_files import write_dcimg

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.commands import info

FRAMES = np.random.default_rng(3).integers(90, 130, (40, 8, 9), dtype=np.uint16)


def test_formats_effects_and_the_cache_are_listed(monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/somewhere/kernels")
    monkeypatch.setattr(info, "find_spec", lambda name: None if name == "astropy" else object())
    lines = [" ".join(line.split()) for line in info.about_program()]
    assert lines[0].startswith("pchem ")
    assert "npy .npy built in" in lines
    assert "fits .fits .fit .fts .fz astropy, not installed" in lines
    assert "row_noise row noise (row temporal noise)" in lines
    assert lines[-1] == "compiled kernels: /somewhere/kernels"


def _said(*paths, refused):
    """Return the lines on files, the last of which is an error."""
    lines = []
    with pytest.raises(InputError, match=refused):
        lines.extend(info.about_files(paths))
    return lines


def test_files_are_described_and_what_cannot_be_read_says_why(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", FRAMES, photometric="minisblack")
    (tmp_path / "night").mkdir()
    (tmp_path / "b.tif").write_bytes(b"hello")
    stamps = np.r_[5:45][np.r_[:30, 33:40]]
    write_dcimg(tmp_path / "c.dcimg", FRAMES[:37], stamps=stamps)
    described, _, disk, note = info.about_files([tmp_path / "c.dcimg"])
    words = "dcimg, 37 frames of 8 x 9, uint16, bit depth not stated, no exposure time, frame stamps, time "
    assert described == f"{tmp_path / 'c.dcimg'}: {words}stamps"
    assert disk.startswith("in a run, frames stay in their files (")
    assert "3 are missing (after frame 29)" in note
    good, bad, together, _ = _said(tmp_path / "a.tif", tmp_path / "b.tif", refused="1 file cannot be used")
    assert "tiff (tifffile), 40 frames of 8 x 9, uint16, bit depth not stated, no exposure time" in good
    assert bad.startswith(f"{tmp_path / 'b.tif'}: ")
    codes = np.unique(FRAMES[[0, 20, 39]])
    assert together == f"together 40 frames of 8 x 9, DN {codes[0]} to {codes[-1]} ({codes.size} codes)"
    for i in (1, 2, 3):
        tifffile.imwrite(tmp_path / "night" / f"{i}.tif", FRAMES[i], photometric="minisblack")
    alike, together, _ = info.about_files([tmp_path / "night"])
    assert alike.startswith(f"{tmp_path}/night/1.tif to 3.tif (3 files, each): tiff (tifffile), 1 frame of 8")
    assert together.startswith("together 3 frames of 8 x 9")
    with pytest.raises(InputError, match="no such file"):
        list(info.about_files([tmp_path / "none.tif"]))
    tifffile.imwrite(tmp_path / "c.tif", FRAMES[:, :, 1:], photometric="minisblack")
    (bad,) = _said(tmp_path / "b.tif", refused="1 file cannot be used")
    assert bad.startswith(f"{tmp_path / 'b.tif'}: ")
