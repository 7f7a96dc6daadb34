"""Compiled kernels on disk: when they are compiled again, by whom, and that nobody gets another's."""

import gc
import os
import subprocess
import sys
from pathlib import Path

import pytest

import pchem_pipeline
from pchem_pipeline.base import kernel_cache
from pchem_pipeline.base.kernel import kernel
from pchem_pipeline.base.kernel_cache import TIGHT_MEMORY, listening

INNER = """
from pchem_pipeline.base.kernel import kernel
@kernel
def shifted(x):
    return x + {shift}
"""
OUTER = """
from pchem_pipeline.base.kernel import kernel
from sample.inner_numba import shifted
@kernel
def doubled(x):
    return 2 * shifted(x)
"""
GIVEN = """
from numba import types
from pchem_pipeline.base.kernel import callback, kernel
from sample.inner_numba import shifted
@kernel
def applied(function, x):
    total = 0
    {long}
    return total
def passed(x):
    return applied(shifted, x) - applied(shifted, x - 1)
given = callback(passed, types.int64, (types.int64,))
""".format(long="; ".join(f"total += function(x % {i})" for i in range(1, 99)))  # LLVM does not inline it
APART = """
from pchem_pipeline.base.kernel import kernel
def powered(power):
    @kernel
    def raised(x):
        total = 1
        for _ in range(power):
            total *= x
        return total
    return raised
squared, cubed = powered(2), powered(3)
"""
CALLS = (
    "from sample.outer_numba import doubled; from sample.apart_numba import {names}\n"
    "kernels = doubled, {names}\n"
    "print([each(3) for each in kernels], sum(sum(each.stats.cache_misses.values()) for each in kernels))"
)


@pytest.fixture
def sample(tmp_path):
    """A package of modules with kernels, some of which call another's."""
    folder = tmp_path / "here" / "sample"
    folder.mkdir(parents=True)
    (folder / "__init__.py").touch()
    (folder / "inner_numba.py").write_text(INNER.format(shift=1))
    (folder / "outer_numba.py").write_text(OUTER)
    (folder / "apart_numba.py").write_text(APART)
    (folder / "given_numba.py").write_text(GIVEN)
    return folder


def start(sample, names="squared, cubed", cache=None, calls=CALLS):
    """Call kernels in a process of its own, which prints their values and how many it compiled."""
    path = [sample.parent, Path(pchem_pipeline.__file__).parents[1]]
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(cache or sample.parents[1] / "cache"),
        "PYTHONPATH": os.pathsep.join(map(str, path)),
        # Python tells files of one size that change within a second apart by nothing
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    command, pipe = [sys.executable, "-c", calls.format(names=names)], subprocess.PIPE
    return subprocess.Popen(command, cwd="/", env=environment, stdout=pipe, stderr=pipe, text=True)


def end(process):
    stdout, stderr = process.communicate(timeout=200)
    assert process.returncode == 0, stderr
    return stdout.strip()


def test_only_what_uses_a_changed_file_is_compiled_again(sample):
    # the functions of one maker are compiled by different processes: nobody may run another's
    assert end(start(sample, "squared")) == "[8, 9] 2"
    assert end(start(sample, "cubed")) == "[8, 27] 1"
    assert end(start(sample)) == "[8, 9, 27] 0"
    (sample / "inner_numba.py").write_text(INNER.format(shift=5))
    assert end(start(sample)) == "[16, 9, 27] 1"
    (sample / "inner_numba.py").write_text(INNER.format(shift=1))
    # what was compiled before, and for another copy, serves
    elsewhere = sample.parents[1] / "there" / "sample"
    elsewhere.parent.mkdir()
    sample.rename(elsewhere)
    assert end(start(elsewhere)) == "[8, 9, 27] 0"
    for file in (sample.parents[1] / "cache").glob("*doubled*.nbc"):
        file.write_bytes(file.read_bytes()[:1000])
    assert end(start(elsewhere)) == "[8, 9, 27] 1"
    assert end(start(elsewhere)) == "[8, 9, 27] 0"


def test_code_with_a_kernel_that_is_given_to_another_is_kept(sample):
    calls = "from sample.given_numba import given; print(given.ctypes(3))"
    for _ in range(2):
        assert end(start(sample, calls=calls)) == "94"
        assert len(list((sample.parents[1] / "cache").glob("*passed*.nbc"))) == 1


def test_a_kernel_is_compiled_by_one_of_two_processes(sample):
    both = [start(sample), start(sample)]
    values, compiled = zip(*(end(process).rsplit(" ", 1) for process in both), strict=True)
    assert values == ("[8, 9, 27]", "[8, 9, 27]")
    assert sum(map(int, compiled)) == 3
    assert len(list((sample.parents[1] / "cache").iterdir())) == 3  # no locks are left


def test_files_that_another_user_may_have_written_are_not_read(sample):
    assert end(start(sample, "squared")) == "[8, 9] 2"
    cache = sample.parents[1] / "cache"
    [doubled], [squared] = (list(cache.glob(f"*{name}*.nbc")) for name in ("doubled", "raised"))
    doubled.chmod(0o666)
    squared.rename(cache / "elsewhere")
    squared.symlink_to(cache / "elsewhere")
    assert end(start(sample, "squared")) == "[8, 9] 2"
    assert not squared.is_symlink()
    assert end(start(sample, "squared")) == "[8, 9] 0"
    if os.getuid() == 0:  # nobody else may give files away
        os.chown(doubled, 4321, -1)
        assert end(start(sample, "squared")) == "[8, 9] 1"


@pytest.mark.parametrize("tight", [False, True])
def test_garbage_is_collected_meanwhile_where_memory_is_short(tmp_path, monkeypatch, tight):
    @kernel
    def added(x):
        return x + tight

    monkeypatch.setattr(kernel_cache, "cache_folder", lambda: tmp_path)
    if tight:
        monkeypatch.setenv(TIGHT_MEMORY, "1")
    else:
        monkeypatch.delenv(TIGHT_MEMORY, raising=False)
    seen = []
    with listening(lambda *_: seen.append(gc.isenabled())):
        added(1)
    assert seen == [tight, tight]
    assert gc.isenabled()


def test_where_nothing_can_be_written_kernels_are_compiled_each_time(sample):
    assert end(start(sample, cache="/proc/nowhere")) == "[8, 9, 27] 3"


@kernel
def _checked(x):
    if x < 0:
        raise ValueError("negative")
    return x


@kernel
def _doubled(x):
    return 2 * _checked(x)


def test_kernels_hand_on_errors_and_python_calls_what_other_kernels_call():
    assert (_doubled(4), _doubled.py_func(4), _checked(4)) == (8, 8, 4)
    with pytest.raises(ValueError, match="negative"):
        _doubled(-4)


def test_functions_of_one_name_and_line_are_told_apart(tmp_path, monkeypatch):
    monkeypatch.setattr(kernel_cache, "cache_folder", lambda: tmp_path)
    plus, minus = (kernel(function) for function in (lambda x: x + 1, lambda x: x - 1))
    assert (plus(3), minus(3)) == (4, 2)
    assert len(list(tmp_path.glob("*.nbc"))) == 2
