"""How to divide frames over samples of different exposures.

The information of samples adds up, so the variance of a parameter is a convex function of the shares of the
frames, and the best shares are found by a multiplicative algorithm (Silvey, Titterington and Torsney 1978,
Commun. Stat. A 7, 1379). With exposures free, it starts from a grid of them and keeps the few that are left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.model.errors.expected_information import shared_information
from pchem_pipeline.planning.targets import Point, Target

_STEPS = 4000
_LEAST_SHARE = 0.01


@dataclass(frozen=True)
class Split:
    """Samples and the share of the frames that each shall have."""

    exposures: tuple[float, ...]  # H of each sample, e-; 0 for bias frames
    shares: tuple[float, ...]  # of the frames, adding up to 1
    frames: float  # frames in total with which all targets are reached; infinite where they are not


def best_split(targets: Sequence[Target], exposures: Sequence[float], point: Point) -> Split:
    """Return the shares with which samples of given exposures (e-) reach all targets with the fewest frames.

    Raises:
        ConfigError: an exposure is negative or given twice, or a target is of one sample only.
    """
    _check(targets, exposures)
    information = _informations(exposures, point)
    shares = _shares(information, *_wishes(targets, point))
    return Split(tuple(exposures), tuple(map(float, shares)), _frames(information, shares, targets, point))


def split_frames(
    targets: Sequence[Target], exposures: Sequence[float], shares: Sequence[float], point: Point
) -> float:
    """Return the frames in total that reach all targets with given shares; infinite where none do."""
    return _frames(_informations(exposures, point), np.asarray(shares, np.float64), targets, point)


def best_samples(targets: Sequence[Target], point: Point, high: float) -> Split:
    """Return exposures up to ``high`` (e-), 0 among them where it helps, that reach the targets soonest."""
    grid = [0.0, *np.geomspace(min(0.05, 0.1 * high), high, 40).tolist()]
    coarse = best_split(targets, grid, point)
    kept = _merged(coarse)
    fine = [0.0] if 0.0 in kept else []
    for exposure in kept:
        if exposure > 0:
            fine += np.geomspace(exposure / 1.2, min(exposure * 1.2, high), 9).tolist()
    again = _merged(best_split(targets, sorted(set(fine)), point))
    return best_split(targets, again, point)


def _merged(split: Split) -> list[float]:
    """Return the exposures with a share, neighbours put together at their mean."""
    groups: list[list[tuple[float, float]]] = []
    for exposure, share in sorted(zip(split.exposures, split.shares, strict=True)):
        if share < _LEAST_SHARE / 4:
            continue
        last = groups[-1][-1][0] if groups else -1.0
        if last > 0 and exposure < 1.35 * last:
            groups[-1].append((exposure, share))
        else:
            groups.append([(exposure, share)])
    weighted = [
        (sum(h * p for h, p in group) / sum(p for _, p in group), sum(p for _, p in group))
        for group in groups
    ]
    kept = [exposure for exposure, share in weighted if share >= _LEAST_SHARE]
    return kept or [max(weighted, key=lambda each: each[1])[0]]


def _check(targets: Sequence[Target], exposures: Sequence[float]) -> None:
    single = [target.name for target in targets if not target.shared]
    if single:
        raise ConfigError(
            f"--target {single[0]}: with several samples choose from the shared parameters conversion_gain, "
            "bias, read_noise_dn, read_noise_e"
        )
    if len(set(exposures)) < len(exposures):
        raise ConfigError("--samples: an exposure is given twice; give each once")
    if min(exposures) < 0 or not np.isfinite(exposures).all():
        raise ConfigError("--samples: give exposures in e-, 0 for bias frames, such as 0,2,8")


def _informations(exposures: Sequence[float], point: Point) -> FloatArray:
    """Return the Fisher information of one frame of each sample on the shared parameters, shape (n, 3, 3)."""
    noise, gain = point.read_noise_e, point.conversion_gain
    return np.stack([shared_information(float(h), noise, gain) for h in exposures])


def _wishes(targets: Sequence[Target], point: Point) -> tuple[FloatArray, FloatArray]:
    exposed = replace(point, quanta_exposure=1.0)
    gradients = np.stack([target.gradient(exposed)[1:] for target in targets])
    return gradients, np.array([target.wanted(exposed) for target in targets])


def _inverse(matrix: FloatArray) -> FloatArray:
    """Return the inverse, with a trace added that keeps matrices invertible while shares go to 0."""
    trace = np.diag(np.diagonal(matrix)) + 1e-9 * np.eye(3)
    return np.asarray(np.linalg.inv(matrix + 1e-12 * trace))


def _shares(information: FloatArray, gradients: FloatArray, wanted: FloatArray) -> FloatArray:
    """Return the shares that minimise the largest of the variances, each over what is wanted, squared."""
    shares = np.full(information.shape[0], 1.0 / information.shape[0])
    weights = np.full(wanted.size, 1.0 / wanted.size)
    for _ in range(_STEPS):
        covariance = _inverse(np.einsum("j,jab->ab", shares, information))
        pulls = gradients @ covariance
        cost = np.einsum("ta,ta->t", pulls, gradients) / wanted**2
        weights = weights * np.sqrt(cost)
        weights /= weights.sum()
        gain = np.einsum("t,ta,jab,tb->j", weights / wanted**2, pulls, information, pulls)
        following = shares * np.sqrt(gain)
        following /= following.sum()
        moved = np.abs(following - shares).max()
        shares = following
        if moved < 1e-9:
            break
    return shares


def _frames(information: FloatArray, shares: FloatArray, targets: Sequence[Target], point: Point) -> float:
    gradients, wanted = _wishes(targets, point)
    total = np.einsum("j,jab->ab", shares, information)
    if np.linalg.cond(total) > 1e12:
        return float("inf")
    covariance = _inverse(total)
    needed = np.einsum("ta,ab,tb->t", gradients, covariance, gradients) / wanted**2
    return float(np.ceil(max(needed.max(), 1.0)))
