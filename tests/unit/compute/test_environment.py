import subprocess
import sys
from pathlib import Path

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


def test_the_cache_lies_in_the_users_cache_folder_or_where_one_can_write(tmp_path):
    home = cache_folder(PACKAGE.parent, HOME=str(tmp_path), XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert home.is_relative_to(tmp_path / "cache")
    elsewhere = cache_folder(
        PACKAGE.parent, HOME="/proc/nowhere", XDG_CACHE_HOME="/proc/nowhere", TMPDIR=str(tmp_path)
    )
    assert elsewhere.is_relative_to(tmp_path)
    assert elsewhere.is_dir()


def test_the_users_own_values_are_kept(monkeypatch):
    import os

    monkeypatch.setenv("OMP_NUM_THREADS", "5")
    monkeypatch.delenv("MPLBACKEND", raising=False)
    prepare_environment()
    assert os.environ["OMP_NUM_THREADS"] == "5"
    assert os.environ["MPLBACKEND"] == "Agg"
