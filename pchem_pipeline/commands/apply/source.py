"""The frames that are to be calibrated: opened as the run's own were, and checked against the run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.errors import InputError
from pchem_pipeline.frames.camera import CameraFacts, unlike
from pchem_pipeline.frames.first_look import first_look
from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.sequence import FrameSequence
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.model.fit.status import flagged_share
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.target import Target
from pchem_pipeline.stages.overscan import read_overscan
from pchem_pipeline.stages.samples import sample_targets
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.use.calibration import Calibration
from pchem_pipeline.use.overscan import Overscan

#: K; beyond it offset and dark current are others.
MOST_WARMER = 2.0


def open_like_run(
    target: Target, sensor: SensorInfo, files: Sequence[str | Path], dataset: str | None = None
) -> FrameSequence:
    """Open other frames with the settings of the run: format, dataset (unless given), region, bits.

    Files are relative to the present folder.

    Raises:
        InputError: the frames do not fit the pixels of the run.
        ConfigError: no files are named.
    """
    settings = _first_sample(target).config.input.model_copy(
        update={"files": tuple(str(each) for each in files), "frame_range": None, "mask": None, "samples": ()}
    )
    if dataset is not None:
        settings = settings.model_copy(update={"dataset": dataset})
    if settings.roi is not None:
        settings = _with_region(settings, list(settings.roi), sensor, target.store.name)
    frames = open_frames(settings, Path.cwd(), check_duplicates=False, least=1)
    first_look(frames, settings)
    name = frames.paths[0]
    if frames.shape[1:] != sensor.shape:
        raise InputError(
            f"{name}: frames of {_by(frames.shape[1:])} pixels, the run {target.store.name} has "
            f"{_by(sensor.shape)}; give frames of the same sensor and region"
        )
    depths = frames.bit_depth, sensor.bit_depth
    if None not in depths and depths[0] != depths[1]:
        raise InputError(
            f"{name}: {depths[0]} bits, the run {target.store.name} has {depths[1]}; give frames of the same "
            "read-out mode"
        )
    if None in depths and frames.dtype.itemsize < np.dtype(sensor.dtype).itemsize:
        raise InputError(
            f"{name}: samples of {frames.dtype}, the run {target.store.name} has {sensor.dtype}; give frames "
            "of the same read-out mode"
        )
    return frames


def _first_sample(target: Target) -> Target:
    """Return the run itself, or the first one of a run of several exposures."""
    return (*sample_targets(target.config, target.base_dir), target)[0]


def _with_region(settings: InputSettings, region: list[int], sensor: SensorInfo, run: str) -> InputSettings:
    """Return the settings that take the run's region of whole frames, or all of frames of that region."""
    whole = settings.model_copy(update={"roi": None, "overscan": None})
    frames = open_frames(whole, Path.cwd(), check_duplicates=False, least=1)
    shape, name = frames.whole_shape, frames.paths[0]
    if shape == sensor.shape:
        return whole
    if sensor.whole is not None and shape != sensor.whole:
        raise InputError(
            f"{name}: frames of {_by(shape)} pixels, the run {run} has the region {region} of frames of "
            f"{_by(sensor.whole)}; give frames of the same sensor, or of this region"
        )
    return settings


def _by(shape: tuple[int, ...]) -> str:
    return " x ".join(str(each) for each in shape)


def overscan_of(target: Target, frames: FrameSequence) -> Overscan:
    """Return what a run, of several exposures the first, says of the overscan that the frames have.

    Raises:
        InputError: the run has none, or the frames have none.
    """
    run = _first_sample(target).store
    found = read_overscan(RunStore.open(run))
    bias = None if found is None else np.where(frames.overscan_pixels, found.bias, np.nan)
    if found is None or bias is None or np.isnan(bias).all():
        raise InputError(
            f"{run if found is None else frames.paths[0]}: no overscan is known; set input.overscan in the "
            "YAML of the run (FITS: BIASSEC) and run it again, or choose another --reference"
        )
    return replace(found, bias=bias)


def limits_of(frames: FrameSequence, sensor: SensorInfo) -> tuple[int, int] | None:
    """Return first and last code of the ADC, DN, or those at which samples pile up; None: not known."""
    (low, high), (run_low, run_high) = frames.seen_limits, sensor.seen_limits
    depth = frames.bit_depth or sensor.bit_depth
    return replace(sensor, bit_depth=depth, seen_limits=(low or run_low, high or run_high)).adc_limits


def open_gain(fit_status: NDArray[np.integer[Any]]) -> str:
    """Return in words that the gain of most pixels is open; else empty."""
    share = flagged_share(fit_status, "conversion_gain")
    return f"the frames do not fix the gain of {100 * share:.0f} % of the pixels" if share > 0.5 else ""


def warmer(here: CameraFacts, there: CameraFacts) -> float:
    """Return by how much a sensor is warmer than another time, K; 0 where that is not known."""
    if here.temperature is None or there.temperature is None:
        return 0.0
    return here.temperature - there.temperature


def check_camera(frames: FrameSequence, sensor: SensorInfo) -> list[str]:
    """Return remarks on frames of another camera or temperature than the run's, as far as the files say.

    Raises:
        InputError: both state a serial number, gain, readout mode or binning, and these differ.
    """
    here, there = frames.camera, sensor.camera
    if why := unlike(here, there):
        raise InputError(f"{frames.paths[0]}: {why}; give a run of the same camera and setting")
    remarks = list(frames.moved)
    if here.name and there.name and here.name.casefold() != there.name.casefold():
        remarks.append(f"camera {here.name}, but {there.name} in the run")
    if abs(warmer(here, there)) > MOST_WARMER:
        remarks.append(
            f"sensor temperature {here.temperature:.4g} °C, but {there.temperature:.4g} °C in the "
            "characterisation: offset, gain and hot pixels may differ; use a characterisation at the same "
            "temperature"
        )
    return remarks


def some_of(frames: FrameSequence) -> NDArray[np.unsignedinteger[Any]]:
    """Return a few frames spread over all, (frame, y, x), DN."""
    chosen = np.unique(np.linspace(0, frames.shape[0] - 1, 16).astype(int))
    return np.concatenate([frames.read(t, t + 1) for t in chosen.tolist()])


def check_level(some: NDArray[Any], calibration: Calibration, name: Path) -> list[str]:
    """Return remarks where the mean level of frames (frame, y, x), DN, does not fit the characterisation.

    Raises:
        InputError: the mean is too far below the bias for frames of these pixels.
    """
    mean = some.mean(axis=0, dtype=np.float64)
    known = calibration.usable
    if not known.any():
        raise InputError("the run has no pixel with a good fit, so it cannot calibrate frames")
    above = (mean - calibration.bias)[known]
    sigma, gain = calibration.read_noise_dn[known], calibration.conversion_gain[known]
    level = float(np.median(above / sigma))
    if level < -3.0:  # standard deviations of a sample
        raise InputError(
            f"{name}: mean {-np.median(above):.1f} DN below the bias of the run: frames of "
            "another sensor, region, offset or temperature"
        )
    signal, usual = float(np.median(above * gain)), float(np.median(calibration.quanta_exposure[known]))
    remarks = []
    if level < -0.5:
        remarks.append(
            f"mean {-np.median(above):.2f} DN below the bias of the run: the offset has changed; use a "
            "characterisation at the same temperature"
        )
    if signal > 30.0 * max(usual, 0.1):  # beyond it a gain is extrapolated
        remarks.append(
            f"mean signal {signal:.3g} e-, but {usual:.3g} e- in the characterisation; the same gain is "
            "assumed"
        )
    return remarks
