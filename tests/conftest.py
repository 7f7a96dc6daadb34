"""The tests run in the surroundings of the command: one thread a worker, one cache of compiled kernels.

Hypothesis draws the same examples every time; HYPOTHESIS_PROFILE=explore draws new ones.
"""

import os
import shutil

import pytest
from filelock import FileLock
from hypothesis import settings

from pchem_pipeline.compute.environment import prepare_environment

prepare_environment()
settings.register_profile("steady", derandomize=True, deadline=None)
settings.register_profile("explore", deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "steady"))


@pytest.fixture(autouse=True)
def _forget_stores():
    """Open no store that another test has opened."""
    from pchem_pipeline.run.stage import open_store  # it brings numpy, which the environment must precede

    yield
    open_store.cache_clear()


@pytest.fixture
def undrawn():
    """Pages without pictures: fast."""
    from helpers.without_pictures import undrawn

    with undrawn():
        yield


@pytest.fixture(scope="session")
def make_once(tmp_path_factory):
    """Fill a folder by a function once for all workers of a session; none of them may change it then."""
    base = tmp_path_factory.getbasetemp()
    shared = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "shared"
    shared.mkdir(exist_ok=True)

    def make(name, fill):
        folder, made = shared / name, shared / f"{name}.made"
        with FileLock(shared / f"{name}.lock"):
            if not made.exists():
                shutil.rmtree(folder, ignore_errors=True)  # of a worker that failed
                folder.mkdir()
                fill(folder)
                made.touch()
        return folder

    return make
