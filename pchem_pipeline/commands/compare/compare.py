"""``pchem compare``: what differs between runs, value by value and in standard errors."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from string import ascii_uppercase
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.errors import ChangedError, ConfigError, StoreError
from pchem_pipeline.base.variables import MEASURED_MAPS, VARIABLES
from pchem_pipeline.base.wording import count, first_few, measured, p_value_text, short, symbol
from pchem_pipeline.commands.compare.history import (
    HISTORY,
    PixelStates,
    append_history,
    history_row,
    identity_of,
    read_history,
)
from pchem_pipeline.commands.compare.settings import settings_that_differ, versions_that_differ
from pchem_pipeline.commands.figures import warn_if_old
from pchem_pipeline.model.checks.run_differences import (
    BlockDifference,
    CommonFit,
    MapDifference,
    Reasons,
    common_fit_p,
    compare_blocks,
    compare_maps,
    reasons_of_change,
)
from pchem_pipeline.model.checks.settings import allowed
from pchem_pipeline.model.fit.status import FitStatus
from pchem_pipeline.model.maps.maps import CAUTION, GOOD, NO_VALUE
from pchem_pipeline.report.comparison import ArrayRow, Comparison, HistoryRow, Pair, RunFacts, by_change
from pchem_pipeline.report.pages.compare import COMPARE_JSON, COMPARE_PAGE, lines_of, render_comparison
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.stage import Command
from pchem_pipeline.run.target import Target, find_run, with_maps
from pchem_pipeline.stages.report.report import draw_and_say
from pchem_pipeline.store.files import write_atomic
from pchem_pipeline.store.remote_path import place_of
from pchem_pipeline.store.run_store import RunStore

_NUCED = ("electrons", "nuced_counts", "nuced_density", "nuced_exact")
_ENSEMBLE = ("dn", "counts", "density", "epcd_exact", *_NUCED)


def compare_runs(
    paths: Sequence[Path],
    folder: Path,
    command: Command,
    *,
    tolerance: float = 1e-12,
    labels: Sequence[str] = (),
    rate: float = 0.01,
    limits: Sequence[str] = (),
    write: Callable[[str], None] = print,
) -> None:
    """Compare runs with the first of them, and the last with the one before it in the history.

    Writes ``compare.html`` and ``compare.json`` to the folder, and adds a line to ``history.csv`` for each
    new run. Relative differences up to ``tolerance`` count as rounding where the frames are the same; of
    others, pixels count as changed at the false-discovery rate ``rate``. Numbers with which ``labels`` begin
    are the axis of the history; without labels it is the date. ``limits`` are ``name=value`` of the section
    ``compare``, in place of those of the first run. ``write`` takes each line of what changed; of a quiet
    command it gets none where nothing changed.

    Raises:
        ChangedError: something changed; the files are written all the same.
        ConfigError: fewer than two runs, or an option is wrong.
        StoreError: a run has no maps, or the folder cannot be written.
    """
    reporter = command.reporter()
    found, new = comparison_of(paths, folder, reporter, tolerance, labels, rate, limits)
    page, numbers = render_comparison(found, draw_and_say(reporter, "figures"))
    for name, text in ((COMPARE_PAGE, page), (COMPARE_JSON, numbers)):
        write_atomic(folder / name, text.encode())
    if new:
        append_history(folder / HISTORY, new)
    if found.changed or not command.quiet:
        for line in lines_of(found):
            write(line)
    if found.changed:
        raise ChangedError(f"changed; see {(folder / COMPARE_PAGE).resolve()}")


def comparison_of(
    paths: Sequence[Path],
    folder: Path,
    reporter: Reporter,
    tolerance: float = 1e-12,
    labels: Sequence[str] = (),
    rate: float = 0.01,
    limits: Sequence[str] = (),
) -> tuple[Comparison, list[HistoryRow]]:
    """Return how the runs differ, and lines that the history does not have yet; see :func:`compare_runs`."""
    if len(paths) < 2:
        raise ConfigError("compare: give two runs or more")
    if not 0 <= tolerance < 1:
        raise ConfigError(f"--tolerance {tolerance:g}: give a relative difference from 0 to below 1")
    if not 0.0 < rate < 1.0:
        raise ConfigError(f"--fdr {rate:g}: give a rate between 0 and 1, such as 0.01")
    if labels and len(labels) != len(paths):
        raise ConfigError(
            f"--label: {len(labels)} labels for {len(paths)} runs; give one per run, in the same order"
        )
    given = [_side(path, reporter) for path in paths]
    first, last = given[0], given[-1]
    between = partial(
        _pair, tolerance=tolerance, rate=rate, limits=_limits(first.target, limits), reporter=reporter
    )
    reference, file = first.facts.identity, folder / HISTORY
    rows = {row["id"]: row for row in read_history(file) if row["reference"] == reference}
    before = _before(given, rows, folder, reporter)
    sides = [*given[:-1], *([] if before is None or before in given else [before]), last]
    names = _shortest_names([side.store.path for side in sides])
    letters = itertools.chain(ascii_uppercase, map("".join, itertools.product(ascii_uppercase, repeat=2)))
    for side, letter, name in zip(sides, letters, names, strict=False):
        side.facts = replace(side.facts, label=letter, name=name)
    pairs = [between(first, side, "reference") for side in given[1:]]
    new: dict[str, HistoryRow] = {}
    for side, label, pair in zip(given, labels or [""] * len(given), [None, *pairs], strict=True):
        row = history_row(side.facts, side.store, side.states, label, folder, pair)
        there = rows.get(row["id"]) or new.setdefault(row["id"], row)
        if label and there["label"] != row["label"]:
            raise ConfigError(
                f"--label {label}: this run is {there['label']} in {file}; choose another --output"
            )
    if before is not None:
        pairs.append(between(before, last, "last run"))
    facts, added = [side.facts for side in sides], list(new.values())
    return Comparison(facts, pairs, tolerance, [*rows.values(), *added], rate), added


@dataclass(eq=False)
class _Side:
    """A run that is compared."""

    target: Target
    store: RunStore
    states: PixelStates
    facts: RunFacts


def _limits(reference: Target, given: Sequence[str]) -> dict[str, float | str]:
    """Return the limits of the section ``compare`` of the reference, and those that are given instead."""
    values = {}
    for text in given:
        name, sign, value = (part.strip() for part in text.partition("="))
        if not sign:
            raise ConfigError(f"--limit {text}: write name=value, such as bias=0.5 or read_noise_e=5%")
        values[name] = value
    section = (reference.changed("compare", **values) if values else reference).config.compare
    return section.model_dump(exclude_none=True)


def _before(
    given: Sequence[_Side], rows: Mapping[str, HistoryRow], folder: Path, reporter: Reporter
) -> _Side | None:
    """Return the run before the last one in the history; None where it is the reference, or gone.

    Lines of the last one as it was before it was redone do not count.
    """
    known = {side.facts.identity: side for side in given}
    places = {each: place_of(row["run"], folder).resolve() for each, row in rows.items()}
    last, own = given[-1].facts.identity, given[-1].store.path.resolve()
    order = [each for each in dict.fromkeys([*rows, *known]) if each == last or places.get(each) != own]
    wanted = order[max(order.index(last) - 1, 0)]
    if wanted == order[0] or wanted in known:
        return None if wanted == order[0] else known[wanted]
    with contextlib.suppress(ConfigError, StoreError):
        side = _side(places[wanted], reporter)
        if side.facts.identity == wanted:
            return side
    place = rows[wanted]["run"]
    reporter.info(
        f"the last run in {folder / HISTORY}, {place}, is gone or another one: not compared with it"
    )
    return None


def _shortest_names(paths: Sequence[Path]) -> list[str]:
    """Return the names of stores, preceded by as many of their folders as make them differ."""
    parts = [path.resolve().parts for path in paths]
    for depth in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [path.name for path in paths]


def _side(path: Path, reporter: Reporter) -> _Side:
    target = find_run(path)
    store = with_maps(target.stored())
    warn_if_old(
        target, ("fit", "maps", "ensemble"), f"{store.path} is compared in its present state", reporter
    )
    states = PixelStates.of(store, target.config)
    sensor = SensorInfo.read(store)
    wanted = states.quality[(states.status & int(FitStatus.EXCLUDED)) == 0]
    good, caution, none = (int((wanted == grade).sum()) for grade in (GOOD, CAUTION, NO_VALUE))
    digest = _data_digest(store, sensor)
    facts = RunFacts(
        "",
        "",
        sensor.shape,
        sensor.n_frames if sensor.kind == "frames" else None,
        digest,
        {each: _median(content) for each, content in store.attributes("maps").get("summary", {}).items()},
        {each: store.read(f"ensemble/{each}") for each in _ENSEMBLE if store.has(f"ensemble/{each}")},
        dict(store.attributes("ensemble").get("rmse", {})),
        (good, caution, none),
        identity_of(store, digest),
    )
    return _Side(target, store, states, facts)


def _median(content: dict[str, Any]) -> tuple[float, float, float]:
    """Return the median of a map, its standard error and the scatter of the pixels; NaN where unknown."""
    median, error, scatter = (
        float("nan") if content[key] is None else float(content[key])
        for key in ("median", "median_stderr", "robust_sd")
    )
    return median, error, scatter


def _data_digest(store: RunStore, sensor: SensorInfo) -> str:
    """Return what identifies the frames of a run: content of the files, and the part taken of them."""
    record = store.records.read("ingest")
    settings = {} if record is None else record.content.get("settings", {})
    taken = [settings.get(f"input.{name}") for name in ("dataset", "roi", "frame_range", "bit_shift")]
    return f"{sensor.identity.get('digest', '')} {taken} {sensor.n_frames} {sensor.shape}"


def _pair(
    first: _Side,
    second: _Side,
    since: Literal["reference", "last run"],
    *,
    tolerance: float,
    rate: float,
    limits: Mapping[str, float | str],
    reporter: Reporter,
) -> Pair:
    one, other, before, now = first.facts, second.facts, first.states, second.states
    same_data = one.digest == other.digest
    confirm = None if same_data else _common_fit(first, second)
    maps: dict[str, MapDifference] = {}
    transitions: list[list[int]] = []
    reasons: dict[str, Reasons] = {}
    changed = compared = np.zeros(one.shape, np.bool_)
    defects = now.changes_since(before, confirm)
    if one.shape == other.shape:
        grades = before.quality.ravel(), now.quality.ravel()
        moves = np.histogram2d(*grades, bins=np.arange(4) - 0.5)[0].astype(int)
        transitions, n_good = moves.tolist(), [moves[:, GOOD].sum(), moves[GOOD].sum()]
        compared = (before.quality == GOOD) & (now.quality == GOOD)
        stores = first.store, second.store
        in_both = [name for name in MEASURED_MAPS if all(store.has(f"maps/{name}") for store in stores)]
        if lacking := limits.keys() - {*in_both, "pixels"}:
            raise ConfigError(
                f"compare.{min(lacking)}: {one.name} or {other.name} has no such map; omit this limit"
            )
        read = ((name, _value(stores[0], name), _value(stores[1], name)) for name in in_both)
        maps = compare_maps(read, compared, same_data=same_data, rate=rate, confirm=confirm, limits=limits)
        judged = [name for name in maps if name in limits] or maps
        changed = np.logical_or.reduce([maps[name].changed for name in judged])
        changed[[each.y for each in defects], [each.x for each in defects]] = True
        compared |= changed
        frames = [SensorInfo.read(store).n_frames for store in stores]
        kept = moves[GOOD, GOOD] / np.maximum(n_good, 1)
        if limits or not same_data:
            reasons = {name: reasons_of_change(each, frames, kept) for name, each in maps.items()}
    arrays = _compared_arrays(first.store, second.store, tolerance, reporter) if same_data else []
    if limits:
        reasons = {
            name: replace(reasons[name], spread=False, pixels=False) for name in limits if name in reasons
        }
    pair = Pair(
        one, other, since, same_data, arrays, maps, reasons, transitions,
        settings_that_differ(first.target.config, second.target.config),
        versions_that_differ(first.store, second.store),
        defects=defects, n_changed=int(changed.sum()), n_compared=int(compared.sum()), limits=limits,
    )  # fmt: skip
    words = _words(pair)
    return replace(pair, changed=bool(words), changes=words)


def _common_fit(*sides: _Side) -> CommonFit | None:
    """Return the test whether pixels of two runs are the same; None for fits of several exposures."""
    stores = [side.store for side in sides]
    sensors = [side.target.sensor(side.store) for side in sides]
    if any(sensor.samples or sensor.adc_limits != sensors[0].adc_limits for sensor in sensors):
        return None
    names = ("histogram/counts", "histogram/origin")
    return lambda y, x: common_fit_p(
        sensors[0].adc_limits, *([store.read_pixels(name, y, x) for store in stores] for name in names)
    )


def _value(store: RunStore, name: str) -> tuple[FloatArray, FloatArray]:
    """Return a map and its standard errors."""
    return store.read(f"maps/{name}"), store.read(f"maps/{name}_stderr")


def _words(pair: Pair) -> list[str]:
    """Say what changed, one sentence each; nothing where nothing did."""
    found, limits = [], pair.limits
    if pair.one.shape != pair.other.shape:
        sizes = " and ".join(f"{ny} x {nx}" for ny, nx in (pair.one.shape, pair.other.shape))
        found.append(f"Different sensors: {sizes} pixels.")
    elif not any(each.n_counted for each in pair.maps.values()):
        found.append("No pixel has a good fit in both runs.")
    if not limits:
        counted = [row for row in pair.arrays if row.counts and row.state in ("changed", "lost")]
        found += [f"{row.name}: {_array_words(row)}." for row in counted]
    for name, why in pair.reasons.items():
        if why:
            sign = f"{symbol(name)[1]}{' (DN)' if name == 'read_noise_dn' else ''}"
            text = _map_words(pair.maps[name], why, limits.get(name), symbol(name)[2])
            found.append(f"{sign[0].upper()}{sign[1:]}: {text}.")
    changes = {change: len(each) for change, each in by_change(pair.defects).items() if each}
    defects = ", ".join(f"{n:,} {change}" for change, n in changes.items())
    if limits and pair.n_changed > allowed(most := limits.get("pixels", math.inf), pair.n_compared):
        beside = f" (defects: {defects})" if defects else ""
        pixels = f"{pair.n_changed:,} of {pair.n_compared:,} changed{beside}"
        found.append(f"Pixels: {pixels}, limit {_limit_words(most, '')}.")
    elif defects and not limits:
        found.append(f"Defects: {defects}.")
    return found


def _limit_words(limit: float | str, unit: str) -> str:
    return limit if isinstance(limit, str) else f"{limit:g} {unit}".strip()


def _map_words(each: MapDifference, why: Reasons, limit: float | str | None, unit: str) -> str:
    text = [f"scatter {short(each.spread_z, 2)} sigma"] if why.spread and not why.shifted else []
    if why.shifted:
        text.append(f"median changed by {measured(each.median, each.median_stderr, unit)}")
    if why.lines:
        moved = (f"{line} moved by {measured(*change, unit)}" for line, change in why.lines.items())
        text.append(f"{first_few(moved)} against the others")
    if limit is not None:
        text.append(f"limit {_limit_words(limit, unit)}")
    if why.pixels and not why.shifted:
        text.append(f"{count(each.n_changed, 'pixel')} changed, {p_value_text(each.p_value)}")
    return ", ".join(text)


def _array_words(row: ArrayRow) -> str:
    if row.state == "lost":
        return "missing"
    if row.why:
        return row.why
    share = f"{count(row.n_beyond, 'value')} of {row.n_values:,} changed"
    return f"{share}, by up to {short(row.largest)}"


# -- arrays, value by value ------------------------------------------------------------------------


def _compared_arrays(one: RunStore, other: RunStore, tolerance: float, reporter: Reporter) -> list[ArrayRow]:
    """Compare all arrays that either of two runs on the same frames has, a row for each."""
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
