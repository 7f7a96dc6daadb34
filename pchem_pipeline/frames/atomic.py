"""Files that appear only when they are whole."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pchem_pipeline.base.errors import InputError

__all__ = ["temporary"]


@contextmanager
def temporary(path: Path) -> Iterator[Path]:
    """Give a path to write to, and rename it to ``path`` if all went well; else remove it.

    The temporary name keeps the suffix, since some libraries look at it.

    Raises:
        InputError: the folder cannot be written, or the disk is full.
    """
    part = path.with_name(f".partial-{path.name}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove(part)
        yield part
        if path.is_dir():
            shutil.rmtree(path)
        part.replace(path)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}); check folder and disk"
        ) from error
    finally:
        _remove(part)


def _remove(part: Path) -> None:
    if part.is_dir():
        shutil.rmtree(part, ignore_errors=True)
    else:
        with suppress(OSError):
            part.unlink()
