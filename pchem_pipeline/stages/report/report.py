"""Stage ``report``: report.html and report.json, from what the other stages stored."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.errors import ConfigError, quoted
from pchem_pipeline.base.variables import CHARGE_RATES, PARAMETERS
from pchem_pipeline.compute.executor import Beside, beside
from pchem_pipeline.compute.memory import BASE_BYTES, SECOND_PROGRAM_BYTES
from pchem_pipeline.compute.settings import ComputeSettings
from pchem_pipeline.config.load import dump_config
from pchem_pipeline.discrepancy.observe.catalogue import STATISTICS
from pchem_pipeline.discrepancy.verdict import Verdict
from pchem_pipeline.effects.framework.compose import model_words
from pchem_pipeline.effects.framework.registry import effect_classes
from pchem_pipeline.model.ensemble.components import COMPONENT_CASES
from pchem_pipeline.model.maps.ordered import median_of
from pchem_pipeline.planning.frames import frames_needed, precision
from pchem_pipeline.planning.point import Point
from pchem_pipeline.planning.targets import parse_target
from pchem_pipeline.report.data import DiscrepancyData, PixelFit, ReportData, Sample, Samples
from pchem_pipeline.report.figures.ensemble import case_name
from pchem_pipeline.report.figures.figure import Figure
from pchem_pipeline.report.figures.stability import stability_figures
from pchem_pipeline.report.inspector import InspectorData, PixelSample
from pchem_pipeline.report.pages.discrepancy import DISCREPANCY_PAGE
from pchem_pipeline.report.pages.page import DrawAll, Drawn, draw_figure
from pchem_pipeline.report.pages.report import render_report
from pchem_pipeline.report.pages.summary import check_sentence
from pchem_pipeline.report.style.wording import short_name
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.run.stage import WHOLE, StageContext, Unit
from pchem_pipeline.stages.maps import NO_TIME
from pchem_pipeline.stages.quick_look import read_sums, run_quick_look
from pchem_pipeline.stages.report.inspector import deciding_parameters, inspector_data, read_maps
from pchem_pipeline.stages.report.pixels import (
    Chosen,
    ChosenPixels,
    bin_masses,
    choose_inspected,
    choose_pixels,
    pixel_fits,
    pixel_index,
)
from pchem_pipeline.stages.report.stored import PixelHistograms, StoredRun, read_histograms, read_run
from pchem_pipeline.stages.samples import exposure_axis
from pchem_pipeline.stages.table import pipeline
from pchem_pipeline.store.run_store import RunStore, stored_config

if TYPE_CHECKING:
    from pchem_pipeline.config.tree import RunConfig
    from pchem_pipeline.run.sensor import SensorInfo
    from pchem_pipeline.store.records import StageRecord


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
                f"report.pixels: pixel y = {y}, x = {x} is outside the sensor of {ny} x {nx} pixels; choose "
                f"y below {ny} and x below {nx}"
            )
    task = functools.partial(
        _write,
        config=context.config,
        stages=_stage_rows(context),
        draw=draw_and_say(context.reporter, context.stage),
    )
    held = 300 * ny * nx  # the maps as a whole; measured at 2048 x 1152, 940 MiB in all
    done = context.run_units([WHOLE], task, unit_name="report", unit_bytes=held)
    for text in done.get(WHOLE.key, {}).get("warnings", ()):
        context.note(text)


def _write(
    unit: Unit,
    store: RunStore,
    *,
    config: RunConfig,
    stages: list[dict[str, Any]],
    draw: DrawAll,
) -> dict[str, Any]:
    """Gather, draw and write."""
    with beside(_workers(config.compute)) as hand:
        data = gather(store, config, stages, hand)
        files = render_report(data, draw)
    for name, text in files.items():
        store.write_file(name, text.encode())
    if DISCREPANCY_PAGE not in files:
        (store.path / DISCREPANCY_PAGE).unlink(missing_ok=True)
    return {"warnings": _warnings(data)}


def _warnings(data: ReportData) -> list[str]:
    """Return what the quick look found that is more than a remark, for the terminal."""
    look = data.quick_look
    if look is None or data.discrepancy is not None:
        return []
    found = [check_sentence(check) for check in look.found if check.level in ("caution", "serious")]
    if not found or look.found[0].name == "levels":
        return found
    return [*found, f"to look closer: {look.command}"]


def gather(
    store: RunStore,
    config: RunConfig,
    stages: Sequence[Mapping[str, Any]],
    hand: Beside = functools.cache,
) -> ReportData:
    """Read all that the report shows.

    Args:
        store: the run.
        config: its configuration.
        stages: rows of the table of stages.
        hand: takes what can be done meanwhile: single pixels, and packing maps for the inspector.

    Raises:
        StoreError: maps or histograms are missing.
    """
    threads = _workers(config.compute)
    run = read_run(store, threads)
    # two ways of about the same length: single pixels and packed maps, the quick look and figures and tables
    pixels = hand(functools.partial(_of_pixels, store, run, config))
    sums = read_sums(store)
    stability = hand(functools.partial(stability_figures, sums))
    inspector = hand(lambda: _inspector(store, run, pixels(), max(1, threads - 1)))
    look = run_quick_look(store, run, sums)
    return replace(
        report_data(run, config, stages),
        pixels=pixels().fits,
        inspector=inspector,
        quick_look=look,
        stability=stability(),
        # what a single command was given is no setting of the run
        config_yaml=stored_config(store.path) or dump_config(config),
    )


@dataclass(frozen=True)
class _Pixels:
    """Single pixels of the report.

    Attributes:
        fits: of those that are shown.
        full: those that the inspector holds in full.
        histograms: of the latter.
        masses: of as many of the first of them, under a model with effects.
    """

    fits: list[PixelFit]
    full: ChosenPixels
    histograms: PixelHistograms
    masses: list[FloatArray]


def _of_pixels(store: RunStore, run: StoredRun, config: RunConfig) -> _Pixels:
    """Choose pixels, and read their histograms."""
    shown = _shown(run, config)
    places, bins = [(y, x) for _, y, x in shown], store.array("histogram/counts").shape[2]
    suspects = [] if run.verdict is None else [p for each in run.verdict.where for p in each.pixels]
    full = choose_inspected(run.maps, run.fit, places, suspects, bins=bins)
    index = np.concatenate([pixel_index(shown, run.sensor.shape), full.index])
    histograms = read_histograms(store, index, run.sensor.shape)
    drawn, held = slice(0, len(shown)), slice(len(shown), None)
    some = slice(0, len(shown) + 300)  # those with the mass of a model with effects
    masses = bin_masses(_parameters(run, index[some]), histograms.of(some), run.model.at(index[some]))
    channel = run.sensor.kind == "histograms"
    fits = pixel_fits(shown, run.maps, run.fit, histograms.of(drawn), masses[drawn], channel=channel)
    return _Pixels(fits, full, histograms.of(held), masses[held])


def _inspector(store: RunStore, run: StoredRun, pixels: _Pixels, threads: int) -> InspectorData:
    """Pack maps, and the pixels that are held in full, for the inspector."""
    index, held, shape = pixels.full.index, pixels.histograms, run.sensor.shape
    read = {f"maps/{name}": values for name, values in run.maps.items()}
    read |= {f"fit/{name}": run.fit[name] for name in ("fit_status", "outlier_share") if name in run.fit}
    maps, exact = read_maps(store, shape, index, read, threads)
    deciding = deciding_parameters(_parameters(run, index), run.model.at(index))
    sample = PixelSample(index, exact, held.origin, held.counts, deciding, pixels.masses, pixels.full.reasons)
    return inspector_data(run.name, shape, maps, sample)


def _parameters(run: StoredRun, index: IntArray) -> list[FloatArray]:
    """Return (H, g, mu, sigma) of some pixels."""
    return [run.maps[name].reshape(-1)[index] for name in PARAMETERS]


def _shown(run: StoredRun, config: RunConfig) -> list[Chosen]:
    """Return the pixels that stand for the sensor."""
    chosen: list[Chosen] = [("", y, x) for y, x in config.report.pixels]
    if not chosen and run.sensor.names and run.sensor.nx <= 12:  # so few are all shown
        chosen = [(short_name(name), 0, x) for x, name in enumerate(run.sensor.names)]
    if not chosen:
        chosen = choose_pixels(run.maps["read_noise_e"], run.maps["quanta_exposure"], run.fit["fit_status"])
    return chosen


def report_data(
    run: StoredRun,
    config: RunConfig,
    stages: Sequence[Mapping[str, Any]],
) -> ReportData:
    """Return all that the report shows but its single pixels, from plain data.

    Args:
        run: what the store holds.
        config: its configuration.
        stages: rows of the table of stages.
    """
    maps, facts, sensor = run.maps, dict(run.facts["ensemble"]), run.sensor
    moments, _ = facts.pop("moments", []), facts.pop("missing", {})
    cases = facts.pop("component_cases", COMPONENT_CASES)
    n_frames = sensor.n_frames if sensor.kind == "frames" else None
    return ReportData(
        title=config.run.title or run.name,
        shape=sensor.shape,
        kind=config.input.kind,
        n_frames=n_frames,
        integration_time=sensor.with_settings(config.input).integration_time,
        camera=sensor.camera.words(),
        maps=maps,
        fit=run.fit,
        misfits=run.facts["maps"].get("goodness", {}),
        intervals=run.intervals,
        interval_level=config.fit.interval_level,
        ensemble=run.ensemble,
        ensemble_facts=facts,
        component_cases=[case_name(case) for case in cases],
        moments=moments,
        truth=run.truth,
        channel_names=[short_name(name) for name in sensor.names],
        percentiles=config.maps.percentiles,
        outlier_sigmas=config.maps.outlier_sigmas,
        allowed_failed=config.run.allowed_failed_pixels,
        criteria=config.report.criteria,
        config_yaml=dump_config(config),
        run=_run_facts(run, config),
        inputs=[
            {"name": file.get("name"), "size": file.get("size"), "hash": file.get("xxh3_128", "")}
            for file in sensor.identity.get("files", [])
        ],
        stages=list(stages),
        missing=_missing(run, maps),
        methods=run.methods,
        # several samples need other frames than one: see pchem plan
        plan=None if sensor.samples else plan_section(maps, n_frames),
        discrepancy=None if run.verdict is None else verdict_data(run.verdict, run.discrepancy),
        samples=_samples(run, config),
    )


def verdict_data(found: Verdict, arrays: Mapping[str, NDArray[Any]]) -> DiscrepancyData:
    """Return what the report shows of a verdict, with the names of effects and statistics.

    Args:
        found: the verdict.
        arrays: group ``discrepancy`` of the store.
    """
    effects = effect_classes()
    # those of a search with other statistics are in another order: what its JSON tells is left
    vectors = ("z_before", "z_after")  # a number for each statistic
    arrays = {n: array for n, array in arrays.items() if n not in vectors or len(array) == len(STATISTICS)}
    signs = dict(zip(STATISTICS, arrays.get("z_before", ()), strict=False))
    return DiscrepancyData(
        found=found,
        arrays=arrays,
        statistics={name: (s.channel, s.says(signs.get(name, 1.0))) for name, s in STATISTICS.items()},
        titles={tag: effect.title for tag, effect in effects.items() if effect.title},
        sources={tag: effect.source for tag, effect in effects.items() if effect.source},
    )


def plan_section(maps: Mapping[str, NDArray[Any]], n_frames: int | None) -> dict[str, Any] | None:
    """Return the frames that precisions need at the median pixel, or None where no pixel has a value.

    Args:
        maps: of the run.
        n_frames: frames of the run, or None where pixels differ.
    """
    names = ("quanta_exposure", "read_noise_e", "conversion_gain")
    medians = [median_of(maps[name]) for name in names if name in maps]
    if len(medians) < len(names) or not np.isfinite(medians).all():
        return None
    exposure, noise, gain = medians
    try:
        point = Point(exposure, noise, gain)
    except ConfigError:
        return None
    targets = ("conversion_gain=1%", "read_noise_e=1%", "quanta_exposure=1%", "bias=0.02e-")
    rows = [
        {"target": str(target), "name": target.name, "frames": frames_needed(target, point)}
        for target in map(parse_target, targets)
    ]
    reached = {} if n_frames is None else precision(point, n_frames)
    return {"rows": rows, "reached": reached, "exposure": exposure, "read_noise": noise}


def _samples(run: StoredRun, config: RunConfig) -> Samples | None:
    """Return the exposures of a run of several; None for a run of one."""
    found = run.sensor.samples
    if not found or "quanta_exposure" not in run.samples:
        return None
    x = exposure_axis(config.input, found)
    places = [None if x is None or np.isnan(x[i]) else float(x[i]) for i in range(len(found))]
    samples = [
        Sample(each.name, "bias" if each.bias else "exposed", place, each.n_frames)
        for each, place in zip(found, places, strict=True)
    ]
    return Samples(tuple(samples), config.input.against, run.samples, run.sensor.shown)


def _run_facts(run: StoredRun, config: RunConfig) -> dict[str, Any]:
    sensor = run.sensor
    facts: dict[str, Any] = {
        "store": run.name,
        "input": _input_text(sensor),
        "type of the data": sensor.dtype,
        "bit depth": sensor.bit_depth,
        "digest of the input": sensor.identity.get("digest", ""),
    }
    if config.simulate is not None:
        facts["seed of the simulation"] = config.simulate.seed
    version = run.model.version
    if version is not None and version.effects:
        facts["model"] = model_words(version.effects)
    if version is not None:
        source = "search for missing effects" if version.source == "verdict" else "configuration"
        facts["version of the model"] = f"{version.number} (from the {source})"
    if run.record is not None:
        facts["report made (UTC)"] = run.record.started
        facts["versions"] = run.record.versions
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


def _input_text(sensor: SensorInfo) -> str:
    if sensor.samples:
        return f"{len(sensor.samples)} samples; maps and ensemble show {sensor.samples[sensor.shown].name}"
    if sensor.kind != "frames":
        return "ready-made histograms"
    return f"frames, {sensor.mode}" + (f", read as {sensor.reader}" if sensor.reader else "")


def _missing(run: StoredRun, maps: Mapping[str, NDArray[Any]]) -> dict[str, str]:
    """Say why parts are left out."""
    found: dict[str, str] = {}
    if not set(CHARGE_RATES) & maps.keys():
        found["charge_rate"] = (
            "no charge rate: input.against is not integration_time" if run.sensor.samples else NO_TIME
        )
    if not any(np.isfinite(values).any() for values in maps.values()):
        found["maps"] = "no pixel has a value"
    why = "no pixel has parameters" if "maps" in found else "the stage ensemble has no result"
    for part, name, what in (
        ("ensemble", "density", "no ensemble prediction"),
        ("nuced", "nuced_density", "no non-uniformity correction"),
        ("electrons", "electron_mass", "no electron numbers"),
        ("components", "component_variance", "no component widths"),
    ):
        if name not in run.ensemble:
            found[part] = f"{what}: {why}"
    if run.sensor.samples:
        found["methods"] = "compare methods in the run of one sample (pchem methods RUN --with OTHER)"
    elif run.methods is None:
        found["methods"] = f"to compare other methods: pchem methods {quoted(Path(run.name))}"
    return found


def _workers(settings: ComputeSettings) -> int:
    """Return how many may work on a report at a time."""
    workers = settings.count()
    if settings.max_memory is not None:
        workers = min(workers, max(1, ((settings.max_memory << 20) - BASE_BYTES) // SECOND_PROGRAM_BYTES))
    return workers


def draw_and_say(reporter: Reporter, label: str) -> DrawAll:
    """Return a function that draws figures in this process, under a bar with this label.

    Others would spend more on their imports than on their share of the figures.
    """

    def draw(figures: Sequence[Figure]) -> dict[str, Drawn]:
        drawn = {}
        with reporter.progress(label, len(figures), "figure") as advance:
            for figure in figures:
                drawn[figure.name] = draw_figure(figure)
                advance()
        return drawn

    return draw
