"""``pchem twin``: the camera of a run as a simulated one, a YAML with its maps beside it."""

from __future__ import annotations

import copy
from pathlib import Path

import numpy as np

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.base.variables import PARAMETERS
from pchem_pipeline.commands.apply.characterisation import check_run, read_calibration
from pchem_pipeline.config.load import make_config, write_config, yaml_text
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.frames.formats.map_files import read_image, write_npz
from pchem_pipeline.run.sensor import SensorInfo
from pchem_pipeline.run.target import Target
from pchem_pipeline.simulate.chain import with_scene
from pchem_pipeline.simulate.settings import SimulateSettings
from pchem_pipeline.stages.fit.fitted_model import fitted_effects
from pchem_pipeline.store.run_store import RunStore
from pchem_pipeline.use.twin import Twin, extrapolated, redrawn, twin_maps


def twin_of(target: Target, *, redraw: int | None = None, shape: tuple[int, int] | None = None) -> Twin:
    """Return the camera of a run, or another sensor of this type with a given shape (rows, columns).

    ``redraw`` is a seed with which the maps are drawn within their errors; None: the estimates themselves.

    Raises:
        StoreError: the run is not finished as far as its fit.
        ConfigError: no pixel has a fit, or the run has no frames.
    """
    store = target.stored()
    check_run(store)
    sensor = target.sensor(store)
    calibration = read_calibration(store)
    usable = calibration.usable & (calibration.quanta_exposure >= 0.0)
    if not usable.any():
        raise ConfigError(f"{target.store} has no pixel with a fit, so there is nothing to simulate")
    maps = tuple(getattr(calibration, name) for name in PARAMETERS)
    if redraw is not None:
        stderr = np.stack([store.read(f"fit/{name}_stderr") for name in PARAMETERS])
        maps = redrawn(maps, stderr, store.read("fit/correlation"), redraw)
    truth = twin_maps(maps, usable, _usual_level(store, sensor))
    if shape is not None:
        truth = extrapolated(truth, shape, 0 if redraw is None else redraw)
    settings = SimulateSettings(
        shape=truth.shape,
        n_frames=max(1, sensor.n_frames),
        bit_depth=sensor.bit_depth or 16,
        effects=fitted_effects(store),
    )
    if (time := sensor.integration_time) is not None:
        settings = settings.model_copy(update={"integration_time": time})
    return Twin(truth, settings)


def _usual_level(store: RunStore, sensor: SensorInfo) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return the middle of the range of each pixel, DN; 0 where it is not stored."""
    if not store.has("histogram/minimum"):
        return np.zeros(sensor.shape)
    ends = [store.read(f"histogram/{name}").astype(np.float64) for name in ("minimum", "maximum")]
    return np.asarray(np.maximum(np.rint((ends[0] + ends[1]) / 2.0), 0.0))


def write_twin(
    target: Target,
    output: Path,
    *,
    scene: str | None = None,
    frames: int | None = None,
    seed: int = 1,
    redraw: int | None = None,
    shape: tuple[int, int] | None = None,
    force: bool = False,
) -> list[Path]:
    """Write a YAML for ``pchem simulate`` and the maps beside it; ``redraw`` and ``shape`` as of `twin_of`.

    The scene is a number, e- per frame, or a file with an image or a sequence; None: the exposure of the run.

    Raises:
        ConfigError: a file exists, or the scene does not fit.
        InputError: the scene cannot be read.
    """
    if output.suffix.lower() not in (".yaml", ".yml"):
        raise ConfigError(f"--output {output}: give a name with the suffix .yaml")
    maps = output.with_name(f"{output.stem}_maps.npz")
    for path in (output, maps):
        if path.exists() and not force:
            raise ConfigError(f"{path} exists; choose another --output, or replace it with --force")
    twin = twin_of(target, redraw=redraw, shape=shape)
    place = None if scene is None else _scene_place(scene, twin)
    given = twin.settings.model_dump(mode="json") | {
        "sensor": maps.name,
        "scene": place,
        "seed": seed,
        "output": f"{output.stem}_frames",
        "n_frames": frames or twin.settings.n_frames,
    }
    named = {"run": {"store": f"{output.stem}.zarr"}, "simulate": given}
    head = (
        f"# Simulated copy of the camera of {target.store.name}: pchem run makes its frames and "
        "characterises them.\n# The effects of its model are simulated, and are in the model here.\n"
    )
    text = head + _yaml_of(make_config(named, "the twin"))
    write_npz(maps, twin.truth.arrays())
    write_config(output, text)
    return [output, maps]


def _yaml_of(config: RunConfig) -> str:
    """Return what a twin differs in from the defaults; its effects are simulated and stand in the model."""
    assert config.simulate is not None
    whole = config.simulate.model_dump(mode="json")
    kept = config.simulate.model_dump(mode="json", exclude_defaults=True).keys() | {"shape", "n_frames"}
    content = {
        "run": {"store": str(config.run.store)},
        "simulate": {name: value for name, value in whole.items() if name in kept},
        **({"model": {"effects": copy.deepcopy(whole["effects"])}} if whole["effects"] else {}),
    }
    return yaml_text(content)


def _scene_place(scene: str, twin: Twin) -> str:
    """Return a scene as the YAML has it, once it was tried."""
    try:
        value = float(scene)
    except ValueError:
        with_scene(twin.truth, twin.settings, read_image(Path(scene)))
        return str(Path(scene).resolve())
    with_scene(twin.truth, twin.settings, value)
    return scene
