import ast
import copy
import os
import pickle
from pathlib import Path, PurePath

import fsspec
import numpy as np
import pytest

import pchem_pipeline
from pchem_pipeline.base.errors import ConfigError, MissingDependencyError, StoreError
from pchem_pipeline.store.remote_path import RemoteError, RemotePath, place_of, refused
from pchem_pipeline.store.run_store import RunStore


@pytest.fixture
def folder():
    """A folder in a storage that lives in this process."""
    path = place_of("memory://lab/night")
    yield path
    path.remove_folder()
    fsspec.filesystem("memory").store.clear()


@pytest.mark.parametrize("text", ["s3://lab/run.zarr", "s3:/lab/run.zarr", Path("s3://lab/run.zarr")])
def test_a_url_survives_what_paths_do_to_it(text):
    path = place_of(text, Path("/home"))
    assert isinstance(path, RemotePath)
    assert str(path) == "s3://lab/run.zarr"
    assert str(path / "fit" / "bias") == "s3://lab/run.zarr/fit/bias"
    assert str(path.parent) == "s3://lab"
    assert path.with_suffix(".yaml").name == "run.yaml"
    for same in (pickle.loads(pickle.dumps(path)), copy.copy(path), path.resolve(), place_of(path)):
        assert isinstance(same, RemotePath)
        assert same == path
        assert hash(same) == hash(path)


def test_a_url_with_a_secret_is_refused_and_not_repeated_and_other_paths_stay_what_they_are():
    for kind in (str, Path):
        with pytest.raises(ConfigError, match="a password, key or signature") as caught:
            place_of(kind("s3://key:SECRET@bucket/run.zarr"))
        assert "SECRET" not in str(caught.value)
    assert place_of("run.zarr") == Path("run.zarr")
    assert place_of("run.zarr", Path("/data")) == Path("/data/run.zarr")
    assert not isinstance(place_of("/data/s3:/x"), RemotePath)
    assert not isinstance(place_of("two.h5:/dark/frames"), RemotePath)


def test_the_files_of_a_run(folder):
    path = folder / "a" / "x.json"
    assert (path.exists(), folder.is_dir(), [*folder.iterdir()]) == (False, False, [])
    for use in (path.read_bytes, path.unlink):
        with pytest.raises(FileNotFoundError):
            use()
    path.unlink(missing_ok=True)
    path.write_bytes("µ".encode())
    assert (path.exists(), path.is_file(), folder.is_dir()) == (True, True, True)
    assert (path.read_text(), path.read_bytes()) == ("µ", "µ".encode())
    (folder / "a" / ".hidden.json").write_bytes(b"")
    assert [each.name for each in (folder / "a").glob("[!.]*.json")] == ["x.json"]
    found = sorted(str(each) for each in (folder / "a").iterdir())
    assert found == ["memory://lab/night/a/.hidden.json", "memory://lab/night/a/x.json"]
    (folder / "a").remove_folder()
    assert not path.exists()


def test_arrays_markers_and_records_in_an_object_storage(folder, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    store = RunStore.create(folder)
    store.create_array("fit/bias", (16, 16), chunks=(8, 8))
    values = np.arange(64.0).reshape(8, 8)
    with store.locked():
        store.write("fit/bias", (slice(0, 8), slice(8, 16)), values)
        store.records.mark("fit", "f" * 64, "0.1", {"pixels": 64})
    other = RunStore.open(folder)
    np.testing.assert_array_equal(other.read("fit/bias", (slice(0, 8), slice(8, 16))), values)
    with pytest.raises(StoreError, match=r"night/fit/bias/c/1/0 is missing .*; run it again: pchem fit"):
        other.read("fit/bias", (slice(8, 16), slice(0, 8)))
    store.fill("fit/bias")
    assert np.isnan(other.read("fit/bias", (slice(8, 16), slice(0, 8)))).all()
    np.testing.assert_array_equal(other.read("fit/bias", (slice(0, 8), slice(8, 16))), values)
    assert other.records.summaries("fit", "f" * 64) == {"0.1": {"pixels": 64}}
    store.records.forget("fit")
    assert other.records.done("fit", "f" * 64) == set()
    store.delete("fit/bias")
    assert not RunStore.open(folder).has("fit/bias")
    (folder / "zarr.json").unlink()
    with pytest.raises(StoreError, match="there is no run at memory://lab/night"):
        RunStore.open(folder)


class StrangeError(Exception):
    """An error of a library of its own."""


def test_what_the_storage_refuses_is_one_line(folder, monkeypatch):
    from zarr.storage import FsspecStore

    store = RunStore.create(folder)
    store.create_array("fit/bias", (8, 8), chunks=(8, 8))

    async def fail(self, *args, **kwargs):
        raise StrangeError("no route\nto host")

    monkeypatch.setattr(FsspecStore, "get", fail)
    for ask, of in (
        (store.has, "fit/bias"), (store.read, "fit/bias"), (store.attributes, "fit"), (RunStore.open, folder),
    ):  # fmt: skip
        with pytest.raises(StoreError, match=r"error \(no route to host\); check address, keys and network"):
            ask(of)
    error = refused("s3://lab/x", ValueError("first\n second"))
    assert str(error) == ("s3://lab/x: object storage error (first second); check address, keys and network")
    assert isinstance(pickle.loads(pickle.dumps(error)), RemoteError)
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
    with pytest.raises(MissingDependencyError, match="needs another package"):
        place_of("nowhere://lab/x").exists()


def test_no_method_touches_the_local_disk(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "memory:" / "lab" / "night").mkdir(parents=True)  # what the disk would take for the place
    (tmp_path / "memory:" / "lab" / "night" / "a").write_text("of the disk")
    path = place_of("memory://lab/night/a")
    assert not isinstance(path, Path)
    impure = {name for name in dir(Path) if not hasattr(PurePath, name) and not name.startswith("_")}
    assert {"open", "read_bytes", "rename", "stat", "rglob"} <= impure
    own = {name for name in impure if hasattr(RemotePath, name)}
    assert all(name in vars(RemotePath) for name in own)
    assert own == {
        "absolute", "exists", "glob", "is_dir", "is_file", "iterdir", "mkdir", "read_bytes", "read_text",
        "resolve", "unlink", "write_bytes",
    }  # fmt: skip
    assert (path.exists(), path.is_file(), path.is_dir()) == (False, False, False)
    assert list(path.parent.iterdir()) == []
    for use in (os.fspath, os.stat, open, os.listdir, np.load):
        with pytest.raises(TypeError, match="path"):
            use(path)
    path.write_bytes(b"far away")
    path.unlink()
    assert (tmp_path / "memory:" / "lab" / "night" / "a").read_text() == "of the disk"


#: modules whose paths are of this machine: camera files, YAML files, logs, the package itself
OF_THE_DISK = {
    "base/kernel_cache.py", "commands/append.py",
    "effects/framework/pixel_sets.py", "frames/histogram_files.py", "frames/identity.py",
    "frames/registry.py", "frames/resolve.py", "run/progress.py", "stages/simulate.py",
    "store/disk.py", "store/files.py", "store/lock.py",
}  # fmt: skip
#: what other objects have, too
OF_OTHERS = {"PIL.Image.open", "self.group", "path.group", "image.group", "reader_class(name).open"}


def test_methods_that_an_object_storage_has_not_are_used_where_paths_are_of_the_disk():
    root = Path(pchem_pipeline.__file__).parent
    undefined = {name for name in dir(Path) if not name.startswith("_") and not hasattr(RemotePath, name)}
    assert {"open", "stat", "rename", "replace", "rglob", "touch"} <= undefined
    found = set()
    for file in sorted(root.rglob("*.py")):
        module = file.relative_to(root).as_posix()
        for call in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute)):
                continue
            of_text = call.func.attr == "replace" and (len(call.args) != 1 or call.keywords)
            of_class = isinstance(call.func.value, ast.Name) and call.func.value.id in (
                "Path", "RunStore", "fits", "zarr", "os", "webbrowser", "tifffile", "cls", "bz2",
            )  # fmt: skip
            words = ast.unparse(call.func)
            if call.func.attr in undefined and not (of_text or of_class) and words not in OF_OTHERS:
                found.add((module, words))
    strange = {(m, w) for m, w in found if m not in OF_THE_DISK and not m.startswith("frames/formats/")}
    assert strange == set(), "is that path never a RemotePath? then add its module to OF_THE_DISK"
    assert ("store/disk.py", "source.replace") in found  # it looks
