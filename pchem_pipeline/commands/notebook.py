"""A finished run for notebooks: its arrays as xarray datasets, its pixels, and the figures of its report.

>>> from pchem_pipeline import open_run
>>> run = open_run("run.zarr")                      # doctest: +SKIP
>>> run.maps.read_noise_e.where(run.good).median()  # doctest: +SKIP
>>> run.pixel(3, 5).plot()                          # doctest: +SKIP
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import ConfigError, PchEmError, StoreError, quoted, require
from pchem_pipeline.base.variables import PARAMETERS, VARIABLES
from pchem_pipeline.base.wording import symbol
from pchem_pipeline.commands.figures import gather_run, millimetres
from pchem_pipeline.commands.in_memory import paths_of, stack_of, write_stack
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.discrepancy.verdict import Verdict, read_verdict
from pchem_pipeline.model.fit.result import html_table
from pchem_pipeline.model.fit.status import FitStatus, words_of
from pchem_pipeline.model.maps.maps import CAUTION, GOOD
from pchem_pipeline.report.charts.chart import COLUMN_MM, Chart
from pchem_pipeline.report.charts.on_paper import Look, draw_chart, draw_panels
from pchem_pipeline.report.data import PixelFit
from pchem_pipeline.report.figures.catalogue import run_figures
from pchem_pipeline.report.figures.figure import Figure
from pchem_pipeline.report.figures.pixels import pixel_columns, pixels_chart
from pchem_pipeline.run.model_versions import ModelVersion, model_of, model_versions
from pchem_pipeline.run.progress import ProgressMode
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.stage import Command
from pchem_pipeline.run.target import Target, find_run, with_maps
from pchem_pipeline.runner.session import run_status
from pchem_pipeline.stages.defects import stored_defects
from pchem_pipeline.stages.fit.fitted_model import FittedModel
from pchem_pipeline.stages.report.pixels import bin_masses, pixel_fits, pixel_index
from pchem_pipeline.stages.report.stored import read_histograms, read_run
from pchem_pipeline.stages.table import STAGES
from pchem_pipeline.store.files import read_json
from pchem_pipeline.store.run_store import RunStore

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

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
    require("xarray", "notebook", "open_run")
    return Run(find_run(Path(path)))


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

    def __reduce__(self) -> tuple[Any, ...]:
        return Run, (self._target,)

    def __repr__(self) -> str:
        states = run_status(self._target)
        open_ = ", ".join(f"{state.stage} {state.state}" for state in states if state.state != "complete")
        answers, medians = self._first_screen()
        lines = [f"<Run {self.path.name}: {self._size()}; {open_ or 'complete'}>"]
        lines += [" ".join(f"{question} {word}." for question, word, _ in answers)] if answers else []
        lines += ["median " + ", ".join(f"{label} {value}" for label, value, _ in medians)] if medians else []
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        """Return what the first screen of the report says, for a notebook."""
        answers, medians = self._first_screen()
        head = f"<b>{escape(self.path.name)}</b>: {escape(self._size())}"
        if not answers:
            states = ", ".join(f"{name} {words}" for name, words in self.status().items())
            return f"<p>{head}<br>{escape(states)}</p>"
        said = "".join(
            f"<p>{escape(question)} <b>{escape(word)}</b>. {escape(text)}</p>"
            for question, word, text in answers
        )
        return f"<p>{head}</p>{said}{html_table(('median', 'value', '5 to 95 %'), medians)}"

    def _first_screen(self) -> tuple[list[tuple[str, str, str]], list[tuple[str, str, str]]]:
        """Return the answers (question, word, text) and the medians (label, value, spread) of the report."""
        found = read_json(self.path / "report.json", "run again to write it")
        if found is None:
            return [], []
        try:
            answers = [(each["question"], each["word"], each["text"]) for each in found["answers"]]
            return answers, [(each["label"], each["value"], each["spread"]) for each in found["headline"]]
        except (KeyError, TypeError, AttributeError) as error:
            raise StoreError(f"{self.path / 'report.json'} is damaged; run again to write it") from error

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
            name: such as ``"maps"``; the reference of the store lists all.

        Raises:
            StoreError: the run does not have it.
        """
        if name in self._groups:
            return self._groups[name]
        there = sorted(filter(self._store.has, {each.group for each in VARIABLES.values()}))
        if name not in there:
            raise StoreError(f"{self.path} has no group {name}; it has {', '.join(there) or 'none yet'}")
        for record in filter(None, map(self._store.records.known, STAGES)):
            for file in record.files:
                if file.startswith(f"{name}/") and "." in file and not (self.path / file).exists():
                    raise StoreError(f"{self.path / file} is missing; {self._store.cure(name)}")
        return self._groups.setdefault(name, self._lazy(self._store, name))

    def _lazy(self, store: RunStore, group: str) -> xr.Dataset:
        """Return a group of a store; arrays over the whole sensor get coordinates."""
        from pchem_pipeline.commands.lazy_arrays import lazy_dataset

        found = lazy_dataset(store, group)
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
        """Arrays of each of several exposures; the coordinate ``sample`` names their runs.

        Raises:
            StoreError: the run has one sample only.
        """
        names = [sample.name for sample in self._sensor.samples]
        return self.group("samples").assign_coords(sample=("sample", names))

    @property
    def histogram(self) -> xr.Dataset:
        """Counts of every pixel, ``counts`` (y, x, bin); the DN of bin 0 is ``origin``."""
        return self.group("histogram")

    @property
    def summary(self) -> xr.Dataset:
        """Sums in time and space."""
        return self.group("summary")

    @property
    def overscan(self) -> dict[str, Any]:
        """Row and frame noise, and medians of bias and read noise there and beside; empty without overscan.

        The maps are in ``run.group("overscan")``.
        """
        return read_run(with_maps(self._store), self.config).data.overscan_medians

    @property
    def ensemble(self) -> xr.Dataset:
        """Ensemble histograms and predictions; coordinates ``dn``, ``electrons`` and ``k``."""
        return self.group("ensemble")

    @property
    def truth(self) -> xr.Dataset:
        """The true parameters of a simulated camera."""
        return self.group("truth")

    def table(self) -> pd.DataFrame:
        """Return the maps as a table, a row for each pixel.

        Columns: ``y``, ``x`` (from 0), each parameter and its ``_stderr``, NaN without a value; ``quality``
        (0: good, 1: caution, 2: no value) and ``fit_status`` in words. ``table().attrs`` has the units.

        Raises:
            StoreError: the run has no maps yet.
        """
        maps = self.maps
        found = maps.to_dataframe().reset_index()
        words = {int(word): words_of(FitStatus(int(word))) for word in np.unique(found["fit_status"])}
        found["fit_status"] = found["fit_status"].map(words)
        found.attrs = {str(name): maps[name].attrs["units"] for name in maps.data_vars}
        return found

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
        frames: Any,
        output: str | os.PathLike[str] | None = None,
        *,
        what: str = "all",
        prior: str = "frames",
        force: bool = False,
    ) -> xr.Dataset:
        """Calibrate other frames of the sensor, as ``pchem apply`` does.

        Args:
            frames: camera files, globs or folders; or whole DN in memory: (frame, y, x) or one frame (y, x),
                anything that :func:`characterise` takes.
            output: zarr store to write, from which the result is read when it is used; one that holds the
                same already is only opened, and frames in memory are written beside it. None: the result is
                in memory.
            what: electrons, numbers, exposure, separated by commas, or all.
            prior: exposure that the electron numbers are expected to have, as on the command line.
            force: replace calibrated frames that are there.

        Returns:
            Electrons, electron numbers and exposure with their standard errors and units, see
            ``docs/howto/use_the_sensor.md``.

        Raises:
            InputError: the frames do not fit the run.
            ConfigError: the frames are no whole DN, or the output is something else.
        """
        from pchem_pipeline.commands.apply.apply import apply_to_frames
        from pchem_pipeline.commands.apply.settings import ApplySettings, kinds_of

        wanted = ApplySettings(kinds_of(what), prior)
        with tempfile.TemporaryDirectory(prefix="pchem-") as folder:
            place = Path(folder, "applied.zarr") if output is None else Path(output)
            files, target, path, words = paths_of(frames), self._target, "", ""
            if files is None:
                stack, target = stack_of(frames, least=1), target.changed("input", format="npy")
                files = [str(write_stack(place.with_name(f"{place.name}-frames.npy"), stack))]
                path, words = files[0], f"array of shape {tuple(stack.shape)}"
            command = Command(force=force, quiet=True, progress="off")
            try:
                [place] = apply_to_frames(target, files, place, wanted, command)
            except PchEmError as error:
                raise type(error)(str(error).replace(path, words)) from None
            found = self._lazy(RunStore.open(place), "applied")
            return found.load() if output is None else found

    @property
    def verdict(self) -> Verdict:
        """What the model is missing, as the last search found it.

        Raises:
            StoreError: nobody has searched yet.
        """
        found = read_verdict(self.path)
        if found is None:
            name = quoted(self._target.config_path or self.path)
            raise StoreError(f"{self.path}: effects were not searched for yet; run: pchem discrepancy {name}")
        return found

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

        command = Command(progress=progress, quiet=progress == "off")
        find_and_add(self._target, command, refit=refit, effort=effort)
        return self.verdict

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
            if not (0 <= y < ny and 0 <= x < nx and y % 1 == x % 1 == 0):
                raise ConfigError(f"pixel y = {y}, x = {x} is outside the sensor of {ny} x {nx} pixels")
        maps, fit = self.group("maps"), self.group("fit")  # which read the pixels asked for alone
        chosen = [("", int(y), int(x)) for y, x in places]
        index = pixel_index(places, nx)
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

    def figure(self, name: str, width: float | str | None = None, *, ax: Any = None) -> Any:
        """Draw a figure of the report or of the discrepancy page, such as ``ensemble`` or ``map_bias``.

        Args:
            name: one of :attr:`figures`.
            width: mm, or a text such as ``"3.5in"``; None: the figure's own.
            ax: axes of matplotlib to draw into, one for each panel. None: a figure of its own.

        Returns:
            ``ax``, or the :class:`Drawing`, which a notebook shows and ``savefig`` saves.

        Raises:
            ConfigError: the run has no such figure, no figure can be so wide, or ``ax`` are no axes of it.
        """
        if name not in self.figures:
            raise ConfigError(f"this run has no figure {name}; it has {', '.join(self.figures)}")
        figure = self.figures[name]
        return _drawn(figure.chart, figure.width_mm if width is None else width, ax)


def _drawn(chart: Chart, width: float | str, ax: Any) -> Any:
    """Draw a chart into axes and return these; without axes return a drawing of its own."""
    if ax is None:
        return draw_chart(Look(millimetres(str(width))), chart)
    draw_panels(ax, chart)
    return ax


class Pixel(PixelFit):
    """One pixel: its parameters with standard errors, its histogram, and what is drawn of it.

    Attributes:
        y, x: row and column; for ready-made histograms ``y = 0`` and ``x`` is the channel.
        parameters: ``quanta_exposure`` (e-), ``conversion_gain`` (e-/DN), ``bias`` (DN), ``read_noise_dn``
            (DN) and ``read_noise_e`` (e-); NaN without a fit.
        stderr: standard errors under the same names.
        status: why it has no fit, or one to be used with caution; empty: a good fit.
        goodness_p: probability of a larger chi-square if the model holds; NaN if unknown.
    """

    def __repr__(self) -> str:
        words = ", ".join(f"{name} = {self.text(name)}" for name in self.parameters)
        return f"<Pixel y = {self.y}, x = {self.x}: {words}; {self.status or 'good fit'}>"

    def _repr_html_(self) -> str:
        """Return the parameters as a table, for a notebook."""
        rows = [(symbol(name)[1], self.text(name)) for name in self.parameters]
        head = f"pixel y = {self.y}, x = {self.x}: {self.status or 'good fit'}"
        return f"<p>{escape(head)}</p>{html_table(('parameter', 'value'), rows)}"

    @cached_property
    def histogram(self) -> xr.DataArray:
        """Number of frames at each DN, over the DN that occur."""
        return self._over_dn(self.counts, "frames at each DN")

    @cached_property
    def expected(self) -> xr.DataArray:
        """Number of frames expected at each DN from the fit; NaN where there is none."""
        return self._over_dn(pixel_columns(self)["expected frames"], "frames expected at each DN")

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

    def plot(self, *, ax: Any = None, width: float | str = COLUMN_MM) -> Any:
        """Draw the histogram with its fit and the residuals, as the report does.

        Args:
            ax: axes of matplotlib to draw into: one for the histogram, or two for the residuals, too. None: a
                figure of its own.
            width: of that figure, mm, or a text such as ``"3.5in"``.

        Returns:
            ``ax``, or the :class:`Drawing`, which a notebook shows and ``savefig`` saves.

        Raises:
            ConfigError: no figure can be so wide, or ``ax`` are no axes of it.
        """
        chart = pixels_chart([self])
        if ax is not None and np.size(ax) == 1:
            [stack] = chart.stacks
            chart = Chart((replace(stack, panels=stack.panels[:1]),))
        return _drawn(chart, width, ax)
