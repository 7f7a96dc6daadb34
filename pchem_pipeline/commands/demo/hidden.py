"""``pchem demo --hidden``: an effect is hidden in simulated frames, and the search has to find it.

The frames are plain camera files for the run: neither its YAML nor its store holds the truth. That lies in a
sealed file beside them, which only the final comparison opens.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.commands.demo.comparison import COMPARED, compare
from pchem_pipeline.commands.demo.demo import is_in_use
from pchem_pipeline.commands.model import adopt_verdict
from pchem_pipeline.config.load import dump_config
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.discrepancy.verdict import read_verdict
from pchem_pipeline.effects.framework.region import GRAMMAR, Region, When, parse_place
from pchem_pipeline.effects.framework.registry import effect_class, effect_classes
from pchem_pipeline.frames.writing import write_frames
from pchem_pipeline.run.target import find_run
from pchem_pipeline.runner.session import Command, run_stages
from pchem_pipeline.simulate.chain import dn_dtype, frames_per_block, simulate_block
from pchem_pipeline.simulate.maps import draw_truth
from pchem_pipeline.simulate.settings import SimulateSettings
from pchem_pipeline.stages.discrepancy.summary_text import verdict_text
from pchem_pipeline.stages.table import pipeline_of
from pchem_pipeline.store.files import read_json, write_atomic, write_json
from pchem_pipeline.store.run_store import RunStore

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pchem_pipeline.effects.framework.effect import Effect
    from pchem_pipeline.run.target import Target
    from pchem_pipeline.simulate.truth import TruthMaps

#: Truth and effect; no part of the run.
SEALED_KEY = "sealed_key.npz"

_ASKED, _PLAIN_MAPS, _YAML = "hidden.json", "plain_maps.npz", "hidden.yaml"
_FRAMES = Path("frames") / "frames.tif"
#: Share of the samples that a hidden limit of the scale cuts.
_CLIPPED_SHARE = 5e-5
#: Memory for the frames in the making.
_BUDGET = 128 << 20
_SENSOR = {
    "quanta_exposure": {"kind": "lognormal", "median": 1.5, "log_std": 0.5, "minimum": 0.3, "maximum": 5.0},
    "hot_pixels": {"fraction": 0.0},
}


def run_hidden_demo(
    output: Path, *, hidden: str, size: int, n_frames: int, seed: int | None, quiet: bool = False
) -> str:
    """Hide an effect, run every stage and the search, and return the verdict beside the truth.

    Args:
        output: folder for the frames, the YAML, the store and the sealed key.
        hidden: tag of the effect; with ``@`` and a place or a time: it acts only there.
        size: rows and columns.
        n_frames: number of frames.
        seed: root of the random numbers; None: 1.
        quiet: say warnings only.

    Raises:
        ConfigError: the effect is unknown or cannot be shown, or the folder holds something else.
        PchEmError: a stage failed.
    """
    _check_tag(hidden)
    asked = {"hidden": hidden, "size": size, "frames": n_frames, "seed": seed}
    _check_folder(output, asked)
    if not (output / SEALED_KEY).exists():
        # first, so that a demonstration stopped here can start again; the key comes last
        write_json(output / _ASKED, asked)
        _hide(output, hidden, size, n_frames, 1 if seed is None else seed)
    command = Command(quiet=quiet)
    if not (output / _PLAIN_MAPS).exists():
        _run_plain(output, command)
    run_stages(find_run(output / _YAML), ["discrepancy"], command)
    extended, _ = adopt_verdict(find_run(output / _YAML))
    run_stages(extended, pipeline_of(extended.config), command)
    return _text(output, extended)


def _check_tag(asked: str) -> None:
    hidden, *_ = _parted(asked)
    if hidden not in effect_classes():
        known = ", ".join(effect_classes())
        raise ConfigError(
            f"--hidden {hidden!r}: there is no such effect; choose one of: {known}; "
            f"behind it @ and a place, if any: {GRAMMAR}"
        )
    if not effect_class(hidden).typical() and hidden != "clipping":
        raise ConfigError(f"--hidden {hidden}: this effect names no typical strength to hide; choose another")


def _parted(asked: str) -> tuple[str, Region | None, When | None]:
    """Return the tag, place and time of ``row_noise@columns=40:50,frames=200:400``.

    Raises:
        ConfigError: the place is not of the grammar; says it.
    """
    tag, at, place = asked.partition("@")
    if not at:
        return tag, None, None
    try:
        return tag, *parse_place(place)
    except ValueError as error:  # of pydantic, too
        raise ConfigError(f"--hidden {asked}: {' '.join(str(error).split())}") from None


def _check_folder(output: Path, asked: dict[str, Any]) -> None:
    """Refuse a folder that holds something else than the same demonstration."""
    if not is_in_use(output):
        return
    known = read_json(output / _ASKED)
    if known == asked:
        return
    what = "holds another demonstration" if known is not None else "is not empty"
    raise ConfigError(f"{output} {what}; choose another folder with --output")


def hidden_effect(asked: str, settings: SimulateSettings, truth: TruthMaps) -> Effect:
    """Return an effect of the library at a strength that is clearly visible but moderate.

    Args:
        asked: its tag; with ``@`` and a place or a time in one line.
        settings: camera, without effects.
        truth: maps of the sensor; limits of the scale are set by them.
    """
    hidden, region, when = _parted(asked)
    share = 1.0
    if region is not None:
        share *= float(region.mask(settings.shape).mean())  # refuses what is not on the sensor
    if when is not None:
        share *= when.share(np.arange(settings.n_frames))
    kinds = effect_class(hidden).typical()
    effect = kinds[0] if kinds else _clipping(settings, truth)
    if effect.strength and 0.0 < share < 1.0:
        # as visible as everywhere: the errors of its statistics grow like that with fewer samples
        effect = effect.scaled(share**-0.5)
    return effect.at_place(region, when)


def _clipping(settings: SimulateSettings, truth: TruthMaps) -> Effect:
    """Return a lower limit of the scale that cuts a small share of this sensor's samples."""
    count = min(settings.n_frames, max(1, 2_000_000 // truth.bias.size))
    dn = simulate_block(truth, settings, (0, count), electron_frames=0)[0]
    return effect_class("clipping").model_validate({"low": int(np.quantile(dn, _CLIPPED_SHARE))})


def _hide(output: Path, hidden: str, size: int, n_frames: int, seed: int) -> None:
    """Write frames with the effect in them, and the sealed key."""
    settings = SimulateSettings.model_validate(
        {"shape": [size, size], "n_frames": n_frames, "seed": seed, "parameters": _SENSOR}
    )
    truth = draw_truth(settings)
    effect = hidden_effect(hidden, settings, truth)
    settings = settings.model_copy(update={"effects": (effect,)})
    (output / _FRAMES.parent).mkdir(parents=True, exist_ok=True)
    write_frames(
        "tiff",
        output / _FRAMES,
        _blocks(settings, truth),
        (n_frames, size, size),
        dn_dtype(settings.bit_depth),
        integration_time=settings.integration_time,
        bit_depth=settings.bit_depth,
    )
    config = RunConfig.model_validate(
        {
            "run": {"store": "hidden.zarr", "title": "Sensor with a hidden effect", "tile": 32},
            "input": {
                "files": [str(_FRAMES)],
                "integration_time": settings.integration_time,
                "bit_depth": settings.bit_depth,
            },
        }
    )
    write_atomic(output / _YAML, dump_config(config).encode())
    key = {name: getattr(truth, name) for name in COMPARED}
    write_atomic(output / SEALED_KEY, _packed({**key, "effect": np.array(effect.model_dump_json())}))


def _blocks(settings: SimulateSettings, truth: TruthMaps) -> Iterator[NDArray[Any]]:
    step = frames_per_block(settings, settings.shape[0], _BUDGET)
    for start in range(0, settings.n_frames, step):
        stop = min(start + step, settings.n_frames)
        yield simulate_block(truth, settings, (start, stop), electron_frames=0)[0]


def _packed(arrays: dict[str, NDArray[Any]]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def _unpacked(path: Path) -> dict[str, NDArray[Any]]:
    with np.load(path, allow_pickle=False) as content:
        return {name: content[name] for name in content.files}


def _run_plain(output: Path, command: Command) -> None:
    """Run every stage with the plain model, and keep its maps: the extended model replaces them."""
    target = find_run(output / _YAML)
    run_stages(target, [name for name in pipeline_of(target.config) if name != "report"], command)
    write_atomic(output / _PLAIN_MAPS, _packed(_maps(target)))


def _maps(target: Target) -> dict[str, NDArray[Any]]:
    store = RunStore.open(target.store)
    names = [*COMPARED, *(f"{name}_stderr" for name in COMPARED), "quality"]
    return {name: store.read(f"maps/{name}") for name in names}


def _text(output: Path, target: Target) -> str:
    found = read_verdict(target.store)
    assert found is not None
    key = _unpacked(output / SEALED_KEY)
    effect: dict[str, Any] = json.loads(str(key.pop("effect")))
    hidden = effect_class(effect["tag"]).model_validate(effect)
    comparison = compare(found, hidden, key, _unpacked(output / _PLAIN_MAPS), _maps(target))
    paths = {
        "verdict": target.store / "discrepancy.html",
        "report": target.store / "report.html",
        "pictures": target.store / "figures",
    }
    places = "\n".join(f"{name + ':':<10}{path}" for name, path in paths.items())
    return f"{verdict_text(found)}\n\n{comparison}\n\n{places}"
