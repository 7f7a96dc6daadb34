import os
import subprocess
import sys
from pathlib import Path

import pytest

import pchem_pipeline
from pchem_pipeline.compute.environment import prepare_environment

PACKAGE = Path(pchem_pipeline.__file__).parent
CODE = (
    "import os; from pchem_pipeline.compute.environment import prepare_environment as p\n"
    "p(); first = os.environ['NUMBA_CACHE_DIR']; p(); assert first == os.environ['NUMBA_CACHE_DIR']\n"
    "print(first)"
)


def cache_folder(place, **environment):
    environment = {"PYTHONPATH": str(place), "PATH": "/usr/bin:/bin", **environment}
    command = [sys.executable, "-c", CODE]
    result = subprocess.run(command, cwd="/", env=environment, capture_output=True, text=True, check=True)
    return Path(result.stdout.strip())


def test_the_cache_lies_in_the_users_cache_folder(tmp_path):
    home = cache_folder(PACKAGE.parent, HOME=str(tmp_path), XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert home.is_relative_to(tmp_path / "cache")


@pytest.mark.parametrize("trap", ["none", "written by all", "a link", "another user's"])
def test_a_folder_in_the_temporary_one_is_taken_if_nobody_else_can_write_it(tmp_path, trap):
    expected = tmp_path / f"pchem_pipeline-{os.getuid()}"
    (tmp_path / "else").mkdir(mode=0o700)
    if trap == "a link":
        expected.symlink_to("else")
    elif trap != "none":
        expected.mkdir()
        expected.chmod(0o777 if trap == "written by all" else 0o700)
    if trap == "another user's":
        if os.getuid() != 0:
            pytest.skip("nobody else may give folders away")
        os.chown(expected, 4321, -1)
    nowhere = {"HOME": "/proc/nowhere", "XDG_CACHE_HOME": "/proc/nowhere", "TMPDIR": str(tmp_path)}
    first, second = (cache_folder(PACKAGE.parent, **nowhere) for _ in range(2))
    assert first.parent == tmp_path
    if trap == "none":
        assert first == second == expected
        assert expected.stat().st_mode & 0o777 == 0o700
    else:
        assert expected not in (first, second)
        assert first != second
        assert not first.exists()  # it ended with its process


def test_the_users_own_values_are_kept(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    monkeypatch.delenv("MPLBACKEND", raising=False)
    prepare_environment()
    assert os.environ["OMP_NUM_THREADS"] == "5"
    assert os.environ["MPLBACKEND"] == "Agg"
