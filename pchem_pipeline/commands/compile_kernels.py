"""Compile the kernels that a run will need: the same stages on a few invented pixels, in a folder of its own.

:mod:`pchem_pipeline.run.compilation` starts this in a process of its own, with the configuration on its
standard input. What is compiled is what the stages call: there is no list of kernels to keep up to date. A
stage that needs frames says itself what compiles its kernels.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pchem_pipeline.config.load import dump_config, make_config
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.run.compilation import mark_path
from pchem_pipeline.run.declaration import imported
from pchem_pipeline.run.target import Target
from pchem_pipeline.runner.session import Command, run_stages
from pchem_pipeline.stages.table import STAGES


def compile_kernels(content: Mapping[str, Any], stages: Sequence[str]) -> None:
    """Run stages on invented histograms, or do what they say; then mark their kernels as compiled.

    Args:
        content: the configuration of a run, whose input, store and workers are not used.
        stages: names of stages that work on ready-made histograms, or say what compiles their kernels.
    """
    config = make_config(content, "the run")
    done = [name for name in stages if STAGES[name].kernels is None]
    if done:
        _do_invented(config, content, done)
    for place in filter(None, (STAGES[name].kernels for name in stages)):
        imported(place)(config)
    mark_path(config, stages).touch()


def _do_invented(config: RunConfig, content: Mapping[str, Any], stages: Sequence[str]) -> None:
    """Run stages, and those that they need, in a folder of its own."""
    with tempfile.TemporaryDirectory(prefix="pchem-kernels-") as place:
        folder = Path(place)
        small = make_config(
            {
                **content,
                "simulate": None,
                "run": {"store": str(folder / "run.zarr")},
                "input": _invented_input(config, folder),
                "compute": {"backend": "serial", "workers": 1},
            },
            "the invented run",
        )
        target = Target(small, folder, folder / "run.zarr")
        run_stages(target, _with_upstream(stages), Command(progress="off", quiet=True))


def _invented_input(config: RunConfig, folder: Path) -> dict[str, Any]:
    """Write invented histograms; return the section ``input`` that reads them, as one sample or as two."""
    depth = config.input.bit_depth
    inputs = []
    for i in range(2 if config.input.samples else 1):
        np.savez(folder / f"invented{i}.npz", **_histograms(depth or 16, seed=i + 1))
        inputs.append({"files": [f"invented{i}.npz"], "bit_depth": depth})
    if not config.input.samples:
        return inputs[0]
    for i, each in enumerate(inputs):
        sample = make_config({"run": {"store": f"sample{i}.zarr"}, "input": each}, "an invented sample")
        (folder / f"sample{i}.yaml").write_text(dump_config(sample))
    return {"samples": [{"run": f"sample{i}.yaml"} for i in range(2)], "against": "none"}


def _with_upstream(stages: Sequence[str]) -> list[str]:
    """Return stages and all that they need, in order."""
    wanted = set(stages)
    for name in reversed(STAGES):
        if name in wanted:
            wanted |= set(STAGES[name].upstream)
    return [name for name in STAGES if name in wanted]


def _histograms(bit_depth: int, seed: int) -> dict[str, Any]:
    """Draw histograms of pixels of many exposures and read noises: ``dn`` (bin,), ``counts`` (pixel, bin)."""
    rng = np.random.default_rng(seed)
    exposure, noise = np.meshgrid([0.3, 2.0, 6.0], [0.2, 0.3, 0.6])
    dn_per_electron = min(8.0, 2.0**bit_depth / 64)
    electrons = rng.poisson(exposure.ravel(), (1000, 9)) + noise.ravel() * rng.standard_normal((1000, 9))
    dn = np.clip(np.rint(dn_per_electron * (electrons + 4)).astype(int), 0, 2**bit_depth - 1)
    counts = np.array([np.bincount(pixel, minlength=dn.max() + 1) for pixel in dn.T])
    return {"dn": np.arange(counts.shape[1]), "counts": counts}


if __name__ == "__main__":
    given = json.load(sys.stdin)
    compile_kernels(given["config"], given["stages"])
