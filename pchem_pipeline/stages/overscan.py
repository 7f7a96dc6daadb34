"""The overscan of a run: its samples in the files, and what the store says of it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.frames.sequence import FrameSequence
from pchem_pipeline.model.arithmetic.significance import BEYOND_DOUBT
from pchem_pipeline.model.arithmetic.statistics import robust_sd
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.use.overscan import Overscan

_FACTS = ("n_frames", "frame_variance", "row_variance")


def overscan_samples(frames: FrameSequence, where: BoolArray, most: int = 1024) -> Iterator[FloatArray]:
    """Yield the samples of some pixels of the overscan in frames spread over all, DN, shape (pixel,).

    The mean of 1024 frames adds a thousandth to the variance of a row's offset. Frames of which the first row
    lies far from that of the others, such as empty ones, are left out.
    """
    source, (y, x) = frames.with_overscan(), np.nonzero(where)
    first, end = int(y[0]), int(y[-1]) + 1
    chosen = np.unique(np.linspace(0, frames.shape[0] - 1, most).astype(int))
    levels = np.array(
        [np.median(source.read(t, t + 1, first, first + 1)[0, 0, x[y == first]]) for t in chosen]
    )
    far = abs(levels - np.median(levels)) > BEYOND_DOUBT * max(robust_sd(levels), 1.0)  # codes are whole DN
    for t in chosen[~far].tolist():
        yield source.read(t, t + 1, first, end)[0, y - first, x].astype(np.float64)


def write_overscan(store: RunStore, frames: FrameSequence) -> None:
    """Write the group ``overscan`` where frames have one."""
    where = frames.overscan_pixels
    if not where.any():
        return
    found = Overscan.measured(overscan_samples(frames, where), where)
    for name, stderr in zip(("bias", "read_noise_dn"), found.stderr, strict=True):
        store.write_array(f"overscan/{name}", getattr(found, name))
        store.write_array(f"overscan/{name}_stderr", stderr)
    store.set_attributes("overscan", {name: getattr(found, name) for name in _FACTS})


def read_overscan(store: RunStore) -> Overscan | None:
    """Return the overscan of a run; None where it has none."""
    if not store.has("overscan/bias"):
        return None
    bias, noise = (store.read(f"overscan/{name}") for name in ("bias", "read_noise_dn"))
    facts = store.attributes("overscan")
    return Overscan(bias, noise, *(facts[name] for name in _FACTS))
