"""Stage ``methods``: the other characterisation methods on the run's pixels, and on simulated ones.

It is not part of ``run``. Its units are the run's pixels and each read noise of the simulation; each leaves
its numbers in its marker, so that a stopped comparison goes on where it was.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.methods.base import FloatArray, PixelSamples, Sample, Settings
from pchem_pipeline.methods.compare import MethodResult, compare
from pchem_pipeline.methods.registry import methods
from pchem_pipeline.methods.settings import MethodsSettings
from pchem_pipeline.methods.study import StudyPoint, study_point
from pchem_pipeline.model.fit.status import AMBIGUOUS, FAILED
from pchem_pipeline.run.stage import Named, StageContext
from pchem_pipeline.stages.methods.inputs import METHODS_FILE, methods_settings, open_other_runs

if TYPE_CHECKING:
    from pchem_pipeline.store.run_store import RunStore

#: Pixels whose fit is no reference: no value, or a bias that may be one electron off.
_NO_REFERENCE = FAILED | AMBIGUOUS
_DARK_LIMIT = 0.01  # e-: more electrons in the dark sample are remarked


#: The run's pixels (None), or one read noise of the simulation.
_Unit = Named[StudyPoint | None]


@dataclass(frozen=True)
class _Task:
    """Does a unit."""

    others: tuple[Path, ...]
    settings: MethodsSettings
    adc_limits: tuple[int, int] | None

    def __call__(self, unit: _Unit, store: RunStore) -> dict[str, Any]:
        """Compare the methods and return the numbers as plain data."""
        numbers = Settings(self.settings.em_iterations, self.settings.em_tolerance)
        if unit.content is not None:
            return study_point(unit.content, numbers)
        return _compare_run(store, self, numbers)


def choose(shape: tuple[int, int], n_pixels: int, seed: int) -> NDArray[np.int64]:
    """Choose pixels at random places, so that no pattern of rows or columns is favoured.

    Args:
        shape: rows and columns of the sensor.
        n_pixels: how many; all if there are fewer.
        seed: of the choice.

    Returns:
        Flat indices, increasing.
    """
    total = shape[0] * shape[1]
    chosen = np.random.default_rng(seed).permutation(total)[: min(n_pixels, total)]
    return np.sort(chosen).astype(np.int64)


def methods_tile(
    pixels: PixelSamples, reference: FloatArray | None, settings: Settings, *, ours: bool
) -> list[MethodResult]:
    """Return what every method makes of some pixels; pure.

    Args:
        pixels: their samples.
        reference: (H, g, mu, sigma) held for true, shape (n, 4), or None.
        settings: of the methods.
        ours: the reference is the fit of the run itself, against which PCH-EM cannot err.
    """
    return compare(pixels, reference, settings, skip_errors=("pchem_em",) if ours else ())


def run(context: StageContext) -> None:
    """Write ``methods.json`` and the estimates of every method.

    Raises:
        ConfigError: a run is listed twice.
        InputError: another run is of other pixels, or the run is one of several samples.
        StoreError: a run is missing or the store cannot be written.
    """
    if context.sensor.samples:
        raise InputError(
            f"{context.store.path} is a joint fit of several samples; compare methods in the run of one "
            "sample: pchem methods RUN --with OTHER"
        )
    settings = methods_settings(context)
    others = open_other_runs(context.store, context.base_dir, settings.with_runs)
    n_pixels = min(settings.pixels, context.sensor.ny * context.sensor.nx)
    names = list(methods())
    lengths = {"method": len(names), "pixel": n_pixels}
    context.create("methods/pixel_y", "methods/pixel_x", lengths=lengths)
    context.create(*(f"methods/{name}" for name in PARAMETERS), lengths=lengths, methods=names)
    units = [_Unit("run", None), *_study_units(context, settings)]
    task = _Task(tuple(o.path for o in others), settings, context.sensor.adc_limits)
    found = context.run_units(units, task, unit_name="part", by_tiles=False)
    if not {unit.key for unit in units} <= found.keys():
        return
    result = {
        "schema": 1,
        "run": context.store.path.name,
        **found["run"],
        "study": [found[unit.key] for unit in units[1:]],
        "study_at": _conditions(units[1:]),
    }
    for remark in result["remarks"]:
        context.note(remark)
    context.store.write_file(METHODS_FILE, (json.dumps(result, indent=2, allow_nan=False) + "\n").encode())


def _conditions(units: Sequence[_Unit]) -> dict[str, Any] | None:
    if not units or (point := units[0].content) is None:
        return None
    names = ("quanta_exposure", "conversion_gain", "n_frames", "n_pixels")
    return {name: getattr(point, name) for name in names}


def _study_units(context: StageContext, settings: MethodsSettings) -> list[_Unit]:
    """Return the points of the simulation, at the median exposure, gain and number of frames of the run."""
    store = context.store
    gain = store.read("fit/conversion_gain")
    if settings.study_pixels == 0 or not np.isfinite(gain).any():
        return []
    exposure = float(np.nanmedian(store.read("fit/quanta_exposure")))
    place = choose(context.sensor.shape, 64, settings.seed)
    frames = int(np.median(_sample(store, context.sensor.shape, place).counts.sum(axis=1)))
    return [
        _Unit(
            f"study-{noise:g}",
            StudyPoint(
                noise, exposure, float(np.nanmedian(gain)), frames, settings.study_pixels, settings.seed
            ),
        )
        for noise in dict.fromkeys(settings.study_read_noise)
    ]


def _compare_run(store: RunStore, task: _Task, numbers: Settings) -> dict[str, Any]:
    """Compare the methods on the run's pixels, and store their estimates."""
    shape = store.array("fit/bias").shape
    place = choose((shape[0], shape[1]), task.settings.pixels, task.settings.seed)
    stores = [store, *(_readable(path) for path in task.others)]
    samples = tuple(_sample(each, (shape[0], shape[1]), place) for each in stores)
    reference, words = _reference(store, place)
    pixels = PixelSamples(samples, task.adc_limits)
    results = methods_tile(pixels, reference, numbers, ours=words == "fit")
    y, x = np.divmod(place, shape[1])
    everything = (slice(None),)
    store.write("methods/pixel_y", everything, y.astype(np.int32))
    store.write("methods/pixel_x", everything, x.astype(np.int32))
    blank = np.full((place.size, 4), np.nan)
    estimates = np.stack([blank if r.estimates is None else r.estimates for r in results])
    for column, name in enumerate(PARAMETERS):
        store.write(f"methods/{name}", (slice(None), slice(None)), estimates[:, :, column])
    return {
        "pixels": int(place.size),
        "reference": words,
        "samples": _sample_words(stores, samples, reference),
        "remarks": _remarks(stores, samples, reference),
        "methods": [result.as_json() for result in results],
    }


@functools.lru_cache(maxsize=8)
def _readable(path: Path) -> RunStore:
    from pchem_pipeline.store.run_store import RunStore

    return RunStore.open(path)


def _sample(store: RunStore, shape: tuple[int, int], place: NDArray[np.int64]) -> Sample:
    """Read the histograms of some pixels."""
    y, x = np.divmod(place, shape[1])
    counts, origin = (store.read_pixels(f"histogram/{name}", y, x) for name in ("counts", "origin"))
    return Sample(counts, origin.astype(np.int64))


def _reference(store: RunStore, place: NDArray[np.int64]) -> tuple[FloatArray, str]:
    """Return what is held for true, and whether it is the truth or the fit of the run."""
    if store.has("truth/read_noise_e"):
        truth = {
            name: store.read(f"truth/{name}").ravel()[place] for name in (*PARAMETERS[:3], "read_noise_e")
        }
        noise = truth["read_noise_e"] / truth["conversion_gain"]
        columns = [truth["quanta_exposure"], truth["conversion_gain"], truth["bias"], noise]
        return np.stack(columns, axis=1).astype(np.float64), "truth"
    fit = np.stack([store.read(f"fit/{name}").ravel()[place] for name in PARAMETERS], axis=1)
    fit[(store.read("fit/fit_status").ravel()[place] & int(_NO_REFERENCE)) != 0] = np.nan
    return fit, "fit"


def _sample_words(
    stores: Sequence[RunStore], samples: Sequence[Sample], reference: FloatArray
) -> list[dict[str, Any]]:
    """Describe the samples: name, frames, and the median exposure that the reference gives them."""
    found = []
    for store, sample in zip(stores, samples, strict=True):
        moments = sample.moments()
        exposure = reference[:, 1] * (moments.mean - reference[:, 2])
        known = exposure[np.isfinite(exposure)]
        found.append(
            {
                "run": store.path.name,
                "n_frames": int(np.median(moments.n_frames)),
                "quanta_exposure": float(np.median(known)) if known.size else None,
            }
        )
    return found


def _remarks(stores: Sequence[RunStore], samples: Sequence[Sample], reference: FloatArray) -> list[str]:
    """Say what the comparison lacks."""
    if len(samples) == 1:
        return [
            "one sample: methods that need dark frames or a series are omitted; add runs of the same pixels "
            "at other exposures with --with"
        ]
    words = _sample_words(stores, samples, reference)
    darkest = min(
        words, key=lambda each: np.inf if each["quanta_exposure"] is None else each["quanta_exposure"]
    )
    exposure = darkest["quanta_exposure"]
    if exposure is not None and exposure > _DARK_LIMIT:
        return [
            f"the darkest sample, {darkest['run']}, has electrons (H = {exposure:.3g} e-): methods that use "
            "it as bias are off by this amount"
        ]
    return []
