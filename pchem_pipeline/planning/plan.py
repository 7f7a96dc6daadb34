"""A plan: frames, exposure and samples that reach what is wanted, or the reason why none do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.model.fit.status import COUNTS_ELECTRONS
from pchem_pipeline.planning.frames import best_exposure, exposure_grid, frames_needed, precision
from pchem_pipeline.planning.likelihood_limits import ambiguity, gain_rival
from pchem_pipeline.planning.point import Point
from pchem_pipeline.planning.split import Split, best_samples, best_split, split_frames
from pchem_pipeline.planning.targets import Target

#: Without so much knowledge of the gain, the bound says nothing about real fits.
_SEEN = Target("conversion_gain", 25.0, "%")
_TRIED = 10  # exposures
#: Smaller shares are not worth a sample.
LEAST_SHARE = 1e-3


@dataclass(frozen=True)
class Need:
    """What one target asks for.

    Attributes:
        target: what is wanted.
        bound: frames by the Cramer-Rao bound.
        certain: frames until electron numbers are not off by one; 0 where that does not matter: at a given
            exposure for a gain or a read noise.
        seen: frames until the gain is known to a quarter, below which one Gaussian fits as well, and until no
            other gain is as likely by chance.
    """

    target: Target
    bound: float
    certain: float
    seen: float

    @property
    def frames(self) -> float:
        """Frames for all of it."""
        return max(self.bound, self.certain, self.seen)


@dataclass(frozen=True)
class Plan:
    """One sample.

    Attributes:
        point: exposure, read noise and gain.
        needs: one a target.
        frames: that reach all targets; those of the budget where there is none.
        precision: standard deviations with these frames, by parameter; relative, of the bias in e-.
        best_exposure: H with which the targets need the fewest frames, e-.
        best_frames: these frames.
    """

    point: Point
    needs: tuple[Need, ...]
    frames: float
    precision: dict[str, float]
    best_exposure: float
    best_frames: float


@dataclass(frozen=True)
class SamplesPlan:
    """Several samples.

    Attributes:
        point: read noise and gain.
        split: exposures, shares and frames in total by the bound.
        even: frames in total with the same exposures and even shares.
        certain: frames in total until electron numbers are not off by one.
        frames: in total, for both.
        per_sample: frames of each sample.
    """

    point: Point
    split: Split
    even: float
    certain: float
    frames: float
    per_sample: tuple[int, ...]


def plan_one_sample(
    targets: Sequence[Target],
    point: Point,
    *,
    exposure_given: bool,
    budget: int | None,
    max_exposure: float,
    max_frames: float,
) -> Plan:
    """Return the plan of one sample.

    Args:
        targets: what is wanted; may be empty with a budget.
        point: the pixel; its exposure counts if it was given.
        exposure_given: else the best exposure is taken.
        budget: frames there are, or None.
        max_exposure: largest exposure allowed, e-.
        max_frames: more frames than these are as good as never.

    Raises:
        ConfigError: a target that no number of frames reaches.
    """
    aims = tuple(targets) or (Target("conversion_gain", 1.0, "%"),)
    best, best_frames = _best(aims, point, max_exposure)
    if not exposure_given:
        if not np.isfinite(best):
            raise ConfigError(_hopeless(aims[0], point, "at any exposure", ""))
        point = replace(point, quanta_exposure=best)
    needs = tuple(_need(target, point, sure=not exposure_given) for target in targets)
    for need in needs:
        _refuse(need, point, max_frames, best, best_frames)
    frames = float(budget) if budget is not None else max(need.frames for need in needs)
    return Plan(point, needs, frames, precision(point, frames), best, best_frames)


def _need(target: Target, point: Point, *, sure: bool) -> Need:
    """Return what a target asks for; ``sure``: no flag is to be left, of whatever quantity."""
    certain = 0.0
    if sure or target.name in COUNTS_ELECTRONS:
        certain = ambiguity([point.quanta_exposure], [1.0], point.read_noise_e).frames()
    seen = max(frames_needed(_SEEN, point), _gain_certain([point.quanta_exposure], [1.0], [target], point))
    return Need(target, frames_needed(target, point), certain, seen)


def _gain_certain(
    exposures: Sequence[float], shares: Sequence[float], targets: Sequence[Target], point: Point
) -> float:
    """Return the frames until no other gain, farther away than what is wanted of it, is as likely."""
    wanted = [target.wanted(point) for target in targets if target.name == "conversion_gain"]
    nearest = max(0.1, 4 * min(wanted, default=0.0))
    gap = gain_rival(exposures, shares, point.read_noise_e, min(nearest, 0.2), point.conversion_gain)
    return gap.frames()


def _refuse(need: Need, point: Point, max_frames: float, best: float, best_frames: float) -> None:
    """Say in one line that a target is out of reach, and what would help.

    Raises:
        ConfigError: it is.
    """
    target = need.target
    if need.frames > max_frames:
        cure = ""
        if best_frames <= max_frames and best_frames < 0.5 * need.frames:
            cure = f"; an exposure of {best:.3g} e- needs {best_frames:,.0f}"
        elif target.shared:
            several = best_samples([target, _SEEN], point, max(point.quanta_exposure, 1.0))
            if several.frames <= max_frames:
                cure = f"; several samples (--samples best) need {several.frames:,.0f}"
        # a larger number is as good as none
        asked = f"{float(f'{need.frames:.2g}'):,.0f} frames" if need.frames < 1e12 else "no number suffices"
        raise ConfigError(
            _hopeless(target, point, f"at an exposure of {point.quanta_exposure:.3g} e-", f" ({asked}){cure}")
        )


def _hopeless(target: Target, point: Point, where: str, more: str) -> str:
    return (
        f"{target}: not reached with one sample within --max-frames, {where} and a read noise of "
        f"{point.read_noise_e:g} e-{more}"
    )


def _best(targets: Sequence[Target], point: Point, max_exposure: float) -> tuple[float, float]:
    """Return the best exposure and its frames: those of the bound, and until nothing is flagged.

    Where the bound's best will not do, the others are tried in the order of their bounds, as long as these
    promise anything.
    """
    low = min(0.02, 0.1 * max_exposure)
    aims = (*targets, _SEEN)
    first, fewest = best_exposure(aims, point, low, max_exposure)
    if not np.isfinite(first):
        return first, fewest
    others = [replace(point, quanta_exposure=float(h)) for h in exposure_grid(low, max_exposure, _TRIED)]
    promises = [(max(frames_needed(target, there) for target in aims), there) for there in others]
    promises.append((fewest, replace(point, quanta_exposure=first)))
    promises.sort(key=lambda each: each[0])
    best, frames = first, float("inf")
    for bound, there in promises:
        if bound >= frames:
            break
        h = there.quanta_exposure
        certain = _gain_certain([h], [1.0], targets, there)
        if certain < frames:
            certain = max(certain, ambiguity([h], [1.0], point.read_noise_e).frames())
        if max(bound, certain) < frames:
            best, frames = h, max(bound, certain)
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
    """Return how to divide frames over several samples.

    Args:
        targets: gain, bias or read noise.
        exposures: H of the samples, e-; None to choose them.
        point: read noise and gain of the pixel.
        budget: frames in total, or None for as many as the targets need.
        max_exposure: largest exposure to choose, e-.
        max_frames: more frames than these are as good as never.

    Raises:
        ConfigError: a target that no number of frames reaches.
    """
    aims = (*targets, _SEEN)
    if exposures is None:
        split = best_samples(aims, point, max_exposure)
    else:
        split = best_split(aims, exposures, point)
    # too few frames to be worth a sample of their own
    kept = [(h, p) for h, p in zip(split.exposures, split.shares, strict=True) if p > LEAST_SHARE]
    certain = 0.0
    if any(exposure > 0 for exposure, _ in kept):
        used, parts = [h for h, _ in kept], [p for _, p in kept]
        certain = ambiguity(used, parts, point.read_noise_e).frames()
        certain = max(certain, _gain_certain(used, parts, targets, point))
    frames = max(split.frames, certain)
    if frames > max_frames:
        lights = ", ".join(f"{h:g}" for h in split.exposures)
        raise ConfigError(
            f"{targets[0]}: not reached within --max-frames with exposures of {lights} e- and a read noise "
            f"of {point.read_noise_e:g} e-; give other exposures, at least one above 0"
        )
    total = float(budget) if budget is not None else frames
    even = split_frames(aims, split.exposures, [1.0 / len(split.shares)] * len(split.shares), point)
    per_sample = tuple(int(np.ceil(share * total)) if share > LEAST_SHARE else 0 for share in split.shares)
    return SamplesPlan(point, split, even, certain, total, per_sample)
