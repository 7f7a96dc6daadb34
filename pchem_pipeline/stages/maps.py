"""Stage ``maps``: the parameters and what follows from them, with standard errors and quality."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import Arrays, FloatArray
from pchem_pipeline.base.plain import plain
from pchem_pipeline.base.variables import INTERVALS, PARAMETERS, interval_names
from pchem_pipeline.model.arithmetic.statistics import false_discovery, poorest
from pchem_pipeline.model.errors.expected_information import covariance_from
from pchem_pipeline.model.fit.status import FAILED, FitStatus, flags_of
from pchem_pipeline.model.maps.maps import (
    derived_maps,
    electron_shifts,
    quality_map,
    status_counts,
    summarise,
)
from pchem_pipeline.model.maps.sample_maps import line_map_names, line_maps
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.stage import StageContext
from pchem_pipeline.stages.samples import exposure_axis
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.store.tiles import Tile

#: Why there is no charge rate.
NO_TIME = "unknown integration time: no charge rate. Set input.integration_time (--integration-time), s"
#: Where the width of the law alone tells the number of electrons, and the window cuts it, H has no error.
_CUT = int(FitStatus.BIAS_AMBIGUOUS | FitStatus.OUTSIDE_WINDOW)


def maps_tile(
    fit: Arrays, integration_time: float | None, rate: str = "charge_rate", n_frames: int | None = None
) -> dict[str, NDArray[Any]]:
    """Return all maps of a tile by name, from its arrays of the group ``fit``.

    ``rate`` is the name of H over the integration time (s, or None), ``n_frames`` the number of frames of the
    one sample, whose errors of H and mu hold the chance of being electrons off; None: several samples, which
    settle the bias.
    """
    parameters = {name: fit[name] for name in PARAMETERS}
    maps: dict[str, NDArray[Any]] = dict(parameters)
    stderr, status = np.stack([fit[f"{name}_stderr"] for name in PARAMETERS], axis=-1), fit["fit_status"]
    if n_frames is not None:
        m, p = electron_shifts(maps["quanta_exposure"].ravel(), fit["likelihood_gap"].ravel(), n_frames)
        off = np.sqrt(p @ m**2).reshape(status.shape)
        off[(status & _CUT) == _CUT] = np.nan
        stderr[..., 0] = np.hypot(stderr[..., 0], off)
        stderr[..., 2] = np.hypot(stderr[..., 2], off / maps["conversion_gain"])
    maps |= {f"{name}_stderr": stderr[..., i] for i, name in enumerate(PARAMETERS)}
    maps |= derived_maps(parameters, covariance_from(stderr, fit["correlation"]), integration_time, rate)
    maps |= {name: fit[name] for each in INTERVALS for name in interval_names(each) if name in fit}
    if integration_time is not None and "quanta_exposure_low" in fit:
        ends = zip(interval_names(rate), interval_names("quanta_exposure"), strict=True)
        maps |= {name: fit[source] / integration_time for name, source in ends}
    maps["quality"] = quality_map(status, maps["conversion_gain"])
    return maps


def run(context: StageContext) -> None:
    """Make all maps and summarise them.

    Raises:
        StoreError: the fit is missing, or the store refuses.
    """
    line, sensor = _line(context), context.sensor
    arrays = functools.partial(
        _arrays,
        integration_time=sensor.integration_time if line is None else None,
        rate=context.charge_rate,
        line=line,
        n_frames=None if sensor.samples else sensor.n_frames,
    )
    of_none = arrays(context.store, (slice(0), slice(0)))  # of no pixel, with all names
    context.create_like(of_none)
    context.create("maps/goodness_q")
    time, stated = sensor.integration_time, SensorInfo.read(context.store).integration_time
    if not sensor.samples and time is None:
        context.note(NO_TIME)
    elif time and stated and abs(time - stated) > 1e-3 * stated:  # times are written with few digits
        context.note(f"integration time {time:g} s from input.integration_time; the files state {stated:g} s")
    held = context.tile_pixels * 80 * 8  # arrays that are read and made
    task = functools.partial(_do_tile, arrays=arrays)
    context.run_units(context.tiles(), task, needs="fit", unit_bytes=held)
    with_error = [path.removesuffix("_stderr") for path in of_none if path.endswith("_stderr")]
    _summarise(context, [path.removeprefix("maps/") for path in with_error if path.startswith("maps/")])


#: What slope and offset of several samples are called, and where each stands (NaN: nowhere).
_Line = tuple[tuple[str, ...], FloatArray]


def _line(context: StageContext) -> _Line | None:
    settings, samples = context.config.input, context.sensor.samples
    if not samples or (x := exposure_axis(settings, samples)) is None:
        return None
    return line_map_names(settings.against, context.charge_rate), x


def _arrays(
    store: RunStore,
    region: tuple[slice, slice],
    *,
    integration_time: float | None,
    rate: str,
    line: _Line | None,
    n_frames: int | None,
) -> dict[str, NDArray[Any]]:
    maps = maps_tile(store.at(region, "fit"), integration_time, rate, n_frames)
    found = {f"maps/{name}": values for name, values in maps.items()}
    if line is None:
        return found
    samples, (names, x) = store.at(region, "samples"), line
    exposure, covariance = samples["quanta_exposure"], samples["covariance"]
    n, *shape = exposure.shape
    of_line = line_maps(exposure.reshape(n, -1).T, covariance.reshape(-1, *covariance.shape[2:]), x, names)
    return found | {
        f"{group}/{name}": np.ascontiguousarray(values.T).reshape(*values.shape[1:], *shape)
        for group, arrays in zip(("maps", "samples"), of_line, strict=True)
        for name, values in arrays.items()
    }


def _do_tile(tile: Tile, store: RunStore, *, arrays: Callable[..., dict[str, NDArray[Any]]]) -> None:
    store.at(tile.region).update(arrays(store, tile.region))


def _summarise(context: StageContext, names: list[str]) -> None:
    settings = context.config.maps
    status = context.store.read("fit/fit_status")
    found: dict[str, Any] = {}
    for name in names:
        left_out = (status & int(flags_of(name))) != 0
        values = context.store.read(f"maps/{name}")
        summary = summarise(values, left_out=left_out, outlier_sigmas=settings.outlier_sigmas)
        percentiles = {f"{p:g}": value for p, value in summary.percentiles.items()}
        found[name] = plain(asdict(summary) | {"percentiles": percentiles})
    facts = {"summary": found, "fit_status": status_counts(status), "goodness": _misfits(context)}
    context.store.set_attributes("maps", facts)


def _misfits(context: StageContext) -> dict[str, Any]:
    """Say which pixels disagree with the model: q-values of all, and the poorest fits with their numbers."""
    store, settings = context.store, context.config.maps
    chi2, dof, p = (store.read(f"fit/goodness_{name}") for name in ("chi2", "dof", "p"))
    # a pixel without a value has no model that it could disagree with
    failed = (store.read("fit/fit_status") & int(FAILED)) != 0
    for values in (chi2, dof, p):
        values[failed] = np.nan
    q = false_discovery(p)
    store.write("maps/goodness_q", None, q)
    tests = {"chi2": chi2, "dof": dof, "p": p, "q": q}
    worst = [
        {"y": y, "x": x, **{name: float(values[y, x]) for name, values in tests.items()}}
        for y, x in poorest(chi2, dof, settings.worst_pixels)
    ]
    outliers = store.read("fit/outlier_share")
    return {
        "tested": int(np.count_nonzero(np.isfinite(p))),
        "misfits": int(np.count_nonzero(q <= settings.false_discovery_rate)),
        "false_discovery_rate": settings.false_discovery_rate,
        "worst": worst,
        "pixels_with_outliers": int(np.count_nonzero(outliers > 0)),
        "tail_guard": context.config.fit.tail_guard,
        "largest_outlier_share": float(np.nanmax(outliers, initial=0.0)),
    }
