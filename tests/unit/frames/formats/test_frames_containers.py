"""HDF5, NeXus, zarr and OME-Zarr: where frames lie, facts beside them, parts that are missing, damage."""

import os

import h5py
import numpy as np
import pytest
import zarr
from helpers import layouts
from helpers.camera_files import check_reads, opened, overwrite, read, refused, write_hdf5

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.formats.hdf5 import Hdf5Reader
from pchem_pipeline.frames.formats.zarr import ZarrReader
from pchem_pipeline.frames.settings import InputSettings

STACK = np.random.default_rng(13).integers(0, 65536, (7, 19, 22)).astype(np.uint16)


@pytest.mark.parametrize(
    ("options", "plain"),
    [
        ({}, True),
        ({"chunks": (1, 19, 22)}, True),
        ({"chunks": (3, 19, 22)}, True),  # the last chunk is not full
        ({"chunks": (3, 5, 22)}, False),
        ({"chunks": (3, 19, 22), "fletcher32": True}, False),
        ({"chunks": (3, 19, 22), "compression": "gzip"}, False),
    ],
)
@pytest.mark.parametrize("dtype", ["<u2", ">u2", "<i2"])
def test_hdf5_is_read_from_offsets_where_frames_lie_plainly(tmp_path, options, plain, dtype):
    path, values = tmp_path / "a.h5", (STACK // 2).astype(dtype)
    with h5py.File(path, "w") as file:
        dataset = file.create_dataset("frames", values.shape, dtype, **options)
        for t in reversed(range(len(values))):  # so that chunks do not lie in order
            dataset[t] = values[t]
    reader = Hdf5Reader.open(path, InputSettings(dtype="uint16"))
    assert (reader.layout is not None) == plain
    np.testing.assert_array_equal(reader.read(0, len(values)), values)
    np.testing.assert_array_equal(reader.read(2, 5, 3, 7), values[2:5, 3:7])


def test_hdf5_that_only_looks_plain(tmp_path):
    twelve = h5py.h5t.NATIVE_UINT16.copy()
    twelve.set_precision(12)
    with h5py.File(tmp_path / "block.h5", "w", userblock_size=512) as file:
        file["frames"] = STACK
    with h5py.File(tmp_path / "holes.h5", "w") as file:
        file.create_dataset("frames", STACK.shape, "u2", chunks=(1, *STACK.shape[1:]))[1] = STACK[1]
    with h5py.File(tmp_path / "bits.h5", "w") as file:
        space = h5py.h5s.create_simple(STACK.shape)
        h5py.h5d.create(file.id, b"frames", twelve, space).write(h5py.h5s.ALL, h5py.h5s.ALL, STACK % 4096)
    holes = np.zeros_like(STACK)
    holes[1] = STACK[1]
    for name, expected in (("block", STACK), ("holes", holes), ("bits", STACK % 4096)):
        reader = Hdf5Reader.open(tmp_path / f"{name}.h5", InputSettings())
        assert reader.layout is None
        np.testing.assert_array_equal(reader.read(0, len(STACK)), expected)


def test_nexus_facts_of_frames_that_are_linked(tmp_path):
    """Most programs put one array into NXdata and NXdetector; what is said of it stands in the detector."""
    path = tmp_path / "linked.nxs"
    with h5py.File(path, "w") as file:
        detector = file.create_group("entry/instrument/detector")
        detector.attrs["NX_class"] = "NXdetector"
        detector["count_time"] = 250.0
        detector["count_time"].attrs["units"] = "ms"
        detector["bit_depth_readout"] = 16
        detector["mask"] = np.zeros(STACK.shape[1:], np.uint8)
        detector["description"] = "Maker Model"
        file["entry/data/data"] = STACK
        detector["data"] = file["entry/data/data"]
    reader = opened(path)
    check_reads(reader, STACK)
    found = reader.integration_time, reader.bit_depth, reader.camera.name
    assert found == (pytest.approx(0.25), 16, "Maker Model")


@pytest.mark.parametrize("from_row", [0, 4])
def test_hdf5_virtual_dataset(tmp_path, from_row):
    """The library reads parts that it does not find as 0; they must not pass for frames."""
    path, (_, rows, columns) = tmp_path / "all.h5", STACK.shape
    layout = h5py.VirtualLayout((len(STACK), rows - from_row, columns), STACK.dtype)
    for i, (start, end) in enumerate([(0, 3), (3, 6), (6, 7)]):
        write_hdf5(tmp_path / f"part{i}.h5", data=STACK[start:end])
        source = h5py.VirtualSource(f"part{i}.h5", "data", (end - start, rows, columns))
        layout[start:end] = source[:, from_row:] if from_row else source
    with h5py.File(path, "w") as file:
        file.create_virtual_dataset("data", layout)
    np.testing.assert_array_equal(read(path), STACK[:, from_row:])
    assert "in 3 other files" in Hdf5Reader.open(path, InputSettings()).notes[0]
    write_hdf5(tmp_path / "part1.h5", data=STACK[3:5])
    words = r"all\.h5: 1 of the 3 parts of /data are missing or truncated, the first in part1\.h5"
    refused(words, path)
    (tmp_path / "part1.h5").unlink()
    refused(words, path)


def test_hdf5_virtual_dataset_without_an_end(tmp_path):
    """A virtual dataset may grow with its source: it has as many frames as there are."""
    with h5py.File(tmp_path / "part.h5", "w") as file:
        file.create_dataset("data", data=STACK, maxshape=(None, *STACK.shape[1:]))
        source = h5py.VirtualSource(file["data"])
    layout = h5py.VirtualLayout((1, *STACK.shape[1:]), STACK.dtype, maxshape=(None, *STACK.shape[1:]))
    layout[: h5py.h5s.UNLIMITED] = source[: h5py.h5s.UNLIMITED]
    with h5py.File(tmp_path / "all.h5", "w") as file:
        file.create_virtual_dataset("data", layout)
    check_reads(opened(tmp_path / "all.h5"), STACK)
    (tmp_path / "part.h5").unlink()
    refused(r"missing or truncated|no frames", tmp_path / "all.h5")


def test_hdf5_links_into_other_files(tmp_path):
    """A master file names its data files, whose frames it does not hold; its masks are no frames."""
    path = tmp_path / "master.h5"
    with h5py.File(path, "w") as file:
        file["mask"] = np.zeros(STACK.shape[1:], np.uint32)
        file["entry/data_000001"] = h5py.ExternalLink("data_000001.h5", "/data")
    refused(r"in other files: entry/data_000001 in data_000001\.h5; give those", path)
    write_hdf5(tmp_path / "data_000001.h5", data=STACK)
    refused(r"in other files: entry/data_000001 in data_000001\.h5; give those", path)
    refused("in other files", path, dataset="/entry/data_000001")
    with h5py.File(path, "a") as file:
        file["frames"] = STACK
    np.testing.assert_array_equal(read(path), STACK)


def test_hdf5_samples_in_a_raw_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    other = tmp_path / "folder" / "a.h5"
    other.parent.mkdir()
    for path, name in (("a.h5", "samples.bin"), (other, str(tmp_path / "samples.bin")), ("fifo.h5", "fifo")):
        with h5py.File(path, "w") as file:
            file.create_dataset("frames", STACK.shape, STACK.dtype, external=[(name, 0, STACK.nbytes)])
    (tmp_path / "samples.bin").write_bytes(STACK.tobytes())
    np.testing.assert_array_equal(read(tmp_path / "a.h5"), STACK)
    (tmp_path / "samples.bin").write_bytes(STACK.tobytes()[:-1])
    refused(rf"samples.bin, truncated: {STACK.nbytes} bytes", tmp_path / "a.h5")
    refused(r"source /.*/samples.bin is not in the same folder or below", other)
    os.mkfifo(tmp_path / "fifo")
    refused(r"source /.*/fifo is not a regular file", tmp_path / "fifo.h5")
    monkeypatch.chdir(tmp_path.parent)
    refused(r"a\.h5: the samples of /frames are in samples\.bin, which is not", tmp_path / "a.h5")


@pytest.mark.parametrize("case", ["itself", "by another", "outside", "fifo", "numbered"])
def test_hdf5_virtual_dataset_of_what_it_must_not_have(tmp_path, case):
    """The library crashes on a part of itself, waits for a pipe, and reads any file of this machine."""
    home = tmp_path / "home"
    home.mkdir()
    os.mkfifo(home / "fifo")
    names = {"by another": "b.h5", "outside": "../c.h5", "fifo": "fifo", "numbered": "fif%b"}

    def virtual(path, source):
        numbered = "%" in source
        shape = (1 if numbered else len(STACK), *STACK.shape[1:])
        layout = h5py.VirtualLayout(shape, STACK.dtype, maxshape=(None, *shape[1:]))
        layout[: h5py.h5s.UNLIMITED if numbered else shape[0]] = h5py.VirtualSource(source, "data", shape)
        with h5py.File(path, "w") as file:
            file.create_virtual_dataset("data", layout)

    virtual(home / "a.h5", names.get(case, "a.h5" if case == "itself" else "."))
    virtual(home / "b.h5", "a.h5")
    write_hdf5(tmp_path / "c.h5", data=STACK)
    words = dict.fromkeys(("itself", "by another"), "contains itself") | {"outside": "folder or below"}
    refused(words.get(case, "not a regular file"), home / "a.h5")


def test_hdf5_where_files_cannot_be_locked(tmp_path, monkeypatch):
    layouts.hdf5(tmp_path / "a.h5", STACK, compression="gzip")
    usual = h5py.File
    wrong = OSError("unable to lock file, errno = 38, error message = 'Function not implemented'")

    def without_locks(path, mode, locking=None):
        if locking is not False:
            raise wrong
        return usual(path, mode, locking=locking)

    monkeypatch.setattr(h5py, "File", without_locks)
    np.testing.assert_array_equal(read(tmp_path / "a.h5"), STACK)
    wrong = BlockingIOError(11, "unable to lock file")
    refused("is open for writing or was not closed; wait", tmp_path / "a.h5")


def test_hdf5_with_a_filter_that_is_not_installed_or_left_open_by_its_writer(tmp_path):
    path = tmp_path / "a.h5"
    layouts.hdf5(path, STACK, chunks=(1, 19, 22), compression="gzip")
    place = path.read_bytes().index(b"deflate\0") - 8
    overwrite(path, place, (40_000).to_bytes(2, "little"))
    refused(r"/frames needs HDF5 filter 40000 \(deflate\), which is not", path)
    path, copy = tmp_path / "a.h5", tmp_path / "copy.h5"
    with h5py.File(path, "w", libver="latest") as file:
        file["frames"] = STACK
        file.swmr_mode = True
        file.flush()
        copy.write_bytes(path.read_bytes())
    refused(r"copy\.h5: is open for writing or was not closed; .*h5clear -s", copy)


def test_matlab_file(tmp_path):
    """Version 7.3 is HDF5 behind a block of text, its axes in reverse order."""
    path = tmp_path / "frames.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        file["frames"] = STACK
        file["frames"].attrs["MATLAB_class"] = np.bytes_("uint16")
    overwrite(path, 0, b"MATLAB 7.3 MAT-file, Platform: GLNXA64")
    np.testing.assert_array_equal(read(path), STACK)
    assert "last axis read as frames" in Hdf5Reader.open(path, InputSettings()).notes[0]


def test_hdf5_candidates_are_listed(tmp_path):
    path = tmp_path / "two.h5"
    write_hdf5(path, **{"dark/frames": STACK, "light/frames": STACK + 1})
    refused(r"several datasets: dark/frames \(7, 19, 22\), light/frames .*input.dataset", path)
    check_reads(opened(path, dataset="/dark/frames"), STACK)
    refused(r"no dataset 'flat', only: dark/frames", path, dataset="flat")
    write_hdf5(path, **{f"frame{i}": STACK[0] for i in range(15)})
    refused(r"and 3 more; choose one", path)
    write_hdf5(path, temperature=np.arange(4))
    refused("no dataset of frames", path)


def test_damaged_chunks(tmp_path):
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        dataset = file.create_dataset("frames", data=STACK, chunks=(1, 19, 22), compression="gzip")
        place = dataset.id.get_chunk_info(3).byte_offset
    reader = opened(tmp_path / "a.h5")
    overwrite(path, place, bytes(60))
    np.testing.assert_array_equal(reader.read(0, 3), STACK[:3])
    with pytest.raises(InputError, match=r"a\.h5: cannot be decoded"):
        reader.read()
    write_hdf5(path, frames=STACK[:4])
    with pytest.raises(InputError, match="the size of the file changed while it was being read"):
        reader.read(0, 2)
    path = tmp_path / "a.zarr"
    zarr.create_array(path, data=STACK, chunks=(3, 19, 22))
    reader = opened(tmp_path / "a.zarr")
    chunk = sorted(file for file in path.rglob("*") if file.is_file() and file.name != "zarr.json")[0]
    chunk.write_bytes(chunk.read_bytes()[:20])
    with pytest.raises(InputError, match=r"a\.zarr: cannot be decoded"):
        reader.read()
    (path / "zarr.json").write_text("{")
    refused("not a valid zarr file", path)


@pytest.mark.parametrize("version", [2, 3])
def test_ome_zarr(tmp_path, version):
    path = tmp_path / "image.ome.zarr"
    group = zarr.open_group(path, mode="w", zarr_format=version)
    group.create_array("full", data=STACK[:, None, None], chunks=(1, 1, 1, 19, 22))
    group.create_array("half", data=STACK[:, None, None, ::2, ::2], chunks=(1, 1, 1, 10, 11))
    scales = [{"datasets": [{"path": "full"}, {"path": "half"}]}]
    group.attrs.update(
        {"multiscales": scales} if version == 2 else {"ome": {"version": "0.5", "multiscales": scales}}
    )
    check_reads(opened(path), STACK)
    group.attrs.update({"multiscales": scales, "ome": {"multiscales": [{"datasets": [{"path": "two"}]}]}})
    group.create_array("two", data=np.zeros((4, 2, 1, 8, 9), np.uint16))
    refused("as 2 channels of 4; write each channel by itself", path)


@pytest.mark.parametrize("chunks", [None, (1, 7, 19, 22), (2, 3, 8, 22)])
def test_events_of_several_frames_are_read_in_turn(tmp_path, chunks):
    """As data brokers write them: (event, frame, y, x)."""
    events = np.stack([STACK, STACK[::-1], STACK + 7])
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("image", data=events, chunks=chunks)
        file["time"] = np.arange(3.0)
    with h5py.File(tmp_path / "b.h5", "w") as file:
        more = chunks and (1, 1, *chunks[1:])
        file.create_dataset("image", data=events.astype(">u2")[:, None], chunks=more)
    zarr.create_array(tmp_path / "a.zarr", name="image", data=events, chunks=chunks or events.shape)
    frames = events.reshape(-1, *STACK.shape[1:])
    for name in ("a.h5", "b.h5", "a.zarr"):
        reader = opened(tmp_path / name)
        check_reads(reader, frames)
        assert "read as 3 x 7 frames" in reader.report.notes[0]


def test_channels_of_ome_zarr_are_reported(tmp_path):
    path = tmp_path / "image.zarr"
    group = zarr.open_group(path, mode="w", zarr_format=2)
    group.create_array("0", data=STACK)
    named = [{"name": name} for name in "cyx"]
    for axes, channels in ((["c", "y", "x"], 1), (named, 1), (["t", "y", "x"], 0)):
        group.attrs["multiscales"] = [{"axes": axes, "datasets": [{"path": "0"}]}]
        reader = ZarrReader.open(path, InputSettings())
        np.testing.assert_array_equal(reader.read(), STACK)
        assert ["7 channels; read as frames" in note for note in reader.notes] == [True] * channels
