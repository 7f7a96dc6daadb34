"""What a command imports decides how fast it answers: lists are compared here, no clock."""

import shutil
import subprocess
import sys

from helpers.commands import imported_by

#: what takes a tenth of a second or more to import, or draws such things in
HEAVY = {
    "numba", "scipy", "matplotlib", "dask", "distributed", "xarray", "tifffile", "imagecodecs", "astropy",
    "h5py", "hdf5plugin", "PIL", "jinja2", "pandas",
}  # fmt: skip
#: what the commands that look at a run need, and --help does not
MIDDLING = {"numpy", "zarr", "pydantic", "yaml"}


def test_help_imports_next_to_nothing():
    assert not imported_by("--help") & (HEAVY | MIDDLING)
    # the command line library loads pydantic by itself where it is installed
    assert not imported_by("run", "--help") & (HEAVY | MIDDLING - {"pydantic", "numpy"})


def test_status_imports_nothing_that_computes(finished):
    found = imported_by("status", finished)
    assert not found & HEAVY
    assert found >= MIDDLING  # the list of imports is read right


def test_fit_imports_its_kernels_and_not_those_who_draw_or_read_cameras(finished, tmp_path):
    store = shutil.copytree(finished, tmp_path / "run.zarr")
    found = imported_by("fit", store, "--force", "--quiet", "--backend", "serial")
    assert "numba" in found
    assert not found & (HEAVY - {"numba", "scipy"})


def test_a_command_that_knows_of_effects_does_not_import_what_few_of_them_call():
    code = (
        "import sys\nfrom pchem_pipeline.effects.framework.registry import effect_classes\n"
        "assert effect_classes()\nprint({'scipy.stats', 'scipy.optimize', 'scipy.signal'} & set(sys.modules))"
    )
    outcome = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=200)
    assert outcome.stdout == "set()\n", outcome.stdout + outcome.stderr
