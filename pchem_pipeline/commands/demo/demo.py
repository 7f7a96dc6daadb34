"""``pchem demo``: a simulated sensor through the whole pipeline, beside its truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pchem_pipeline.base.errors import ConfigError, quoted
from pchem_pipeline.base.variables import VARIABLES
from pchem_pipeline.config.load import dump_config
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.run.target import find_run
from pchem_pipeline.runner.session import Command, run_stages
from pchem_pipeline.stages.table import pipeline_of
from pchem_pipeline.store.files import write_atomic
from pchem_pipeline.store.run_store import RunStore

_COMPARED = ("quanta_exposure", "conversion_gain", "bias", "read_noise_e")


def is_in_use(output: Path) -> bool:
    """Tell whether there is something in a folder.

    Raises:
        ConfigError: it is a file.
    """
    if output.exists() and not output.is_dir():
        raise ConfigError(f"{output} is a file; choose a folder with --output")
    return output.exists() and any(output.iterdir())


def run_demo(output: Path, *, size: int, n_frames: int, seed: int, quiet: bool = False) -> str:
    """Simulate a sensor of ``size`` x ``size`` pixels to TIFF, run every stage, and return a text.

    Args:
        output: folder for the frames, the YAML and the store.
        size: rows and columns.
        n_frames: number of frames.
        seed: root of the random numbers.
        quiet: say warnings only.

    Raises:
        ConfigError: the folder holds something else.
        PchEmError: a stage failed.
    """
    if is_in_use(output) and not (output / "demo.yaml").exists():
        raise ConfigError(f"{output} is not empty; choose another folder with --output")
    config = RunConfig.model_validate(
        {
            "run": {"store": "demo.zarr", "title": "Simulated demo sensor", "tile": 32},
            "simulate": {"shape": [size, size], "n_frames": n_frames, "seed": seed, "format": "tiff"},
        }
    )
    path = output / "demo.yaml"
    write_atomic(path, dump_config(config).encode())
    target = find_run(path)
    run_stages(target, pipeline_of(target.config), Command(quiet=quiet))
    table = comparison_table(RunStore.open(target.store))
    place = quoted(target.store)
    return (
        f"{table}\n\nreport: {target.store / 'report.html'}\n\n"
        f"use it: pchem apply {place} FRAMES --output OUT    (other frames in electrons, with errors)\n"
        f"        pchem twin {place} --output camera.yaml    (this camera, to simulate other scenes)"
    )


def comparison_table(store: RunStore) -> str:
    """Return a table of estimated against true parameters of the good pixels of a simulated run.

    ``error / stderr`` is the standard deviation over pixels of (estimate - truth) / standard error: 1
    where the standard errors are right.
    """
    quality = store.read("maps/quality")
    good = quality == 0
    columns = ("true median", "estimated", "rms error", "stderr", "error/stderr")
    head = f"{'parameter':<24}" + "".join(f"{column:>14}" for column in columns)
    lines = [head, "-" * len(head)]
    for name in _COMPARED:
        truth = store.read(f"truth/{name}")[good]
        estimate = store.read(f"maps/{name}")[good]
        stderr = store.read(f"maps/{name}_stderr")[good]
        error = estimate - truth
        numbers = (
            np.median(truth),
            np.median(estimate),
            np.sqrt(np.mean(error**2)),
            np.median(stderr),
            np.std(error / stderr),
        )
        label = f"{name}, {VARIABLES[f'maps/{name}'].unit}"
        lines.append(f"{label:<24}" + "".join(f"{number:>14.4g}" for number in numbers))
    caution, failed = np.count_nonzero(quality == 1), np.count_nonzero(quality == 2)
    lines.append(
        f"{good.sum()} of {good.size} pixels are good (the table is of these), {caution} are to be used with "
        f"caution, {failed} have no value"
    )
    return "\n".join(lines)
