"""Hide effects in a stack of frames: the frames into one folder, the key to another place.

    python tests/hidden/make.py --effect row_noise,clipping --level 4 --seed 7 --out FOLDER

``--effect none`` hides nothing, ``--effect random`` one effect that it does not tell. The folder gets
``frames.npy`` (uint16: frame, y, x). The key (JSON, with the true maps beside it) goes to ``--key``, by
default into the folder ``sealed`` beside the output folder.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from hidden.chain import LIBRARY, hide


def main() -> None:
    """Read the arguments, write the stack and its key."""
    layout = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=layout)
    parser.add_argument("--effect", required=True, help="tags with commas between, none, or random")
    parser.add_argument(
        "--level", type=float, default=4.0, help="times the strength found in 95 %% of stacks"
    )
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--key", type=Path)
    parser.add_argument("--shape", type=int, nargs=2, default=(64, 64), metavar=("ROWS", "COLUMNS"))
    parser.add_argument("--frames", type=int, default=4000)
    parser.add_argument("--take", type=int, default=0, help="of the same sensor, its electrons and noise")
    options = parser.parse_args()
    tags = tuple(options.effect.split(","))
    if options.effect == "none":
        tags = ()
    elif options.effect == "random":
        tags = (str(np.random.default_rng([options.seed, 1]).choice(sorted(LIBRARY))),)
    shape = tuple(options.shape)
    hiding = hide(tags, options.level, options.seed, shape, options.frames, options.take)
    options.out.mkdir(parents=True, exist_ok=True)
    np.save(options.out / "frames.npy", hiding.frames)
    hiding.seal(options.key or options.out.parent / "sealed" / f"{options.out.name}.json")


if __name__ == "__main__":
    main()
