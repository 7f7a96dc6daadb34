"""A plan: frames, exposure and samples that reach what is wanted, or the reason why none do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.planning.split import Split, best_samples, best_split, split_frames
from pchem_pipeline.planning.targets import Point, Target, best_exposure, frames_needed, precision
from pchem_pipeline.planning.verify import frames_simulated

#: Without so much knowledge of the gain, one Gaussian fits as well.
_SEEN = Target("conversion_gain", 25.0, "%")
# smaller shares are not worth a sample.
_LEAST_SHARE = 1e-3


@dataclass(frozen=True)
class Plan:
    """One sample.

    Attributes:
        point: exposure, read noise and gain.
        bounds: frames for each target by the Cramer-Rao bound.
        needed: frames with which simulated pixels reach all targets, few of them flagged.
        frames: these, or those of the budget.
        precision: standard deviations with these frames, by parameter; relative, of the bias in e-.
        best_exposure: H with which the targets need the fewest frames, e-.
        best_frames: these frames.
    """

    point: Point
    bounds: tuple[float, ...]
    needed: float
    frames: float
    precision: dict[str, float]
    best_exposure: float
    best_frames: float


@dataclass(frozen=True)
class SamplesPlan:
    """Several samples."""

    point: Point  # read noise and gain
    split: Split  # exposures, shares and frames in total by the bound
    even: float  # frames in total with the same exposures and even shares
    needed: float  # frames in total with which simulated pixels reach the targets, few of them flagged
    frames: float  # these, or those of the budget
    per_sample: tuple[int, ...]  # frames of each sample


def plan_one_sample(
    targets: Sequence[Target],
    point: Point,
    *,
    exposure_given: bool,
    budget: int | None,
    max_exposure: float,
    max_frames: float,
) -> Plan:
    """Return the plan of one sample, with the exposure of the point if it is given, else with the best one.

    With a budget of frames there may be no targets. Exposures above ``max_exposure``, e-, are not tried.

    Raises:
        ConfigError: a target that no number of frames up to ``max_frames`` reaches.
    """
    aims = tuple(targets) or (Target("conversion_gain", 1.0, "%"),)
    best, best_frames = _best(aims, point, max_exposure, max_frames)
    if not exposure_given:
        if not np.isfinite(best) or (targets and not np.isfinite(best_frames)):
            raise ConfigError(
                _hopeless(aims[0], point, "at any exposure", "; try several samples: --samples best")
            )
        point = replace(point, quanta_exposure=best)
    bounds = tuple(frames_needed(target, point) for target in targets)
    needed = best_frames if not exposure_given else _needed(aims, point, max_frames)
    if targets and needed > max_frames:
        raise ConfigError(_out_of_reach(targets, bounds, point, max_frames, best, best_frames))
    frames = needed if budget is None else float(budget)
    return Plan(point, bounds, needed, frames, precision(point, frames), best, best_frames)


def _needed(targets: Sequence[Target], point: Point, most: float, *, every_flag: bool = False) -> float:
    """Compute the frames under one exposure with which simulated pixels reach the targets."""
    h = point.quanta_exposure
    bound = max(frames_needed(target, point) for target in targets)
    return frames_simulated(targets, point, [h], [1.0], bound, most, every_flag=every_flag)


def _out_of_reach(
    targets: Sequence[Target],
    bounds: Sequence[float],
    point: Point,
    max_frames: float,
    best: float,
    best_frames: float,
) -> str:
    """Say in one line that targets are out of reach, and what would help."""
    asked, target = max(zip(bounds, targets, strict=True), key=lambda each: each[0])
    cure = ""
    if best_frames <= max_frames:
        cure = f"; an exposure of {best:.3g} e- needs {best_frames:,.0f}"
    elif target.shared:
        several = best_samples([target, _SEEN], point, max(point.quanta_exposure, 1.0))
        if several.frames <= max_frames:
            cure = f"; several samples (--samples best) need at least {several.frames:,.0f}"
    # a larger number is as good as none
    bound = f"bound: {float(f'{asked:.2g}'):,.0f} frames" if asked < 1e12 else "no number suffices"
    flagged = "; more than 5 % of simulated pixels stay flagged" if asked <= max_frames else ""
    return _hopeless(
        target, point, f"at an exposure of {point.quanta_exposure:.3g} e-", f" ({bound}{flagged}){cure}"
    )


def _hopeless(target: Target, point: Point, where: str, more: str) -> str:
    return (
        f"{target}: not reached with one sample within --max-frames, {where} and a read noise of "
        f"{point.read_noise_e:g} e-{more}"
    )


def _best(
    targets: Sequence[Target], point: Point, max_exposure: float, max_frames: float
) -> tuple[float, float]:
    """Return exposure and frames with which simulated pixels reach the targets, few of them flagged."""
    low = min(0.02, 0.1 * max_exposure)
    first, fewest = best_exposure((*targets, _SEEN), point, low, max_exposure)
    if not np.isfinite(first):
        return first, fewest
    tried = [first, *np.geomspace(low, max_exposure, 10).tolist()]
    points = [replace(point, quanta_exposure=h) for h in tried]
    bounds = [(max(frames_needed(target, each) for target in targets), each) for each in points]
    best, frames = first, float("inf")
    for bound, exposed in sorted(bounds, key=lambda each: each[0]):
        if bound >= frames:  # nor can the next ones, of larger bounds, need fewer
            break
        needed = _needed(targets, exposed, min(frames, max_frames), every_flag=True)
        if needed < frames:
            best, frames = exposed.quanta_exposure, needed
    return best, frames


def plan_samples(
    targets: Sequence[Target],
    exposures: Sequence[float] | None,
    point: Point,
    *,
    budget: int | None,
    max_exposure: float,
    max_frames: float,
) -> SamplesPlan:
    """Return how to divide frames over samples of given exposures, e-, or chosen ones up to ``max_exposure``.

    The frames in total are the budget, or as many as the targets (gain, bias or read noise) need.

    Raises:
        ConfigError: a target that no number of frames up to ``max_frames`` reaches.
    """
    aims = (*targets, _SEEN)
    if exposures is None:
        split = best_samples(aims, point, max_exposure)
    else:
        split = best_split(aims, exposures, point)
    # too few frames to be worth a sample of their own
    kept = [(h, p) for h, p in zip(split.exposures, split.shares, strict=True) if p > _LEAST_SHARE]
    used, parts = [h for h, _ in kept], [p for _, p in kept]
    frames = frames_simulated(targets, point, used, parts, split.frames, max_frames)
    if frames > max_frames:
        lights = ", ".join(f"{h:g}" for h in split.exposures)
        raise ConfigError(
            f"{targets[0]}: not reached within --max-frames with exposures of {lights} e- and a read noise "
            f"of {point.read_noise_e:g} e-; give other exposures, at least one above 0"
        )
    total = frames if budget is None else float(budget)
    even = split_frames(aims, split.exposures, [1.0 / len(split.shares)] * len(split.shares), point)
    per_sample = tuple(int(np.ceil(share * total)) if share > _LEAST_SHARE else 0 for share in split.shares)
    return SamplesPlan(point, split, even, frames, total, per_sample)
