"""Writers of all formats on a disk that takes no more: one line with the cure, and no half file."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from pchem_pipeline.frames.writing import WRITERS

PROGRAM = """
import json, resource, signal, sys
from pathlib import Path
import numpy as np
from pchem_pipeline.base.errors import PchEmError
from pchem_pipeline.frames.writing import write_frames

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
frames = np.random.default_rng(1).integers(0, 60000, (60, 64, 64), dtype=np.uint16)
found = {}
for name in sys.argv[2:]:
    place = Path(sys.argv[1]) / name
    write_frames(name, place / "a", iter([frames[:2]]), (2, 64, 64), frames.dtype)  # libraries are loaded
    before = sorted(str(path) for path in place.rglob("*"))
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))
    try:
        write_frames(name, place / "a", iter(np.split(frames, 4)), frames.shape, frames.dtype)
        found[name] = "written"
    except PchEmError as error:
        found[name] = str(error)
    except Exception as error:
        found[name] = f"foreign {type(error).__name__}: {error}"
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    if sorted(str(path) for path in place.rglob("*")) != before:
        found[name] += " and left something"
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("full")
    command = [sys.executable, "-c", PROGRAM, str(folder), *WRITERS]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    words: dict[str, str] = json.loads(result.stdout.splitlines()[-1])
    return words


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_that_may_not_grow(found: dict[str, str], name: str) -> None:
    words = found[name]
    assert words.startswith("cannot use "), words
    if name == "tiff":  # numpy does not say why
        assert words.endswith("written; check the disk: its free space, quota and permissions")
    else:
        assert words.endswith("size limit (see ulimit -f): raise it and run again"), words
