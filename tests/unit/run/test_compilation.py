"""What the terminal says of kernels that are compiled."""

from pathlib import Path

from pchem_pipeline.base import kernel_cache
from pchem_pipeline.run import compilation
from pchem_pipeline.run.compilation import announced
from pchem_pipeline.run.progress import Reporter


def heard(*calls):
    """Call the listeners of kernels that begin (None) or are compiled."""
    for kernel, seconds in calls:
        for listener in kernel_cache._listeners:
            listener(kernel, seconds)


def test_the_terminal_says_what_is_compiled(tmp_path, capsys, monkeypatch):
    def said():
        return capsys.readouterr().err.splitlines()

    monkeypatch.setattr(compilation, "cache_folder", lambda: tmp_path)
    with announced(Reporter("off"), "fit"):
        pass
    assert said() == []
    with announced(Reporter("off"), "fit"):
        heard(("one", None), ("one", 1.5), ("two", None), ("two", 2.5))
    assert said() == [
        "fit: compiling kernels (once after an installation or update)",
        "fit: 2 kernels compiled in 4 s",
    ]
    with announced(Reporter("off"), "maps", 400):
        heard(("one", None), ("one", 1.0))
    assert "490 MiB, more than compute.max_memory (--max-memory) allows (400 MiB)" in said()[1]
    monkeypatch.setattr(compilation, "cache_folder", lambda: Path("/proc/nowhere"))
    with announced(Reporter("off"), "maps", 600):
        heard(("one", None), ("one", 1.0))
    assert said()[1:] == [
        "maps: 1 kernel compiled in 1 s",
        "warning: maps: /proc/nowhere is not writable, so every command compiles its kernels again; set "
        "NUMBA_CACHE_DIR to another folder",
    ]
