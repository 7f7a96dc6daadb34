"""Zarr stores made by someone else: nothing in them is run, and nothing outside of them is read."""

from __future__ import annotations

import json
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import zarr
from helpers.camera_files import read, refused
from helpers.damage import frames

from pchem_pipeline.base.errors import InputError, PchEmError, StoreError
from pchem_pipeline.store.run_store import RunStore, _refuse_links


class Trap:
    """An object whose loading leaves a trace."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[object, ...]:
        return os.mkdir, (str(self.trace),)


def changed(path: Path, **content: object) -> None:
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
def test_a_codec_that_may_run_code(tmp_path: Path, content: dict[str, object]) -> None:
    path = tmp_path / "a.zarr"
    zarr.create_array(path, data=frames(), zarr_format=2, compressors=None)
    read(path)
    changed(path / ".zarray", **{"compressor": None, **content})
    for chunk in path.glob("[0-9]*"):
        chunk.write_bytes(pickle.dumps(Trap(tmp_path / "trace")))
    refused(r"a\.zarr", path)
    assert not (tmp_path / "trace").exists()


@pytest.mark.parametrize("link", ["c", "c/0/0/0"])
def test_a_link_out_of_the_store(tmp_path: Path, link: str) -> None:
    path = tmp_path / "a.zarr"
    zarr.create_array(path, data=frames(), chunks=(6, 8, 9))
    moved = tmp_path / "elsewhere"
    (path / link).rename(moved)
    (path / link).symlink_to(moved)
    refused(f"{link} is a link out of the store; copy its files into the store", path)


def test_a_link_within_the_store(tmp_path: Path) -> None:
    path = tmp_path / "a.zarr"
    zarr.create_array(path, data=frames(), chunks=(3, 8, 9))
    (path / "c/1/0/0").unlink()
    (path / "c/1/0/0").symlink_to("../../0/0/0")
    read(path)


@pytest.mark.parametrize("place", ["../b.zarr", "..", "/etc", "x/../../b.zarr"])
def test_a_path_out_of_the_store(tmp_path: Path, place: str) -> None:
    zarr.create_array(tmp_path / "b.zarr", data=frames())
    group = zarr.create_group(tmp_path / "a.zarr")
    group.attrs["ome"] = {"multiscales": [{"datasets": [{"path": place}]}]}
    refused(r"a\.zarr", tmp_path / "a.zarr")
    group.attrs["ome"] = {}
    refused(r"a\.zarr", tmp_path / "a.zarr", dataset=place)


def test_a_run_with_a_codec_that_is_not_ours(tmp_path: Path) -> None:
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
def test_a_run_with_a_link_out_of_it(tmp_path: Path, link: str) -> None:
    """`pchem view` would show the file, and a stage that is done again would write into the folder."""
    path = tmp_path / "run.zarr"
    store = RunStore.create(path)
    store.write_array("fit/bias", np.ones((8, 8)))
    store.write_file("report.json", b"{}")
    moved = tmp_path / "elsewhere"
    (path / link).rename(moved)
    (path / link).symlink_to(moved)
    _refuse_links.cache_clear()  # the links of a store are looked at once in a process
    for writable in (False, True):
        with pytest.raises(StoreError, match=f"run.zarr: {link} is a link out of the store"):
            RunStore.open(path, writable=writable)


def test_a_link_to_a_run_and_one_within_it(tmp_path: Path) -> None:
    store = RunStore.create(tmp_path / "far" / "run.zarr")
    store.write_array("fit/bias", np.ones((8, 8)))
    (store.path / "page.html").symlink_to("report.html")
    (tmp_path / "run.zarr").symlink_to(store.path)
    assert RunStore.open(tmp_path / "run.zarr").read("fit/bias").sum() == 64.0


SCRIPTS = "äöü Ελληνικά кириллица 日本語 한국어 عربى עברית हिन्दी ไทย ქართული አማርኛ ខ្មែរ 😀 \u202e \u0301"


@pytest.mark.parametrize("name", [SCRIPTS, "a\nb", "\x1b[31mred", "x" * 200, " ", "-rf", "'; rm -rf ~"])
def test_names_in_all_scripts(tmp_path: Path, name: str) -> None:
    path = tmp_path / f"{name}.npy"
    np.save(path, frames())
    read(path)
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(InputError) as caught:
        read(path)
    assert "truncated" in str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    "text", ["µ" * 500_000, "\x1b]0;x\a" * 100_000, "{" * 1_000_000, '{"shape": [[' * 90_000]
)
def test_comments_of_a_megabyte(tmp_path: Path, text: str) -> None:
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
