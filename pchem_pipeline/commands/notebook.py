"""A finished run for notebooks: its arrays as xarray datasets, its pixels, and the figures of its report.

>>> from pchem_pipeline import open_run
>>> run = open_run("run.zarr")                      # doctest: +SKIP
>>> run.maps.read_noise_e.where(run.good).median()  # doctest: +SKIP
>>> run.pixel(3, 5).plot()                          # doctest: +SKIP
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import ConfigError, MissingDependencyError, StoreError, install_hint, quoted
from pchem_pipeline.base.variables import PARAMETERS, variable_at
from pchem_pipeline.commands.figures import gather_run, millimetres
from pchem_pipeline.model.fit.result import html_table
from pchem_pipeline.model.law.pcd import pcd
from pchem_pipeline.model.maps.maps import CAUTION, GOOD
from pchem_pipeline.report.charts.chart import COLUMN_MM
from pchem_pipeline.report.charts.on_paper import Look, draw_chart
from pchem_pipeline.report.data import PixelFit
from pchem_pipeline.report.figures.catalogue import run_figures
from pchem_pipeline.report.figures.pixels import has_fit, pixels_chart
from pchem_pipeline.report.style.wording import measured, symbol
from pchem_pipeline.run.model_versions import ModelVersion, model_of, model_versions
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.target import Target, find_run, with_maps
from pchem_pipeline.runner.session import run_status
from pchem_pipeline.stages.defects import stored_defects
from pchem_pipeline.stages.fit.fitted_model import FittedModel
from pchem_pipeline.stages.report.pixels import bin_masses, pixel_fits, pixel_index
from pchem_pipeline.stages.report.stored import read_histograms
from pchem_pipeline.stages.table import STAGES
from pchem_pipeline.store.files import read_json
from pchem_pipeline.store.run_store import RunStore

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from pchem_pipeline.config.tree import RunConfig
    from pchem_pipeline.discrepancy.verdict import Verdict
    from pchem_pipeline.report.charts.on_paper import Drawing
    from pchem_pipeline.report.figures.figure import Figure
    from pchem_pipeline.run.progress import ProgressMode
    from pchem_pipeline.use.twin import Twin


def open_run(path: str | os.PathLike[str]) -> Run:
    """Open a run for reading.

    Args:
        path: its store, or the YAML file that made it.

    Raises:
        MissingDependencyError: xarray is not installed.
        ConfigError: the path is neither a YAML file nor a store.
        StoreError: there is no run, or it is damaged.
    """
    require_xarray("open_run")
    return Run(find_run(Path(path)))


def require_xarray(what: str) -> None:
    """Check that xarray can be imported.

    Raises:
        MissingDependencyError: it cannot.
    """
    try:
        import xarray as _  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(f"{what} needs another package: {install_hint('notebook')}") from error


class Run:
    """A run on disk, read only; arrays are read when they are used. Made by :func:`open_run`.

    Attributes:
        path: its store.
        config: its configuration.
        shape: rows and columns of the sensor (for ready-made histograms: one row of channels).
        n_frames: frames of each pixel.
    """

    def __init__(self, target: Target) -> None:
        self._target = target
        self._store = target.stored()
        self._sensor = SensorInfo.read(self._store)
        self._groups: dict[str, xr.Dataset] = {}
        self.path: Path = target.store
        self.config: RunConfig = target.config
        self.shape: tuple[int, int] = self._sensor.shape
        self.n_frames: int = self._sensor.n_frames

    def __repr__(self) -> str:
        states = run_status(self._target)
        open_ = ", ".join(f"{state.stage} {state.state}" for state in states if state.state != "complete")
        return f"<Run {self.path.name}: {self._size()}; {open_ or 'complete'}>"

    def _repr_html_(self) -> str:
        """Return what the first screen of the report says, for a notebook."""
        found = read_json(self.path / "report.json", "run again to write it")
        states = ", ".join(f"{name} {words}" for name, words in self.status().items())
        head = f"<b>{escape(self.path.name)}</b>: {escape(self._size())}"
        if found is None:
            return f"<p>{head}<br>{escape(states)}</p>"
        try:
            answers = "".join(
                f"<p>{escape(each['question'])} <b>{escape(each['word'])}</b>. {escape(each['text'])}</p>"
                for each in found["answers"]
            )
            rows = [(each["label"], each["value"], each["spread"]) for each in found["headline"]]
        except (KeyError, TypeError, AttributeError) as error:
            raise StoreError(f"{self.path / 'report.json'} is damaged; run again to write it") from error
        return f"<p>{head}</p>{answers}{html_table(('median', 'value', '5 to 95 %'), rows)}"

    def _size(self) -> str:
        ny, nx = self.shape
        if self._sensor.kind == "histograms":
            return f"{nx} channels of up to {self.n_frames:,} samples"
        if self._sensor.samples:
            n = len(self._sensor.samples)
            return f"{ny} x {nx} pixels, {n} samples of {self.n_frames:,} frames in all"
        return f"{ny} x {nx} pixels, {self.n_frames:,} frames"

    def status(self) -> dict[str, str]:
        """Return how far each stage is, as ``pchem status`` says it."""
        return {state.stage: state.words() for state in run_status(self._target)}

    @property
    def model_versions(self) -> tuple[ModelVersion, ...]:
        """The versions of the model that the run has, by number, with their effects and their sources."""
        return model_versions(self._store)

    @property
    def model(self) -> ModelVersion | None:
        """The version that the fit rests on; None without a fit."""
        return model_of(self._store, "fit")

    # -- arrays -------------------------------------------------------------------------------

    def group(self, name: str) -> xr.Dataset:
        """Return a group of the store as a dataset, lazily, with units and sentences as attributes.

        Arrays over the sensor have coordinates ``y`` and ``x`` (pixel), those over DN or electrons theirs.

        Args:
            name: such as ``"maps"``; see the table of the store in the README.

        Raises:
            StoreError: the run does not have it.
        """
        if name not in self._groups:
            self._groups[name] = self._opened(name)
        return self._groups[name]

    def _opened(self, name: str) -> xr.Dataset:
        if not self._store.has(name):
            raise StoreError(
                f"{self.path} has no {name} yet; for the state of the run: pchem status {quoted(self.path)}"
            )
        for record in filter(None, map(self._store.records.known, STAGES)):
            for file in record.files:
                if file.startswith(f"{name}/") and "." in file and not (self.path / file).exists():
                    raise StoreError(f"{self.path / file} is missing; {self._store.cure(name)}")
        found = lazy_dataset(self._store, name)
        for axis, length in zip(("y", "x"), self.shape, strict=True):
            if found.sizes.get(axis) == length:
                found = found.assign_coords({axis: (axis, np.arange(length), {"units": "pixel"})})
        return found.set_coords([each for each in found.data_vars if found[each].dims == (each,)])

    @property
    def maps(self) -> xr.Dataset:
        """The maps with their standard errors; ``quality`` and ``fit_status`` are coordinates.

        What the store keeps with them beside the arrays is in ``run.group("maps").attrs``.
        """
        found = self.group("maps").copy(deep=False)
        found.attrs = {}
        if self._store.has("fit/fit_status"):
            found = found.assign_coords(fit_status=self.group("fit").fit_status)
        return found.set_coords("quality")

    @property
    def good(self) -> xr.DataArray:
        """Mask of the pixels with a good fit; ``run.maps.where(run.good)`` leaves the others out."""
        return self._mask(GOOD)

    @property
    def usable(self) -> xr.DataArray:
        """Mask of the pixels with a value, those to be used with caution included."""
        return self._mask(CAUTION)

    def _mask(self, worst: int) -> xr.DataArray:
        mask: xr.DataArray = self.group("maps").quality <= worst
        mask.attrs = {"long_name": "pixels with a good fit" if worst == GOOD else "pixels with a value"}
        return mask

    @property
    def fit(self) -> xr.Dataset:
        """What the fit found for each pixel."""
        return self.group("fit")

    @property
    def samples(self) -> xr.Dataset:
        """What each of several exposures has of its own; coordinate ``sample``: names of their runs.

        Raises:
            StoreError: the run has one sample only.
        """
        names = [sample.name for sample in self._sensor.samples]
        return self.group("samples").assign_coords(sample=("sample", names))

    @property
    def histogram(self) -> xr.Dataset:
        """Counts of every pixel: ``counts`` (y, x, bin), the DN of bin 0 is ``origin``."""
        return self.group("histogram")

    @property
    def summary(self) -> xr.Dataset:
        """Sums in time and space."""
        return self.group("summary")

    @property
    def ensemble(self) -> xr.Dataset:
        """Ensemble histograms and predictions; coordinates ``dn``, ``electrons`` and ``k``."""
        return self.group("ensemble")

    @property
    def truth(self) -> xr.Dataset:
        """The true parameters of a simulated camera."""
        return self.group("truth")

    def defects(self) -> pd.DataFrame:
        """Return the pixels that are not ordinary, a row for each kind of each pixel.

        Columns: ``x``, ``y`` (from 0), ``kind``; ``value`` with ``stderr`` in ``unit``, and ``usual``, the
        median of the sensor; ``fit_status`` in words. ``pchem export --format defects`` writes the same.

        Raises:
            StoreError: the run has no maps yet.
        """
        import pandas as pd

        return pd.DataFrame(stored_defects(with_maps(self._store), self.config).table)

    # -- what is done with the sensor ---------------------------------------------------------

    def apply(
        self,
        frames: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
        output: str | os.PathLike[str],
        *,
        what: str = "all",
        prior: str = "frames",
        force: bool = False,
    ) -> xr.Dataset:
        """Calibrate other frames of the sensor, as ``pchem apply`` does, and return the result, lazily.

        Args:
            frames: camera files, globs or folders.
            output: zarr store to write; one that holds the same already is only opened.
            what: electrons, numbers, exposure, separated by commas, or all.
            prior: exposure that the electron numbers are expected to have, as on the command line.
            force: replace calibrated frames that are there.

        Raises:
            InputError: the frames do not fit the run.
            ConfigError: the output is something else.
        """
        from pchem_pipeline.commands.apply.apply import apply_to_frames
        from pchem_pipeline.commands.apply.settings import ApplySettings, kinds_of
        from pchem_pipeline.run.stage import Command

        files = [frames] if isinstance(frames, (str, os.PathLike)) else list(frames)
        command = Command(force=force, quiet=True, progress="off")
        wanted = ApplySettings(kinds_of(what), prior)
        [place] = apply_to_frames(self._target, [str(f) for f in files], Path(output), wanted, command)
        return lazy_dataset(RunStore.open(place), "applied")

    @property
    def verdict(self) -> Verdict | None:
        """What the model is missing, as the last search found it; None where nobody looked."""
        from pchem_pipeline.discrepancy.verdict import read_verdict

        return read_verdict(self.path)

    def discrepancy(
        self, *, refit: bool = False, effort: float | None = None, progress: ProgressMode = "off"
    ) -> Verdict:
        """Search for what the model is missing, and return the verdict; the evidence is in the report.

        Args:
            refit: add what is named to the model and fit with it, as ``pchem discrepancy`` does; open the run
                again afterwards.
            effort: times the usual limit of the search's work; None: as the run's settings say.
            progress: auto, on or off.

        Raises:
            PchEmError: the frames are gone or too few, or another command works on the run.
        """
        from pchem_pipeline.commands.discrepancy import find_and_add
        from pchem_pipeline.run.stage import Command

        command = Command(progress=progress, quiet=progress == "off")
        find_and_add(self._target, command, refit=refit, effort=effort)
        found = self.verdict
        assert found is not None
        return found

    def twin(self, *, redraw: int | None = None, shape: tuple[int, int] | None = None) -> Twin:
        """Return the camera as it was measured, to simulate with: ``run.twin().frames(scene, n)``.

        Args:
            redraw: seed with which the maps are drawn within their errors; None: the estimates themselves.
            shape: rows and columns of another sensor of this make; None: this one.
        """
        from pchem_pipeline.commands.twin import twin_of

        return twin_of(self._target, redraw=redraw, shape=shape)

    # -- pixels -------------------------------------------------------------------------------

    def pixel(self, y: int, x: int) -> Pixel:
        """Return one pixel with its histogram and its fit.

        Args:
            y: row, from 0.
            x: column, from 0; for ready-made histograms the channel.

        Raises:
            ConfigError: the sensor has no such pixel.
            StoreError: the run has no maps yet.
        """
        return self.pixels([(y, x)])[0]

    def pixels(self, places: Sequence[tuple[int, int]]) -> list[Pixel]:
        """Return several pixels, each given as (y, x); see :meth:`pixel`."""
        ny, nx = self.shape
        for y, x in places:
            if not (0 <= y < ny and 0 <= x < nx):
                raise ConfigError(f"pixel y = {y}, x = {x} is outside the sensor of {ny} x {nx} pixels")
        maps, fit = self.group("maps"), self.group("fit")  # which read the pixels asked for alone
        chosen = [("", int(y), int(x)) for y, x in places]
        index = pixel_index(chosen, self.shape)
        histograms = read_histograms(self._store, index, self.shape)
        channel = self._sensor.kind == "histograms"
        columns = [np.array([float(maps[name][y, x]) for _, y, x in chosen]) for name in PARAMETERS]
        masses = bin_masses(columns, histograms, FittedModel.read(self._store).at(index))
        found = pixel_fits(chosen, maps, fit, histograms, masses, channel=channel)
        return [Pixel(**vars(each)) for each in found]

    # -- figures ------------------------------------------------------------------------------

    @cached_property
    def figures(self) -> Mapping[str, Figure]:
        """The figures of the report and of the discrepancy page by name, undrawn, with their numbers."""
        return {figure.name: figure for figure in run_figures(gather_run(self._target))}

    def figure(self, name: str, width: float | str | None = None) -> Drawing:
        """Draw a figure of the report or of the discrepancy page, such as ``ensemble`` or ``map_bias``.

        Args:
            name: one of :attr:`figures`.
            width: mm, or a text such as ``"3.5in"``; None: the figure's own.

        Raises:
            ConfigError: the run has no such figure, or no figure can be so wide.
        """
        if name not in self.figures:
            raise ConfigError(f"this run has no figure {name}; it has {', '.join(self.figures)}")
        figure = self.figures[name]
        return figure.draw(Look(figure.width_mm if width is None else millimetres(str(width))))


def lazy_dataset(store: RunStore, group: str) -> xr.Dataset:
    """Return a group of a store as a dataset that reads when it is used; damage is one line then.

    xarray's own way reads a chunk that is missing as NaN or 0, and raises the errors of zarr.
    """
    import xarray as xr
    from xarray.backends import BackendArray
    from xarray.core.indexing import IndexingSupport, LazilyIndexedArray, explicit_indexing_adapter

    class Lazy(BackendArray):
        def __init__(self, name: str) -> None:
            array = store.array(name)
            self.name, self.shape, self.dtype = name, array.shape, array.dtype

        def __getitem__(self, key: Any) -> Any:
            return explicit_indexing_adapter(key, self.shape, IndexingSupport.BASIC, self.read)

        def read(self, region: Any) -> NDArray[Any]:
            return store.read(self.name, region)

    found = {}
    try:
        for name in store.arrays(group):
            array = store.array(f"{group}/{name}")
            lazy = LazilyIndexedArray(Lazy(f"{group}/{name}"))
            dims = variable_at(f"{group}/{name}").dims
            found[name] = xr.Variable(dims, lazy, dict(array.attrs))
        return xr.Dataset(found, attrs=store.attributes(group))
    except ValueError as error:  # shapes of other arrays
        raise StoreError(f"{store.path / group} is damaged ({error}); {store.cure(group)}") from error


class Pixel(PixelFit):
    """One pixel: its parameters with standard errors, its histogram, and what is drawn of it."""

    def __repr__(self) -> str:
        words = []
        for name, value in self.parameters.items():
            words.append(f"{name} = {measured(value, self.stderr.get(name, float('nan')), symbol(name)[2])}")
        return f"<Pixel y = {self.y}, x = {self.x}: {', '.join(words)}; {self.status or 'good fit'}>"

    def _repr_html_(self) -> str:
        """Return the parameters as a table, for a notebook."""
        rows = []
        for name, value in self.parameters.items():
            _, words, unit = symbol(name)
            rows.append((words, measured(value, self.stderr.get(name, float("nan")), unit)))
        head = f"pixel y = {self.y}, x = {self.x}: {self.status or 'good fit'}"
        return f"<p>{escape(head)}</p>{html_table(('parameter', 'value'), rows)}"

    @cached_property
    def histogram(self) -> xr.DataArray:
        """Number of frames at each DN, over the DN that occur."""
        return self._over_dn(self.counts, "frames at each DN")

    @cached_property
    def expected(self) -> xr.DataArray:
        """Number of frames expected at each DN from the fit; NaN where there is none."""
        values = np.full(self.counts.size, np.nan)
        if has_fit(self.parameters):
            theta = (self.parameters[name] for name in PARAMETERS)
            dn = self.origin + np.arange(self.counts.size, dtype=np.float64)
            density = pcd(dn, *theta) if self.mass is None else self.mass
            values = self.counts.sum() * density
        return self._over_dn(values, "frames expected at each DN")

    def _over_dn(self, values: NDArray[Any], words: str) -> xr.DataArray:
        import xarray as xr

        dn = self.origin + np.arange(values.size)
        seen = np.flatnonzero(self.counts)
        part = slice(seen[0], seen[-1] + 1) if seen.size else slice(0)
        return xr.DataArray(
            values[part],
            dims="dn",
            coords={"dn": ("dn", dn[part], {"units": "DN"})},
            attrs={"units": "1", "long_name": words},
        )

    def plot(self, width: float | str = COLUMN_MM) -> Drawing:
        """Draw the histogram with its fit and the residuals, as the report does.

        Args:
            width: of the figure, mm, or a text such as ``"3.5in"``.
        """
        return draw_chart(Look(millimetres(str(width))), pixels_chart([self]))
