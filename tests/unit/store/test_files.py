"""Files of the package appear whole or not at all, whatever fails, and all of them by one function."""

import errno
import os
import re
import stat
from pathlib import Path

import pytest

import pchem_pipeline
from pchem_pipeline.base.errors import StoreError
from pchem_pipeline.store import disk
from pchem_pipeline.store.files import checked, whole_file, write_atomic


def _fail(*_, **__):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize(("home", "name"), [(disk, "write"), (disk, "replace"), (os, "fsync")])
def test_a_write_that_fails_or_is_not_on_the_disk_leaves_the_old_file(tmp_path, monkeypatch, home, name):
    path = tmp_path / "a.json"
    write_atomic(path, b"old")
    monkeypatch.setattr(home, name, _fail)
    with pytest.raises(StoreError, match=r"a\.json: No space left on device; the disk is full"):
        write_atomic(path, b"new")
    assert [*tmp_path.iterdir()] == [path]
    assert path.read_bytes() == b"old"
    if name == "fsync":  # of no interest to what may be lost
        write_atomic(path, b"progress", sync=False)
        assert path.read_bytes() == b"progress"


@pytest.mark.parametrize("names", [["a.fits"], ["a.zarr/zarr.json", "a.zarr/c/0/0"]])
def test_a_large_file_or_folder_is_on_the_disk_before_it_takes_its_place(tmp_path, monkeypatch, names):
    def written(content):
        with whole_file(tmp_path / names[0].split("/")[0]) as part:
            for name in names:
                place = part.joinpath(*name.split("/")[1:])
                place.parent.mkdir(parents=True, exist_ok=True)
                place.write_bytes(content)

    synced = []
    with monkeypatch.context() as patch:
        patch.setattr(disk, "sync_file", lambda path: synced.append((path.name, path.read_bytes())))
        patch.setattr(disk, "sync_folder", synced.append)
        written(b"old")
    assert sorted(each for each in synced[: len(names)]) == sorted(
        (".partial-a.fits" if name == "a.fits" else name.split("/")[-1], b"old") for name in names
    )
    assert synced[-1] == tmp_path
    monkeypatch.setattr(os, "fsync", _fail)
    with pytest.raises(StoreError, match="disk is full"):
        written(b"new")
    assert [(tmp_path / name).read_bytes() for name in names] == [b"old"] * len(names)


def test_files_follow_the_umask_and_folders_are_made(tmp_path):
    before = os.umask(0o027)
    try:
        write_atomic(tmp_path / "a" / "b.json", b"x")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a" / "b.json").stat().st_mode) == 0o640


def test_a_folder_takes_the_place_of_an_older_one(tmp_path):
    for content in ("old", "new"):
        with whole_file(tmp_path / "a.zarr") as part:
            part.mkdir()
            (part / content).touch()
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")] == ["a.zarr", "a.zarr/new"]
    (tmp_path / ".partial-a.zarr").mkdir()  # left by a kill
    with whole_file(tmp_path / "a.zarr") as part:
        part.touch()
    assert [path.name for path in tmp_path.iterdir()] == ["a.zarr"]


def test_no_other_module_puts_files_in_their_place():
    """Writers of camera formats write to the path that `whole_file` gives; the log is appended to."""
    root = Path(pchem_pipeline.__file__).parent
    writes = re.compile(
        r"\.write_(text|bytes)\(|open\(\s*\"[wax]|\.rename\(|os\.replace|np\.savez?\w*\(|mkstemp"
    )
    allowed = {
        "store/disk.py": None,
        "store/files.py": 1,  # an object
        "store/remote_path.py": None,
        "store/lock.py": 1,  # an object
        "run/progress.py": 1,
        "base/kernel_cache.py": None,  # compiled kernels, which may be lost
        # into memory
        "commands/adapters.py": 1,
        "stages/fit/fit.py": 1,
        "stages/simulate.py": 1,
        "commands/twin.py": 1,
    }
    found: dict[str, int] = {}
    for path in sorted(root.rglob("*.py")):
        name = path.relative_to(root).as_posix()
        text = path.read_text(encoding="utf-8")
        if name.startswith("frames/formats/"):
            assert not writes.search(text) or "whole_file(" in text, name
        elif number := len(writes.findall(text)):
            found[name] = number
    for name, number in found.items():
        assert name in allowed, name
        assert allowed[name] in (None, number), name


@pytest.mark.parametrize("data", [b"[1]", b"null", b"7", b"{", b"\xff", b"[" * 100_000])
def test_a_record_that_is_no_object_is_damaged(data):
    with pytest.raises(StoreError, match=r"^a\.json is damaged \(.*\); run it again$"):
        checked(data, Path("a.json"), "run it again")
