"""``pchem demo``: a simulated sensor through the whole pipeline, beside its truth.

With ``--hidden`` the simulated frames contain an effect that the fitted model lacks, and the search for a
discrepancy has to find it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pchem_pipeline.base.errors import ConfigError, quoted
from pchem_pipeline.base.variables import PARAMETERS, VARIABLES
from pchem_pipeline.commands.model import adopt_verdict
from pchem_pipeline.config.load import dump_config, write_config
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.discrepancy.verdict import read_verdict
from pchem_pipeline.effects.framework.compose import effect_words
from pchem_pipeline.effects.framework.effect import Effect
from pchem_pipeline.effects.framework.region import GRAMMAR, parse_place
from pchem_pipeline.effects.framework.registry import effect_class, effect_classes
from pchem_pipeline.run.stage import Command
from pchem_pipeline.run.target import Target, find_run
from pchem_pipeline.runner.session import run_stages
from pchem_pipeline.stages.discrepancy.summary_text import verdict_text
from pchem_pipeline.stages.table import pipeline_of
from pchem_pipeline.store.run_store import RunStore


def run_demo(
    output: Path, command: Command, *, size: int, n_frames: int, seed: int, hidden: str | None = None
) -> str:
    """Simulate a sensor of ``size`` x ``size`` pixels to TIFF, run every stage, and return a text.

    Frames, YAML and store are written to the folder ``output``. The search has to find the effect ``hidden``
    in the frames, see `hidden_effect`.

    Raises:
        ConfigError: the folder holds something else, or the effect is unknown or has no typical strength.
        PchEmError: a stage failed.
    """
    if output.exists() and not output.is_dir():
        raise ConfigError(f"{output} is a file; choose a folder with --output")
    path = output / "demo.yaml"
    if output.exists() and any(output.iterdir()) and not path.exists():
        raise ConfigError(f"{output} is not empty; choose another folder with --output")
    effect = None if hidden is None else hidden_effect(hidden, size, n_frames)
    simulate = {"shape": [size, size], "n_frames": n_frames, "seed": seed, "format": "tiff"}
    if effect is not None:
        simulate["effects"] = [effect.model_dump(mode="json")]
    config = RunConfig.model_validate(
        {"run": {"store": "demo.zarr", "title": "Simulated demo sensor", "tile": 32}, "simulate": simulate}
    )
    write_config(path, dump_config(config))
    target = find_run(path)
    run_stages(target, pipeline_of(target.config), command)
    table = _comparison_table(RunStore.open(target.store))
    if effect is not None:
        table = _search(target, effect, command, table)
    place = quoted(target.store)
    return (
        f"{table}\n\nreport: {target.store / 'report.html'}\n\n"
        f"use it: pchem apply {place} FRAMES --output OUT    (other frames in electrons, with errors)\n"
        f"        pchem twin {place} --output camera.yaml    (this camera, to simulate other scenes)"
    )


def hidden_effect(asked: str, size: int, n_frames: int) -> Effect:
    """Return an effect of the library at its typical strength.

    It is given by its tag, with ``@`` and a place or a time as ``row_noise@columns=40:50``. The strength
    there is larger by one over the root of the share of the samples: as significant as everywhere.

    Raises:
        ConfigError: there is no such effect, place or typical strength.
    """
    tag, at, place = asked.partition("@")
    if tag not in effect_classes():
        raise ConfigError(
            f"--hidden {tag!r}: no such effect; pchem info lists them; for a part of the sensor or run "
            f"append @ and a place: {GRAMMAR}"
        )
    typical = effect_class(tag).typical()
    if not typical:
        raise ConfigError(f"--hidden {tag}: this effect has no typical strength; choose another")
    try:
        region, when = parse_place(place) if at else (None, None)
    except ValueError as error:  # of pydantic, too
        raise ConfigError(f"--hidden {asked}: {' '.join(str(error).split())}") from None
    share = 1.0 if region is None else float(region.mask((size, size)).mean())
    share *= 1.0 if when is None else when.share(np.arange(n_frames))
    effect = typical[0]
    if effect.strength and 0.0 < share < 1.0:
        effect = effect.scaled(share**-0.5)
    return effect.at_place(region, when)


def _search(target: Target, effect: Effect, command: Command, plain: str) -> str:
    """Search for the effect, run again with the model found, and return verdict, effect and both tables."""
    run_stages(target, ["discrepancy"], command)
    extended, _ = adopt_verdict(target)
    run_stages(extended, pipeline_of(extended.config), command)
    found = read_verdict(target.store)
    assert found is not None
    numbers = {n: v for n, v in effect.model_dump().items() if isinstance(v, int | float)}
    missed = "" if effect.tag in found.effects else " (not found; take more --frames)"
    if reason := type(effect).untestable:
        missed = f" (not detectable in such frames: {reason})"
    after = _comparison_table(RunStore.open(target.store))
    tables = plain if after == plain else f"with the plain model:\n{plain}\n\nwith the model found:\n{after}"
    return (
        f"{verdict_text(found)}\n\nhidden effect: {effect_words(effect)}"
        f"{''.join(f', {name} = {value:.4g}' for name, value in numbers.items())}"
        f"{missed}\n\n{tables}\n\n"
        f"verdict: {target.store / 'discrepancy.html'}"
    )


def _comparison_table(store: RunStore) -> str:
    """Return a table of estimated against true parameters of the good pixels of a simulated run."""
    quality = store.read("maps/quality")
    good = quality == 0
    columns = ("true median", "estimated", "rms error", "stderr", "error/stderr")
    head = f"{'parameter':<24}" + "".join(f"{column:>14}" for column in columns)
    lines = [head, "-" * len(head)]
    for name in (*PARAMETERS[:3], "read_noise_e"):
        truth = store.read(f"truth/{name}")[good]
        estimate = store.read(f"maps/{name}")[good]
        stderr = store.read(f"maps/{name}_stderr")[good]
        error = estimate - truth
        numbers = (
            np.median(truth),
            np.median(estimate),
            np.sqrt(np.mean(error**2)),
            np.median(stderr),
            np.std(error / stderr),  # 1 where the standard errors are right
        )
        label = f"{name}, {VARIABLES[f'maps/{name}'].unit}"
        lines.append(f"{label:<24}" + "".join(f"{number:>14.4g}" for number in numbers))
    caution, failed = np.count_nonzero(quality == 1), np.count_nonzero(quality == 2)
    lines.append(
        f"{good.size} pixels: {good.sum()} good (used in the table), {caution} with caution, "
        f"{failed} without a value"
    )
    return "\n".join(lines)
