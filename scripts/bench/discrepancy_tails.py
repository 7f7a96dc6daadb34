"""Whether chances of the search in frames are as rare as they say, on cheap clean sensors of the whole range.

Each simulated stack of a sensor is taken for the data and judged by the others of that sensor: twenty clean
data sets for the cost of one. What the replicates share with each other and not with the data (what is learnt
of the sensor) shows in the data of each sensor alone, which are judged as well.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from discrepancy_figures import wilson
from discrepancy_null import results_of_seeds
from numpy.typing import NDArray

LEVELS = (1e-2, 1e-3, 1e-4)
SIGNIFICANCE = 0.005
MOST_SAMPLES = 3e5
_COLOURS = 10  # before they begin anew
OWN = "data"  # what comes of the measured stack, not of the simulated ones


def run_null_tails(folder: Path, first: int, minutes: float) -> None:
    """Judge clean sensors until the time is over; print shares of small p-values by kind, and draw them.

    The folder of the results gets ``null_tails.jsonl`` and ``null_tails.png``.
    """
    results = results_of_seeds(folder / "null_tails.jsonl", first, minutes, judged_sensor)
    records = [r for r in results if "p" in r]
    print_tails(records)
    draw_tails(records, folder / "null_tails.png")


def judged_sensor(seed: int) -> dict[str, Any]:
    """Return p-values by kind of statistic of a clean sensor, simulated stacks and data, and the alarms."""
    from helpers.plain_camera import drawn_camera

    from pchem_pipeline.base.errors import PchEmError
    from pchem_pipeline.discrepancy.by_simulation.candidates.candidates import candidate_classes, serial
    from pchem_pipeline.discrepancy.by_simulation.explainer import FrameExplainer
    from pchem_pipeline.discrepancy.by_simulation.frames.frame_stack import FrameStack
    from pchem_pipeline.discrepancy.by_simulation.frames.observed import ObservedFrames
    from pchem_pipeline.discrepancy.null import Measured, NullModel, disagrees
    from pchem_pipeline.discrepancy.settings import DiscrepancySettings
    from pchem_pipeline.discrepancy.splits import block_length, split_frames

    stack = drawn_camera(np.random.default_rng([seed, 1]), MOST_SAMPLES).frames(seed)
    numbers = np.arange(len(stack))
    splits = split_frames(numbers, block_length(len(stack)))
    frames = FrameStack(stack, numbers, splits, len(stack), int(stack.max()).bit_length() + 1, 1.0)
    settings = DiscrepancySettings()
    try:
        observed, classes = ObservedFrames.of(frames), candidate_classes(settings)
        explainer = FrameExplainer.begin(observed, settings, classes, (), serial)
    except PchEmError as error:
        return {"seed": seed, "refused": str(error)}
    null, data = explainer.prepared.first, explainer.prepared.z
    found: dict[str, list[float]] = defaultdict(list)
    alarms = {"simulated": 0, OWN: int(disagrees(null, data, SIGNIFICANCE))}
    for kind, p in _by_kind(null.names, null.p_values(data.both, 2)):
        found[f"{OWN} {kind}"].append(p)
    for i in range(0, null.n_replicates - 1, 2):
        others = NullModel.from_replicates(null.names, np.delete(null.replicates, [i, i + 1], axis=0))
        own = Measured(*null.replicates[[i, i + 1, i]])
        alarms["simulated"] += disagrees(others, own, SIGNIFICANCE)
        for kind, p in _by_kind(null.names, others.p_values(own.both, 2)):
            found[kind].append(p)
    return {"seed": seed, "stacks": null.n_replicates // 2, "alarms": alarms, "p": found}


def _by_kind(names: Sequence[str], p: NDArray[np.float64]) -> Iterator[tuple[str, float]]:
    """Yield p-values with the family and, where several statistics have it, the last word of the name."""
    from pchem_pipeline.discrepancy.observe.catalogue import EXACT

    for name, value in zip(names, p.tolist(), strict=True):
        words = name.partition("@")[0].split(".")
        last = words[-1] if words[0] in ("shape", "time", "tail") and len(words) > 2 else ""
        if name not in EXACT:
            yield f"{words[0]} {last}".strip(), value


def print_tails(records: Sequence[dict[str, Any]]) -> None:
    """Print alarms with 95 % intervals, and the shares of small p-values over the level, by kind."""
    from scipy import stats

    for what, total in ((OWN, len(records)), ("simulated", sum(r["stacks"] for r in records))):
        count = sum(r["alarms"][what] for r in records)
        low, high = (100 * end for end in wilson(count, total))
        print(f"{what}: {count} of {total} disagree, [{low:.2f}, {high:.2f}] %; {100 * SIGNIFICANCE} % meant")
    print(f"{'kind':24s}{'p-values':>9s}" + "".join(f"{f'< {level:g}':>9s}" for level in LEVELS) + "   KS p")
    for kind, p in _gathered(records).items():
        shares = "".join(f"{np.mean(p < level) / level:9.2f}" for level in LEVELS)
        print(f"{kind:24s}{p.size:9d}{shares}   {stats.kstest(p, 'uniform').pvalue:.2g}")


def draw_tails(records: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw the share of p-values below p against p, by kind; on the diagonal they are as rare as they say."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 5), layout="constrained")
    simulated = {kind: p for kind, p in _gathered(records).items() if not kind.startswith(OWN)}
    for i, (kind, p) in enumerate(simulated.items()):
        style = "-" if i < _COLOURS else ":"
        axes.loglog(np.sort(p), np.arange(1, p.size + 1) / p.size, style, lw=1.2, label=kind)
    axes.loglog([1e-6, 1], [1e-6, 1], "k--", lw=0.8)
    axes.set(xlabel="p-value", ylabel="share of clean stacks below it", xlim=(1e-6, 1), ylim=(1e-5, 1))
    axes.legend(fontsize=7)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _gathered(records: Sequence[dict[str, Any]]) -> dict[str, NDArray[np.float64]]:
    kinds = sorted({kind for r in records for kind in r["p"]})
    return {kind: np.concatenate([r["p"].get(kind, []) for r in records]) for kind in kinds}
