#!/usr/bin/env python3
"""Simulate a stack of the paper's size to one raw file: 17,750 frames of 512 x 512 pixels, 9.3 GB.

    python scripts/simulate_full_size.py FOLDER [--frames N] [--shape NY NX] [--seed S] [--workers W]

FOLDER gets config.yaml, frames/frames.raw with its sidecar frames.raw.json, frames/truth.npz and run.zarr,
which holds the truth. Go on with: pchem run FOLDER/config.yaml
"""

from __future__ import annotations

import argparse
import math
import os
import time
from pathlib import Path

from pchem_pipeline.config.load import dump_config
from pchem_pipeline.config.tree import RunConfig
from pchem_pipeline.run.stage import Command
from pchem_pipeline.run.target import find_run
from pchem_pipeline.runner.session import run_stages


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="where to write; 9.3 GB at full size")
    parser.add_argument("--frames", type=int, default=17750, help="number of frames [17750]")
    parser.add_argument(
        "--shape", type=int, nargs=2, default=(512, 512), metavar=("NY", "NX"), help="[512 512]"
    )
    parser.add_argument("--seed", type=int, default=1, help="root of the random numbers [1]")
    parser.add_argument("--workers", type=int, default=None, help="threads [all processors]")
    given = parser.parse_args()

    config = RunConfig.model_validate(
        {
            "run": {"title": "Simulated sensor of the paper's size"},
            "simulate": {"shape": given.shape, "n_frames": given.frames, "seed": given.seed, "format": "raw"},
        }
    )
    given.folder.mkdir(parents=True, exist_ok=True)
    path = given.folder / "config.yaml"
    path.write_text(dump_config(config), encoding="utf-8")
    wall, cpu = time.perf_counter(), sum(os.times()[:2])
    run_stages(find_run(path), ["simulate"], Command(workers=given.workers))
    wall, cpu = time.perf_counter() - wall, sum(os.times()[:2]) - cpu
    samples = given.frames * math.prod(given.shape) / 1e6
    print(
        f"{samples:.0f} Msamples in {wall:.1f} s wall, {cpu:.1f} s CPU: {samples / cpu:.1f} Msamples/s/core"
    )


if __name__ == "__main__":
    main()
