"""Which part of a stack is looked at closely: where the summaries of all its samples disagree most.

Where they disagree clearly, few samples identify the cause.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from pchem_pipeline.base.arrays import BoolArray, IntArray
from pchem_pipeline.base.errors import ConfigError, PchEmError
from pchem_pipeline.discrepancy.families import box_sums, cumulative
from pchem_pipeline.discrepancy.null import free_of_parameters
from pchem_pipeline.discrepancy.observe.observe import observe
from pchem_pipeline.discrepancy.settings import DiscrepancySettings
from pchem_pipeline.discrepancy.splits import block_length
from pchem_pipeline.discrepancy.verdict import Surveyed, Verdict
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.region import Region
from pchem_pipeline.frames.stream import FrameSource, FrameStream

#: Bytes of a search: with its program and kernels, however small the window; of a sample; of a pixel, and of
#: each code of its law. Measured with one worker, 256 to 8190 pixels and 1000 to 6000 frames.
_PROGRAM_BYTES, _SAMPLE_BYTES, _PIXEL_BYTES, _CODE_BYTES = 290 << 20, 8, 12 << 10, 75
#: Standard deviations of the largest statistic. Some poor sensors have as many without any effect (of 60 of
#: all kinds none more than 20), as without simulations their statistics are not quite standard normal: of
#: these less is compared, with simulations that tell.
_CLEAR = 15.0


SUMS, SHAPES, PAIRS = (
    "neighbours, successive frames, levels",
    "shapes and tails of the histograms",
    "pairs of pixels in rows, columns and frames",
)


@dataclass(frozen=True)
class Spot:
    """A part of the sensor that stands out, and its p-value."""

    region: Region
    p: float


@dataclass(frozen=True)
class Survey:
    """What stands out, and how much was looked at."""

    places: Mapping[str, Spot] = field(default_factory=dict)  # of each map (next_x, score.C2) the worst
    shares: Mapping[str, float] = field(default_factory=dict)  # of the run's samples, by what was looked at
    left_out: tuple[int, ...] = ()  # empty, copied, outlying or moved frames: nothing is said of them
    copied: tuple[int, ...] = ()  # those of them that are copies of earlier ones

    def told(self, verdict: Verdict, share: float) -> Verdict:
        """Return the verdict with this survey, and the share of the samples that was compared."""
        spots = tuple(
            Surveyed(map=name, region=place.region.numbers(), p=place.p)
            for name, place in sorted(self.places.items(), key=lambda item: item[1].p)
        )
        least = min(self.shares.get(kind, 0.0) for kind in (SUMS, SHAPES, PAIRS))
        examined = verdict.examined.model_copy(
            update={
                "share": share,
                "surveyed": max(share, least),
                "surveyed_by": dict(self.shares),
                "places": (*verdict.examined.places, *spots),
                "left_out": self.left_out,
            }
        )
        return verdict.model_copy(update={"examined": examined})


#: To and from JSON data, for a marker.
SURVEY = TypeAdapter(Survey)


@dataclass(frozen=True)
class Window:
    """The part of the stack that is looked at: whole blocks of frames, by number; first and end of its rows.

    ``copied`` are the frames of the run that are copies of earlier ones.
    """

    numbers: IntArray
    rows: tuple[int, int]
    columns: tuple[int, int]
    copied: tuple[int, ...] = ()

    @property
    def times(self) -> IntArray:
        """Frame numbers without the copies, which took no time."""
        return self.numbers - np.searchsorted(self.copied, self.numbers)

    @property
    def pixels(self) -> int:
        """Number of its pixels."""
        return (self.rows[1] - self.rows[0]) * (self.columns[1] - self.columns[0])

    def share(self, shape: tuple[int, int, int]) -> float:
        """Return its share of the samples of a stack of some shape."""
        return self.numbers.size * self.pixels / math.prod(shape)


def choose_window(
    shape: tuple[int, int, int],
    settings: DiscrepancySettings,
    roi: Sequence[int] | None = None,
    seen: Survey = Survey(),
) -> Window:
    """Return what to look at: everything if small enough, else a window and blocks over the whole run.

    The window lies where the sensor disagrees most, as much of it inside the place as outside: what is only
    there shows against its quiet neighbours. Without such a place it lies in the middle.

    The shape of the stack is (frames, rows, columns), the ``roi`` (y0, y1, x0, x1) that the user asked for.
    """
    kept = np.setdiff1d(np.arange(shape[0], dtype=np.int64), seen.left_out)
    n_frames, ny, nx = kept.size, *shape[1:]
    y0, y1, x0, x1 = roi or (0, ny, 0, nx)
    within = (y1 - y0) * (x1 - x0)
    # frames tell more than pixels about what happens in time; pixels more about what is rare
    frames = min(n_frames, max(6000, settings.max_samples // max(within, 1)))
    pixels = max(min(settings.max_samples // frames, settings.max_pixels), 1)
    if within > pixels:
        height = min(y1 - y0, max(int(np.sqrt(pixels)), pixels // (x1 - x0)))
        width = min(x1 - x0, pixels // height)
        worst = min(seen.places.values(), key=lambda place: place.p, default=None)
        mask = None if worst is None else worst.region.mask(shape[1:])
        y0, x0 = _corner(mask, (y0, y1, x0, x1), (height, width))
        y1, x1 = y0 + height, x0 + width
    numbers = kept
    if frames < n_frames:
        length = block_length(frames, settings.block_frames)
        starts = np.linspace(0, n_frames - length, frames // length).astype(np.int64)
        numbers = kept[(starts[:, None] + np.arange(length)).ravel()]
    return Window(numbers, (y0, y1), (x0, x1), seen.copied)


def other_window(window: Window, shape: tuple[int, int, int], roi: Sequence[int] | None) -> Window | None:
    """Return a window of the same size as far from one as there is; None where most of both is the same.

    The shape of the stack is (frames, rows, columns), the ``roi`` (y0, y1, x0, x1) that the user asked for.
    """
    y0, y1, x0, x1 = roi or (0, shape[1], 0, shape[2])
    height, width = (end - first for first, end in (window.rows, window.columns))

    def away(corner: tuple[int, int]) -> tuple[int, int]:
        y, x = corner[0] - window.rows[0], corner[1] - window.columns[0]
        return -max(height - abs(y), 0) * max(width - abs(x), 0), y**2 + x**2

    rows, columns = (
        {first, (first + end - size) // 2, end - size}
        for first, end, size in ((y0, y1, height), (x0, x1, width))
    )
    y, x = max(itertools.product(sorted(rows), sorted(columns)), key=away)
    # of windows that share more the one says little of the other
    if -away((y, x))[0] > 0.5 * height * width:
        return None
    return replace(window, rows=(y, y + height), columns=(x, x + width))


def search_bytes(window: Window, codes: float) -> int:
    """Return the memory that a search in a window takes with one worker, with so many codes of each pixel."""
    each = _PIXEL_BYTES + codes * _CODE_BYTES + window.numbers.size * _SAMPLE_BYTES
    return _PROGRAM_BYTES + int(window.pixels * each)


def within_memory(
    settings: DiscrepancySettings,
    shape: tuple[int, int, int],
    roi: Sequence[int] | None,
    codes: float,
    limit: int,
) -> DiscrepancySettings:
    """Return the settings with as many samples and pixels as a search may have within ``limit`` bytes.

    Shape and roi as of :func:`choose_window`; ``codes`` is the number of codes of the law of a pixel.

    Raises:
        ConfigError: it is not enough for the smallest window.
    """
    window = choose_window(shape, settings, roi)
    while (least := search_bytes(window, codes)) > limit:
        pixels = int(window.pixels * 0.9)
        if pixels < 256:
            raise ConfigError(
                f"discrepancy needs at least {-(-least >> 20)} MiB, compute.max_memory (--max-memory) allows "
                f"{limit >> 20}; raise it"
            )
        samples = min(settings.max_samples, pixels * window.numbers.size)
        settings = settings.model_copy(update={"max_samples": samples, "max_pixels": pixels})
        window = choose_window(shape, settings, roi)
    return settings


def _corner(
    place: BoolArray | None, within: tuple[int, int, int, int], size: tuple[int, int]
) -> tuple[int, int]:
    """Return first row and column of a window within a region: half in the place, else in the middle."""
    y0, y1, x0, x1 = within
    middle = y0 + (y1 - y0 - size[0]) // 2, x0 + (x1 - x0 - size[1]) // 2
    if place is None or not place[y0:y1, x0:x1].any():
        return middle
    ys, xs = (
        np.unique(np.linspace(first, last - length, 64).astype(np.int64))
        for first, last, length in ((y0, y1, size[0]), (x0, x1, size[1]))
    )
    inside = box_sums(cumulative(place.astype(np.float64)), (1, 1), (ys, ys + size[0]), (xs, xs + size[1]))
    both = np.minimum(inside, size[0] * size[1] - inside)
    # of windows that hold as much of it the one nearest to the middle
    away = np.abs(ys - middle[0])[:, None] + np.abs(xs - middle[1])[None, :]
    row, column = np.unravel_index(int(np.argmax(both - 1e-6 * away)), both.shape)
    return int(ys[row]), int(xs[column])


def read_window(source: FrameSource, window: Window) -> NDArray[np.unsignedinteger]:
    """Return the frames of a window, (frame, y, x), DN."""
    (y0, y1), (x0, x1) = window.rows, window.columns
    stack = np.empty((window.numbers.size, y1 - y0, x1 - x0), source.dtype)
    # not more at once than a few dozen megabytes, whatever the width of the sensor
    step = max(1, (1 << 23) // ((y1 - y0) * source.shape[2]))
    done = 0
    for block in frame_blocks(source, window.numbers, window.rows, step):
        stack[done : done + block.shape[0]] = block[:, :, x0:x1]
        done += block.shape[0]
    return stack


def frame_blocks(
    source: FrameSource, numbers: IntArray, rows: tuple[int, int], size: int
) -> Iterator[NDArray[np.unsignedinteger]]:
    """Yield at most ``size`` successive frames of some rows at a time, (frame, y, x), DN.

    The numbers of the frames are increasing; rows are given by the first and the end.
    """
    for part in np.split(np.arange(numbers.size), np.flatnonzero(np.diff(numbers) != 1) + 1):
        frames = int(numbers[part[0]]), int(numbers[part[-1]]) + 1
        with FrameStream(source, [rows], size, frames=frames) as stream:
            for _, (block,) in stream:
                yield block


def fewer_samples(
    source: FrameSource,
    settings: DiscrepancySettings,
    roi: Sequence[int] | None,
    seen: Survey,
    model: Sequence[Effect],
) -> DiscrepancySettings:
    """Return the settings with as few samples to be compared as show the disagreement beyond any doubt.

    Those of ``clear_samples``, or twice as many, and so on; and fewer replicates.
    """
    if model:  # only a simulation tells what disagrees with effects
        return settings
    most = choose_window(source.shape, settings, roi, seen).share(source.shape)
    samples = settings.clear_samples
    while samples < settings.max_samples:
        few = settings.model_copy(update={"max_samples": samples})
        window = choose_window(source.shape, few, roi, seen)
        if window.share(source.shape) >= most:
            break
        length = block_length(window.numbers.size, settings.block_frames)
        frames = read_window(source, window)
        if is_clear(frames, window.times, n_run=source.shape[0], block_frames=length):
            lower = {  # enough where much is wrong
                "replicates": min(settings.replicates, 24),
                "extended_replicates": min(settings.extended_replicates, 12),
            }
            return few.model_copy(update=lower)
        samples *= 2
    return settings


def is_clear(
    frames: NDArray[np.unsignedinteger], numbers: IntArray, *, n_run: int, block_frames: int
) -> bool:
    """Return whether frames disagree with the plain model beyond any doubt, without simulating it.

    Arguments as of :func:`~pchem_pipeline.discrepancy.observe.observe.observe`.
    """
    try:
        evidence = observe(frames, numbers, n_run=n_run, block_frames=block_frames)
    except PchEmError:  # those who compare the frames say what is wrong with them
        return False
    z = np.abs(np.array(list(evidence.z.values())))
    if evidence.ambiguous > 0.1:  # of the pixels, whose bias may be off by an electron
        z = z[free_of_parameters(tuple(evidence.z), evidence.maps)]
    return bool(z.max(initial=0.0) > _CLEAR)
