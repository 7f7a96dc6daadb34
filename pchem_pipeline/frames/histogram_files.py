"""Ready-made histograms: many laboratories keep only those.

A file holds digital numbers and counts: CSV (two columns ``DN, count`` or ``Energy, Count``; more count
columns are more channels; a header line is optional), npy (two columns, or channels x bins with bin 0 at DN
0), or npz (``dn`` and ``counts``). Each channel becomes a pixel of a sensor of one row.
"""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import IntArray
from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.formats.kinds import MOST_PIECE
from pchem_pipeline.frames.inspect import FileReport, InputReport, mark_repeated_paths
from pchem_pipeline.frames.resolve import HISTOGRAM_SUFFIXES, resolve_files
from pchem_pipeline.frames.settings import InputSettings

#: more bins than any ADC of interest has codes; a wider span is a mistake in the file
_MOST_BINS = 1 << 24
_MOST_BINS_OF_ALL = 1 << 27


@dataclass(frozen=True)
class HistogramInput:
    """Histograms of all channels on one common axis.

    Attributes:
        counts: events per bin, (1, channels, bins), uint32, or uint64 where a count needs it.
        origin: DN of bin 0 of each channel, (1, channels), int32.
        names: name of each channel: the file's stem, with the column's name if a file has several.
        paths: the files, in reading order.
        notes: remarks, such as gaps that were filled with zeros.
    """

    counts: NDArray[np.unsignedinteger[Any]]
    origin: NDArray[np.int32]
    names: tuple[str, ...]
    paths: tuple[Path, ...]
    notes: tuple[str, ...]


class _Channel(NamedTuple):
    """One histogram with its leading and trailing zeros cut off."""

    name: str
    origin: int
    counts: IntArray
    notes: list[str]


def is_histogram_input(settings: InputSettings, base_dir: Path) -> bool:
    """Return whether the input is ready-made histograms: by ``input.format``, or CSV and npz with auto.

    Raises:
        InputError: a path is missing, or frames and histograms are mixed.
    """
    if settings.format != "auto":
        return settings.format == "histogram"
    names = [Path(entry) for entry in settings.files]
    if any((base_dir / name).is_dir() for name in names):
        return False
    kinds = {path.suffix.lower() in (".csv", ".npz") for path in resolve_files(settings, base_dir)}
    if len(kinds) > 1:
        raise InputError(
            "input.files: camera files and ready-made histograms are mixed; make one run of each"
        )
    return kinds == {True}


def read_histograms(settings: InputSettings, base_dir: Path) -> HistogramInput:
    """Read all histograms of ``input.files`` onto axes of equal length.

    Raises:
        InputError: files that cannot be read, or that are no histograms, all in one message.
    """
    report = InputReport([FileReport(path) for path in resolve_files(settings, base_dir)])
    mark_repeated_paths(report.files)
    channels: list[_Channel] = []
    for entry in report.good:
        try:
            channels += _read(entry.path)
        except InputError as error:
            entry.problem = str(error)
    report.raise_if_refused(settings.on_bad_file)
    paths = tuple(entry.path for entry in report.good)
    bins = max(channel.counts.size for channel in channels)
    if bins * len(channels) > _MOST_BINS_OF_ALL:
        raise InputError(
            f"{paths[0]} and others: {len(channels)} channels of {bins} bins, too many; give fewer"
        )
    largest = max(int(channel.counts.max()) for channel in channels)
    counts = np.zeros((1, len(channels), bins), np.uint32 if largest < 1 << 32 else np.uint64)
    for i, channel in enumerate(channels):
        counts[0, i, : channel.counts.size] = channel.counts
    origin = np.asarray([[channel.origin for channel in channels]], np.int32)
    left_out = [report.message()] if report.bad else []
    notes = (*left_out, *(note for channel in channels for note in channel.notes))
    return HistogramInput(counts, origin, tuple(channel.name for channel in channels), paths, notes)


def _read(path: Path) -> list[_Channel]:
    """Read the channels of one file."""
    suffix = path.suffix.lower()
    if suffix not in HISTOGRAM_SUFFIXES:
        raise InputError("give histograms as .csv, .txt, .npy or .npz")
    read = _read_numpy if suffix in (".npy", ".npz") else _read_text
    try:
        dn, columns, names = read(path)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror or error}); check the file") from error
    except csv.Error as error:
        raise InputError(f"no table of numbers ({error}); histograms have columns DN, count") from error
    channels: list[_Channel] = []
    for name, column in zip(names, columns, strict=True):
        several = len(names) > 1
        try:
            channels.append(_channel(path, f"{path.stem}:{name}" if several else path.stem, dn, column))
        except InputError as error:
            raise InputError(f"channel {name}: {error}" if several else str(error)) from error
        if max(each.counts.size for each in channels) * len(channels) > _MOST_BINS_OF_ALL:
            raise InputError(
                f"its channels span more than {_MOST_BINS_OF_ALL} DN in total; correct the DN column, or "
                "give fewer channels"
            )
    return channels


def _read_numpy(path: Path) -> tuple[NDArray[Any], list[NDArray[Any]], list[str]]:
    """Read npy or npz: DN, the counts of each channel, and names of the channels."""
    split = _split_npz if path.suffix.lower() == ".npz" else _split_npy
    try:
        with path.open("rb") as stream:
            dn, table = split(path, np.load(stream, allow_pickle=False))
    except (ValueError, EOFError, KeyError) as error:
        raise InputError(
            f"not a valid {path.suffix[1:]} file of plain numbers (pickles are never opened); save it again"
        ) from error
    except (OSError, InputError):
        raise
    except Exception as error:  # a damaged zip archive raises its own kind
        raise InputError(f"damaged ({error}); copy it again") from error
    if dn.ndim != 1 or table.ndim != 2 or table.shape[1] != dn.size:
        raise InputError(
            f"shapes dn {dn.shape} and counts {table.shape} do not match; counts is (channels, bins)"
        )
    return dn, list(table), [str(i) for i in range(len(table))]


def _split_npz(path: Path, archive: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return DN and counts (channels, bins) of an archive of named arrays."""
    held = set(getattr(archive, "files", ()))
    if not {"dn", "counts"} <= held:
        listed = ", ".join(sorted(held)) or "nothing"
        raise InputError(f"needs arrays dn and counts, has {listed}; save it with these names")
    unpacked = sum(part.file_size for part in archive.zip.infolist())
    if unpacked > max(MOST_PIECE, 100 * path.stat().st_size):
        raise InputError(f"{unpacked} bytes unpacked, too large for histograms; save it again")
    return archive["dn"], np.atleast_2d(archive["counts"])


def _split_npy(path: Path, array: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Tell two columns (DN, count) from channels x bins."""
    if array.ndim == 1:
        return np.arange(array.size), array[None]
    if array.ndim != 2:
        raise InputError(f"an array of shape {array.shape}; histograms are (bins, 2) or (channels, bins)")
    if array.shape[1] == 2:
        return array[:, 0], array[None, :, 1]
    return np.arange(array.shape[1]), array


def _read_text(path: Path) -> tuple[NDArray[Any], list[NDArray[Any]], list[str]]:
    """Read CSV, or columns parted by semicolons, tabs or blanks: DN, counts of each channel, their names."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError("not a text file; histograms as CSV have columns DN, count") from error
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        raise InputError("no histogram; omit it")
    mark = next((sign for sign in (",", ";", "\t") if sign in lines[0]), " ")
    rows = [
        [cell.strip() for cell in row]
        for row in csv.reader(io.StringIO("\n".join(lines)), delimiter=mark, skipinitialspace=True)
    ]
    rows = [row[:-1] if len(row) > 2 and not row[-1] else row for row in rows]  # a comma at the end of lines
    header = None if _is_number(rows[0][0]) else rows.pop(0)
    width = len(header or rows[0])
    if width < 2:
        raise InputError("needs two or more columns, DN and count")
    for number, row in enumerate(rows, 1 + (header is not None)):
        if len(row) != width or not all(_is_number(cell) for cell in row):
            raise InputError(f"row {number} ({mark.join(row)[:40]}) is not {width} numbers; correct it")
    table = np.fromiter((float(cell) for row in rows for cell in row), np.float64).reshape(-1, width)
    names = [name or str(i) for i, name in enumerate((header or [""] * width)[1:])]
    return table[:, 0], list(table[:, 1:].T), names


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text


def _channel(path: Path, name: str, dn: NDArray[Any], counts: NDArray[Any]) -> _Channel:
    """Check one histogram, and put it on an axis without gaps and empty ends."""
    axis = _integers("DN", dn)
    values = _integers("count", counts)
    if axis.size == 0:
        raise InputError("no bins; omit it")
    if (values < 0).any():
        raise InputError(f"negative counts (first at DN {axis[values < 0][0]}); counts are 0 or more")
    steps = np.diff(axis)
    if (steps == 0).any():
        raise InputError(f"DN {axis[:-1][steps == 0][0]} occurs twice; add up its counts")
    if (steps < 0).any():
        raise InputError(f"DN not in increasing order (at DN {axis[1:][steps < 0][0]}); sort them")
    if not values.any():
        raise InputError("all counts are zero; omit it")
    first, last = np.flatnonzero(values)[[0, -1]]
    low, high = int(axis[first]), int(axis[last])
    if high - low >= _MOST_BINS or not -(2**31) <= low <= high < 2**31:
        raise InputError(f"DN from {low} to {high}, more than any ADC; correct the DN column")
    full = np.zeros(high - low + 1, np.int64)
    full[axis[first : last + 1] - low] = values[first : last + 1]
    missing = full.size - (last - first + 1)
    notes = [f"{path.name}: {missing} unlisted DN between {low} and {high} are taken as 0"] if missing else []
    return _Channel(name, low, full, notes)


def _integers(what: str, values: NDArray[Any]) -> IntArray:
    """Return values as integers; refuse NaN, fractions and other types."""
    array = np.asarray(values)
    if array.dtype.kind not in "iuf":
        raise InputError(f"{what} column of type {array.dtype}; numbers are needed")
    if array.dtype.kind == "f":
        if not np.isfinite(array).all():
            raise InputError(f"{what} column has NaN or infinity; correct it")
        broken = array != np.rint(array)
        if broken.any():
            raise InputError(f"{what} {array[broken][0]} is not a whole number; give raw DN and raw counts")
        if (np.abs(array) >= 2.0**53).any():
            raise InputError(f"{what} column has numbers too large to be exact; correct it")
    elif array.size and int(array.max()) > np.iinfo(np.int64).max:
        raise InputError(f"{what} column has numbers above 2**63; correct it")
    return array.astype(np.int64)
