"""What is listed, and what is said of files and runs."""

import numpy as np
import pytest
import tifffile

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.commands import info
from pchem_pipeline.config.load import parse_config
from pchem_pipeline.run.target import Target
from pchem_pipeline.runner.session import Command, run_stages

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


def test_files_are_described_with_the_first_problem(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", FRAMES, photometric="minisblack")
    (tmp_path / "b.tif").write_bytes(b"hello")
    good, bad, first = info.about_files([tmp_path / "a.tif", tmp_path / "b.tif"])
    assert "tiff (tifffile), 40 frames of 8 x 9, uint16, bit depth not stated, no exposure time" in good
    assert "b.tif" in bad
    assert first.startswith(f"first problem: {tmp_path / 'b.tif'}: ")
    with pytest.raises(InputError, match="no such file"):
        info.about_files([tmp_path / "none.tif"])


def test_a_run_says_its_reader_and_stages(tmp_path):
    np.save(tmp_path / "a.npy", FRAMES)
    text = "run: {store: run.zarr}\ninput: {files: [a.npy]}\n"
    path = tmp_path / "run.yaml"
    path.write_text(text)
    assert info.is_run(path)
    assert "no stage was run yet" in info.about_run(path)[1]
    target = Target(parse_config(text), tmp_path, tmp_path / "run.zarr", path)
    run_stages(target, ["ingest"], Command(quiet=True))
    assert info.is_run(target.store)
    _, reader, ingest, *_ = info.about_run(target.store)
    assert reader == "  frames, reader npy, 40 frames of 8 x 9 uint16, mode copy"
    assert ingest.split() == ["ingest", "complete"]
