"""``pchem export``: maps as FITS, TIFF or npz, tables, and calibrations for other programs."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pchem_pipeline.base.variables import Variable, variables_of
from pchem_pipeline.commands.adapters import ADAPTERS, Calibration
from pchem_pipeline.commands.figures import check_formats, warn_if_old
from pchem_pipeline.frames.formats.map_files import MapImage, write_fits, write_npz, write_tiff
from pchem_pipeline.model.fit.status import MEANINGS, words_of
from pchem_pipeline.model.maps.defects import OPEN, Defect, Defects
from pchem_pipeline.report.pages.emva import COLUMNS as EMVA_COLUMNS
from pchem_pipeline.report.pages.emva import emva_rows
from pchem_pipeline.run.progress import Reporter
from pchem_pipeline.run.target import Target, find_run, with_maps
from pchem_pipeline.stages.defects import stored_defects
from pchem_pipeline.stages.report.stored import samples_of
from pchem_pipeline.store.files import write_atomic
from pchem_pipeline.store.run_store import RunStore

#: Images of maps, tables (summary, EMVA 1288, pixels that are not ordinary), and files for other programs.
_IMAGES, _TABLES = ("fits", "tiff", "npz"), ("csv", "emva", "defects")
FORMATS = (*_IMAGES, *_TABLES, *ADAPTERS)

_COLUMNS = (
    "n_valid",
    "n_missing",
    "n_left_out",
    "median",
    "median_stderr",
    "robust_sd",
    "minimum",
    "maximum",
    "n_low",
    "n_high",
)


def export_run(path: Path, folder: Path, formats: Sequence[str], reporter: Reporter) -> list[Path]:
    """Write the maps of a run, given by its store or YAML, in any of ``FORMATS``; return the files.

    Raises:
        ConfigError: an unknown format, or none.
        StoreError: the run has no maps, or the folder cannot be written.
    """
    check_formats(formats, FORMATS, "written")
    target = find_run(path)
    store = with_maps(target.stored())
    warn_if_old(target, ("maps",), "written in this state", reporter)
    written: list[Path] = []
    images = _images(store) if set(formats) & set(_IMAGES) else []
    for name in dict.fromkeys(formats):
        if name == "fits":
            sensor = target.sensor(store)
            frames = sensor.n_frames if sensor.kind == "frames" else None
            facts: dict[str, Any] = {"CREATOR": "pchem-pipeline", "RUN": store.path.name}
            facts |= {"NFRAMES": frames, "EXPTIME": sensor.integration_time}
            written += write_fits(folder / "maps.fits", images, facts)
        elif name == "tiff":
            written += write_tiff(folder, images)
        elif name == "npz":
            written += write_npz(folder / "maps.npz", {image.name: image.values for image in images})
        elif name == "emva":
            written.append(_write_emva(folder, target, store))
        elif name == "defects":
            written += _write_defects(folder, stored_defects(store, target.config))
        elif name in ADAPTERS:
            written += ADAPTERS[name](Calibration.of(target, store), folder)
        else:
            written += _write_csv(folder, store)
    return written


def _images(store: RunStore) -> list[MapImage]:
    chosen: list[Variable] = [v for v in variables_of("maps") if store.has(v.path)]
    own = ("fit_status", "likelihood_gap", "goodness_p")
    chosen += [v for v in variables_of("fit") if v.name in own and store.has(v.path)]
    return [MapImage(v.name, store.read(v.path), v.unit, v.long_name) for v in chosen]


def _write_csv(folder: Path, store: RunStore) -> list[Path]:
    """Write the summaries of the maps, and how many pixels bear each word of the status."""
    attributes = store.attributes("maps")
    units = {v.name: v.unit for v in variables_of("maps")}
    summary: dict[str, dict[str, Any]] = attributes["summary"]
    percentiles = list(next(iter(summary.values()))["percentiles"])
    rows: list[list[Any]] = [["map", "unit", *_COLUMNS, *(f"percentile_{p}" for p in percentiles)]]
    for name, content in summary.items():
        cells = [name, units[name], *(content[column] for column in _COLUMNS)]
        rows.append([*cells, *(content["percentiles"][p] for p in percentiles)])
    meanings = {"ok": "good fit", **{str(bit.name).lower(): text for bit, text in MEANINGS.items()}}
    reasons = [["fit_status", "pixels", "meaning"]]
    reasons += [[name, n, meanings.get(name, "")] for name, n in attributes["fit_status"].items()]
    return [_table(folder / "summary.csv", rows), _table(folder / "fit_status.csv", reasons)]


def _write_emva(folder: Path, target: Target, store: RunStore) -> Path:
    """Write what an EMVA 1288 data sheet can take of the run."""
    config = target.config
    maps, status = store.at(group="maps"), store.read("fit/fit_status")
    defects = stored_defects(store, config)
    samples = samples_of(target.sensor(store), store.at(group="samples"), config)
    found = emva_rows(maps, status, config.input.kind, defects, config.maps.outlier_sigmas, samples)
    return _table(folder / "emva1288.csv", [list(EMVA_COLUMNS), *(row.cells() for row in found)])


def _write_defects(folder: Path, found: Defects) -> list[Path]:
    """Write the pixels that are not ordinary as a table, as regions for DS9, and as a mask."""
    table = found.table
    columns = [
        [f"{value:.6g}" if np.isfinite(value) else "" for value in values]
        if values.dtype.kind == "f"
        else values
        for values in table.values()
    ]
    # the centre of the first pixel of an image is (1, 1) there
    boxes = [
        f"box({x + 1},{y + 1},1,1) # text={{{words_of(Defect(int(found.kinds[y, x])))}}}"
        for y, x in np.argwhere(found.kinds)
    ]
    regions = folder / "defects.reg"
    write_atomic(regions, "\n".join(["# Region file format: DS9 version 4.1", "image", *boxes, ""]).encode())
    bits = ", ".join(f"{int(kind)} {words_of(kind)}" for kind in Defect if kind not in OPEN)
    mask = MapImage("defects", found.mask, "1", f"defects, as bits; 0: none known ({bits})")
    rows = [list(table), *map(list, zip(*columns, strict=True))]
    return [_table(folder / "defects.csv", rows), regions, *write_tiff(folder, [mask])]


def _table(path: Path, rows: list[list[Any]]) -> Path:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    write_atomic(path, text.getvalue().encode())
    return path
