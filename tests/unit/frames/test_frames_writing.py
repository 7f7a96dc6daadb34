"""Writers: every format, whole or not at all, readable by the format's own library; disks that are full."""

import json
import subprocess
import sys

import h5py
import numpy as np
import pytest
import tifffile
import zarr
from astropy.io import fits

from pchem_pipeline.base.errors import ConfigError, InputError, StoreError
from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.frames.writing import WRITERS, write_frames

SHAPE = (13, 9, 10)


def make_stack(dtype):
    stack = np.random.default_rng(5).integers(0, np.iinfo(dtype).max, SHAPE, dtype=dtype, endpoint=True)
    stack[0, 0, :2] = 0, np.iinfo(dtype).max
    return stack


def blocks(stack, size):
    for start in range(0, len(stack), size):
        yield stack[start : start + size]


@pytest.mark.parametrize("format", WRITERS)
@pytest.mark.parametrize("dtype", ["uint8", "uint16", "uint32"])
@pytest.mark.parametrize(("size", "per_file"), [(4, 13), (4, 1), (5, 3)])
def test_round_trip(tmp_path, format, dtype, size, per_file):
    stack = make_stack(dtype)
    if format == "ser" and dtype == "uint32":
        with pytest.raises(InputError, match="at most 16 bits"):
            write_frames(format, tmp_path / "a", blocks(stack, size), SHAPE, dtype)
        return
    paths = [
        write_frames(format, tmp_path / f"new/{i:02d}", blocks(p, size), p.shape, dtype, integration_time=0.5)
        for i, p in enumerate(blocks(stack, per_file))
    ]
    assert not list(tmp_path.rglob(".partial*"))
    reader = open_frames(InputSettings(files=tuple(str(path) for path in paths)), tmp_path)
    assert reader.dtype == np.dtype(dtype)
    np.testing.assert_array_equal(reader.read(), stack)
    assert reader.integration_time == (None if format in ("npy", "ser") else 0.5)


def test_own_libraries_read_what_we_write(tmp_path):
    stack = make_stack("uint16")
    written, facts = {}, {"integration_time": 4.87, "bit_depth": 16}
    for name in WRITERS:
        written[name] = write_frames(name, tmp_path / "a", blocks(stack, 4), SHAPE, "uint16", **facts)
    np.testing.assert_array_equal(tifffile.imread(written["tiff"]), stack)
    with fits.open(written["fits"]) as units:
        units.verify("exception")
        np.testing.assert_array_equal(units[0].data, stack)
        assert units[0].header["EXPTIME"] == 4.87
    with h5py.File(written["hdf5"]) as file:
        np.testing.assert_array_equal(file["frames"][()], stack)
        assert file["frames"].attrs["integration_time"] == 4.87
    np.testing.assert_array_equal(np.load(written["npy"]), stack)
    np.testing.assert_array_equal(np.fromfile(written["raw"], "<u2").reshape(SHAPE), stack)
    assert json.loads((tmp_path / "a.raw.json").read_text())["bit_depth"] == 16
    array = zarr.open_array(written["zarr"], mode="r")
    np.testing.assert_array_equal(np.asarray(array[:]), stack)
    assert array.metadata.dimension_names == ("frame", "y", "x")


def test_big_files_become_bigtiff(tmp_path, monkeypatch):
    asked: list[bool] = []
    real = tifffile.TiffWriter
    monkeypatch.setattr(
        tifffile, "TiffWriter", lambda path, bigtiff: asked.append(bigtiff) or real(path, bigtiff=True)
    )
    write_frames("tiff", tmp_path / "a", blocks(make_stack("uint16"), 4), SHAPE, "uint16")
    assert asked == [False]
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        assert file.is_bigtiff

    def stop(path, bigtiff):
        asked.append(bigtiff)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(tifffile, "TiffWriter", stop)
    with pytest.raises(StoreError, match=r"cannot use .*b\.tif: No space left on device; the disk is full"):
        write_frames("tiff", tmp_path / "b", iter([]), (17_750, 512, 512), "uint16")
    assert asked[-1]


@pytest.mark.parametrize("format", WRITERS)
@pytest.mark.parametrize("shape", [(3, 5, 1), (3, 1, 5), (2, 1, 1)])
def test_frames_of_one_row_or_column_are_read_as_they_were_written(tmp_path, format, shape):
    stack = np.arange(np.prod(shape), dtype=np.uint8).reshape(shape)
    path = write_frames(format, tmp_path / "a", iter([stack]), shape, "uint8")
    np.testing.assert_array_equal(open_frames(InputSettings(files=(str(path),)), tmp_path).read(), stack)


@pytest.mark.parametrize("format", WRITERS)
def test_nothing_is_left_of_a_broken_write(tmp_path, format):
    stack = make_stack("uint16")

    def breaking():
        yield stack[:4]
        raise RuntimeError("simulated mishap")

    with pytest.raises(RuntimeError, match="mishap"):
        write_frames(format, tmp_path / "a", breaking(), SHAPE, "uint16")
    assert list(tmp_path.iterdir()) == []
    write_frames(format, tmp_path / "a", iter([stack]), SHAPE, "uint16")
    before = sorted((p.name, p.stat().st_size) for p in tmp_path.rglob("*"))
    with pytest.raises(RuntimeError, match="mishap"):
        write_frames(format, tmp_path / "a", breaking(), SHAPE, "uint16")
    assert sorted((p.name, p.stat().st_size) for p in tmp_path.rglob("*")) == before


def test_blocks_must_make_up_the_shape(tmp_path):
    stack = make_stack("uint16")
    for given, dtype, words in (
        ([stack[:10]], "uint16", "end 3 frames too early"),
        ([stack, stack[:1]], "uint16", "more frames than"),
        ([stack[:, :4]], "uint16", "a block of shape"),
        ([stack], "int16", "not int16"),
    ):
        with pytest.raises(ValueError, match=words):
            write_frames("npy", tmp_path / "a", iter(given), SHAPE, dtype)
    with pytest.raises(ConfigError, match="cannot be written as 'jpeg'; choose one of: tiff, fits"):
        write_frames("jpeg", tmp_path / "a", iter([stack]), SHAPE, "uint16")


PROGRAM = """
import json, resource, signal, sys
from pathlib import Path
import numpy as np
from pchem_pipeline.base.errors import PchEmError
from pchem_pipeline.frames.writing import write_frames

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
frames = np.random.default_rng(1).integers(0, 60000, (60, 64, 64), dtype=np.uint16)
found = {}
for name in sys.argv[2:]:
    place = Path(sys.argv[1]) / name
    write_frames(name, place / "a", iter([frames[:2]]), (2, 64, 64), frames.dtype)  # libraries are loaded
    before = sorted(str(path) for path in place.rglob("*"))
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))
    try:
        write_frames(name, place / "a", iter(np.split(frames, 4)), frames.shape, frames.dtype)
        found[name] = "written"
    except PchEmError as error:
        found[name] = str(error)
    except Exception as error:
        found[name] = f"foreign {type(error).__name__}: {error}"
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    if sorted(str(path) for path in place.rglob("*")) != before:
        found[name] += " and left something"
print(json.dumps(found))
"""


def test_a_file_that_may_not_grow(tmp_path):
    command = [sys.executable, "-c", PROGRAM, str(tmp_path), *WRITERS]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    found: dict[str, str] = json.loads(result.stdout.splitlines()[-1])
    assert [*found] == [*WRITERS]
    for name, words in found.items():
        assert words.startswith("cannot use "), (name, words)
        assert words.endswith("size limit (see ulimit -f): raise it and run again"), (name, words)
