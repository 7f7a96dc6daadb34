import doctest
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from helpers.places import ROOT

import pchem_pipeline


def test_the_public_names_are_these():
    names = {
        "FitResult",
        "FitSettings",
        "FitStatus",
        "PchEmError",
        "RunStore",
        "__version__",
        "characterise",
        "fit_counts",
        "fit_histograms",
        "open_run",
    }
    assert set(pchem_pipeline.__all__) == names
    for name in names:
        assert getattr(pchem_pipeline, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'offset'"):
        _ = pchem_pipeline.offset


def test_the_example_runs():
    outcome = doctest.testmod(pchem_pipeline)
    assert outcome.attempted >= 7
    assert outcome.failed == 0


@pytest.mark.parametrize(
    ("module", "light"),
    [
        ("pchem_pipeline", {"numpy", "numba", "zarr", "pydantic"}),
        ("pchem_pipeline.simulate.settings", {"numpy", "numba", "scipy"}),
        (
            "pchem_pipeline.frames.open, pchem_pipeline.frames.writing, pchem_pipeline.frames.registry as r; "
            "r.frame_suffixes()",
            {"numba", "scipy", "zarr", "matplotlib", "tifffile", "astropy", "h5py", "dask", "yaml"},
        ),
    ],
)
def test_what_is_imported_imports_nothing_heavy(module: str, light: set[str]) -> None:
    code = f"import sys, {module}; print({light!r} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


def test_versions_agree():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == pchem_pipeline.__version__


def test_every_module_says_what_it_is_for_and_fits_in_the_head():
    for path in Path(pchem_pipeline.__file__).parent.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert len(text.splitlines()) <= 800, path
        assert text.lstrip().startswith('"""'), path
