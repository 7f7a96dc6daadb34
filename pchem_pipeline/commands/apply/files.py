"""What ``pchem apply`` made, as files for other programs: TIFF stacks, or FITS files with SCI, ERR and DQ."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError, require
from pchem_pipeline.base.variables import Variable, variables_of
from pchem_pipeline.commands.apply.finish import FLAGS
from pchem_pipeline.frames.formats.fits_files import FitsImage, image_cards, input_cards, write_images
from pchem_pipeline.frames.formats.map_files import write_tiff_cube
from pchem_pipeline.frames.reader import FrameReader
from pchem_pipeline.frames.sequence import FrameSequence
from pchem_pipeline.store.files import write_json
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.use.electrons import stderr_at

_WHOLE = slice(None)
_AT_LIMIT = "applied/at_adc_limit"
_FRAMES = ("frame", "y", "x")
#: of the coordinates, which files do without
_AXES = tuple((axis,) for axis in _FRAMES)
#: bits of DQ: overlapping peaks concern electron numbers, whose probability is a separate image
_DQ = {name: flag for name, flag in FLAGS.items() if name != "peaks_overlap"}


def write_files(
    store: RunStore, folder: Path, kind: str, frames: FrameSequence, content: dict[str, Any]
) -> list[Path]:
    """Write the images of the group ``applied`` as files, and their provenance ``content`` as JSON.

    The kind is tiff (a file for each array) or fits (a file for each input file of ``frames``, for the
    exposure, and for each other array).

    Raises:
        StoreError: the folder cannot be written.
        MissingDependencyError: astropy is not installed.
    """
    made = [each for each in variables_of("applied") if each.dims not in _AXES and store.has(each.path)]
    if kind == "tiff":
        written = [_write_tiff(store, folder / f"{each.name}.tif", each, content) for each in made]
    else:
        written = _write_fits(store, folder, made, frames, content)
    write_json(folder / "provenance.json", content)
    return [*written, folder / "provenance.json"]


def _write_tiff(store: RunStore, path: Path, variable: Variable, content: dict[str, Any]) -> Path:
    array = store.array(variable.path)
    shape = array.shape if len(array.shape) == 3 else (1, *array.shape)
    dtype = np.dtype(array.dtype)
    if dtype == np.float64:
        dtype = np.dtype(np.float32)  # the largest that ImageJ reads
    facts = {**content, **{key: array.attrs[key] for key in ("sentences", "no_number") if key in array.attrs}}
    about = {name: getattr(variable, name) for name in ("name", "unit", "long_name")} | {"provenance": facts}
    write_tiff_cube(path, _blocks(store, variable.path), shape, dtype, about)
    return path


def _blocks(store: RunStore, name: str) -> Iterator[NDArray[Any]]:
    """Yield blocks of images."""
    array = store.array(name)
    if len(array.shape) != 3:
        yield store.read(name)[None]
        return
    depth = array.chunks[0]
    for start in range(0, array.shape[0], depth):
        yield store.read(name, (slice(start, start + depth), _WHOLE, _WHOLE))


# -- FITS ------------------------------------------------------------------------------------------


def check_names(frames: FrameSequence, folder: Path) -> None:
    """Refuse input files whose FITS files would replace them, or have one name, or that of a map.

    Raises:
        InputError: there are such files.
        MissingDependencyError: FITS files cannot be written here.
    """
    require("astropy.io.fits", "fits", "FITS files")
    maps = (each.name for each in variables_of("applied") if each.dims not in (*_AXES, _FRAMES))
    seen = dict.fromkeys(maps, "a map")
    for reader, _, _ in _files(frames):
        path, name = reader.paths[0], _name(reader)
        if Path(str(path)).resolve() == (folder / f"{name}.fits").resolve():
            seen[name] = "the file itself"
        if name in seen:
            raise InputError(
                f"{path}: its calibrated frames would have the name of {seen[name]}, {name}.fits; give the "
                "file another name, or another command and --output"
            )
        seen[name] = f"those of {path}"


def _name(reader: FrameReader) -> str:
    return reader.paths[0].stem.removesuffix(".fits")  # .fits.fz


def _files(frames: FrameSequence) -> Iterator[tuple[FrameReader, int, int]]:
    """Yield each input file with the first and the end of its frames."""
    for reader, first, end, before in frames.pieces(0, frames.shape[0]):
        yield reader, before, before + end - first


def _write_fits(
    store: RunStore, folder: Path, made: Sequence[Variable], frames: FrameSequence, content: dict[str, Any]
) -> list[Path]:
    """Write a file for each input file, for the exposure, and for each other map."""
    made_of = _provenance(content)
    written: list[Path] = []

    def write(name: str, images: Sequence[FitsImage], cards: Iterable[Any] = ()) -> None:
        first, *others = images
        written.append(folder / f"{name}.fits")
        write_images(written[-1], [first._replace(cards=[*cards, *first.cards, *made_of]), *others])

    stacks = [each for each in made if each.dims == _FRAMES and each.path != _AT_LIMIT]
    maps = {each.name: each for each in made if each.dims != _FRAMES}
    quality = store.read("applied/quality") & np.uint32(sum(bit for bit, _ in _DQ.values()))
    if stacks:
        images_of = _stack_images(store, stacks, quality)
        for reader, start, end in _files(frames):
            cards = input_cards(frames, [reader], reader.camera, reader.integration_time)
            write(_name(reader), images_of(start, end), cards)
    if "exposure" in maps:
        readers = [reader for reader, _, _ in _files(frames)]
        cards = input_cards(frames, readers, frames.camera, frames.stated_integration_time)
        parts = (("exposure", "SCI"), ("exposure_stderr", "ERR"))
        images = [_map(store, maps.pop(name), part) for name, part in parts]
        write("exposure", [*images, _quality([quality], quality.shape)], cards)
    for name, each in maps.items():
        write(name, [_map(store, each)])
    return written


def _stack_images(
    store: RunStore, stacks: Sequence[Variable], quality: NDArray[np.uint32]
) -> Callable[[int, int], list[FitsImage]]:
    """Return a function that makes the images of frames ``start:end``: SCI, ERR, DQ, and the other arrays."""
    path = stacks[0].path
    depth = store.array(path).chunks[0]
    with_errors = stacks[0].name == "electrons"
    if with_errors:
        read = store.read("applied/electrons_stderr_read")
        variance = store.read("applied/calibration_variance")

    @functools.lru_cache(len(stacks) + 1)  # files of few frames share a block
    def block(path: str, number: int) -> NDArray[Any]:
        return store.read(path, (slice(number * depth, (number + 1) * depth), _WHOLE, _WHOLE))

    def blocks(path: str, start: int, end: int) -> Iterator[NDArray[Any]]:
        for number in range(start // depth, -(-end // depth)):
            before = number * depth
            yield block(path, number)[max(start - before, 0) : end - before]

    def images_of(start: int, end: int) -> list[FitsImage]:
        shape = quality.shape if end - start == 1 else (end - start, *quality.shape)
        sci, *others = (
            _image(store, each, blocks(each.path, start, end), shape, "SCI" * (each is stacks[0]))
            for each in stacks
        )
        images = [sci]
        if with_errors:
            frames = (frame for block in blocks(path, start, end) for frame in block)
            errors = (np.hypot(read, stderr_at(variance, frame)) for frame in frames)
            cards = image_cards("ERR", "e-", "1 sigma error of sample and calibration, without shot noise")
            images.append(FitsImage(errors, shape, np.dtype(np.float32), cards))
        marks: Iterable[NDArray[np.uint32]] = itertools.repeat(quality, end - start)
        if store.has(_AT_LIMIT):
            bit = np.uint32(_DQ["at_adc_limit"][0])
            at_limit = (frame for block in blocks(_AT_LIMIT, start, end) for frame in block)
            marks = ((quality & ~bit) | bit * frame for frame in at_limit)
        return [*images, _quality(marks, shape), *others]

    return images_of


def _quality(frames: Iterable[NDArray[np.uint32]], shape: tuple[int, ...]) -> FitsImage:
    """Return the quality of frames."""
    cards = [*image_cards("DQ", "1", "why a pixel has no value or needs caution; 0: good"), *_bits(_DQ)]
    return FitsImage(frames, shape, np.dtype(np.uint32), cards)


def _map(store: RunStore, variable: Variable, name: str = "") -> FitsImage:
    return _image(store, variable, _blocks(store, variable.path), store.array(variable.path).shape, name)


def _image(
    store: RunStore,
    variable: Variable,
    blocks: Iterator[NDArray[Any]],
    shape: tuple[int, ...],
    name: str = "",
) -> FitsImage:
    array = store.array(variable.path)
    cards: list[Any] = [*image_cards(name or variable.name, variable.unit, variable.long_name)]
    if "no_number" in array.attrs:
        cards.append(("NONUMBER", array.attrs["no_number"], "pixels without a number"))
    if variable.name == "quality":
        cards += _bits(FLAGS)
    return FitsImage(blocks, shape, np.dtype(array.dtype), cards)


def _bits(flags: Mapping[str, tuple[int, str]]) -> list[tuple[str, str]]:
    """Return the cards that name the bits of a quality."""
    known = sorted((bit.bit_length() - 1, name, text) for name, (bit, text) in flags.items())
    named = [(f"DQBIT{number}", name) for number, name, _ in known]
    return [*named, *(("COMMENT", f"{name}: {text}") for _, name, text in known)]


def _provenance(content: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the provenance as cards; long texts continue in further cards."""
    names = {"PCHEMVER": "program", "PCHEMRUN": "run", "PCHEMSHA": "run_digest", "PCHEMMOD": "model"}
    found = {card: str(content[name]).encode("ascii", "replace").decode() for card, name in names.items()}
    return [*found.items(), ("HISTORY", "pchem apply: DN to physical units by the calibration of PCHEMRUN")]
