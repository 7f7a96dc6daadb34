"""Where the samples of an HDF5 dataset lie, and what they need to be decoded; works on h5py's objects.

The library reads what it cannot find as the fill value, without a word, and of a filter that it does not have
it tells only the folder where it looked.
"""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from typing import Any

from pchem_pipeline.base.errors import InputError, install_hint
from pchem_pipeline.base.wording import first_few
from pchem_pipeline.frames.reader import unwritten_notes

#: parts of a virtual dataset, and virtual datasets within each other
_MOST_PARTS, _DEEPEST = 100_000, 16


def check_links(path: Path, file: Any, wanted: str | None) -> None:
    """Raise InputError if the wanted dataset (None: any) is in another file, as in a Dectris master file."""
    from h5py import h5l

    links = file.id.links  # not visititems_links, which fails at links of kinds that it does not know
    found: dict[str, str] = {}

    def visit(name: bytes, info: Any) -> None:
        if info.type == h5l.TYPE_EXTERNAL:
            found[name.decode("utf-8", "replace")] = links.get_val(name)[0].decode("utf-8", "replace")

    links.visit(visit, info=True)

    def may_be_a_stack(name: str) -> bool:
        try:
            _source_file(path, path.parent / found[name])
        except InputError:
            return True
        return getattr(file.get(name), "ndim", 3) >= 3

    names = [name for name in found if wanted is None or name == wanted.strip("/")]
    if asked := [f"{name} in {found[name]}" for name in names if may_be_a_stack(name)]:
        raise InputError(
            f"its frames are in other files: {first_few(asked)}; give those, with "
            "--integration-time and --bit-depth from this file, or choose a dataset with --dataset"
        )


def check_sources(path: Path, dataset: Any) -> tuple[str, ...]:
    """Check that the files which hold the samples of a dataset exist and are long enough; return a remark.

    Raises:
        InputError: one of them is missing, shorter than the dataset says, or not beside or below its file.
    """
    if dataset.external:
        return _check_raw_parts(path, dataset)
    if not dataset.is_virtual:
        return ()
    sources = check_virtual(path, dataset)
    bad = [source.file_name for source in sources if not _is_whole(path, source)]
    if bad:
        raise InputError(
            f"{len(bad)} of the {len(sources)} parts of {dataset.name} are missing or truncated, the first "
            f"in {bad[0]}; restore these files"
        )
    notes = _elsewhere({source.file_name for source in sources} - {"."})
    try:
        covered = sum(source.vspace.get_select_npoints() for source in sources)
    except (RuntimeError, ValueError):  # no end
        return notes
    return notes + unwritten_notes(dataset.size - covered, dataset.size, "samples")


def _check_raw_parts(path: Path, dataset: Any) -> tuple[str, ...]:
    """Check the files of plain samples that a dataset names."""
    needed, found = dataset.size * dataset.dtype.itemsize, 0
    for name, offset, size in dataset.external:
        if not Path(name).exists():  # so the library looks for it: from the current folder
            raise InputError(
                f"the samples of {dataset.name} are in {name}, which is not found; start the command in the "
                "folder of this file"
            )
        found += max(0, min(size, _source_file(path, Path(name)).stat().st_size - offset))
    names = {name for name, *_ in dataset.external}
    if found < needed:
        raise InputError(
            f"the samples of {dataset.name} are in {', '.join(sorted(names)[:4])}, truncated: {needed} bytes "
            f"needed, {found} found; copy the file again"
        )
    return _elsewhere(names)


def _source_file(path: Path, other: Path) -> Path:
    """Return a file that another one names as its source; refuse one that is not beside or below that one."""
    home, real = path.resolve().parent, other.resolve()
    if home not in real.parents:
        raise InputError(f"its source {real} is not in the same folder or below; copy it there")
    if real.exists() and not real.is_file():
        raise InputError(f"its source {real} is not a regular file; copy it again")
    return real


def check_virtual(path: Path, dataset: Any, above: tuple[tuple[Path, str], ...] = ()) -> list[Any]:
    """Check where the parts of a virtual dataset are, before the library looks for them; return them.

    The datasets ``above`` have this one as a part.

    Raises:
        InputError: a part is the dataset itself, or not beside or below the file; or they are too many.
    """
    here = (*above, (path.resolve(), dataset.name.strip("/")))
    if len(here) > _DEEPEST or dataset.id.get_create_plist().get_virtual_count() > _MOST_PARTS:
        raise InputError(
            f"{dataset.name} has too many or too deeply nested parts; copy its frames into one dataset"
        )
    sources = dataset.virtual_sources()
    for source in sources:
        name = source.file_name
        other = _source_file(path, path if name == "." else path.parent / name)
        if "%" in name:  # numbered files without an end: as many as there are
            pattern = re.sub(r"%\d*b", "*", other.name)
            for each in other.parent.glob(pattern):
                _source_file(path, each)
            continue
        if (other, source.dset_name.strip("/")) in here:
            raise InputError(f"{dataset.name} contains itself; write its frames again")
        with suppress(OSError), opened(other) as file:
            part = _plain(file, source.dset_name)
            if getattr(part, "is_virtual", False):
                check_virtual(other, part, here)
    return list(sources)


def virtual_files(path: Path, dataset: Any) -> list[Path]:
    """Return the existing files that the parts of a virtual dataset are in."""
    files: set[Path] = set()
    for name in {source.file_name for source in dataset.virtual_sources()} - {"."}:
        other = path.parent / name
        files.update(other.parent.glob(re.sub(r"%\d*b", "*", other.name)) if "%" in name else [other])
    return [file for file in files if file.is_file()]


def _plain(file: Any, name: str) -> Any:
    """Return what a file itself has under a name, or None: links into other files are not followed."""
    import h5py

    item = file
    for step in filter(None, name.split("/")):
        if not isinstance(item, h5py.Group) or not is_own(item, step):
            return None
        item = item[step]
    return item


def is_own(group: Any, name: str) -> bool:
    """Return whether a group has something in its own file under a name."""
    import h5py

    return isinstance(group.get(name, getlink=True), h5py.HardLink)


def opened(path: Path) -> Any:
    """Return an open HDF5 file, without a lock where the file system has none.

    Raises:
        OSError: it cannot be opened, or another program has locked it to write.
    """
    import h5py

    try:
        return h5py.File(path, "r")
    except OSError as error:
        if isinstance(error, BlockingIOError) or "unable to lock file" not in str(error):
            raise
        return h5py.File(path, "r", locking=False)


def _elsewhere(names: set[str]) -> tuple[str, ...]:
    words = f"its frames are in {len(names)} other files; changes of these are not detected"
    return (words,) if names else ()


def _is_whole(path: Path, source: Any) -> bool:
    """Return whether a part of a virtual dataset is there and as large as it was."""
    if "%" in source.file_name:
        return True
    try:
        with opened(path if source.file_name == "." else path.parent / source.file_name) as file:
            part = _plain(file, source.dset_name)
            return part is not None and _fits(part, source)
    except OSError:
        return False


def _fits(part: Any, source: Any) -> bool:
    """Return whether a part has all samples taken from it; those without an end take what is there."""
    from h5py import h5s

    try:
        if source.src_space.get_select_type() == h5s.SEL_ALL:
            return bool(part.size >= source.vspace.get_select_npoints())
        _, last = source.src_space.get_select_bounds()
    except (RuntimeError, ValueError):  # no end
        return True
    return all(length > end for length, end in zip(part.shape, last, strict=True))


def check_filters(dataset: Any) -> None:
    """Raise InputError if a dataset is coded by a filter that is not installed."""
    from h5py import h5z

    record = dataset.id.get_create_plist()
    for number in range(record.get_nfilters()):
        code, _, _, name = record.get_filter(number)
        if h5z.filter_avail(code):
            continue
        try:
            dataset[(0,) * dataset.ndim]
        except (OSError, ValueError) as error:
            words = name.decode("utf-8", "replace") or "without a name"
            raise InputError(
                f"{dataset.name} needs HDF5 filter {code} ({words}), which is not installed; install it "
                f"({install_hint('hdf5')} has most), or write the file again with gzip"
            ) from error
