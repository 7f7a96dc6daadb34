"""From paths, globs and folders to a list of files in natural order."""

from __future__ import annotations

import glob
import os
import re
from contextlib import suppress
from pathlib import Path

from pchem_pipeline.base.errors import ConfigError, InputError
from pchem_pipeline.frames.formats.raw import SIDECARS, RawReader, find_sidecar
from pchem_pipeline.frames.formats.zarr import is_zarr
from pchem_pipeline.frames.registry import frame_suffixes
from pchem_pipeline.frames.remote import fetch, is_remote
from pchem_pipeline.frames.settings import InputSettings

HISTOGRAM_SUFFIXES = {".csv": "histogram", ".npy": "histogram", ".npz": "histogram", ".txt": "histogram"}
_NUMBER = re.compile(r"(\d+)")


def natural_key(path: Path) -> tuple[tuple[tuple[int, int | str], ...], str]:
    """Return a key that sorts frame2 before frame10, folders first."""
    pieces = _NUMBER.split(str(path).casefold())
    return tuple((0, int(p)) if p.isdecimal() else (1, p) for p in pieces if p), str(path)


def resolve_files(settings: InputSettings, base_dir: Path) -> list[Path]:
    """Return the files that ``input.files`` names, in natural order; a path named twice is listed twice.

    Raises:
        ConfigError: no files are named.
        InputError: a path is missing, a glob matches nothing, a folder holds no camera files or several
            formats.
    """
    if not settings.files:
        raise ConfigError("input.files is empty; give camera files, a glob such as frames/*.tif, or a folder")
    found: list[Path] = []
    missing: list[Path] = []
    for entry in settings.files:
        if is_remote(entry):
            found += fetch(entry)
            continue
        path = Path(entry)
        with suppress(RuntimeError):  # a file called ~x.tif
            path = path.expanduser()
        pattern, path = path, base_dir / path
        if path.is_dir() and not is_zarr(path):
            found += _folder(path, settings)
        elif path.exists():
            found.append(path)
        elif glob.has_magic(entry):
            found += _glob(pattern, base_dir)
        else:
            missing.append(path)
    if missing:
        more = f" and {len(missing) - 1} more (last {missing[-1].name})" if len(missing) > 1 else ""
        raise InputError(f"{missing[0]}{more}: no such file or folder; restore it, or correct its path")
    for path in found:
        if not (path.is_file() or path.is_dir()):
            raise InputError(f"{path}: not a regular file; write its content to a file first")
        if not str(path).isascii() and str(path) != os.fsencode(path).decode("utf-8", "replace"):
            raise InputError(f"{path}: its name is not UTF-8; rename it")
    return sorted(found, key=natural_key)


def input_paths(settings: InputSettings, base_dir: Path) -> list[Path]:
    """Return all files that decide what is read: mask, camera files, each with its sidecar.

    Raises:
        ConfigError: no files are named.
        InputError: as in `resolve_files`.
    """
    mask = mask_path(settings, base_dir)
    paths = [] if mask is None else [mask]
    for path in resolve_files(settings, base_dir):
        paths.append(path)
        raw = settings.format == "raw" or path.suffix.lower() in RawReader.suffixes
        if raw and (sidecar := find_sidecar(path)):
            paths.append(sidecar)
    return paths


def mask_path(settings: InputSettings, base_dir: Path) -> Path | None:
    """Return the file of ``input.mask``, fetched where it is remote.

    Raises:
        InputError: there is none.
    """
    if settings.mask is None:
        return None
    return resolve_files(settings.model_copy(update={"files": (settings.mask,)}), base_dir)[0]


def _glob(pattern: Path, base_dir: Path) -> list[Path]:
    """Return the files that a pattern names; in the names of ``base_dir`` nothing is a pattern."""
    whole = pattern.is_absolute()
    folder = Path(pattern.anchor) if whole else base_dir
    matches = folder.glob(str(pattern.relative_to(pattern.anchor) if whole else pattern))
    # a description (frames.raw.json) is no camera file
    files = [p for p in matches if not p.name.startswith(".") and p.suffix.lower() not in SIDECARS]
    plain = [path for path in files if path.is_file() or is_zarr(path)]
    if not plain:
        raise InputError(f"{base_dir / pattern}: matches no file; restore the files, or correct the path")
    return plain


def _folder(folder: Path, settings: InputSettings) -> list[Path]:
    histograms = settings.format == "histogram"
    suffixes = HISTOGRAM_SUFFIXES if histograms else frame_suffixes(settings.format)
    entries = [path for path in folder.iterdir() if not path.name.startswith(".")]
    files = [path for path in entries if path.is_file() and path.suffix.lower() in suffixes]
    if not files:
        files = [path for path in entries if is_zarr(path)] if "zarr" in suffixes.values() else []
    if not files:
        kinds = ", ".join(sorted(suffixes))
        raise InputError(
            f"{folder}: the folder has no camera files ({kinds}); correct the path (input.files), or set "
            "input.format"
        )
    formats = sorted({suffixes.get(path.suffix.lower(), "zarr") for path in files})
    if len(formats) > 1:
        raise InputError(
            f"{folder}: the folder has files of several formats ({', '.join(formats)}); set input.format, or "
            "select the files by a glob"
        )
    return files
