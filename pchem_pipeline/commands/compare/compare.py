"""``pchem compare``: what differs between runs, value by value and in standard errors."""

from __future__ import annotations

import hashlib
import string
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.errors import ChangedError, ConfigError
from pchem_pipeline.base.variables import CHARGE_RATES, PARAMETERS, VARIABLES
from pchem_pipeline.commands.compare.history import PixelStates, history_csv, history_rows
from pchem_pipeline.commands.compare.settings import settings_that_differ, versions_that_differ
from pchem_pipeline.commands.figures import warn_if_old
from pchem_pipeline.model.checks.run_differences import (
    BlockDifference,
    CommonFit,
    common_fit_p,
    compare_blocks,
    compare_maps,
    reasons_of_change,
)
from pchem_pipeline.model.maps.maps import CAUTION, GOOD, NO_VALUE
from pchem_pipeline.report.comparison import ArrayRow, Comparison, Pair, RunFacts, by_change
from pchem_pipeline.report.pages.compare import (
    COMPARE_JSON,
    COMPARE_PAGE,
    render_comparison,
    sentence_of,
)
from pchem_pipeline.report.style.wording import count, measured, p_value_text, short, signed, symbol
from pchem_pipeline.run.progress import ProgressMode, Reporter
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.target import Target, find_run, with_maps
from pchem_pipeline.stages.report.report import draw_and_say
from pchem_pipeline.store.files import write_atomic
from pchem_pipeline.store.run_store import RunStore

#: The maps that are compared.
MAPS = (*PARAMETERS, "read_noise_e", "analog_read_noise_e", *CHARGE_RATES)

_ENSEMBLE = (
    "dn",
    "counts",
    "density",
    "epcd_exact",
    "electrons",
    "nuced_counts",
    "nuced_density",
    "nuced_exact",
)


def compare_runs(
    paths: Sequence[Path],
    folder: Path,
    *,
    tolerance: float = 1e-12,
    labels: Sequence[str] = (),
    rate: float = 0.01,
    progress: ProgressMode = "auto",
) -> list[Path]:
    """Compare runs with the first of them and write ``compare.html``, ``compare.json`` and ``history.csv``.

    Args:
        paths: stores, or the YAML files that made them; two or more.
        folder: where to write; made if needed.
        tolerance: relative difference that counts as rounding, where the frames are the same.
        labels: of the runs, in their order, such as setpoints, which the history draws them against by the
            numbers that these begin with; none: the dates.
        rate: false-discovery rate at which a pixel counts as moved since the first run.
        progress: auto | on | off.

    Returns:
        The files written, where nothing changed.

    Raises:
        ChangedError: something changed; the files are written all the same.
        ConfigError: fewer than two runs.
        StoreError: a run has no maps, or the folder cannot be written.
    """
    reporter = Reporter(progress)
    found = comparison_of(paths, tolerance, reporter, labels, rate)
    page, numbers = render_comparison(found, draw_and_say(reporter, "figures"))
    files = {COMPARE_PAGE: page, COMPARE_JSON: numbers, "history.csv": history_csv(found.history)}
    for name, text in files.items():
        write_atomic(folder / name, text.encode())
    if found.changed:
        raise ChangedError(f"{sentence_of(found)} See {folder / COMPARE_PAGE}")
    reporter.info(sentence_of(found))
    return [folder / name for name in files]


def comparison_of(
    paths: Sequence[Path],
    tolerance: float,
    reporter: Reporter,
    labels: Sequence[str] = (),
    rate: float = 0.01,
) -> Comparison:
    """Return how the runs differ from the first of them; see :func:`compare_runs`."""
    if len(paths) < 2:
        raise ConfigError("compare: give two runs or more")
    if not 0 <= tolerance < 1:
        raise ConfigError(f"--tolerance {tolerance:g}: give a relative difference from 0 to below 1")
    if not 0.0 < rate < 1.0:
        raise ConfigError(f"--fdr {rate:g}: give a rate between 0 and 1, such as 0.01")
    targets = [find_run(path) for path in paths]
    stores = [with_maps(target.stored()) for target in targets]
    for target, store in zip(targets, stores, strict=True):
        warn_if_old(target, ("fit", "maps", "ensemble"), f"{store.path} is compared in its present state")
    names = _told_apart([store.path for store in stores])
    states = [PixelStates.of(store, target.config) for store, target in zip(stores, targets, strict=True)]
    runs = list(map(_facts, _letters(len(names)), names, stores, states))
    sides = list(zip(runs, targets, stores, states, strict=True))
    pairs = [_pair(sides[0], side, tolerance, rate, reporter) for side in sides[1:]]
    rows = history_rows(runs, stores, pairs, labels, states)
    return Comparison(runs, pairs, tolerance, rows, bool(labels), rate)


def _letters(n: int) -> list[str]:
    """Return n labels: A to Z, then AA to AZ and so on."""
    singles = string.ascii_uppercase
    return [(singles[i // 26 - 1] if i >= 26 else "") + singles[i % 26] for i in range(n)]


_Side = tuple[RunFacts, Target, RunStore, PixelStates]


def _told_apart(paths: Sequence[Path]) -> list[str]:
    """Return the names of the stores, with as many of their folders as tell them apart."""
    parts = [path.resolve().parts for path in paths]
    for depth in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [path.name for path in paths]


def _facts(label: str, name: str, store: RunStore, states: PixelStates) -> RunFacts:
    sensor = SensorInfo.read(store)
    good, caution, none = (int((states.quality == grade).sum()) for grade in (GOOD, CAUTION, NO_VALUE))
    return RunFacts(
        label,
        name,
        sensor.shape,
        sensor.n_frames if sensor.kind == "frames" else None,
        _data_digest(store, sensor),
        {each: _median(content) for each, content in store.attributes("maps").get("summary", {}).items()},
        {each: store.read(f"ensemble/{each}") for each in _ENSEMBLE if store.has(f"ensemble/{each}")},
        dict(store.attributes("ensemble").get("rmse", {})),
        (good, caution, none),
    )


def _median(content: dict[str, Any]) -> tuple[float, float, float]:
    """Return the median of a map, its standard error and the scatter of the pixels; NaN where unknown."""
    median, error, scatter = (
        float("nan") if content[key] is None else float(content[key])
        for key in ("median", "median_stderr", "robust_sd")
    )
    return median, error, scatter


def _data_digest(store: RunStore, sensor: SensorInfo) -> str:
    """Return what tells the frames of a run: content of the files, and what was taken of them."""
    record = store.records.read("ingest")
    settings = {} if record is None else record.content.get("settings", {})
    taken = [settings.get(f"input.{name}") for name in ("dataset", "roi", "frame_range", "bit_shift")]
    return f"{sensor.identity.get('digest', '')} {taken} {sensor.n_frames} {sensor.shape}"


def _pair(first: _Side, second: _Side, tolerance: float, rate: float, reporter: Reporter) -> Pair:
    (one, one_target, one_store, before), (other, other_target, other_store, now) = first, second
    same_data = one.digest == other.digest
    confirm = None if same_data else _common_fit((one_target, one_store), (other_target, other_store))
    maps: dict[str, Any] = {}
    transitions: list[list[int]] = []
    if one.shape == other.shape:
        grades = before.quality.ravel(), now.quality.ravel()
        transitions = np.histogram2d(*grades, bins=np.arange(4) - 0.5)[0].astype(int).tolist()
        good = (before.quality == GOOD) & (now.quality == GOOD)
        in_both = (name for name in MAPS if one_store.has(f"maps/{name}") and other_store.has(f"maps/{name}"))
        read = ((name, _value(one_store, name), _value(other_store, name)) for name in in_both)
        maps = compare_maps(read, good, same_data=same_data, rate=rate, confirm=confirm)
    arrays = _compared_arrays(one_store, other_store, tolerance, reporter) if same_data else []
    reasons = {} if same_data else {name: reasons_of_change(found) for name, found in maps.items()}
    words = _words(one, other, arrays, maps, reasons)
    defects = now.changes_since(before, confirm)
    if defects:
        counts = (f"{len(each):,} {change}" for change, each in by_change(defects).items() if each)
        words.append(f"Defects: {', '.join(counts)}.")
    return Pair(
        one, other, same_data, arrays, maps, reasons, transitions,
        settings_that_differ(one_target.config, other_target.config),
        versions_that_differ(one_store, other_store),
        bool(words), words, defects,
    )  # fmt: skip


def _common_fit(*runs: tuple[Target, RunStore]) -> CommonFit | None:
    """Return the test whether pixels of two runs are the same; None for fits of several exposures."""
    stores = [store for _, store in runs]
    sensors = [target.sensor(store) for target, store in runs]
    if any(sensor.samples or sensor.adc_limits != sensors[0].adc_limits for sensor in sensors):
        return None
    names = ("histogram/counts", "histogram/origin")
    return lambda y, x: common_fit_p(
        sensors[0].adc_limits, *([store.read_pixels(name, y, x) for store in stores] for name in names)
    )


def _value(store: RunStore, name: str) -> tuple[FloatArray, FloatArray]:
    """Return a map and its standard errors."""
    return store.read(f"maps/{name}"), store.read(f"maps/{name}_stderr")


def _words(
    one: RunFacts, other: RunFacts, arrays: Sequence[ArrayRow], maps: dict[str, Any], reasons: dict[str, Any]
) -> list[str]:
    """Say what changed, one sentence each; nothing where nothing did."""
    found = []
    if one.shape != other.shape:
        sizes = " and ".join(f"{ny} x {nx}" for ny, nx in (one.shape, other.shape))
        found.append(f"Different sensors: {sizes} pixels.")
    counted = [row for row in arrays if row.counts and row.state in ("changed", "lost")]
    found += [f"{row.name}: {_array_words(row)}." for row in counted]
    for name, why in reasons.items():
        text = []
        if why.shifted:
            each = maps[name]
            median = measured(each.median, each.median_stderr, symbol(name)[2])
            text.append(f"median changed by {median} ({signed(each.median_z)} sigma of one pixel)")
        if why.spread:
            text.append(f"scatter {short(maps[name].spread_z, 2)} sigma")
        if why.pixels:
            text.append(
                f"{count(maps[name].n_changed, 'pixel')} changed, {p_value_text(maps[name].p_value)} "
                "over all pixels and maps"
            )
        if text:
            sign = f"{symbol(name)[1]}{' (DN)' if name == 'read_noise_dn' else ''}"
            found.append(f"{sign[0].upper()}{sign[1:]}: {', '.join(text)}.")
    return found


def _array_words(row: ArrayRow) -> str:
    if row.state == "lost":
        return "missing"
    if row.why:
        return row.why
    share = f"{count(row.n_beyond, 'value')} of {row.n_values:,} changed"
    return f"{share}, by up to {short(row.largest)}"


# -- arrays, value by value ------------------------------------------------------------------------


def _compared_arrays(one: RunStore, other: RunStore, tolerance: float, reporter: Reporter) -> list[ArrayRow]:
    """Compare all arrays that either store has.

    Args:
        one: a run.
        other: a run on the same frames.
        tolerance: difference that counts as rounding, relative to the largest value of an array.
        reporter: hears of each array.

    Returns:
        A row for each array, in the order of the registry.
    """
    # frames have the same digest, electrons follow from them and the maps, sums depend on the tiling
    left_out = ("frames", "electrons", "ensemble_tiles")
    names = [
        name
        for name, variable in VARIABLES.items()
        if variable.group not in left_out and (one.has(name) or other.has(name))
    ]
    rows = []
    with reporter.progress("compare", len(names), "array") as advance:
        for name in names:
            rows.append(_row(name, one, other, tolerance))
            advance()
    return rows


def _row(name: str, one: RunStore, other: RunStore, tolerance: float) -> ArrayRow:
    counts = name != "fit/n_iterations"  # of a computation, no result
    here = one if one.has(name) else other
    array = here.array(name)
    dtype, shape = str(array.dtype), tuple(array.shape)
    if not (one.has(name) and other.has(name)):
        state: Any = "lost" if here is one else "new"
        return ArrayRow(name, state, counts, dtype, shape)
    if shape != tuple(other.array(name).shape):
        why = f"shape {shape} before, {tuple(other.array(name).shape)} now"
        return ArrayRow(name, "changed", counts, dtype, shape, why=why)
    digests, scales = zip(*(_digest(store, name) for store in (one, other)), strict=True)
    n_values = int(np.prod(shape))
    if digests[0] == digests[1] and str(other.array(name).dtype) == dtype:
        return ArrayRow(name, "identical", counts, dtype, shape, n_values, scale=scales[0], sha256=digests)
    scale = max(scales)
    found = BlockDifference(0, 0, 0, 0.0)
    for a, b in zip(_blocks(one, name), _blocks(other, name), strict=True):
        found += compare_blocks(a, b, scale=scale, tolerance=tolerance)
    return ArrayRow(
        name, "changed" if found.n_beyond else "equal", counts, dtype, shape, found.n_values,
        found.n_different, found.n_beyond, found.largest, scale, digests,
    )  # fmt: skip


def _digest(store: RunStore, name: str) -> tuple[str, float]:
    """Return the SHA-256 of an array's values in C order, and their largest absolute value."""
    digest, scale = hashlib.sha256(), 0.0
    for block in _blocks(store, name):
        digest.update(np.ascontiguousarray(block).data)
        if block.size:
            size = np.abs(block.astype(np.float64, copy=False))
            scale = max(scale, float(np.max(size, initial=0.0, where=np.isfinite(size))))
    return digest.hexdigest(), scale


def _blocks(store: RunStore, name: str) -> Iterator[NDArray[Any]]:
    """Read an array in blocks along its first axis, the same ones for every store."""
    array = store.array(name)
    shape = tuple(array.shape)
    if not shape:
        yield store.read(name)
        return
    row_bytes = max(1, int(np.prod(shape[1:])) * array.dtype.itemsize)
    chunk = int(array.chunks[0])
    rows = max(1, (1 << 25) // row_bytes)
    rows = max(rows // chunk, 1) * chunk if chunk <= 4 * rows else rows
    for start in range(0, shape[0], rows):
        yield store.read(name, (slice(start, min(start + rows, shape[0])),))
