"""Stage ``maps``: the parameters and what follows from them, with standard errors and quality."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from pchem_pipeline.model.maps import derived_maps, quality_map, status_counts, summarise
from pchem_pipeline.stages.base import StageContext, open_store
from pchem_pipeline.stages.declared import DECLARED
from pchem_pipeline.stages.plain import plain
from pchem_pipeline.variables import PARAMETERS

if TYPE_CHECKING:
    from pchem_pipeline.store.tiles import Tile

__all__ = ["NAME", "READS", "SETTINGS", "UPSTREAM", "VERSION", "WRITES", "identity", "maps_tile", "run"]

_THIS = DECLARED["maps"]
NAME, VERSION, UPSTREAM = _THIS.NAME, _THIS.VERSION, _THIS.UPSTREAM
SETTINGS, READS, WRITES = _THIS.SETTINGS, _THIS.READS, _THIS.WRITES
identity = _THIS.identity

_SUMMARISED = (*PARAMETERS, "read_noise_e", "analog_read_noise_e", "dark_current")
_NO_TIME = "integration time is not known: no dark current; give input.integration_time, s"


def maps_tile(fit: Mapping[str, NDArray[Any]], integration_time: float | None) -> dict[str, NDArray[Any]]:
    """Return all maps of a tile.

    Args:
        fit: the arrays of the group ``fit`` of the tile, by name.
        integration_time: s, or None.

    Returns:
        The arrays of the group ``maps`` of the tile, by name.
    """
    parameters = {name: fit[name] for name in PARAMETERS}
    maps: dict[str, NDArray[Any]] = dict(parameters)
    maps |= {f"{name}_stderr": fit[f"{name}_stderr"] for name in PARAMETERS}
    maps |= derived_maps(parameters, fit["covariance"], integration_time)
    maps["quality"] = quality_map(fit["fit_status"], fit["conversion_gain"])
    return maps


def run(context: StageContext) -> None:
    """Make all maps and summarise them.

    Raises:
        StoreError: the fit is missing, or the store refuses.
    """
    time = context.integration_time
    names = [name for name in _SUMMARISED if time is not None or name != "dark_current"]
    context.create_maps([f"maps/{name}" for each in names for name in (each, f"{each}_stderr")])
    context.create_maps(["maps/quality"])
    if time is None:
        context.note(_NO_TIME)
    task = functools.partial(_do_tile, store=context.store.path, integration_time=time)
    context.run_units(context.tiles(), task, needs="fit")
    _summarise(context, names)


def _do_tile(tile: Tile, *, store: Path, integration_time: float | None) -> dict[str, Any]:
    opened = open_store(store)
    needed = [*PARAMETERS, *(f"{name}_stderr" for name in PARAMETERS), "covariance", "fit_status"]
    fit = {
        name: opened.read(f"fit/{name}", (*tile.region, *(slice(None),) * (2 * (name == "covariance"))))
        for name in needed
    }
    for name, values in maps_tile(fit, integration_time).items():
        opened.write(f"maps/{name}", tile.region, values)
    return {}


def _summarise(context: StageContext, names: list[str]) -> None:
    """Keep the summaries of the maps in the attributes of their group."""
    settings = context.config.maps
    found: dict[str, Any] = {}
    for name in names:
        values = context.store.read(f"maps/{name}")
        summary = summarise(values, percentiles=settings.percentiles, outlier_sigmas=settings.outlier_sigmas)
        percentiles = {f"{p:g}": value for p, value in summary.percentiles.items()}
        found[name] = plain(asdict(summary) | {"percentiles": percentiles})
    status = context.store.read("fit/fit_status")
    context.store.set_attributes("maps", {"summary": found, "fit_status": status_counts(status)})
