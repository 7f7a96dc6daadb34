"""Stage ``report``: report.html, report.json and the figures, from what the other stages stored."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.base.variables import FREE_LOBES, INTERVALS, PARAMETERS, interval_names, variables_of
from pchem_pipeline.effects.framework.compose import marginal_model, model_words, pixel_maps
from pchem_pipeline.model.ensemble.components import COMPONENT_CASES
from pchem_pipeline.model.fit.grown import marginal_mass
from pchem_pipeline.model.fit.status import FAILED, MEANINGS, describe
from pchem_pipeline.report.data import PixelFit, ReportData
from pchem_pipeline.report.figures.catalogue import FIGURE_NAMES
from pchem_pipeline.report.figures.ensemble import case_name
from pchem_pipeline.report.pages.discrepancy import DISCREPANCY_PAGE
from pchem_pipeline.report.pages.report import RenderedReport, render_report
from pchem_pipeline.run.model_versions import model_of
from pchem_pipeline.run.stage import WHOLE, StageContext, Unit, open_store
from pchem_pipeline.stages.discrepancy.result import read_discrepancy
from pchem_pipeline.stages.fit.fitted_model import fitted_added_exposure, fitted_effects
from pchem_pipeline.stages.methods.result import METHODS_FILE, read_methods
from pchem_pipeline.stages.report.drawing import draw_by_workers
from pchem_pipeline.stages.report.inspector import gather_inspector
from pchem_pipeline.stages.report.plan_section import plan_section
from pchem_pipeline.stages.report.samples import read_samples
from pchem_pipeline.stages.table import pipeline

if TYPE_CHECKING:
    from pchem_pipeline.config.tree import RunConfig
    from pchem_pipeline.effects.framework.effect import Effect
    from pchem_pipeline.report.pages.pictures import DrawAll
    from pchem_pipeline.report.settings import ReportSettings
    from pchem_pipeline.run.sensor import SensorInfo
    from pchem_pipeline.store.records import StageRecord
    from pchem_pipeline.store.run_store import RunStore

__all__ = ["choose_pixels", "read_pixels", "report_tile", "run"]

#: Where a version of the model comes from, in words.
_SOURCES = {"config": "from the configuration", "verdict": "from the verdict on what the model is missing"}
_FIT_MAPS = ("fit_status", "goodness_p", "goodness_chi2", "goodness_dof", "outlier_share")
#: Maps that are no parameters.
_NOT_SHOWN = ("quality", "goodness_q")
_TRUTH = (*PARAMETERS, "read_noise_e")
#: Labels of the four shown pixels, and the ranks of read noise and quanta exposure at which they lie.
_CORNERS = (
    ("low read noise, low exposure", 0.1, 0.1),
    ("low read noise, high exposure", 0.1, 0.9),
    ("high read noise, low exposure", 0.9, 0.1),
    ("high read noise, high exposure", 0.9, 0.9),
)
#: All channels of a line of so few are shown.
_FEW_CHANNELS = 12

Chosen = tuple[str, int, int]


def choose_pixels(
    read_noise_e: NDArray[np.float64], quanta_exposure: NDArray[np.float64], fit_status: NDArray[Any]
) -> list[Chosen]:
    """Choose four pixels at low and high read noise and low and high exposure (fig:plot_per_pixel_fits).

    Ranks are taken among the pixels with a good fit (with any value, if fewer than four are good); the
    pixel nearest to the 10 or 90 % rank of both is taken, each once. Where no pixel has a value, one of each
    reason for it is shown, the most frequent reasons first.

    Args:
        read_noise_e: sigma_e-, e-, shape (ny, nx), NaN where there is no value.
        quanta_exposure: H, e-, shape (ny, nx).
        fit_status: status words, shape (ny, nx).

    Returns:
        Label, y and x of each; at most four.
    """
    known = np.isfinite(read_noise_e) & np.isfinite(quanta_exposure)
    if not known.any():
        words, first, counts = np.unique(fit_status, return_index=True, return_counts=True)
        order = np.argsort(-counts, kind="stable")[:4]
        places = [divmod(int(first[i]), fit_status.shape[1]) for i in order]
        return [("no fit", y, x) for (y, x), _ in zip(places, words[order], strict=True)]
    good = known & (fit_status == 0)
    where = np.argwhere(good if good.sum() >= len(_CORNERS) else known)
    noise, exposure = (_ranks(values[tuple(where.T)]) for values in (read_noise_e, quanta_exposure))
    chosen: list[Chosen] = []
    free = np.ones(len(where), dtype=bool)
    for label, at_noise, at_exposure in _CORNERS[: len(where)]:
        distance = (noise - at_noise) ** 2 + (exposure - at_exposure) ** 2
        best = int(np.argmin(np.where(free, distance, np.inf)))
        free[best] = False
        chosen.append((label, int(where[best, 0]), int(where[best, 1])))
    return chosen


def _ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    ranks = np.empty(values.size)
    ranks[np.argsort(values, kind="stable")] = (np.arange(values.size) + 0.5) / values.size
    return ranks


def report_tile(data: ReportData, settings: ReportSettings, draw: DrawAll | None = None) -> RenderedReport:
    """Return the files of the report; pure. ``draw`` draws all figures at once."""
    return render_report(data, settings, draw)


def run(context: StageContext) -> None:
    """Write the report.

    Raises:
        ConfigError: a pixel of ``report.pixels`` lies outside the sensor.
        StoreError: an array is missing or the store cannot be written.
    """
    ny, nx = context.sensor.shape
    for y, x in context.config.report.pixels:
        if y >= ny or x >= nx:
            raise ConfigError(
                f"report.pixels: pixel y = {y}, x = {x} lies outside the sensor of {ny} x {nx} pixels; "
                f"choose y below {ny} and x below {nx}"
            )
    task = functools.partial(
        _write,
        context.store.path,
        context.config,
        context.integration_time,
        _stage_rows(context),
        draw_by_workers(context.executor.workers, context.reporter, context.stage),
    )
    context.run_units([WHOLE], task, unit_name="report")


def _write(
    path: Path,
    config: RunConfig,
    integration_time: float | None,
    stages: list[dict[str, Any]],
    draw: DrawAll | None,
    unit: Unit,
) -> dict[str, Any]:
    """Gather, draw and write; files of figures that this run does not have any more are removed."""
    store = open_store(path)
    data = gather(store, config, integration_time, stages)
    rendered = report_tile(data, config.report, draw)
    for name, content in rendered.figures.items():
        store.write_file(f"figures/{name}", content)
    for old in (path / "figures").glob("*.*"):
        if old.name not in rendered.figures and old.stem in FIGURE_NAMES:
            old.unlink(missing_ok=True)
    for name, page in rendered.pages.items():
        store.write_file(name, page.encode())
    if not rendered.pages:
        (path / DISCREPANCY_PAGE).unlink(missing_ok=True)
    store.write_file("report.json", rendered.json.encode())
    store.write_file("report.html", rendered.html.encode())
    return {"figures": len(rendered.figures), "html_bytes": len(rendered.html.encode())}


def gather(
    store: RunStore, config: RunConfig, integration_time: float | None, stages: Sequence[Mapping[str, Any]]
) -> ReportData:
    """Read all that the report shows.

    Args:
        store: the run.
        config: its configuration.
        integration_time: seconds, or None.
        stages: rows of the table of stages.

    Raises:
        StoreError: maps or histograms are missing.
    """
    from pchem_pipeline.config.load import dump_config
    from pchem_pipeline.run.sensor import SensorInfo

    sensor = SensorInfo.read(store)
    n_frames = sensor.n_frames if sensor.kind == "frames" else None
    intervals = _intervals(store)
    ends = [path for name in intervals for path in interval_names(name)]
    maps = _group(store, "maps", skip=(*_NOT_SHOWN, *ends))
    fit = {name: store.read(f"fit/{name}") for name in _FIT_MAPS if store.has(f"fit/{name}")}
    pixels = read_pixels(store, _shown(config, sensor, maps, fit), sensor, maps, fit)
    discrepancy = read_discrepancy(store)
    suspects = [place for each in discrepancy.found.where for place in each.pixels] if discrepancy else []
    if store.has("maps/goodness_q"):
        fit["goodness_q"] = store.read("maps/goodness_q")
    if "fit_status" in fit:
        # only what has a value can agree with its model or not
        failed = (fit["fit_status"] & int(FAILED)) != 0
        fit |= {name: np.where(failed, np.nan, fit[name]) for name in fit if name.startswith("goodness_")}
    misfits = store.attributes("maps").get("goodness", {})
    worst = [(f"q = {row['q']:.2g}", row["y"], row["x"]) for row in misfits.get("worst", ())]
    ensemble = _group(store, "ensemble")
    facts = dict(store.attributes("ensemble"))
    moments, _ = facts.pop("moments", []), facts.pop("missing", {})
    cases = facts.pop("component_cases", COMPONENT_CASES)
    return ReportData(
        title=config.run.title or store.path.name,
        shape=sensor.shape,
        n_frames=n_frames,
        integration_time=integration_time,
        maps=maps,
        fit=fit,
        status_words={int(bit): text for bit, text in MEANINGS.items()},
        failed_mask=int(FAILED),
        pixels=pixels,
        misfits=misfits,
        worst=read_pixels(store, worst, sensor, maps, fit),
        intervals=intervals,
        interval_level=config.fit.interval_level,
        ensemble=ensemble,
        ensemble_facts=facts,
        component_cases=[case_name(case) for case in cases],
        moments=moments,
        truth={name: store.read(f"truth/{name}") for name in _TRUTH if store.has(f"truth/{name}")},
        channel_names=sensor.names,
        percentiles=config.maps.percentiles,
        outlier_sigmas=config.maps.outlier_sigmas,
        allowed_failed=config.run.allowed_failed_pixels,
        config_yaml=dump_config(config),
        run=_run_facts(store, config, sensor),
        inputs=[
            {"name": file.get("name"), "size": file.get("size"), "hash": file.get("xxh3_128", "")}
            for file in sensor.identity.get("files", [])
        ],
        stages=list(stages),
        missing=_missing(maps, ensemble, sensor) | _not_compared(store, sensor),
        methods=read_methods(store),
        # several samples need other frames than one: see pchem plan
        plan=None if sensor.samples else plan_section(maps, n_frames),
        discrepancy=discrepancy,
        samples=read_samples(store, config.input, sensor),
        inspector=gather_inspector(store, sensor, maps, fit, [(p.y, p.x) for p in pixels], suspects),
    )


def _group(store: RunStore, group: str, skip: Sequence[str] = ()) -> dict[str, NDArray[Any]]:
    return {
        variable.name: store.read(variable.path)
        for variable in variables_of(group)
        if variable.name not in skip and store.has(variable.path)
    }


def _intervals(store: RunStore) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Read the ends of the profile intervals, by quantity, where there are any."""
    found = {}
    for name in (*INTERVALS, "dark_current"):
        low, high = (f"maps/{path}" for path in interval_names(name))
        if store.has(low):
            found[name] = store.read(low), store.read(high)
    return found


def _shown(
    config: RunConfig,
    sensor: SensorInfo,
    maps: Mapping[str, NDArray[Any]],
    fit: Mapping[str, NDArray[Any]],
) -> list[Chosen]:
    """Return the pixels that stand for the sensor."""
    chosen: list[Chosen] = [("", y, x) for y, x in config.report.pixels]
    if not chosen and sensor.names and sensor.nx <= _FEW_CHANNELS:
        chosen = [(name, 0, x) for x, name in enumerate(sensor.names)]
    if not chosen:
        chosen = choose_pixels(maps["read_noise_e"], maps["quanta_exposure"], fit["fit_status"])
    return chosen


def read_pixels(
    store: RunStore,
    chosen: Sequence[Chosen],
    sensor: SensorInfo,
    maps: Mapping[str, NDArray[Any]],
    fit: Mapping[str, NDArray[Any]],
) -> list[PixelFit]:
    """Read the histograms and fits of some pixels.

    Args:
        store: the run.
        chosen: label, y and x of each.
        sensor: the input.
        maps: parameters and standard errors, (y, x); anything that is indexed so.
        fit: ``fit_status`` and ``goodness_p``, likewise.
    """
    names = (*PARAMETERS, "read_noise_e")
    effects = fitted_effects(store)
    found = []
    for label, y, x in chosen:
        word = int(fit["fit_status"][y, x])
        origin = int(store.read("histogram/origin", (slice(y, y + 1), slice(x, x + 1)))[0, 0])
        counts = store.read("histogram/counts", (slice(y, y + 1), slice(x, x + 1), slice(None)))[0, 0]
        parameters = {name: float(maps[name][y, x]) for name in names}
        found.append(
            PixelFit(
                label=label,
                y=y,
                x=x,
                origin=origin,
                counts=counts,
                parameters=parameters,
                stderr={name: float(maps[f"{name}_stderr"][y, x]) for name in names},
                status=describe(word) if word else "",
                goodness_p=float(fit["goodness_p"][y, x]) if "goodness_p" in fit else float("nan"),
                channel=sensor.kind == "histograms",
                mass=_grown_mass(store, effects, parameters, (y, x), origin + np.arange(counts.size)),
            )
        )
    return found


def _grown_mass(
    store: RunStore,
    effects: tuple[Effect, ...],
    parameters: Mapping[str, float],
    place: tuple[int, int],
    codes: NDArray[np.int64],
) -> NDArray[np.float64] | None:
    """Return the mass of a pixel's codes under the model with effects; None without effects or a value."""
    columns = [np.array([parameters[name]]) for name in PARAMETERS]
    if not effects or not np.isfinite(columns).all():
        return None
    region = tuple(slice(i, i + 1) for i in place)
    lobes = tuple(store.read(f"fit/{name}", region).ravel() for name in FREE_LOBES)
    added = fitted_added_exposure(store, (region[0], region[1]))
    model = marginal_model(effects, pixel_maps(columns, np.ones(1, bool)), added)
    mass: NDArray[np.float64] = marginal_mass(model, columns, codes, lobes=(lobes[0], lobes[1]))[0]
    return mass


def _run_facts(store: RunStore, config: RunConfig, sensor: SensorInfo) -> dict[str, Any]:
    record = store.records.read("report")
    facts: dict[str, Any] = {
        "store": store.path.name,
        "input": _input_words(sensor),
        "type of the data": sensor.dtype,
        "bit depth": sensor.bit_depth,
        "digest of the input": sensor.identity.get("digest", ""),
    }
    if config.simulate is not None:
        facts["seed of the simulation"] = config.simulate.seed
    version = model_of(store, "fit")
    if version is not None and version.effects:
        facts["model"] = model_words(version.effects)
    if version is not None:
        facts["version of the model"] = f"{version.number} ({_SOURCES[version.source]})"
    if record is not None:
        facts["report made (UTC)"] = record.started
        facts["versions"] = record.versions
    return facts


def _stage_rows(context: StageContext) -> list[dict[str, Any]]:
    """Return what the table of stages shows, the report itself left out."""
    names = [name for name in pipeline() if name != context.stage]
    records = [context.store.records.read(name) for name in names]
    return [_stage_row(context.store, record) for record in records if record is not None]


def _stage_row(store: RunStore, record: StageRecord) -> dict[str, Any]:
    done = len(store.records.done(record.stage, record.fingerprint))
    complete = done >= record.keys > 0
    return {
        "stage": record.stage,
        "state": "complete" if complete else f"{done} of {record.keys} units",
        "seconds": record.seconds,
        "cpu_seconds": record.cpu_seconds,
        "peak_memory_bytes": record.peak_rss_bytes,
        "started": record.started,
        "notes": list(record.notes),
    }


def _input_words(sensor: SensorInfo) -> str:
    if sensor.samples:
        return f"{len(sensor.samples)} samples; maps and ensemble show {sensor.samples[sensor.shown].name}"
    return f"{sensor.kind}, {sensor.mode}" if sensor.kind == "frames" else "ready-made histograms"


def _missing(
    maps: Mapping[str, NDArray[Any]], ensemble: Mapping[str, NDArray[Any]], sensor: SensorInfo
) -> dict[str, str]:
    """Say why parts are left out."""
    found: dict[str, str] = {}
    if "dark_current" not in maps:
        found["dark_current"] = (
            "no dark current: the samples are not drawn over their integration time (input.against)"
            if sensor.samples
            else "no dark current, since the integration time is not known; set input.integration_time (s)"
        )
    if not any(np.isfinite(values).any() for values in maps.values()):
        found["maps"] = "no pixel has a value"
    why = "no pixel has parameters" if "maps" in found else "the stage ensemble has no result"
    for part, name in (
        ("ensemble", "density"),
        ("nuced", "nuced_density"),
        ("electrons", "electron_mass"),
        ("components", "component_variance"),
    ):
        if name not in ensemble:
            found[part] = f"{_PARTS[part]}: {why}"
    return found


def _not_compared(store: RunStore, sensor: SensorInfo) -> dict[str, str]:
    if sensor.samples:
        return {"methods": "methods are compared in the run of a sample, with the others beside it (--with)"}
    if (store.path / METHODS_FILE).exists():
        return {}
    return {"methods": f"not compared in this run; to do so, run: pchem methods {store.path.name}"}


_PARTS = {
    "ensemble": "no ensemble prediction",
    "nuced": "no non-uniformity correction",
    "electrons": "no electron numbers",
    "components": "no component widths",
}
