"""What a stage is given, and how its units are done.

A stage is a row of :mod:`pchem_pipeline.stages.table` and a module with ``run(context)``; what it computes is
a pure function, arrays in and arrays out. ``run`` makes its arrays (``context.create``), then calls
``context.run_units(units, task)``. ``task`` is a picklable callable (a module-level function, or a
``functools.partial`` of one) that takes a unit and the store, writes whole chunks and returns a small
JSON-able summary, or nothing. The marker of a unit is set, in the worker, after its task returned.

A unit is anything picklable with ``key``, its name in messages and its marker: a
:class:`~pchem_pipeline.store.tiles.Tile`, or a block of frames; a band of tiles has ``keys``, the markers of
its tiles. A stage without parallel units has one, ``WHOLE``, which is done in this process.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

from pchem_pipeline.base.arrays import Arrays
from pchem_pipeline.base.errors import InputError, StoreError, error_words
from pchem_pipeline.base.variables import LENGTHS, VARIABLES
from pchem_pipeline.compute.environment import available_memory
from pchem_pipeline.compute.executor import Executor, Outcome, SerialExecutor, Stop
from pchem_pipeline.compute.memory import BASE_BYTES, affordable
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.run.model_versions import ModelVersion, model_in_force
from pchem_pipeline.run.progress import ProgressFile, ProgressMode, Reporter, telling_parts
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.signals import StopRequest
from pchem_pipeline.store.files import is_fatal
from pchem_pipeline.store.records import check_work, working
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.store.tiles import Tile, roi_tiles, tile_grid, tile_shape

if TYPE_CHECKING:
    from pchem_pipeline.frames.sequence import FrameSequence


T = TypeVar("T", covariant=True)


class Unit(Protocol):
    """A piece of a stage's work."""

    @property
    def key(self) -> str:
        """What messages call it, and its marker."""
        ...


@dataclass(frozen=True)
class Named(Generic[T]):
    """A unit that is not a part of the sensor: its name, which is its only marker, and what is done."""

    key: str
    content: T


#: The only unit of a stage that is not divided.
WHOLE = Named("all", None)

AnyUnit = TypeVar("AnyUnit", bound=Unit)


def markers(unit: Unit) -> tuple[str, ...]:
    """Return the markers that a unit sets when it is done: its key, or of several tiles its ``keys``."""
    found: tuple[str, ...] = getattr(unit, "keys", (unit.key,))
    return found


#: Does a unit, in a worker, with the store of the run; its summary is JSON data.
Task = Callable[[AnyUnit, RunStore], Mapping[str, Any] | None]


@dataclass(frozen=True)
class Command:
    """What the command line asked for, beside the configuration, whose section ``compute`` it overrides.

    Attributes:
        roi: only the tiles of this region.
        settings: of a stage on demand, in place of those of its section; None: those of its last result.
        log_json: file for JSON lines.
        max_memory: MiB.
    """

    force: bool = False
    dry_run: bool = False
    roi: tuple[int, int, int, int] | None = None
    settings: tuple[tuple[str, Any], ...] | None = None
    workers: int | None = None
    backend: str | None = None
    progress: ProgressMode = "auto"
    quiet: bool = False
    log_json: Path | None = None
    max_memory: int | None = None

    def reporter(self, progress_file: ProgressFile | None = None) -> Reporter:
        """Return what tells of the work."""
        return Reporter(self.progress, quiet=self.quiet, log=self.log_json, progress_file=progress_file)


@functools.lru_cache(maxsize=8)
def open_store(path: Path) -> RunStore:
    """Return the store at ``path``, writable, opened once per process."""
    return RunStore.open(path, writable=True)


def _do_unit(
    path: Path,
    stage: str,
    fingerprint: str,
    task: Task[AnyUnit] | None,
    tell: Callable[[str, float], None] | None,
    unit: AnyUnit,
) -> None:
    """Do a unit of a run, in the worker, and set its markers once it is done.

    ``tell`` hears by key what share of a unit is done, where the worker shares the memory. Where it does not
    (None), the worker may be overtaken by a later command, and writes no more then.
    """
    store = open_store(path)
    with working(store.records, stage, fingerprint if tell is None else None):
        with telling_parts(None if tell is None else functools.partial(tell, unit.key)):
            summary = {} if task is None else dict(task(unit, store) or {})
        check_work(path)
        for key in markers(unit):
            store.records.mark(stage, fingerprint, key, summary)


@dataclass(frozen=True)
class Prepared:
    """What a single pass over the camera files did for some stages, which then have but to mark their units.

    The clock is wall and CPU time when the pass began: its time belongs to the last of the stages.
    """

    stages: tuple[str, ...]
    frames: FrameSequence
    clock: tuple[float, float]


def allowed_bytes(config: RunConfig, workers: int) -> int:
    """Return the memory that the run may take, in all: the setting, else half of what is free."""
    if config.compute.max_memory is not None:
        return config.compute.max_memory << 20
    bands = BASE_BYTES + workers * (config.histogram.band_memory << 20)
    return max(bands, (available_memory() or 0) // 2)


def band_bytes(config: RunConfig, workers: int, limit: int | None = None) -> int:
    """Return the memory of a worker that counts a band of rows.

    ``limit``: bytes that the process of a worker may take, above which it is killed; None: no limit.
    """
    bytes_each = [config.histogram.band_memory << 20]
    if limit is not None:
        bytes_each.append(max(16 << 20, limit - BASE_BYTES))
    if config.compute.max_memory is not None:
        bytes_each.append(max(16 << 20, ((config.compute.max_memory << 20) - BASE_BYTES) // workers))
    return min(bytes_each)


@dataclass
class StageContext:
    """All that a stage is given.

    Attributes:
        base_dir: folder to which relative paths of the configuration refer.
        store: the run's store, writable.
        stop: raised signals; checked between units.
        stage, fingerprint: of the running stage.
        fresh: True where the stage starts anew and must create its arrays.
        failed: unit key to reason, filled by :meth:`run_units`.
        n_keys: number of markers of the complete stage, filled by :meth:`run_units`.
        notes: remarks for the report, filled by the stage.
        prepared: by a single pass over the input, if there was one.
        begin: gives up what the running stage left before, at the first call: :meth:`create` and
            :meth:`run_units` call it, a stage that writes before those does so itself. What is refused until
            then costs nothing.
        created: the arrays that :meth:`create` made or found, with their stages.
    """

    config: RunConfig
    base_dir: Path
    store: RunStore
    executor: Executor = field(default_factory=SerialExecutor)
    reporter: Reporter = field(default_factory=lambda: Reporter("off", quiet=True))
    stop: StopRequest = field(default_factory=StopRequest)
    command: Command = field(default_factory=Command)
    stage: str = ""
    fingerprint: str = ""
    fresh: bool = True
    failed: dict[str, str] = field(default_factory=dict)
    n_keys: int = 0
    config_path: Path | None = None
    notes: list[str] = field(default_factory=list)
    prepared: Prepared | None = None
    begin: Callable[[], None] = lambda: None
    created: dict[str, str] = field(default_factory=dict)

    @property
    def is_prepared(self) -> bool:
        """The arrays of the running stage were made beforehand, by a single pass over the input."""
        return self.prepared is not None and self.stage in self.prepared.stages

    @functools.cached_property
    def model(self) -> ModelVersion:
        """The version of the model that the configuration means."""
        return model_in_force(self.store, self.config.model)

    @property
    def sensor(self) -> SensorInfo:
        """The input, with the bit depth and integration time of the configuration, where it sets them.

        Raises:
            StoreError: nothing was ingested yet.
        """
        return SensorInfo.read(self.store).with_settings(self.config.input)

    @property
    def charge_rate(self) -> str:
        """Name of the map of charge over time: ``dark_current`` where all was dark, else ``charge_rate``."""
        exposed = [sample.kind for sample in self.sensor.samples if not sample.bias]
        kinds = exposed if self.config.input.kind == "unknown" and exposed else [self.config.input.kind]
        return "dark_current" if all(kind == "dark" for kind in kinds) else "charge_rate"

    @property
    def tile(self) -> tuple[int, int]:
        """Rows and columns of a tile, as configured; with ``auto`` those that the run has already."""
        size: Any = self.config.run.tile
        record = self.store.records.known("histogram") if size == "auto" else None
        if record is not None:
            size = record.content.get("settings", {}).get("run.tile", size)
        return tile_shape(tuple(size) if isinstance(size, list) else size, self.sensor.shape)

    @property
    def tile_pixels(self) -> int:
        """Pixels of the largest tile."""
        return math.prod(self.tiles()[0].shape)

    @property
    def band_bytes(self) -> int:
        """Memory of a worker that takes a band of rows."""
        return band_bytes(self.config, self.executor.workers, self.executor.memory_limit)

    def tiles(self) -> list[Tile]:
        """Return all tiles of the sensor."""
        return tile_grid(self.sensor.shape, self.tile)

    def tiles_done(self, stage: str) -> set[str]:
        """Return the keys of the tiles that an upstream stage has finished."""
        record = self.store.records.known(stage)
        return set() if record is None else self.store.records.done(stage, record.fingerprint)

    def note(self, text: str) -> None:
        """Warn once, and keep the remark for the report."""
        self.notes.append(text)
        self.reporter.warning(text, stage=self.stage)

    def create(
        self,
        *names: str,
        lengths: Mapping[str, int] | None = None,
        chunks: Mapping[str, int] | None = None,
        shards: tuple[int, ...] | None = None,
        dtype: Any = None,
        **attributes: Any,
    ) -> None:
        """Make arrays of this stage with their declared dimensions, unless the stage resumes and has them.

        Lengths are those of dimensions, of y and x the sensor's where they are not given; chunks are a tile
        along y and x, the whole along others that are not given. For the rest see
        :meth:`RunStore.create_array`.
        """
        self.begin()
        sizes, parts = {**LENGTHS, **(lengths or {})}, dict(chunks or {})
        if "y" not in sizes:
            sizes |= zip(("y", "x"), self.sensor.shape, strict=True)
            parts = dict(zip(("y", "x"), self.tile, strict=True)) | parts
        for name in names:
            self.created[name] = self.stage
            if self.fresh or not self.store.has(name):
                dims = VARIABLES[name].dims
                self.store.create_array(
                    name,
                    tuple(sizes[dim] for dim in dims),
                    chunks=tuple(parts.get(dim, sizes[dim]) for dim in dims),
                    shards=shards,
                    dtype=dtype,
                    attributes=attributes,
                )

    def create_like(self, arrays: Arrays) -> None:
        """Make arrays over the sensor that are, beside y and x, as those of some of its pixels, by path."""
        for path, values in arrays.items():
            lengths = dict(zip(VARIABLES[path].dims, values.shape, strict=True))
            self.create(path, lengths={dim: n for dim, n in lengths.items() if dim not in ("y", "x")})

    def selected(self, units: Sequence[AnyUnit]) -> list[AnyUnit]:
        """Return the units that ``--roi`` chooses: all of them without it, and all that are no tiles.

        Raises:
            ConfigError: the sensor has no such region.
        """
        if self.command.roi is None or (units and all(isinstance(unit, Named) for unit in units)):
            return list(units)
        chosen = {tile.key for tile in roi_tiles(self.command.roi, self.tiles())}
        return [unit for unit in units if isinstance(unit, Named) or chosen & set(markers(unit))]

    def pending(self, units: Sequence[AnyUnit], *, resumes: bool = False) -> list[AnyUnit]:
        """Return the chosen units that are not done; with ``--force`` all, unless the stage ``resumes``."""
        done, chosen = self.store.records.done(self.stage, self.fingerprint), self.selected(units)
        if self.command.force and not resumes:
            return chosen
        return [unit for unit in chosen if not set(markers(unit)) <= done]

    def run_units(
        self,
        units: Sequence[AnyUnit],
        task: Task[AnyUnit] | None = None,
        *,
        unit_name: str = "tile",
        needs: str | None = None,
        total: int | None = None,
        unit_bytes: int = 0,
    ) -> dict[str, dict[str, Any]]:
        """Run ``task`` on every unit that is chosen and not done yet, and mark each; None: only mark them.

        Units that raise are kept in :attr:`failed` and stop nothing, except errors that would hit
        every unit (a full disk, vanished camera files). With ``needs``, an upstream stage of the same
        tiles, units that it has not finished are failures too. A stage that learns only on its way
        what its units are calls this several times and says in ``total`` how many markers that makes so far;
        it resumes also under ``--force``, which has made it start anew. ``unit_bytes`` is the memory that a
        worker takes for a unit: fewer work at once where ``compute.max_memory`` says so. Returns the
        summaries of all finished units by key, earlier runs included.

        Raises:
            ConfigError: the memory allowed is not enough for one unit.
            InterruptedRunError: a signal asked for a stop; running units were finished.
            InputError: the camera files are gone.
            StoreError: the store cannot be written.
        """
        self.begin()
        self.n_keys = sum(len(markers(unit)) for unit in units) if total is None else total
        record = self.store.records.read(self.stage)
        if record is not None and record.keys != self.n_keys:  # a kill must not lose it
            self.store.records.write(replace(record, keys=self.n_keys))
        todo = self._ready(self.pending(units, resumes=total is not None), needs)
        again = (key for unit in todo for key in markers(unit))
        self.store.records.unmark(self.stage, self.fingerprint, again)
        fatal: list[BaseException] = []
        shown = len(self.selected(units))
        undivided = list(units) == [WHOLE]
        # what is not divided is done here, and tells its own steps
        executor = SerialExecutor() if undivided else self.executor
        if (limit := self.config.compute.max_memory) is not None and unit_bytes:
            executor = affordable(executor, limit << 20, unit_bytes, f"stage {self.stage}")
        with self.reporter.progress(
            self.stage, shown, unit_name, shown - len(todo), hidden=undivided
        ) as advance:
            shares: dict[str, float] = {}  # of the running units, that are done

            def tell(key: str, share: float) -> None:
                share = min(share, 1.0 - shares.get(key, 0.0))
                shares[key] = shares.get(key, 0.0) + share
                advance(share)

            def on_result(unit: AnyUnit, outcome: Outcome) -> None:
                advance(1.0 - shares.pop(unit.key, 0.0))
                if outcome.error is not None:
                    self._failed(unit, outcome, fatal)
                if fatal or self.stop.signal is not None:
                    raise Stop

            self.stop.check()
            listener = tell if executor.shares_memory else None
            place = self.store.path, self.stage, self.fingerprint
            try:
                with self.stop.at_once() if undivided else contextlib.nullcontext():
                    executor.map(functools.partial(_do_unit, *place, task, listener), todo, on_result)
            except Stop:
                if fatal:
                    raise fatal[0] from fatal[0].__cause__
        self._fill(units)
        self.stop.check()
        return self.store.records.summaries(self.stage, self.fingerprint)

    def _fill(self, units: Sequence[AnyUnit]) -> None:
        """Where units are left undone, write "no value" for their pixels into the maps of the stage."""
        done = self.store.records.done(self.stage, self.fingerprint)
        if all(set(markers(unit)) <= done for unit in units):
            return
        for name, stage in self.created.items():
            if stage == self.stage and "frame" not in VARIABLES[name].dims:
                self.store.fill(name)

    def _ready(self, units: list[AnyUnit], needs: str | None) -> list[AnyUnit]:
        """Split off the units that an upstream stage has not finished."""
        if needs is None:
            return units
        ready, finished = [], self.tiles_done(needs)
        for unit in units:
            if set(markers(unit)) <= finished:
                ready.append(unit)
            else:
                self.failed[unit.key] = f"stage {needs} of {self.store.path} is not finished"
        return ready

    def _failed(self, unit: Unit, outcome: Outcome, fatal: list[BaseException]) -> None:
        error = outcome.error
        assert error is not None
        self.failed[unit.key] = reason = error_words(error)
        self.reporter.event("failed", stage=self.stage, unit=unit.key, reason=reason, trace=outcome.trace)
        full = (isinstance(error, StoreError) and is_fatal(error.__cause__ or error)) or is_fatal(error)
        # camera files that vanished or changed are gone for all units, too
        if full or isinstance(error, InputError):
            fatal.append(error)
