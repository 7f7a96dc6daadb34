"""Readers from elsewhere, doubles, missing optional libraries, and import manners."""

import bz2
import gzip
import lzma
import re
import sys
from importlib.metadata import EntryPoint
from typing import ClassVar

import numpy as np
import pytest
from helpers.camera_files import not_opened, opened, write_fits
from helpers.nd2_files import nd2_bytes
from helpers.sif_files import sif_bytes

from pchem_pipeline.base.errors import ConfigError, InputError, MissingDependencyError
from pchem_pipeline.frames import registry
from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.reader import FrameReader, check_window
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.frames.writing import write_frames


class TextReader(FrameReader):
    """A reader as someone else would write it: frames as lines of text."""

    format_name = "textframes"
    suffixes: ClassVar[tuple[str, ...]] = (".txf",)
    magic: ClassVar[tuple[bytes, ...]] = (b"TEXTFRAMES",)

    @classmethod
    def open(cls, path, settings):
        reader = cls()
        reader.paths = (path,)
        frames = [[row.split() for row in line.split("|")] for line in path.read_text().splitlines()[1:]]
        reader.data = np.array(frames, np.uint16)
        reader.shape, reader.dtype = reader.data.shape, reader.data.dtype
        return reader

    def read_into(self, buffer, t0, t1, y0=0, y1=None):
        y0, y1 = check_window(self, buffer, t0, t1, y0, y1)
        buffer[...] = self.data[t0:t1, y0:y1]


@pytest.mark.parametrize("pack", [gzip, bz2, lzma])
@pytest.mark.parametrize("name", ["a.fits", "a.fits.packed"])
@pytest.mark.parametrize("given", ["auto", "fits"])
def test_packed_files_are_refused(tmp_path, pack, name, given):
    """A library that unpacks by itself must not tell where frames lie in a file that it did not read."""
    path = tmp_path / name
    stack = np.random.default_rng(1).integers(0, 65536, (4, 30, 40)).astype(np.uint16)
    path.write_bytes(pack.compress(write_fits(tmp_path / "plain.fits", stack).read_bytes()))
    not_opened(r"compressed with (gzip|bzip2|xz); unpack it first", path, format=given)
    samples = tmp_path / "a.raw"
    samples.write_bytes(b"PK\x03\x04" + bytes(20))
    assert opened(samples, shape=(3, 2), dtype="uint16").shape == (2, 3, 2)


@pytest.fixture(autouse=True)
def _forget_plug_ins():
    """Readers are looked up once per process."""
    yield
    registry._plugins.cache_clear()
    registry._warn.cache_clear()


def plug_in(monkeypatch, *points):
    found = [EntryPoint(name, value, registry.ENTRY_POINT_GROUP) for name, value in points]
    monkeypatch.setattr(registry, "entry_points", lambda group: found)
    registry._plugins.cache_clear()


def test_reader_from_a_plug_in_which_is_not_loaded_without_need(tmp_path, monkeypatch):
    plug_in(monkeypatch, ("textframes", f"{__name__}:TextReader"))
    (tmp_path / "a.txf").write_text("TEXTFRAMES\n1 2|3 4\n5 6|7 8\n")
    for name, format in (("a.txf", "auto"), (".", "auto"), ("a.txf", "textframes")):
        found = open_frames(InputSettings(files=(name,), format=format), tmp_path).read()
        np.testing.assert_array_equal(found, np.arange(1, 9).reshape(2, 2, 2))
    assert "textframes" in registry.reader_names()
    plug_in(monkeypatch, ("broken", "there_is_no_such_module:Reader"))
    np.save(tmp_path / "a.npy", np.zeros((2, 3, 4), np.uint8))
    assert open_frames(InputSettings(files=("a.npy",)), tmp_path).shape == (2, 3, 4)
    with pytest.raises(ConfigError, match=r"the reader 'broken' .* cannot be loaded"):
        open_frames(InputSettings(files=("a.npy",), format="broken"), tmp_path)


def test_doubles_and_what_is_no_reader_are_left_out(monkeypatch, caplog):
    points = [("tiff", "other.package:Tiff"), ("lab", "one.package:Lab"), ("lab", "two.package:Lab")]
    plug_in(monkeypatch, *points, points[1])  # one that is listed twice is no double
    assert registry.reader_names()[-2:] == ["raw", "lab"]
    assert registry._plugins()["lab"].value == "one.package:Lab"
    assert [record.getMessage() for record in caplog.records] == [
        "the reader 'tiff' (other.package:Tiff) is left out: pchem_pipeline has that name",
        "the reader 'lab' (two.package:Lab) is left out: one.package:Lab has that name",
    ]
    for name, cls in (("noreader", "EntryPoint"), ("othername", "TextReader")):
        plug_in(monkeypatch, (name, f"{__name__}:{cls}"))
        with pytest.raises(ConfigError, match=f"must be a FrameReader with format_name = '{name}'"):
            registry.reader_class(name)


def test_a_plug_in_that_is_broken_is_one_line_and_leaves_others_as_they_are(tmp_path, monkeypatch, caplog):
    plug_in(monkeypatch, ("broken", "there_is_no:Reader"), ("textframes", f"{__name__}:TextReader"))
    path = tmp_path / "a.txf"
    path.write_text("TEXTFRAMES\n1 2|3 4\n5 6|7 8\n")
    assert registry.detect_format(path) == "textframes"
    assert registry.frame_suffixes()[".txf"] == "textframes"
    assert [record.getMessage() for record in caplog.records] == [
        "the reader 'broken' (there_is_no:Reader) cannot be loaded: ModuleNotFoundError: No module named "
        "'there_is_no'; repair or uninstall that package"
    ]
    frames = open_frames(InputSettings(files=("a.txf",)), tmp_path)
    with monkeypatch.context() as patched:
        patched.setattr(TextReader, "recognises", lambda *_: {}["y"])
        assert {registry.detect_format(path) for _ in range(2)} == {"textframes"}  # by its suffix
    assert [record.getMessage() for record in caplog.records[1:]] == [
        f"the reader 'textframes' ({__name__}) failed: KeyError: 'y'; repair or uninstall that package"
    ]
    monkeypatch.setattr(TextReader, "read_into", lambda *_: {}["x"])
    with pytest.raises(InputError, match=r"a\.txf: not a valid textframes file, .*KeyError: 'x'"):
        frames.read()
    monkeypatch.setattr(TextReader, "open", lambda *_: object())
    with pytest.raises(InputError, match=r"a\.txf: not a valid textframes file, .*no attribute 'shape'"):
        open_frames(InputSettings(files=("a.txf",)), tmp_path)


@pytest.mark.parametrize(
    ("format", "library"), [("fits", "astropy"), ("hdf5", "h5py"), ("nd2", "nd2"), ("sif", "sif_parser")]
)
def test_missing_library_is_named_with_what_installs_it(tmp_path, monkeypatch, format, library):
    stack = np.zeros((2, 3, 4), np.uint16)
    by_hand = {"nd2": nd2_bytes, "sif": sif_bytes}.get(format)
    actions = [lambda: opened(path)]
    if by_hand:
        path = tmp_path / f"a.{format}"
        path.write_bytes(by_hand(stack))
    else:
        path = write_frames(format, tmp_path / "a", iter([stack]), stack.shape, "uint16")
        actions.append(lambda: write_frames(format, tmp_path / "b", iter([stack]), stack.shape, "uint16"))
    assert registry.detect_format(path) == format
    for name in {library, *(name for name in sys.modules if name.startswith(f"{library}."))}:
        monkeypatch.setitem(sys.modules, name, None)
    for action in actions:
        with pytest.raises(MissingDependencyError) as caught:
            action()
        assert re.search(rf"pip install '{library.replace('_', '-')}>=[\d.]+'", str(caught.value))
