"""Which array of a container (HDF5, zarr) holds the frames."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pchem_pipeline.base.errors import InputError


def choose_dataset(path: Path, shapes: Mapping[str, tuple[int, ...]], wanted: str | None) -> str:
    """Return the dataset to read: the wanted one, else the only one of three axes or more, else of two.

    Args:
        path: the file, for the message.
        shapes: shape of every dataset in the file, by its path inside.
        wanted: ``input.dataset``.

    Raises:
        InputError: not there, or not the only one; the message lists the candidates.
    """
    stacks = [name for name, shape in shapes.items() if len(shape) >= 3]
    images = [name for name, shape in shapes.items() if len(shape) == 2]
    names = [*stacks, *images]
    listed = ", ".join(f"{name} {shapes[name]}" for name in names[:12])
    listed += f" and {len(names) - 12} more" if len(names) > 12 else ""
    if wanted is not None:
        name = wanted.strip("/")
        if name in shapes:
            return name
        raise InputError(
            f"{path}: no dataset {wanted!r}; there are: {listed or 'no images'}; correct input.dataset "
            "(--dataset)"
        )
    if not stacks and not images:
        raise InputError(f"{path}: holds no dataset of frames (frames, rows, columns); leave it out")
    candidates = stacks or images
    if len(candidates) > 1:
        raise InputError(f"{path}: holds several datasets: {listed}; choose one by input.dataset (--dataset)")
    return candidates[0]
