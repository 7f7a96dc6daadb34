"""Where the samples of an HDF5 dataset lie, and what they need to be decoded; works on h5py's objects.

The library reads what it cannot find as the fill value, without a word, and of a filter that it does not have
it tells only the folder where it looked.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pchem_pipeline.base.errors import InputError, install_hint


def external_links(file: Any) -> dict[str, str]:
    """Return the links to what may be stacks in other files: path in this file -> name of the other."""
    from h5py import h5l

    links = file.id.links  # not visititems_links, which fails at links of kinds that it does not know
    found: dict[str, str] = {}

    def visit(name: bytes, info: Any) -> None:
        if info.type == h5l.TYPE_EXTERNAL:
            found[name.decode("utf-8", "replace")] = links.get_val(name)[0].decode("utf-8", "replace")

    links.visit(visit, info=True)
    return {name: other for name, other in found.items() if getattr(file.get(name), "ndim", 3) >= 3}


def check_links(path: Path, links: dict[str, str], wanted: str | None) -> None:
    """Refuse what lies in another file (a Dectris master file, say).

    Raises:
        InputError: the wanted dataset is a link, or (none is wanted) there are links.
    """
    asked = {name: links[name] for name in links if wanted is None or name == wanted.strip("/")}
    if asked:
        shown = ", ".join(f"{name} in {file}" for name, file in list(asked.items())[:4])
        more = f" and {len(asked) - 4} more" if len(asked) > 4 else ""
        raise InputError(
            f"{path}: its frames are in other files: {shown}{more}; name those instead, and what this file "
            "says besides by --integration-time and --bit-depth, or choose a dataset here by --dataset"
        )


def check_sources(path: Path, dataset: Any) -> tuple[str, ...]:
    """Check that the files which hold the samples of a dataset are there and long enough.

    Args:
        path: the file of the dataset.
        dataset: of h5py.

    Returns:
        A remark for the user where there are such files.

    Raises:
        InputError: one of them is missing, or shorter than the dataset says.
    """
    for name, *_ in dataset.external or ():
        if not Path(name).exists():  # so the library looks for it: from the current folder
            raise InputError(
                f"{path}: the samples of {dataset.name} lie in {name}, which is not here; start the command "
                "in the folder of that file"
            )
    if not dataset.is_virtual:
        return _elsewhere(path, {name for name, *_ in dataset.external or ()})
    sources = dataset.virtual_sources()
    bad: list[str] = []
    for source in sources:
        if "%" in source.file_name:  # numbered files without an end: as many as there are
            continue
        if not _is_whole(path, source):
            bad.append(source.file_name)
    if bad:
        raise InputError(
            f"{path}: {len(bad)} of the {len(sources)} parts of {dataset.name} are missing or too short, the "
            f"first in {bad[0]}; put the files where they were when it was written"
        )
    return _elsewhere(path, {source.file_name for source in sources} - {"."})


def _elsewhere(path: Path, names: set[str]) -> tuple[str, ...]:
    words = f"{path.name}: its frames lie in other files ({len(names)}), whose changes are not noticed"
    return (words,) if names else ()


def _is_whole(path: Path, source: Any) -> bool:
    """Tell whether a part of a virtual dataset is there and as large as it was."""
    import h5py

    other = path if source.file_name == "." else path.parent / source.file_name
    try:
        with h5py.File(other, "r") as file:
            part = file.get(source.dset_name)
            return part is not None and _fits(part, source)
    except OSError:
        return False


def _fits(part: Any, source: Any) -> bool:
    """Tell whether a part has all samples that are taken from it; those without an end take what is there."""
    from h5py import h5s

    try:
        if source.src_space.get_select_type() == h5s.SEL_ALL:
            return bool(part.size >= source.vspace.get_select_npoints())
        _, last = source.src_space.get_select_bounds()
    except (RuntimeError, ValueError):  # no end
        return True
    return all(length > end for length, end in zip(part.shape, last, strict=True))


def check_filters(path: Path, dataset: Any) -> None:
    """Check that the filters by which a dataset is coded are installed, unless they were not applied.

    Raises:
        InputError: one is not.
    """
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
                f"{path}: {dataset.name} is coded by HDF5 filter {code} ({words}), which is not installed; "
                f"install it ({install_hint('hdf5')} has most), or write the file again with gzip"
            ) from error
