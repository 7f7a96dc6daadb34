"""Stage ``report``: report.html and report.json, from what the other stages stored."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.base.wording import short_name
from pchem_pipeline.compute.executor import Beside, beside
from pchem_pipeline.compute.memory import BASE_BYTES, SECOND_PROGRAM_BYTES
from pchem_pipeline.compute.settings import ComputeSettings
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.report.data import PixelFit, ReportData
from pchem_pipeline.report.figures.figure import Figure
from pchem_pipeline.report.figures.stability import stability_figures
from pchem_pipeline.report.inspector import InspectorData, PixelSample
from pchem_pipeline.report.pages.discrepancy import DISCREPANCY_PAGE
from pchem_pipeline.report.pages.page import DrawAll, Drawn, draw_figure
from pchem_pipeline.report.pages.report import render_report
from pchem_pipeline.report.pages.summary import check_sentence
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.run.stage import WHOLE, StageContext, Unit
from pchem_pipeline.stages.defects import stored_defects
from pchem_pipeline.stages.quick_look import read_sums, run_quick_look
from pchem_pipeline.stages.report.inspector import deciding_parameters, inspector_data, read_maps
from pchem_pipeline.stages.report.pixels import (
    Chosen,
    bin_masses,
    choose_inspected,
    choose_pixels,
    pixel_fits,
    pixel_index,
)
from pchem_pipeline.stages.report.stored import StoredRun, read_histograms, read_run
from pchem_pipeline.stages.table import pipeline
from pchem_pipeline.store.run_store import RunStore


def run(context: StageContext) -> None:
    """Write the report.

    Raises:
        ConfigError: a pixel of ``report.pixels`` or a region is outside the sensor.
        StoreError: an array is missing or the store cannot be written.
    """
    ny, nx = context.sensor.shape
    for y, x in context.config.report.pixels:
        if y >= ny or x >= nx:
            raise ConfigError(
                f"report.pixels: pixel y = {y}, x = {x} is outside the sensor of {ny} x {nx} pixels; choose "
                f"y below {ny} and x below {nx}"
            )
    for name, region in context.config.report.regions.items():
        try:
            region.mask((ny, nx))
        except ConfigError as error:
            raise ConfigError(f"report.regions.{name}: {error}") from error
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
    unit: Unit, store: RunStore, *, config: RunConfig, stages: list[dict[str, Any]], draw: DrawAll
) -> dict[str, Any]:
    with beside(_workers(config.compute)) as hand:
        data = gather(store, config, stages, hand)
        files = render_report(data, draw)
    for name, text in files.items():
        store.write_file(name, text.encode())
    if DISCREPANCY_PAGE not in files:
        (store.path / DISCREPANCY_PAGE).unlink(missing_ok=True)
    look = data.quick_look
    if look is None or data.discrepancy is not None:
        return {}
    # what is more than a remark is told in the terminal, too
    found = [check_sentence(check) for check in look.found if check.level in ("caution", "serious")]
    if found and look.found[0].name != "levels":
        found.append(f"to look closer: {look.command}")
    return {"warnings": found}


def gather(
    store: RunStore, config: RunConfig, stages: Sequence[Mapping[str, Any]], hand: Beside = functools.cache
) -> ReportData:
    """Read all that the report shows; ``hand`` takes what can be done meanwhile.

    Raises:
        StoreError: maps or histograms are missing.
    """
    threads = _workers(config.compute)
    run = read_run(store, config, stages, threads)
    # two ways of about the same length: single pixels and packed maps, the quick look and figures and tables
    pixels = hand(functools.partial(_of_pixels, run, config.report.pixels))
    sums = read_sums(store)
    stability = hand(functools.partial(stability_figures, sums))
    inspector = hand(lambda: _inspector(run, pixels()[1], max(1, threads - 1)))
    look = run_quick_look(run, sums)
    defects = stored_defects(store, config, run.data.maps) if "fit_status" in run.data.fit else None
    return replace(
        run.data,
        pixels=pixels()[0],
        inspector=inspector,
        defects=defects,
        quick_look=look,
        stability=stability(),
    )


def _of_pixels(run: StoredRun, asked: Sequence[tuple[int, int]]) -> tuple[list[PixelFit], PixelSample]:
    """Return the fits of the pixels that are shown, and those that the inspector holds, without maps."""
    data, store = run.data, run.store
    shown = _shown(run, asked)
    places, bins = [(y, x) for _, y, x in shown], store.array("histogram/counts").shape[2]
    verdict = data.discrepancy
    suspects = [] if verdict is None else [p for place in verdict.found.where for p in place.pixels]
    full, reasons = choose_inspected(data.maps, data.fit, places, suspects, bins=bins)
    index = np.concatenate([pixel_index(places, data.shape[1]), full])
    histograms = read_histograms(store, index, data.shape)
    drawn, held = slice(0, len(shown)), slice(len(shown), None)
    some = slice(0, len(shown) + 300)  # those with the mass of a model with effects
    masses = bin_masses(run.parameters(index[some]), histograms.of(some), run.model.at(index[some]))
    channel = run.sensor.kind == "histograms"
    fits = pixel_fits(shown, data.maps, data.fit, histograms.of(drawn), masses[drawn], channel=channel)
    deciding, kept = deciding_parameters(run.parameters(full), run.model.at(full)), histograms.of(held)
    return fits, PixelSample(full, {}, kept.origin, kept.counts, deciding, masses[held], reasons)


def _shown(run: StoredRun, asked: Sequence[tuple[int, int]]) -> list[Chosen]:
    data, names = run.data, run.sensor.names
    if asked:
        return [("", y, x) for y, x in asked]
    if names and len(names) <= 12:  # so few are all shown
        return [(short_name(name), 0, x) for x, name in enumerate(names)]
    return choose_pixels(data.maps["read_noise_e"], data.maps["quanta_exposure"], data.fit["fit_status"])


def _inspector(run: StoredRun, sample: PixelSample, threads: int) -> InspectorData:
    data = run.data
    read = {f"maps/{name}": values for name, values in data.maps.items()}
    read |= {f"fit/{name}": data.fit[name] for name in ("fit_status", "outlier_share") if name in data.fit}
    maps, exact = read_maps(run.store, data.shape, sample.index, read, threads)
    return inspector_data(run.store.path.name, data.shape, maps, replace(sample, exact=exact))


def _stage_rows(context: StageContext) -> list[dict[str, Any]]:
    records, rows = context.store.records, []
    for record in (records.read(name) for name in pipeline() if name != context.stage):
        if record is not None:
            done = len(records.done(record.stage, record.fingerprint))
            row = {
                "stage": record.stage,
                "state": "complete" if done >= record.keys > 0 else f"{done} of {record.keys} units",
                "seconds": record.seconds,
                "cpu_seconds": record.cpu_seconds,
                "peak_memory_bytes": record.peak_rss_bytes,
                "started": record.started,
                "notes": list(record.notes),
            }
            rows.append(row)
    return rows


def _workers(settings: ComputeSettings) -> int:
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
