"""Calibrations of a camera in the files of other programs, by the name of the program.

PYME and navigate take maps (Lin et al. 2017, Optics Express 25, 11701), SMAP and BANZAI as well; DECODE and
Picasso medians. Pyxel and getframes simulate the camera.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

from pchem_pipeline.base.arrays import BoolArray, FloatArray
from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.config.load import yaml_text
from pchem_pipeline.frames.camera import CameraFacts
from pchem_pipeline.frames.formats.fits_files import FitsImage, camera_cards, image_cards, write_images
from pchem_pipeline.frames.formats.map_files import MapImage, write_tiff
from pchem_pipeline.model.arithmetic.statistics import robust_sd
from pchem_pipeline.run.target import Target
from pchem_pipeline.stages.defects import stored_defects
from pchem_pipeline.store.files import whole_file, write_atomic
from pchem_pipeline.store.run_store import RunStore


@dataclass(frozen=True)
class Calibration:
    """A camera as its frames without light show it.

    Maps have shape (y, x), and the median where a pixel has no fit.
    """

    camera: CameraFacts
    integration_time: float | None  # s; None: not known
    bits: int  # of the codes of its ADC
    bias: FloatArray  # DN
    gain: FloatArray  # conversion gain, e-/DN
    read_noise: FloatArray  # e-
    electrons: FloatArray  # mean of the dark electrons of a frame, e-; 0 in a run of frames with light
    fitted: BoolArray
    defects: BoolArray

    @classmethod
    def of(cls, target: Target, store: RunStore) -> Calibration:
        """Read it from the maps; the dark current counts where the run is of dark frames."""
        sensor, dark = target.sensor(store), target.config.input.kind == "dark"
        names = ("bias", "conversion_gain", "read_noise_e", "quanta_exposure")
        maps = [store.read(f"maps/{name}").astype(np.float64) for name in names]
        maps[3] = maps[3] if dark else np.zeros_like(maps[3])
        bits = sensor.bit_depth or 8 * np.dtype(sensor.dtype).itemsize
        fitted, defects = np.isfinite(sum(maps)), stored_defects(store, target.config).mask > 0
        bias, gain, noise, charge = (np.where(np.isfinite(m), m, np.nanmedian(m)) for m in maps)
        facts = sensor.camera, sensor.integration_time, bits
        return cls(*facts, bias, gain, noise, charge, fitted, defects)

    @property
    def serial(self) -> str:
        """The serial number as a file name; "camera" where it is not known."""
        return re.sub(r"\W+", "_", self.camera.serial or "").strip("_") or "camera"

    @property
    def exposure(self) -> float:
        """The integration time, s.

        Raises:
            ConfigError: it is not known.
        """
        if self.integration_time is None:
            raise ConfigError("the exposure time of the calibration is not known; set input.integration_time")
        return self.integration_time

    @property
    def offset(self) -> FloatArray:
        """Mean of a pixel without light, DN."""
        return self.bias + self.electrons / self.gain

    @property
    def variance(self) -> FloatArray:
        """Of a pixel without light, e-^2; so large that it does not count where a pixel has no fit."""
        # PYME leaves a pixel out by it
        return np.where(self.fitted, self.read_noise**2 + self.electrons, 1e8)

    @property
    def dark_rate(self) -> FloatArray:
        """Dark current, e-/s; 0 in a run of frames with light."""
        return self.electrons / self.exposure if self.electrons.any() else self.electrons


def _pyme(found: Calibration, folder: Path) -> list[Path]:
    """Write the maps that PYME looks for in its folder of calibrations."""
    time = f"{round(1000 * found.exposure)}ms"
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
        "baseline": _median(found.bias),
        "e_per_adu": _median(found.gain),
        "em_gain": None,
        "qe": 1.0,
        "read_sigma": _median(found.read_noise),
        "spur_noise": _median(found.electrons),
    }
    return [_yaml(folder / "decode_camera.yaml", {"Camera": camera})]


def _picasso(found: Calibration, folder: Path) -> list[Path]:
    """Write the entry of the camera in Picasso's ``config.yaml``."""
    camera = {"Sensor": "sCMOS", "Baseline": _median(found.offset), "Sensitivity": _median(found.gain)}
    return [_yaml(folder / "picasso_config.yaml", {"Cameras": {found.camera.name or "camera": camera}})]


def _smap(found: Calibration, folder: Path) -> list[Path]:
    """Write the maps that SMAP looks for in its folder ``settings/cameras``: DN, DN^2 and DN/e-."""
    path = folder / "smap" / f"{found.serial}.mat"
    maps = {"offsetmap": found.offset, "varmap": found.variance / found.gain**2, "gainmap": 1 / found.gain}
    with whole_file(path) as part:
        savemat(part, {name: values.astype(np.float32) for name, values in maps.items()}, appendmat=False)
    return [path]


def _banzai(found: Calibration, folder: Path) -> list[Path]:
    """Write the masters that ``banzai_add_super_calibration`` takes, for frames without overscan.

    BANZAI multiplies frames by one ``GAIN``, here the median. Bias and dark current are subtracted after
    this, in e- and e-/s; the read noise is read before, in DN.
    """
    gain, level = _median(found.gain), _median(found.bias)
    masters: dict[str, tuple[Any, str, float, list[Any]]] = {
        "BIAS": (gain * (found.bias - level), "e-", 1.0, [("BIASLVL", gain * level)]),
        "READNOISE": (found.read_noise / found.gain, "DN", gain, []),
        "BPM": ((found.defects | ~found.fitted).astype(np.uint8), "1", gain, []),
    }
    if found.electrons.any():
        masters["DARK"] = (gain * found.dark_rate / found.gain, "e-/px/s", 1.0, [])
    cards: list[Any] = [("DATE", datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%S"))]
    cards += camera_cards(found.camera, found.integration_time)
    if found.camera.temperature is not None:
        cards += [(name, found.camera.temperature) for name in ("CCDSTEMP", "CCDATEMP")]
    written = []
    for kind, (values, unit, own, more) in masters.items():
        top = (2**found.bits - 1) * gain / own
        more += [("OBSTYPE", kind), ("GAIN", own), ("SATURATE", top), ("MAXLIN", top)]
        values = values.astype(np.float32) if values.dtype.kind == "f" else values
        more += image_cards("BPM" if kind == "BPM" else "SCI", unit, f"master of kind {kind}")
        written.append(folder / "banzai" / f"{kind.lower()}-{found.serial}.fits")
        write_images(written[-1], [FitsImage([values], values.shape, values.dtype, [*cards, *more])])
    return written


def _pyxel(found: Calibration, folder: Path) -> list[Path]:
    """Write a configuration of Pyxel for frames without light, and its map of the gain; 1 V stands for 1 DN.

    Pyxel has no maps of offset, read noise and dark current with its shot noise: these are medians.
    """
    path = folder / "pyxel" / "charge_to_volt.npy"
    array = io.BytesIO()
    np.save(array, 1 / found.gain)
    write_atomic(path, array.getvalue())
    noise = _median(found.read_noise / found.gain)
    models: dict[str, dict[str, Any]] = {
        "photon_collection": {"illumination": {"level": 0.0}, "shot_noise": {}},
        "charge_generation": {
            "simple_conversion": {},
            "simple_dark_current": {"dark_rate": _median(found.dark_rate)},
        },
        "charge_collection": {"simple_collection": {}},
        "charge_measurement": {
            "simple_measurement": {},
            "dc_offset": {"offset": _median(found.bias) + 0.5},  # simple_adc truncates
            # output_node_noise_cmos counts the signal twice (Pyxel 3.0.2)
            "output_node_noise": {"std_deviation": noise},
        },
        "readout_electronics": {"simple_adc": {}},
    }
    content = {
        "exposure": {"readout": {"times": [found.integration_time or 1.0]}},
        "cmos_detector": {
            "geometry": dict(zip(("row", "col"), found.gain.shape, strict=True)),
            "environment": {},
            "characteristics": {
                "quantum_efficiency": 1.0,
                "charge_to_volt": {"value": path.name},
                "adc_bit_resolution": found.bits,
                "adc_voltage_range": [0.0, 2.0**found.bits - 1],
            },
        },
        "pipeline": {
            group: [
                {"name": name, "func": f"pyxel.models.{group}.{name}", "enabled": True, "arguments": given}
                for name, given in steps.items()
            ]
            for group, steps in models.items()
        },
    }
    return [_yaml(path.with_name("pyxel.yaml"), content), path]


def _getframes(found: Calibration, folder: Path) -> list[Path]:
    """Write the table ``camera`` of getframes: medians, and the spread of bias and read noise.

    Quantum efficiency and pixel size are 1, and the range of the codes is the full well: frames without light
    do not tell.
    """
    gain, bias = _median(found.gain), _median(found.bias)
    spread = robust_sd(np.log(found.read_noise))
    camera: dict[str, Any] = {
        "name": found.camera.name or "camera",
        "sensor_type": "SCMOS",
        "resolution": found.gain.shape,
        "pixel_size_um": 1.0,
        "quantum_efficiency": 1.0,
        "full_well_e": (2**found.bits - 1 - bias) * gain,
        "bit_depth": found.bits,
        "gain_e_per_adu": gain,
        "bias_offset_adu": bias,
        "bias_pixel_spread_adu": robust_sd(found.bias),
        "read_noise_e": _median(found.read_noise) * np.exp(spread**2 / 2),  # mean of a log-normal law
        "read_noise_nonuniformity": spread,
        "dark_current_e_per_s": _median(found.dark_rate),
    }
    if found.camera.temperature is not None:
        camera["dark_current_ref_temp_c"] = found.camera.temperature
    lines = [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in camera.items()]
    path = folder / "getframes.toml"
    write_atomic(path, "\n".join(["[camera]", *lines, ""]).encode())
    return [path]


#: Writes the files of a program into a folder and returns them, by the name of the program.
ADAPTERS: dict[str, Callable[[Calibration, Path], list[Path]]] = {
    "pyme": _pyme,
    "navigate": _navigate,
    "decode": _decode,
    "picasso": _picasso,
    "smap": _smap,
    "banzai": _banzai,
    "pyxel": _pyxel,
    "getframes": _getframes,
}


def _median(values: FloatArray) -> float:
    return float(np.median(values))


def _yaml(path: Path, content: Any) -> Path:
    write_atomic(path, yaml_text(content).encode())
    return path
