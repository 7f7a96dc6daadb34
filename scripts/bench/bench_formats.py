"""Compressed camera files: our readers beside the bare decoder, in the same run.

Some frames of a raw file are written as TIFF (zlib), HDF5 (bitshuffle with LZ4) and FITS (RICE), and read
in whole frames: by the library itself on one thread, by ours on one thread, and by ours with the hash of the
bytes on several threads, as ``pchem run`` does.

    python scripts/bench/bench_formats.py /data/full/frames/frames.raw --frames 200
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from timeit import repeat

import numpy as np
from numpy.typing import NDArray
from running import machine

from pchem_pipeline.compute.environment import prepare_environment
from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.sequence import FrameSequence
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.frames.stream import HashedFrameStream

Stack = NDArray[np.uint16]


def _tiff(path: Path, stack: Stack) -> Callable[[], object]:
    import tifffile

    tifffile.imwrite(path, stack, photometric="minisblack", compression="zlib", maxworkers=1)

    def bare() -> None:
        with tifffile.TiffFile(path) as file:
            for page in file.pages:
                page.asarray(maxworkers=1)

    return bare


def _hdf5(path: Path, stack: Stack) -> Callable[[], object]:
    import h5py
    import hdf5plugin

    with h5py.File(path, "w") as file:
        file.create_dataset("frames", data=stack, chunks=(4, *stack.shape[1:]), **hdf5plugin.Bitshuffle())

    def bare() -> None:
        with h5py.File(path) as file:
            for t in range(0, len(stack), 4):
                file["frames"][t : t + 4]

    return bare


def _fits(path: Path, stack: Stack) -> Callable[[], object]:
    from astropy.io import fits

    tile = (1, *stack.shape[1:])
    image = fits.CompImageHDU(stack, compression_type="RICE_1", tile_shape=tile)
    fits.HDUList([fits.PrimaryHDU(), image]).writeto(path)

    def bare() -> None:
        with fits.open(path, memmap=False) as units:
            for t in range(0, len(stack), 4):
                np.asarray(units[1].section[t : t + 4])

    return bare


FORMATS = {"stack.tif": _tiff, "stack.h5": _hdf5, "stack.fits": _fits}


def hashed(frames: FrameSequence, path: Path, threads: int) -> None:
    """Read all frames with the hash of their bytes."""
    with HashedFrameStream(
        frames, [(0, frames.shape[1])], frames.shape[0], files=[path], threads=threads
    ) as stream:
        for _ in stream:
            pass
        stream.identity()


def main() -> None:
    prepare_environment()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("raw", type=Path, help="raw file, uint16, with its sidecar")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--threads", type=int, default=2)
    given = parser.parse_args()
    reader = open_frames(InputSettings(files=(str(given.raw.resolve()),)), Path())
    stack = reader.read(0, min(given.frames, reader.shape[0]))
    print(machine())
    print(f"{stack.shape[0]} frames of {stack.shape[1]} x {stack.shape[2]}; MB/s of decoded samples")
    print(f"{'file':<12}{'bare':>8}{'ours':>8}{'ours + hash':>13}  ({given.threads} threads)")
    with tempfile.TemporaryDirectory(prefix="bench-formats-") as folder:
        for name, write in FORMATS.items():
            path = Path(folder) / name
            bare = write(path, stack)
            frames = open_frames(InputSettings(files=(str(path),)), Path())
            np.testing.assert_array_equal(frames.read(), stack)
            ours = partial(frames.read_into, np.empty_like(stack), 0, len(stack))
            calls = (bare, ours, partial(hashed, frames, path, given.threads))
            speeds = [stack.nbytes / 1e6 / min(repeat(call, number=1, repeat=2)) for call in calls]
            print(f"{name:<12}{speeds[0]:>8.0f}{speeds[1]:>8.0f}{speeds[2]:>13.0f}")


if __name__ == "__main__":
    main()
