"""Hostile files: small ones that stand for much, and zarr stores that run code or lead elsewhere."""

import bz2
import gzip
import io
import json
import os
import pickle
import struct
import time
import zipfile
import zlib

import h5py
import hdf5plugin
import numcodecs
import numpy as np
import pytest
import zarr
from astropy.io import fits
from helpers.camera_files import read, refused, write_hdf5
from helpers.damage import frames

from pchem_pipeline.base.errors import InputError, PchEmError, StoreError
from pchem_pipeline.frames.histogram_files import read_histograms
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.store.run_store import RunStore, _refuse_links

STACK = np.random.default_rng(2).integers(0, 4096, (40, 16, 16)).astype(np.uint16)
BOMB = 1 << 24


def refused_at_once(words, path, use=read):
    clock = time.process_time()
    with pytest.raises(InputError, match=words):
        use(path)
    assert time.process_time() - clock < 2.0


@pytest.mark.parametrize("codec", ["zlib", "gzip", "zstd", "blosc", "bz2", "lz4", "lzma"])
def test_zarr(tmp_path, codec):
    path, new = tmp_path / "a.zarr", codec in ("gzip", "zstd", "blosc")
    coder = numcodecs.get_codec({"id": codec})
    coded = {"name": codec, "configuration": {}} if new else coder
    zarr.create_array(path, data=STACK, chunks=(20, 16, 16), compressors=coded, zarr_format=3 if new else 2)
    read(path)
    (path / ("c/1/0/0" if new else "1.0.0")).write_bytes(coder.encode(bytes(BOMB)))
    refused_at_once(r"a\.zarr: damaged: a piece of \d+ bytes unpacks to more than", path)


def test_zarr_of_many_frames_compressed_twice_or_of_many_chunks_in_a_shard(tmp_path):
    gzip_, zstd = ({"name": name, "configuration": {}} for name in ("gzip", "zstd"))
    path, coder = tmp_path / "a.zarr", numcodecs.Zstd()
    zarr.create_array(path, data=STACK, chunks=(20, 16, 16), compressors=zstd)
    (path / "c/1/0/0").write_bytes(coder.encode(bytes(8)) + coder.encode(bytes(BOMB)))
    refused_at_once("unpacks to more than", path)
    zarr.create_array(tmp_path / "b.zarr", data=STACK, chunks=(20, 16, 16), compressors=[gzip_, zstd])
    refused_at_once(r"compressed twice, by \w+ and \w+; write it again with one of them", tmp_path / "b.zarr")
    path = tmp_path / "c.zarr"
    zarr.create_array(path, shape=(80, 256, 256), chunks=(1, 8, 8), shards=(80, 256, 256), dtype="u2")
    (path / "c/0/0").mkdir(parents=True)
    (path / "c/0/0/0").write_bytes(b"")
    refused_at_once("shards of more than 65536 chunks", path)


@pytest.mark.parametrize("place", ["start", "end"])
@pytest.mark.parametrize("codec", ["gzip", "zstd", "blosc"])
def test_shards_are_many_pieces(tmp_path, codec, place):
    path, coded = tmp_path / "a.zarr", {"name": codec, "configuration": {}}
    shards = {"shape": (40, 16, 16), "index_location": place}
    zarr.create_array(path, data=STACK, chunks=(2, 16, 16), shards=shards, compressors=coded)
    read(path)
    data = (path / "c/0/0/0").read_bytes()
    first, size = (0 if place == "start" else len(data) - 324), 320
    index = np.frombuffer(data[first : first + size], "<u8").reshape(20, 2).copy()
    bomb = numcodecs.get_codec({"id": codec}).encode(bytes(BOMB))
    index[7] = (324 if place == "start" else 0), len(bomb)
    coded_index = index.tobytes() + bytes(4)
    (path / "c/0/0/0").write_bytes(coded_index + bomb if place == "start" else bomb + coded_index)
    refused_at_once("unpacks to more than", path)


def test_another_array_of_the_store_is_no_piece(tmp_path):
    group = zarr.create_group(tmp_path / "a.zarr")
    group.create_array("frames", data=STACK, chunks=(1, 4, 4))
    group.create_array("dark", data=STACK[0].repeat(50, axis=0))
    read(tmp_path / "a.zarr")


@pytest.mark.parametrize("codec", ["gzip", "bz2", "lz4", "bitshuffle", "zstd", "blosc"])
def test_hdf5_filters(tmp_path, codec):
    filters = {
        "gzip": ({"compression": "gzip"}, zlib.compress(bytes(BOMB), 9)),
        "bz2": (hdf5plugin.BZip2(), bz2.compress(bytes(BOMB >> 4))),
        "lz4": (hdf5plugin.LZ4(), struct.pack(">QI", BOMB, 1 << 12) + bytes(99)),
        "bitshuffle": (hdf5plugin.Bitshuffle(), struct.pack(">QI", BOMB, 1 << 12) + bytes(99)),
        "zstd": (hdf5plugin.Zstd(), numcodecs.Zstd().encode(bytes(BOMB))),
        "blosc": (hdf5plugin.Blosc(), numcodecs.Blosc().encode(bytes(BOMB))),
    }
    coded, bomb = filters[codec]
    with h5py.File(tmp_path / "a.h5", "w") as file:
        dataset = file.create_dataset("frames", data=STACK, chunks=(20, 16, 16), **coded)
        dataset.id.write_direct_chunk((0, 0, 0), STACK[:20].tobytes(), filter_mask=1)  # left as it is
        file.flush()
        read(tmp_path / "a.h5")
        dataset.id.write_direct_chunk((20, 0, 0), bomb)
    refused_at_once("unpacks to more than", tmp_path / "a.h5")


def test_hdf5_compressed_twice_or_of_more_frames_than_its_parts_have(tmp_path):
    record = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    record.set_chunk((20, 16, 16))
    for _ in range(2):
        record.set_filter(h5py.h5z.FILTER_DEFLATE, 0, (9,))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        space, type_ = h5py.h5s.create_simple(STACK.shape), h5py.h5t.NATIVE_UINT16
        h5py.h5d.create(file.id, b"frames", type_, space, record).write(h5py.h5s.ALL, h5py.h5s.ALL, STACK)
    refused_at_once("compressed twice, by zlib and zlib", tmp_path / "a.h5")
    layout = h5py.VirtualLayout((10**9, 16, 16), STACK.dtype)
    layout[:40] = h5py.VirtualSource(write_hdf5(tmp_path / "b.h5", x=STACK), "x", STACK.shape)
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file.create_virtual_dataset("frames", layout)
    refused_at_once("cannot hold 1000000000 frames", tmp_path / "c.h5")


def test_fits(tmp_path):
    path = tmp_path / "a.fits"
    image = fits.CompImageHDU(STACK, compression_type="GZIP_1", tile_shape=(1, 16, 16))
    fits.HDUList([fits.PrimaryHDU(), image]).writeto(path)
    read(path)
    with fits.open(path, disable_image_compression=True) as units:
        tiles = [np.asarray(tile).tobytes() for tile in units[1].data["COMPRESSED_DATA"]]
        header = units[1].header
        tiles[3] = gzip.compress(bytes(BOMB))
        values = np.empty(len(tiles), object)
        values[:] = [np.frombuffer(tile, np.uint8) for tile in tiles]
        table = fits.BinTableHDU.from_columns([fits.Column("COMPRESSED_DATA", "1PB()", array=values)])
        for card in header.cards:
            if card.keyword.startswith("Z") or card.keyword in ("BZERO", "BSCALE"):
                table.header.append(card)
        fits.HDUList([fits.PrimaryHDU(), table]).writeto(path, overwrite=True)
    refused_at_once("unpacks to more than the 512 of its shape", path)


def test_tiff_of_many_pages(tmp_path):
    size, n = 2 + 12 + 4, 300_000
    page = struct.pack("<HHHII", 1, 256, 4, 1, 1)
    with (tmp_path / "a.tif").open("wb") as stream:
        stream.write(b"II*\0" + struct.pack("<I", 8))
        stream.write(b"".join(page + struct.pack("<I", 8 + size * (i + 1)) for i in range(n)))
    refused_at_once("more than 100000 pages", tmp_path / "a.tif")


def test_npz(tmp_path):
    member = io.BytesIO()
    np.save(member, np.zeros(8, np.int64))
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("dn.npy", member.getvalue())
        archive.writestr("counts.npy", bytes((1 << 28) + 1))
    settings = InputSettings(files=("a.npz",))
    refused_at_once("unpacked, too large for histograms", settings, lambda s: read_histograms(s, tmp_path))


class Trap:
    """An object whose loading leaves a trace."""

    def __init__(self, trace):
        self.trace = trace

    def __reduce__(self):
        return os.mkdir, (str(self.trace),)


def changed(path, **content):
    record = json.loads(path.read_text())
    path.write_text(json.dumps({**record, **content}))


@pytest.mark.parametrize(
    "content",
    [
        {"compressor": {"id": "pickle"}},
        {"filters": [{"id": "pickle"}]},
        {"filters": [{"id": "delta", "dtype": "<u2"}, {"id": "pickle"}]},
        {"dtype": "|O", "filters": [{"id": "pickle"}], "fill_value": None},
        {"filters": [{"id": "json2"}]},
        {"compressor": {"id": "vlen-bytes"}},
    ],
)
def test_a_codec_that_may_run_code(tmp_path, content):
    path = tmp_path / "a.zarr"
    zarr.create_array(path, data=frames(), zarr_format=2, compressors=None)
    read(path)
    changed(path / ".zarray", **{"compressor": None, **content})
    for chunk in path.glob("[0-9]*"):
        chunk.write_bytes(pickle.dumps(Trap(tmp_path / "trace")))
    refused(r"a\.zarr", path)
    assert not (tmp_path / "trace").exists()


def linked_out(path):
    """Move a file or folder out of its store, and leave a link to it."""
    moved = next(each for each in path.parents if each.suffix == ".zarr").with_name("elsewhere")
    path.rename(moved)
    path.symlink_to(moved)


@pytest.mark.parametrize("link", ["c", "c/0/0/0"])
def test_a_link_may_not_lead_out_of_the_store(tmp_path, link):
    path = tmp_path / "a.zarr"
    zarr.create_array(path, data=frames(), chunks=(2, 8, 9))
    (path / "c/1/0/0").unlink()
    (path / "c/1/0/0").symlink_to("../../2/0/0")
    read(path)
    linked_out(path / link)
    refused(f"{link} is a link out of the store; copy its files into the store", path)


@pytest.mark.parametrize("place", ["../b.zarr", "..", "/etc", "x/../../b.zarr"])
def test_a_path_out_of_the_store(tmp_path, place):
    zarr.create_array(tmp_path / "b.zarr", data=frames())
    group = zarr.create_group(tmp_path / "a.zarr")
    group.attrs["ome"] = {"multiscales": [{"datasets": [{"path": place}]}]}
    refused(r"a\.zarr", tmp_path / "a.zarr")
    group.attrs["ome"] = {}
    refused(r"a\.zarr", tmp_path / "a.zarr", dataset=place)


def test_a_run_with_a_codec_that_is_not_ours(tmp_path):
    store = RunStore.create(tmp_path / "run.zarr")
    store.create_array("fit/bias", (8, 8), chunks=(8, 8))
    store.write("fit/bias", (slice(0, 8), slice(0, 8)), np.ones((8, 8)))
    place = tmp_path / "run.zarr" / "fit" / "bias" / "zarr.json"
    codecs = json.loads(place.read_text())["codecs"]
    changed(place, codecs=[codecs[0], {"name": "vlen-bytes"}])
    with pytest.raises(PchEmError) as caught:
        RunStore.open(tmp_path / "run.zarr").read("fit/bias")
    assert "fit/bias" in str(caught.value)
    changed(place, codecs=codecs, shape=[8, 8, 8])
    with pytest.raises(StoreError):
        RunStore.open(tmp_path / "run.zarr").read("fit/bias")


@pytest.mark.parametrize("link", ["report.json", "fit", "fit/bias/c/0/0"])
def test_a_run_with_a_link_out_of_it(tmp_path, link):
    """`pchem view` would show the file, and a stage that is done again would write into the folder."""
    path = tmp_path / "run.zarr"
    store = RunStore.create(path)
    store.write_array("fit/bias", np.ones((8, 8)))
    store.write_file("report.json", b"{}")
    linked_out(path / link)
    _refuse_links.cache_clear()  # the links of a store are looked at once in a process
    for writable in (False, True):
        with pytest.raises(StoreError, match=f"run.zarr: {link} is a link out of the store"):
            RunStore.open(path, writable=writable)


def test_a_link_to_a_run_and_one_within_it(tmp_path):
    store = RunStore.create(tmp_path / "far" / "run.zarr")
    store.write_array("fit/bias", np.ones((8, 8)))
    (store.path / "page.html").symlink_to("report.html")
    (tmp_path / "run.zarr").symlink_to(store.path)
    assert RunStore.open(tmp_path / "run.zarr").read("fit/bias").sum() == 64.0


SCRIPTS = "äöü Ελληνικά кириллица 日本語 한국어 عربى עברית हिन्दी ไทย ქართული አማርኛ ខ្មែរ 😀 \u202e \u0301"


@pytest.mark.parametrize("name", [SCRIPTS, "a\nb", "\x1b[31mred", "x" * 200, " ", "-rf", "'; rm -rf ~"])
def test_names_in_all_scripts(tmp_path, name):
    path = tmp_path / f"{name}.npy"
    np.save(path, frames())
    read(path)
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(InputError, match="truncated") as caught:
        read(path)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    "text", ["µ" * 500_000, "\x1b]0;x\a" * 100_000, "{" * 1_000_000, '{"shape": [[' * 90_000]
)
def test_comments_of_a_megabyte(tmp_path, text):
    import tifffile

    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as writer:
        for frame in frames():
            writer.write(frame, photometric="minisblack", description=text.encode(), metadata=None)
    read(path)
    (tmp_path / "a.raw").write_bytes(frames().tobytes())
    (tmp_path / "a.raw.json").write_text(json.dumps({"shape": [8, 9], "dtype": "uint16", "comment": text}))
    read(tmp_path / "a.raw")
    (tmp_path / "a.raw.json").write_text(text)
    with pytest.raises(InputError) as caught:
        read(tmp_path / "a.raw")
    assert len(str(caught.value)) < 4100
