"""What a command imports decides how fast it answers: lists are compared here, no clock."""

import os
import shutil
import subprocess
import sys

import pytest

from pchem_pipeline.run.declared import DECLARED
from pchem_pipeline.run.runner import OPTIONAL_STAGES, STAGES, load_stage

COMMAND = """
import sys
from pchem_pipeline.cli.app import app
try:
    app.main(sys.argv[1:])
except SystemExit as end:
    assert end.code in (0, None), end.code
print(' '.join(sorted({name.partition('.')[0] for name in sys.modules})))
"""

#: what takes a tenth of a second or more to import, or draws such things in
HEAVY = {
    "numba", "scipy", "matplotlib", "dask", "distributed", "xarray", "tifffile", "imagecodecs", "astropy",
    "h5py", "hdf5plugin", "PIL", "jinja2", "pandas",
}  # fmt: skip
#: what the commands that look at a run need, and --help does not
MIDDLING = {"numpy", "zarr", "pydantic", "yaml"}


@pytest.fixture
def imported(finished, tmp_path, kernels):
    """Call a command on a copy of a finished run, and return the libraries that it imported."""
    store = tmp_path / "run.zarr"
    shutil.copytree(finished, store)

    def call(*arguments):
        outcome = subprocess.run(
            [sys.executable, "-c", COMMAND, *(a.format(store=store) for a in arguments)],
            capture_output=True,
            text=True,
            timeout=200,
            env={**os.environ, "NUMBA_CACHE_DIR": kernels},
        )
        assert outcome.returncode == 0, outcome.stderr
        return set(outcome.stdout.splitlines()[-1].split())

    return call


def test_help_imports_next_to_nothing(imported):
    assert not imported("--help") & (HEAVY | MIDDLING)
    # the command line library loads pydantic by itself where it is installed
    assert not imported("run", "--help") & (HEAVY | MIDDLING - {"pydantic", "numpy"})


def test_status_imports_nothing_that_computes(imported):
    found = imported("status", "{store}")
    assert not found & HEAVY
    assert found >= MIDDLING  # the list of imports is read right


def test_fit_imports_its_kernels_and_not_those_who_draw_or_read_cameras(imported):
    found = imported("fit", "{store}", "--force", "--quiet", "--backend", "serial")
    assert "numba" in found
    assert not found & (HEAVY - {"numba", "scipy"})


def test_stages_are_what_they_declare():
    assert set(DECLARED) >= {*STAGES, *OPTIONAL_STAGES}  # and those of joint runs
    for name, declared in DECLARED.items():
        stage = load_stage(name)
        assert (name, declared.VERSION) == (stage.NAME, stage.VERSION)
        assert (stage.UPSTREAM, stage.SETTINGS) == (declared.UPSTREAM, declared.SETTINGS)
        assert (stage.READS, stage.WRITES) == (declared.READS, declared.WRITES)
        assert getattr(stage, "identity", None) is declared.identity
