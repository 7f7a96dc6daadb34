"""The run with which frames are to be calibrated, chosen from a folder of runs by what the files say."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path

from pchem_pipeline.base.errors import ConfigError, InputError, StoreError
from pchem_pipeline.commands.apply.source import MOST_WARMER, open_gain, warmer
from pchem_pipeline.frames.camera import unlike
from pchem_pipeline.frames.open import open_frames
from pchem_pipeline.frames.settings import InputSettings
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.store.run_store import RunStore, stored_config


def finished_runs(folder: Path) -> dict[Path, SensorInfo]:
    """Return the sensor of each run with a fit in a folder and in its folders, without damaged ones."""
    found = {}
    for path in sorted([*folder.glob("*.zarr"), *folder.glob("*/*.zarr")]):
        with contextlib.suppress(StoreError):
            store = RunStore.open(path)
            if (record := store.records.read("fit")) is not None and record.finished:
                found[path] = SensorInfo.read(store)
    return found


def run_for(target: Path, files: Sequence[str], max_age: float | None) -> tuple[Path, str]:
    """Return the run for some frames, and why it is that one: of a folder of runs; else ``target`` itself.

    Of the runs of the same camera, setting, temperature and pixels, the last before the frames were taken;
    else the first after. At most ``max_age`` days may lie between run and frames.

    Raises:
        ConfigError: ``max_age`` without a folder of runs, or ``target`` is a file of something else.
        InputError: no run fits, the one that fits is too old, or dates do not tell which is the last.
    """
    if target.is_file() and target.suffix.lower() not in (".yaml", ".yml"):
        raise ConfigError(f"{target} is no run; give the run before the frames: pchem apply run.zarr FRAMES")
    runs = finished_runs(target) if target.is_dir() and stored_config(target) is None else {}
    if not runs and max_age is not None:
        raise ConfigError(f"--max-age: {target} is no folder of finished runs; omit it")
    if not runs:
        return target, ""
    settings = InputSettings(files=tuple(files))
    frames = open_frames(settings, Path.cwd(), check_duplicates=False, least=1)
    name, camera, shapes = frames.paths[0], frames.camera, {frames.shape[1:], frames.whole_shape}
    fitting, against = {}, []
    for path, sensor in runs.items():
        why = unlike(camera, sensor.camera)
        if not {sensor.shape, sensor.whole} & shapes:
            why = f"{sensor.ny} x {sensor.nx} pixels, but {' x '.join(map(str, frames.whole_shape))} here"
        if abs(warmer(camera, sensor.camera)) > MOST_WARMER:
            why = f"sensor at {sensor.camera.temperature:.4g} °C, but {camera.temperature:.4g} °C here"
        why = why or open_gain(RunStore.open(path).read("fit/fit_status"))
        if why:
            against.append(f"{path.relative_to(target)}: {why}")
        else:
            fitting[path] = sensor.camera.taken
    if not fitting:
        raise InputError(
            f"no run in {target} fits {name} ({'; '.join(against)}); characterise the camera in this setting"
        )
    if len(fitting) == 1 and max_age is None:
        return next(iter(fitting)), "the only one of this camera and setting"
    dated = [(taken - camera.taken, path) for path, taken in fitting.items() if taken and camera.taken]
    if len(dated) < len(fitting):
        listed = ", ".join(str(path.relative_to(target)) for path in fitting)
        raise InputError(f"{name}: files or runs without a date, so none of {listed} can be chosen; name one")
    age, path = max((each for each in dated if each[0] <= 0.0), default=min(dated))
    if len(same := [str(other.relative_to(target)) for other_age, other in dated if other_age == age]) > 1:
        raise InputError(f"{' and '.join(same)} in {target} were taken at the same time; name one")
    age = max(age, age + (camera.taken or 0.0) - (frames.last_taken or 0.0), key=abs)  # of the farthest file
    days = abs(age) / 86_400.0
    words = f"{days:.1f} days {'before' if age <= 0.0 else 'after'} the frames"
    if max_age is not None and days > max_age:
        raise InputError(
            f"{path}: taken {words}, more than --max-age {max_age:g}; characterise the camera again"
        )
    return path, f"taken {words}"
