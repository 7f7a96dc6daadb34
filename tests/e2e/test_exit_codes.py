"""Which exit code each command gives where input files are gone or unreadable, or the store is half made."""

import shutil

import numpy as np
import pytest
from helpers.commands import Shell

from pchem_pipeline.base.errors import ExitCode

CONFIG = "run: {{store: run.zarr, tile: 8}}\ninput: {{files: [a.npy, b.npy], mode: {mode}}}\n"


def _unreadable(folder):
    (folder / "b.npy").write_bytes((folder / "b.npy").read_bytes()[:1000])


def _refused(folder):
    _unreadable(folder)
    assert _code(folder, "ingest") == ExitCode.INPUT


def _gone(folder):
    for path in folder.glob("*.npy"):
        path.unlink()


def _no_store(folder):
    shutil.rmtree(folder / "run.zarr")


def _no_histogram(folder):
    shutil.rmtree(folder / "run.zarr" / "histogram")


COMMANDS = ("ingest", "histogram", "run", "fit", "status", "model", "export")
OK, INPUT = ExitCode.OK, ExitCode.INPUT

#: Of a run that has its histograms: what happened to it, and the exit code of each command then.
TABLE = {
    (_unreadable,): (INPUT, OK, INPUT, OK, OK, OK, INPUT),
    (_gone,): (OK, OK, OK, OK, OK, OK, INPUT),
    (_refused, _gone): (OK, OK, OK, OK, OK, OK, INPUT),
    (_gone, _no_store): (INPUT, INPUT, INPUT, INPUT, OK, INPUT, INPUT),
    (_no_store,): (OK, INPUT, OK, INPUT, OK, INPUT, INPUT),
    (_no_histogram,): (OK, OK, OK, INPUT, OK, OK, INPUT),
    (_gone, _no_histogram): (OK, OK, OK, INPUT, OK, OK, INPUT),
}
#: Where the frames stay in the files, what differs from this.
REFERENCED = {(_refused, _gone): {}, (_gone, _no_histogram): {"histogram": INPUT, "run": INPUT}}


def _code(folder, command):
    until = ("--until", "histogram") if command == "run" else ()
    return Shell(folder)(command, "run.yaml", *until).code


@pytest.fixture(scope="module")
def counted(tmp_path_factory):
    """Folders of a run up to its histograms, by how it reads its files."""
    rng = np.random.default_rng(4)
    folders = {}
    for mode in ("copy", "reference"):
        folders[mode] = tmp_path_factory.mktemp(mode)
        for name in ("a", "b"):
            frames = np.rint(100 + 9 * rng.poisson(2, (300, 8, 8)) + rng.normal(0, 2, (300, 8, 8)))
            np.save(folders[mode] / f"{name}.npy", frames.astype(np.uint16))
        (folders[mode] / "run.yaml").write_text(CONFIG.format(mode=mode))
        assert _code(folders[mode], "run") == ExitCode.OK
    return folders


@pytest.mark.parametrize(
    ("mode", "mishaps"),
    [*(("copy", mishaps) for mishaps in TABLE), *(("reference", mishaps) for mishaps in REFERENCED)],
    ids=lambda value: value if isinstance(value, str) else "".join(each.__name__ for each in value),
)
def test_exit_codes_are_those_of_the_table(counted, mode, mishaps, tmp_path):
    wanted = dict(zip(COMMANDS, TABLE[mishaps], strict=True))
    wanted |= REFERENCED[mishaps] if mode == "reference" else {}
    found = {}
    for command in COMMANDS:
        folder = tmp_path / command
        shutil.copytree(counted[mode], folder)
        for happens in mishaps:
            happens(folder)
        found[command] = _code(folder, command)
    assert found == wanted


def test_missing_files_are_named_with_the_cure(counted, tmp_path):
    shutil.copytree(counted["copy"], tmp_path / "run")
    _gone(tmp_path / "run")
    _no_store(tmp_path / "run")
    message = Shell(tmp_path / "run").refused(INPUT, "ingest", "run.yaml")
    assert "a.npy and 1 more (last b.npy): no such file or folder; restore it" in message
