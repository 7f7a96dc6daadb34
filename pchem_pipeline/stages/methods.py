"""Stage ``methods``: the other characterisation methods on the run's pixels, and on simulated ones.

It is not part of ``run``. Its units are the run's pixels and each read noise of the simulation; each leaves
its numbers in its marker, so that a stopped comparison goes on where it was.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pchem_pipeline.base.arrays import FloatArray, IntArray
from pchem_pipeline.base.errors import InputError, StoreError
from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.methods.base import PixelSamples, Sample, methods
from pchem_pipeline.methods.compare import StudyPoint, compare, study_point
from pchem_pipeline.methods.settings import MethodsSettings
from pchem_pipeline.model.fit.status import AMBIGUOUS, FAILED
from pchem_pipeline.run.stage import Named, StageContext
from pchem_pipeline.run.target import Target
from pchem_pipeline.stages.identities import methods_settings
from pchem_pipeline.stages.samples import find_runs, open_sample, same_sensor
from pchem_pipeline.store.files import read_json, write_json
from pchem_pipeline.store.run_store import RunStore

#: File of the result in the folder of a run.
METHODS_FILE = "methods.json"
#: The run's pixels (None), or one read noise of the simulation.
_Unit = Named[StudyPoint | None]


def read_methods(store: RunStore) -> dict[str, Any] | None:
    """Return the content of ``methods.json`` of a run, or None where there is none.

    Raises:
        StoreError: it cannot be read.
    """
    result = read_json(store.path / METHODS_FILE)
    if result is not None and not (isinstance(result, dict) and "study" in result):
        raise StoreError(f"{store.path / METHODS_FILE} is damaged; run pchem methods with --force")
    return result


def open_other_runs(here: Target, names: Sequence[str]) -> list[RunStore]:
    """Return the stores of other runs, as named in ``methods.with_runs`` of a run.

    Raises:
        ConfigError: a run is listed twice, is the run itself, or has other pixels or the same frames.
        StoreError: a run is missing or has no histograms.
    """
    runs = find_runs(names, here.base_dir, "methods.with_runs", here)
    samples = [open_sample(run, where) for run, where in zip(runs, ("this run", *names), strict=True)]
    same_sensor(samples)
    return [each.store for each in samples[1:]]


def choose(shape: tuple[int, int], n_pixels: int, seed: int) -> IntArray:
    """Return flat indices, increasing, of ``n_pixels`` pixels at random places, all if there are fewer.

    Random, so that no pattern of rows or columns is favoured.
    """
    total = shape[0] * shape[1]
    chosen = np.random.default_rng(seed).permutation(total)[: min(n_pixels, total)]
    return np.sort(chosen).astype(np.int64)


def run(context: StageContext) -> None:
    """Write ``methods.json`` and the estimates of every method.

    Raises:
        ConfigError: another run is of other pixels, or is listed twice.
        InputError: the run is one of several samples.
        StoreError: a run is missing or the store cannot be written.
    """
    if context.sensor.samples:
        raise InputError(
            f"{context.store.path} is a joint fit of several samples; compare methods in the run of one "
            "sample: pchem methods RUN --with OTHER"
        )
    settings = methods_settings(context)
    here = Target(context.config, context.base_dir, context.store.path)
    others = open_other_runs(here, settings.with_runs)
    units = [_Unit("run", None), *_study_units(context, settings)]
    stores = [context.store.path, *(other.path for other in others)]
    task = functools.partial(_do, stores=stores, settings=settings, adc_limits=context.sensor.adc_limits)
    found = context.run_units(units, task, unit_name="part")
    if not {unit.key for unit in units} <= found.keys():
        return
    points = [unit.content for unit in units if unit.content is not None]
    names = ("quanta_exposure", "conversion_gain", "n_frames", "n_pixels")
    result = {
        "schema": 1,
        "run": context.store.path.name,
        **found["run"],
        "study": [found[unit.key] for unit in units[1:]],
        "study_at": {name: getattr(points[0], name) for name in names} if points else None,
    }
    for remark in result["remarks"]:
        context.note(remark)
    write_json(context.store.path / METHODS_FILE, result)


def _study_units(context: StageContext, settings: MethodsSettings) -> list[_Unit]:
    """Return the points of the simulation, at the median exposure, gain and number of frames of the run."""
    store = context.store
    gain = store.read("fit/conversion_gain")
    if settings.study_pixels == 0 or not np.isfinite(gain).any():
        return []
    exposure = float(np.nanmedian(store.read("fit/quanta_exposure")))
    y, x = np.divmod(choose(context.sensor.shape, 64, settings.seed), context.sensor.nx)
    frames = int(np.median(_sample(store, y, x).counts.sum(axis=1)))
    conditions = exposure, float(np.nanmedian(gain)), frames, settings.study_pixels, settings.seed
    noises = dict.fromkeys(settings.study_read_noise)
    return [_Unit(f"study-{noise:g}", StudyPoint(noise, *conditions)) for noise in noises]


def _do(
    unit: _Unit,
    store: RunStore,
    *,
    stores: Sequence[Path],
    settings: MethodsSettings,
    adc_limits: tuple[int, int] | None,
) -> dict[str, Any]:
    """Compare the methods on simulated pixels, or on those of the run, whose estimates are stored."""
    if unit.content is not None:
        return study_point(unit.content, settings)
    ny, nx = store.array("fit/bias").shape
    y, x = np.divmod(choose((ny, nx), settings.pixels, settings.seed), nx)
    samples = tuple(_sample(RunStore.open(path), y, x) for path in stores)
    reference, source = _reference(store, y, x)
    # against its own fit PCH-EM cannot err
    skipped = ("pchem_em",) if source == "fit" else ()
    results = compare(PixelSamples(samples, adc_limits), reference, settings, skip_errors=skipped)
    store.write_array("methods/pixel_y", y)
    store.write_array("methods/pixel_x", x)
    blank = np.full((y.size, 4), np.nan)
    estimates = np.stack([blank if r.estimates is None else r.estimates for r in results])
    for column, name in enumerate(PARAMETERS):
        store.write_array(f"methods/{name}", estimates[:, :, column], {"methods": list(methods())})
    words = _sample_words([path.name for path in stores], samples, reference)
    return {
        "pixels": int(y.size),
        "reference": source,
        "samples": words,
        "remarks": _remarks(words),
        "methods": [result.facts for result in results],
    }


def _sample(store: RunStore, y: IntArray, x: IntArray) -> Sample:
    counts, origin = (store.read_pixels(f"histogram/{name}", y, x) for name in ("counts", "origin"))
    return Sample(counts, origin.astype(np.int64))


def _reference(store: RunStore, y: IntArray, x: IntArray) -> tuple[FloatArray, str]:
    """Return what is held for true, and whether it is the truth or the fit of the run."""
    if store.has("truth/read_noise_e"):
        names = (*PARAMETERS[:3], "read_noise_e")
        exposure, gain, bias, noise = (store.read(f"truth/{name}")[y, x] for name in names)
        return np.stack([exposure, gain, bias, noise / gain], axis=1).astype(np.float64), "truth"
    fit = np.stack([store.read(f"fit/{name}")[y, x] for name in PARAMETERS], axis=1)
    # no value, or a bias that may be one electron off
    fit[(store.read("fit/fit_status")[y, x] & int(FAILED | AMBIGUOUS)) != 0] = np.nan
    return fit, "fit"


def _sample_words(
    names: Sequence[str], samples: Sequence[Sample], reference: FloatArray
) -> list[dict[str, Any]]:
    found = []
    for name, sample in zip(names, samples, strict=True):
        moments = sample.moments()
        exposure = reference[:, 1] * (moments.mean - reference[:, 2])
        known = exposure[np.isfinite(exposure)]
        found.append(
            {
                "run": name,
                "n_frames": int(np.median(moments.n_frames)),
                "quanta_exposure": float(np.median(known)) if known.size else None,
            }
        )
    return found


def _remarks(samples: Sequence[Mapping[str, Any]]) -> list[str]:
    if len(samples) == 1:
        return [
            "one sample: methods that need dark frames or a series are omitted; add runs of the same pixels "
            "at other exposures with --with"
        ]
    known = [each for each in samples if each["quanta_exposure"] is not None]
    darkest = min(known, key=lambda each: each["quanta_exposure"], default=None)
    if darkest is None or darkest["quanta_exposure"] <= 0.01:
        return []
    return [
        f"the darkest sample, {darkest['run']}, has electrons (H = {darkest['quanta_exposure']:.3g} e-): "
        "methods that use it as bias are off by this amount"
    ]
