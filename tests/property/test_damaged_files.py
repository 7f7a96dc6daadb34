"""A damaged camera file gives the same frames or one clear line: no foreign error, no hang, no hunger."""

import io
import json
import struct
from collections import Counter

import numpy as np
import pytest
import tifffile
from helpers.damage import frames
from helpers.damaged_formats import SEEDS, outcome_of, run_cases

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.settings import InputSettings


def test_300_damaged_files(tmp_path):
    cases = list(run_cases(tmp_path, 0, 300))
    assert len(cases) == 300
    assert [case for case in cases if case.bad] == []
    found = Counter(case.outcome for case in cases)
    assert found["refused"] > 100  # the damage is real ...
    assert found["same"] > 10  # ... and does not always matter
    assert {case.layout for case in cases} == set(SEEDS)


def refusal(path):
    with pytest.raises(InputError) as caught:
        open_frames(InputSettings(files=(str(path),)), path.parent)
    return str(caught.value)


@pytest.mark.parametrize("bigtiff", [False, True])
@pytest.mark.parametrize("target", [0, 150, 299])
def test_a_chain_of_directories_in_a_circle(tmp_path, bigtiff, target):
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path, bigtiff=bigtiff) as writer:
        for frame in frames(n=300, shape=(2, 3)):
            writer.write(frame, photometric="minisblack", metadata=None)
    with tifffile.TiffFile(path) as file:
        places = [page.offset for page in file.pages]
        kind = file.tiff
    content = bytearray(path.read_bytes())
    (tags,) = struct.unpack_from(kind.tagnoformat, content, places[-1])
    last = places[-1] + kind.tagnosize + tags * kind.tagsize
    struct.pack_into(kind.offsetformat, content, last, places[target])
    path.write_bytes(content)
    assert "after 300 pages the list of pages is circular" in refusal(path)


@pytest.mark.parametrize(
    ("shape", "words"),
    [
        ("(6, 8, 9", "not a valid npy file"),
        ("(6, 8, 9" + "(" * 60, "not a valid npy file"),
        (f"({1 << 62}, 8, 9)", "truncated"),
        (f"({1 << 40}, 0, 9)", "no frames"),
        ("(6, -8, 9)", "damaged header"),
        (f"(2, 1, {1 << 40})", "damaged header"),
    ],
)
def test_headers_of_npy(tmp_path, shape, words):
    path = tmp_path / "a.npy"
    header = f"{{'descr': '<u2', 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(100))
    assert words in refusal(path)


def test_bytes_behind_an_array_are_told(tmp_path):
    path = tmp_path / "a.npy"
    with path.open("wb") as file:
        np.save(file, frames())
        np.save(file, frames())
    stack = open_frames(InputSettings(files=(str(path),)), tmp_path)
    assert stack.shape[0] == 6
    assert "992 bytes after the array" in stack.report.notes[0]


def test_a_zarr_array_that_claims_to_be_huge(tmp_path):
    SEEDS["zarr"](tmp_path)
    place = tmp_path / "a.zarr" / "zarr.json"
    place.write_text(json.dumps(json.loads(place.read_text()) | {"shape": [1 << 40, 8, 9]}))
    assert "cannot hold" in refusal(tmp_path / "a.zarr")


def test_the_judge_sees_what_must_not_be(tmp_path, monkeypatch):
    SEEDS["npy"](tmp_path)
    expected = frames()
    assert outcome_of(tmp_path, expected) == ("same", "")
    assert outcome_of(tmp_path, expected + 1)[0] == "silent"
    monkeypatch.setattr("helpers.damaged_formats.open_frames", lambda *_: io.BytesIO().nothing)
    assert outcome_of(tmp_path, expected)[0] == "foreign"
