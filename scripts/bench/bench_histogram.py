"""How fast the pass over the frames is: the kernel, with summaries, from a file; and what others would use.

    python scripts/bench/bench_histogram.py --frames 1024 --rows 128 --columns 512

Everything runs on one core (the file is read by a second thread, as in the pipeline), on the same frames,
which are simulated as in the paper. Slow peers get fewer pixels, as said in the table. CPU seconds count,
of the best of ``--repeat`` runs.
"""

from __future__ import annotations

import argparse
import platform
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.frames.stream import FrameStream
from pchem_pipeline.model.histogram.count import HistogramAccumulator, RowHistograms, histogram_frames
from pchem_pipeline.model.histogram.settings import HistogramSettings
from pchem_pipeline.model.histogram.summaries import SummaryAccumulator, line_sums

Frames = NDArray[np.uint16]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--frames", type=int, default=1024)
    parser.add_argument("--rows", type=int, default=128)
    parser.add_argument("--columns", type=int, default=512)
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--peer-pixels", type=int, default=2048, help="pixels for the slow peers")
    parser.add_argument("--exposure", type=float, default=2.0, help="e-")
    args = parser.parse_args()
    frames = simulate(args.frames, args.rows, args.columns, args.exposure)
    print(
        f"{args.frames} x {args.rows} x {args.columns} uint16 ({frames.nbytes / 1e6:.0f} MB), "
        f"{platform.machine()}, numpy {np.__version__}, Python {platform.python_version()}\n"
    )
    print(f"{'':46}{'ns/sample':>10}{'Msamples/s/core':>17}")
    expected = ours(frames, args.repeat)
    peers(frames, expected, args.peer_pixels)


def simulate(n_frames: int, rows: int, columns: int, exposure: float) -> Frames:
    """Return frames of a sensor like the paper's."""
    rng = np.random.default_rng(1)
    step = rng.normal(11, 0.3, (rows, columns))
    bias = rng.normal(100, 6, (rows, columns))
    frames = np.empty((n_frames, rows, columns), np.uint16)
    for frame in frames:
        electrons = rng.poisson(exposure, frame.shape) + rng.normal(0, 0.3, frame.shape)
        frame[...] = np.rint(bias + step * electrons)
    return frames


def ours(frames: Frames, repeat: int) -> RowHistograms:
    """Time the package's own ways."""
    n_frames, rows, columns = frames.shape
    expected = histogram_frames(frames)
    bins = expected.counts.shape[2]
    print(f"{bins} bins")

    def pieces() -> Iterable[Frames]:
        return (frames[t : t + 256] for t in range(0, n_frames, 256))

    def count(blocks: Iterable[Frames], *, histograms: bool = True, summaries: bool = True) -> None:
        counted = HistogramAccumulator((rows, columns), bins, n_frames)
        summed = SummaryAccumulator((rows, columns), HistogramSettings().block_length(n_frames))
        for block in blocks:
            if histograms:
                counted.add(block)
            if summaries:
                summed.add(block)
                line_sums(block)
        if histograms:
            counted.finish()
        if summaries:
            summed.finish()

    report(
        "histograms (windows checked, exact under/over)",
        lambda: count(pieces(), summaries=False),
        frames.size,
        repeat,
    )
    report("summaries alone", lambda: count(pieces(), histograms=False), frames.size, repeat)
    report("histograms and summaries", lambda: count(pieces()), frames.size, repeat)
    with tempfile.TemporaryDirectory() as folder:
        np.save(Path(folder) / "frames.npy", frames)
        reader = open_frames(InputSettings(files=("frames.npy",)), Path(folder))
        buffer = np.empty_like(frames[:256])

        def read() -> None:
            for t in range(0, n_frames, 256):
                end = min(t + 256, n_frames)
                reader.read_into(buffer[: end - t], t, end)

        def from_file(*, summaries: bool) -> None:
            with FrameStream(reader, [(0, rows)], 256) as stream:
                count((block for _, (block,) in stream), summaries=summaries)

        report("reading the file alone (warm)", read, frames.size, repeat)
        report("file to histograms", lambda: from_file(summaries=False), frames.size, repeat)
        report("file to histograms and summaries", lambda: from_file(summaries=True), frames.size, repeat)
    return expected


def peers(frames: Frames, expected: RowHistograms, pixels: int) -> None:
    """Time what others would use, on fewer pixels."""
    import dask
    import dask.array as da

    columns = frames.shape[2]
    rows = max(1, min(frames.shape[1], pixels // columns))
    part = np.ascontiguousarray(frames[:, :rows])
    by_pixel = np.ascontiguousarray(part.reshape(part.shape[0], -1).T)
    bins = int(part.max()) + 1
    print(f"\npeers, on {part[0].size} pixels:")

    def bincount() -> NDArray[np.int64]:
        return np.array([np.bincount(pixel, minlength=bins) for pixel in by_pixel])

    def with_transpose() -> NDArray[np.int64]:
        contiguous = np.ascontiguousarray(part.reshape(part.shape[0], -1).T)
        return np.array([np.bincount(pixel, minlength=bins) for pixel in contiguous])

    def offsets() -> NDArray[np.int64]:
        flat = part.reshape(part.shape[0], -1) + np.arange(part[0].size) * bins
        return np.bincount(flat.ravel(), minlength=part[0].size * bins).reshape(-1, bins)

    def numpy_histogram() -> NDArray[np.int64]:
        edges = np.arange(bins + 1) - 0.5
        return np.array([np.histogram(pixel, edges)[0] for pixel in by_pixel])

    def dask_way() -> NDArray[np.int64]:
        stack = da.from_array(part, chunks=(part.shape[0], 16, 128))
        counted = da.apply_along_axis(np.bincount, 0, stack, dtype=np.int64, shape=(bins,), minlength=bins)
        with dask.config.set(scheduler="synchronous"):
            return np.asarray(counted.compute()).reshape(bins, -1).T

    ways: list[tuple[str, Callable[[], NDArray[np.int64]]]] = [
        ("np.bincount of each pixel, transposed before", bincount),
        ("np.bincount of each pixel, with the transpose", with_transpose),
        ("np.bincount with offsets", offsets),
        ("np.histogram of each pixel", numpy_histogram),
        ("dask.array apply_along_axis(bincount)", dask_way),
    ]
    for name, way in ways:
        check(way(), expected, columns)
        report(name, way, part.size, 1)


def check(counts: NDArray[np.int64], expected: RowHistograms, columns: int) -> None:
    """Compare a peer's histogram of every pixel with ours."""
    for pixel, row in enumerate(counts):
        y, x = divmod(pixel, columns)
        start = expected.origin[y, x]
        mine = expected.counts[y, x, : max(0, row.size - start)]
        if row.sum() != mine.sum() or not np.array_equal(row[start : start + mine.size], mine):
            raise SystemExit(f"pixel ({y}, {x}) differs")


def report(name: str, work: Callable[[], object], samples: int, repeat: int) -> None:
    """Print the CPU time of the best run, per sample."""
    work()
    best = float("inf")
    for _ in range(repeat):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    print(f"{name:46}{best / samples * 1e9:10.2f}{samples / best / 1e6:17.0f}")


if __name__ == "__main__":
    main()
