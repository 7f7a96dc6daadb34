"""Calibrations of a camera in the files of programs for localisation microscopy, by the name of the program.

PYME and navigate take maps (Lin et al. 2017, Optics Express 25, 11701), DECODE and Picasso medians.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.frames.formats.map_files import MapImage, write_tiff
from pchem_pipeline.run.target import Target
from pchem_pipeline.store.files import write_atomic
from pchem_pipeline.store.run_store import RunStore

_NO_WEIGHT = 1e8  # e-^2: the variance by which PYME leaves a pixel out


@dataclass(frozen=True)
class Calibration:
    """A camera as its frames without light show it; maps have shape (y, x).

    Attributes:
        name: of the camera.
        serial: its serial number, as a file name; "camera" where it is not known.
        integration_time: s; None: not known.
        offset: mean of a pixel, DN; the median where a pixel has no fit.
        gain: conversion gain, e-/DN; the median where a pixel has no fit.
        variance: of a pixel, e-^2; so large that it does not count where a pixel has no fit.
        read_noise_e: median, e-.
        electrons: median of the electrons of a frame, e-.
    """

    name: str
    serial: str
    integration_time: float | None
    offset: FloatArray
    gain: FloatArray
    variance: FloatArray
    read_noise_e: float
    electrons: float

    @classmethod
    def of(cls, target: Target, store: RunStore) -> Calibration:
        """Read it from the maps; the dark current counts where the run is of dark frames."""
        sensor, dark = target.sensor(store), target.config.input.kind == "dark"
        names = ("bias", "conversion_gain", "read_noise_e", "quanta_exposure")
        bias, gain, noise, exposure = (store.read(f"maps/{name}").astype(np.float64) for name in names)
        electrons = exposure if dark else np.zeros_like(exposure)
        offset, variance = bias + electrons / gain, noise**2 + electrons
        return cls(
            sensor.camera.name or "camera",
            re.sub(r"\W+", "_", sensor.camera.serial or "").strip("_") or "camera",
            sensor.integration_time,
            np.where(np.isfinite(offset), offset, np.nanmedian(offset)),
            np.where(np.isfinite(gain), gain, np.nanmedian(gain)),
            np.where(np.isfinite(variance), variance, _NO_WEIGHT),
            float(np.nanmedian(noise)),
            float(np.nanmedian(electrons)),
        )


def _pyme(found: Calibration, folder: Path) -> list[Path]:
    """Write the maps that PYME looks for in its folder of calibrations."""
    if found.integration_time is None:
        raise ConfigError(
            "PYME names maps by the exposure time, which is not known; set input.integration_time"
        )
    time = f"{round(1000 * found.integration_time)}ms"
    flat = found.gain / np.median(found.gain)
    maps = [
        MapImage(f"dark_{time}", found.offset, "DN", "mean without light"),
        MapImage(f"variance_{time}", found.variance, "e-^2", "variance without light"),
        MapImage("flatfield", flat, "1", "by what signals above the dark map are multiplied"),
    ]
    return write_tiff(folder / "pyme" / found.serial, maps)


def _navigate(found: Calibration, folder: Path) -> list[Path]:
    """Write the maps that navigate looks for in its folder ``camera_maps``."""
    maps = [
        MapImage(f"{found.serial}_off", found.offset, "DN", "mean without light"),
        MapImage(f"{found.serial}_var", found.variance / found.gain**2, "DN^2", "variance without light"),
    ]
    return write_tiff(folder / "camera_maps", maps, ".tiff")


def _decode(found: Calibration, folder: Path) -> list[Path]:
    """Write the section ``Camera`` of DECODE's parameters; numbers are in electrons (qe 1)."""
    camera: dict[str, Any] = {
        "baseline": float(np.median(found.offset - found.electrons / found.gain)),
        "e_per_adu": float(np.median(found.gain)),
        "em_gain": None,
        "qe": 1.0,
        "read_sigma": found.read_noise_e,
        "spur_noise": found.electrons,
    }
    return [_yaml(folder / "decode_camera.yaml", {"Camera": camera})]


def _picasso(found: Calibration, folder: Path) -> list[Path]:
    """Write the entry of the camera in Picasso's ``config.yaml``."""
    camera = {
        "Sensor": "sCMOS",
        "Baseline": float(np.median(found.offset)),
        "Sensitivity": float(np.median(found.gain)),
    }
    return [_yaml(folder / "picasso_config.yaml", {"Cameras": {found.name: camera}})]


#: Writes the files of a program into a folder and returns them, by the name of the program.
ADAPTERS: dict[str, Callable[[Calibration, Path], list[Path]]] = {
    "pyme": _pyme,
    "navigate": _navigate,
    "decode": _decode,
    "picasso": _picasso,
}


def _yaml(path: Path, content: Any) -> Path:
    """Write JSON, which is YAML as well."""
    write_atomic(path, (json.dumps(content, indent=1) + "\n").encode())
    return path
