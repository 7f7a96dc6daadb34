"""Which samples, shapes and arrays of a container can be frames: one set of refusals for all formats."""

from __future__ import annotations

import bz2
import lzma
import math
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.base.wording import first_few
from pchem_pipeline.frames.settings import InputSettings

#: rows or columns, above which a header is damaged; it keeps a row of frames in memory
_MOST_PIXELS = 1 << 20
#: a file of coded frames, and a coded piece of it, that may hold much in little
_MOST_CODED, MOST_PIECE, _MOST_RATIO = 1 << 30, 1 << 28, 10_000
#: of the largest and of the smallest coded pieces, as many as are unpacked to see how much they hold
_FEW_PIECES = 32
#: where coded bytes say how many they hold: first byte, end, order (lz4 and bitshuffle as filters of HDF5)
_SIZES: dict[str, tuple[int, int, Literal["little", "big"]]] = {
    "blosc": (4, 8, "little"),
    "lz4": (0, 4, "little"),
    "lz4 in blocks": (0, 8, "big"),
}
_DECODERS: dict[str, Callable[[], Any]] = {
    "gzip": partial(zlib.decompressobj, 47),  # gzip or zlib
    "zlib": partial(zlib.decompressobj, 47),
    "bz2": bz2.BZ2Decompressor,
    "lzma": lzma.LZMADecompressor,
}
_COMPRESSING = {*_SIZES, *_DECODERS, "zstd"}


def check_samples(dtype: np.dtype[Any], settings: InputSettings) -> int | None:
    """Return what is to be added to signed samples, DN; None for unsigned ones. Refuse all others.

    Raises:
        InputError: float, complex, boolean, object, 64-bit or undeclared signed samples, or ``input.dtype``
            says otherwise.
    """
    wanted = settings.dtype
    if dtype.kind == "u" and dtype.itemsize in (1, 2, 4):
        if wanted is not None and np.dtype(wanted).itemsize != dtype.itemsize:
            raise InputError(f"has {dtype.name} samples, but input.dtype is {wanted}; correct input.dtype")
        if settings.offset is not None:
            raise InputError(f"has unsigned samples ({dtype.name}); remove input.offset (--offset)")
        return None
    if dtype.kind == "i" and dtype.itemsize in (1, 2, 4):
        unsigned, top = f"uint{8 * dtype.itemsize}", 1 << (8 * dtype.itemsize - 1)
        if wanted not in (None, unsigned) or (settings.offset or 0) > top:
            raise InputError(
                f"has {dtype.name} samples, read as {unsigned} with an offset of at most {top} DN; correct "
                "input.dtype or input.offset"
            )
        if settings.offset is not None or wanted is not None:
            return settings.offset or 0
        raise InputError(
            f"signed samples ({dtype.name}); if none is negative, set input.dtype: {unsigned} (--dtype "
            f"{unsigned}); if 0 DN is stored as -{top}, set input.offset: {top} (--offset {top})"
        )
    if dtype.kind in "fc":
        raise InputError(
            f"floating-point samples ({dtype.name}); raw integer digital numbers (uint8, uint16, uint32) are "
            "needed, before any correction or averaging"
        )
    if dtype.kind in "OV" or dtype.hasobject:
        raise InputError("objects instead of numbers; save a plain array of uint8, uint16 or uint32")
    raise InputError(f"samples of type {dtype.name}; uint8, uint16 or uint32 are needed")


def stack_shape(shape: Sequence[int], what: str) -> tuple[int, int, int]:
    """Return (frames, rows, columns) of an array; the axes before rows and columns are counted in turn.

    Raises:
        InputError: too few axes, or colours.
    """
    sizes = list(shape)
    if min(sizes, default=0) < 0 or max(sizes[-2:], default=0) > _MOST_PIXELS:
        raise InputError(f"damaged header: {what} of shape {tuple(shape)}; copy the file again")
    if len(sizes) < 2:
        raise InputError(f"{what} of shape {tuple(shape)}; needed: (frames, rows, columns)")
    n = math.prod(sizes[:-2])
    if n != 1 and sizes[-1] in (3, 4) and len(sizes) > 3:
        raise InputError(
            f"{what} of shape {tuple(shape)} looks like colour images; monochrome frames are needed"
        )
    return n, sizes[-2], sizes[-1]


def axes_notes(shape: Sequence[int]) -> tuple[str, ...]:
    """Return a remark where several axes of an array are read as frames."""
    leading = [str(size) for size in shape[:-2] if size != 1]
    if len(leading) < 2:
        return ()
    return (
        f"array of shape {tuple(shape)} read as {' x '.join(leading)} frames; if one of these axes is "
        "colours or channels, write one channel as (frames, rows, columns)",
    )


def channel_notes(channels: int, images: int) -> list[str]:
    """Say that images called channels are read as frames; refuse those that have another axis, too."""
    if channels < 2 or images < 2:
        return []
    if images > channels:
        raise InputError(
            f"its metadata describe the {images} images as {channels} channels of {images // channels}; "
            "write each channel by itself"
        )
    return [f"its metadata describe the images as {channels} channels; read as frames"]


def mosaic_note(pattern: str) -> str:
    """Return the remark on a sensor whose pixels lie behind filters of several colours."""
    return (
        f"colour mosaic ({pattern}): read as the monochrome samples of its pixels, each of which sees one "
        "colour"
    )


def check_coded(shape: tuple[int, int, int], piece: Sequence[int], itemsize: int, size: int) -> None:
    """Check that frames coded in pieces of a shape can be in ``size`` bytes, before memory is taken for them.

    Raises:
        InputError: the frames are too many for so few bytes, or a piece is far larger than they all.
    """
    total, one = math.prod(shape) * itemsize, math.prod(piece) * itemsize
    if total > max(_MOST_CODED, _MOST_RATIO * size):
        raise InputError(
            f"damaged header: {size} bytes cannot hold {shape[0]} frames of {shape[1]} x {shape[2]}; copy "
            "the file again"
        )
    if one > max(MOST_PIECE, 4 * total):
        raise InputError(
            f"damaged header: pieces of {' x '.join(map(str, piece))} samples; copy the file again"
        )


def check_unpacked_size(pieces: Iterable[bytes], expected: int, codecs: Sequence[str]) -> None:
    """Check that coded pieces hold no more than the expected bytes, before the library unpacks them whole.

    Of the codecs in use those that do not compress are ignored.

    Raises:
        InputError: one holds more, or is compressed twice.
    """
    used = [codec for codec in codecs if codec in _COMPRESSING]
    if len(used) > 1:
        raise InputError(f"compressed twice, by {' and '.join(used)}; write it again with one of them")
    for data in pieces if used else ():
        if _unpacked_size(data, used[0], expected) > expected:
            raise InputError(
                f"damaged: a piece of {len(data)} bytes unpacks to more than the {expected} of its shape; "
                "copy it again"
            )


def n_pieces(shape: Sequence[int], piece: Sequence[int]) -> int:
    """Return how many pieces of a shape make up an array."""
    return math.prod(-(-length // part) for length, part in zip(shape, piece, strict=True))


def chosen_pieces(pieces: Iterable[Any], size: Callable[[Any], int]) -> list[Any]:
    """Return the largest and the smallest coded pieces: what hides much in little is among either."""
    some = sorted(pieces, key=size)
    return some[:_FEW_PIECES] + some[_FEW_PIECES:][-_FEW_PIECES:]


def _unpacked_size(data: bytes, codec: str, most: int) -> int:
    """Return the bytes that coded data say or are found to hold, at most one more than ``most``."""
    if codec in _SIZES:
        start, end, order = _SIZES[codec]
        return int.from_bytes(data[start:end], order)
    if codec == "zstd":
        import imagecodecs  # slow to import

        try:
            return len(imagecodecs.zstd_decode(data, out=most))
        except imagecodecs.ZstdError as error:
            return most + 1 if "too small" in str(error) else 0
    found = 0
    while data and found <= most:
        unpack = _DECODERS[codec]()
        try:
            found += len(unpack.decompress(data, most + 1 - found))
        except (zlib.error, lzma.LZMAError, OSError):
            break  # reading the frames will say so
        data = unpack.unused_data
    return found


def windows(
    buffer: NDArray[Any], full: tuple[int, ...], t0: int, y0: int
) -> Iterator[tuple[NDArray[Any], tuple[slice, ...]]]:
    """Yield the parts of a buffer (frame, y, x), shaped like parts of an array, with the indices of these.

    The axes of the array before its last two are counted in turn: together they are the frames.
    """
    n, rows, columns = buffer.shape
    axes = full[:-2] or (1,)
    inner = max((axis for axis, length in enumerate(axes) if length != 1), default=0)
    image = (slice(y0, y0 + rows), slice(0, columns))
    start = 0
    while start < n:
        place = [slice(int(at), int(at) + 1) for at in np.unravel_index(t0 + start, axes)]
        first = place[inner].start
        place[inner] = slice(first, min(axes[inner], first + n - start))
        end = start + place[inner].stop - first
        index = (*place[: len(full) - 2], *image)
        yield buffer[start:end].reshape([part.stop - part.start for part in index]), index
        start = end


def choose_dataset(shapes: Mapping[str, tuple[int, ...]], wanted: str | None) -> str:
    """Return the dataset to read: the wanted one, else the only one of three axes or more, else of two.

    Raises:
        InputError: not there, or not the only one; the message lists the candidates.
    """
    stacks = [name for name, shape in shapes.items() if len(shape) >= 3]
    images = [name for name, shape in shapes.items() if len(shape) == 2]
    names = [*stacks, *images]
    listed = first_few((f"{name} {shapes[name]}" for name in names), 12)
    if wanted is not None:
        name = wanted.strip("/")
        if name in shapes:
            return name
        raise InputError(
            f"no dataset {wanted!r}, only: {listed or 'no images'}; correct input.dataset (--dataset)"
        )
    candidates = stacks or images
    if not candidates:
        raise InputError("no dataset of frames (frames, rows, columns); omit it")
    if len(candidates) > 1:
        raise InputError(f"several datasets: {listed}; choose one with input.dataset (--dataset)")
    return candidates[0]
