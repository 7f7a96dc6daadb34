"""Checks of the codes of the ADC: widths that differ, and a pile-up at the highest code.

The histograms of some pixels are compared with the exact mass of each code, at parameters that one step of
Fisher's scoring takes from those of the run to where the exact likelihood is largest: the density at whole
DN, with which the run may have been fitted, differs from the mass by more than the widths that show here.
Plain array arithmetic, so that no kernel has to be compiled for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pchem_pipeline.base.units import QUANTISATION_VARIANCE
from pchem_pipeline.discrepancy.observe.laws import chi_square, extreme, largest_normal
from pchem_pipeline.discrepancy.observe.vector import period_statistics
from pchem_pipeline.discrepancy.quick.checks import Check
from pchem_pipeline.discrepancy.quick.series import normal_p, of_many

FloatArray = NDArray[np.float64]

#: Statistics of the codes, and what they say.
_WORDS = {
    "code.alternating": "even and odd codes differ",
    "code.period4": "with a period of 4 DN",
    "code.period8": "with a period of 8 DN",
    "code.period16": "with a period of 16 DN",
    "rough": "from code to code",
    "largest": "most at {code} DN",
}
#: Samples expected at a code that is judged by itself.
_ENOUGH = 100.0
_FEWEST_CODES = 8
#: Elements (codes x electrons) of all pixels together, and of those that are computed at a time.
_MOST_WORK, _AT_ONCE = 2_500_000, 500_000
#: Steps of scoring, and the length in standard errors below which a pixel has arrived.
_STEPS, _LONGEST, _ARRIVED = 6, 10.0, 0.1
_NEGLIGIBLE = 1e-14
#: The variance that fits leave to the codes is linear theory: on 150 stacks without any effect p-values below
#: 0.01 came in one of twenty.
_CAUTION = 10.0
#: Chi-squares above this multiple of the median are no matter of the codes, which all pixels share.
_POOR = 6.0
_SMALLEST_WIDTH = 0.1


@dataclass(frozen=True)
class CodeSample:
    """Histograms of some pixels, with the fit of each.

    Attributes:
        counts: samples at each DN, (n, bin).
        origin: DN of bin 0, (n,).
        parameters: H, g, mu, sigma (with quantisation), (n, 4), all finite.
        covariance: of these, (n, 4, 4), where they come from a joint fit of several exposures, of which the
            histograms are one: they are taken as they are. None: a fit of these histograms alone.
    """

    counts: NDArray[np.unsignedinteger[Any]]
    origin: NDArray[np.integer[Any]]
    parameters: FloatArray
    covariance: FloatArray | None = None

    def of(self, some: NDArray[Any]) -> CodeSample:
        """Return some of the pixels."""
        covariance = None if self.covariance is None else self.covariance[some]
        return CodeSample(self.counts[some], self.origin[some], self.parameters[some], covariance)


@dataclass
class _Residuals:
    """Sums over the pixels along DN, and of the residuals modulo 16, with their variance after a fit."""

    observed: FloatArray
    expected: FloatArray
    variance: FloatArray
    fold: FloatArray
    fold_covariance: FloatArray


def code_checks(sample: CodeSample) -> list[Check]:
    """Return the checks of the codes: their widths, and whether samples pile up at the highest.

    Args:
        sample: pixels with a fit that can be relied upon.
    """
    # pixels with samples, and of so many electrons that one of them is not too much
    most = _MOST_WORK // (2 * sample.counts.shape[1])
    kept = np.any(sample.counts, axis=1) & (sample.parameters[:, 0] < most)
    if not kept.any():
        return []
    sample = sample.of(kept)
    first = int(sample.origin.min())
    codes = int(sample.origin.max()) + sample.counts.shape[1] - first
    sums = _Residuals(np.zeros(codes), np.zeros(codes), np.zeros(codes), np.zeros(16), np.zeros((16, 16)))
    for some in _pieces(sample):
        _add(_trimmed(sample.of(some)), first, sums)
    return [check for check in (_widths(sums, first), _pile_up(sums, first)) if check is not None]


def _pieces(sample: CodeSample) -> list[NDArray[np.int64]]:
    """Return the pixels that are looked at, evenly spread, so many at a time that they fit into memory."""
    exposure = float(np.quantile(sample.parameters[:, 0], 0.95))
    each = sample.counts.shape[1] * _electrons(exposure)
    n = len(sample.counts)
    chosen = np.unique(np.linspace(0, n - 1, max(min(n, _MOST_WORK // each), 1)).astype(np.int64))
    return np.array_split(chosen, min(-(-chosen.size * each // _AT_ONCE), chosen.size))


def _trimmed(sample: CodeSample) -> CodeSample:
    """Return pixels without the bins that none of them occupies."""
    filled = np.flatnonzero(sample.counts.any(axis=0))
    start, stop = max(int(filled[0]) - 2, 0), int(filled[-1]) + 3
    return replace(sample, counts=sample.counts[:, start:stop], origin=sample.origin.astype(np.int64) + start)


def _electrons(exposure: float) -> int:
    return int(exposure + 7.0 * math.sqrt(exposure) + 8.0)


def _masses(theta: FloatArray, low: FloatArray, bins: int) -> tuple[FloatArray, FloatArray]:
    """Return the mass of each code and its derivatives in H, 1/g, mu and width.

    Args:
        theta: H, 1/g (DN), mu (DN), analog read noise (DN), (n, 4).
        low: DN of bin 0, (n,).
        bins: number of codes.

    Returns:
        (n, bins) and (n, bins, 4).
    """
    exposure, step, bias, width = (theta[:, i, None] for i in range(4))
    edges = low[:, None] - 0.5 + np.arange(bins + 1)
    mass, slopes = np.zeros((len(theta), bins)), np.zeros((len(theta), bins, 4))
    for k in range(_electrons(float(theta[:, 0].max()))):
        weight = np.exp(special.xlogy(k, exposure) - exposure - special.gammaln(k + 1.0))
        z = (edges - bias - k * step) / width
        below = special.ndtr(z)
        density = np.exp(-0.5 * z * z) * (0.3989422804014327 / width)
        cell = weight * np.diff(below, axis=1)
        shift = -weight * np.diff(density, axis=1)
        mass += cell
        slopes[:, :, 0] += cell * (k / exposure - 1.0)
        slopes[:, :, 1] += k * shift
        slopes[:, :, 2] += shift
        slopes[:, :, 3] -= weight * np.diff(z * density, axis=1)
    return mass, slopes


@dataclass(frozen=True)
class _AtMaximum:
    """Mass and slopes of the codes of some pixels at their exact estimates, with its covariance (n, 4, 4)."""

    mass: FloatArray
    slopes: FloatArray
    covariance: FloatArray
    arrived: NDArray[np.bool_]


def _climbed(sample: CodeSample) -> _AtMaximum:
    """Climb to the maximum of the exact likelihood by Fisher's scoring; a joint fit is there already."""
    seen, low = sample.counts.astype(np.float64), sample.origin.astype(np.float64)
    exposure, gain, bias, sigma = sample.parameters.T
    width = np.sqrt(np.maximum(sigma**2 - QUANTISATION_VARIANCE, _SMALLEST_WIDTH**2))
    theta = np.stack([exposure, 1.0 / gain, bias, width], axis=1)
    if sample.covariance is not None:
        scale = np.stack([np.ones_like(gain), -1.0 / gain**2, np.ones_like(gain), sigma / width], axis=1)
        joint = scale[:, :, None] * sample.covariance * scale[:, None, :]
        return _AtMaximum(*_masses(theta, low, seen.shape[1]), joint, np.ones(len(seen), np.bool_))
    total = seen.sum(axis=1)
    for step in range(_STEPS):
        mass, slopes = _masses(theta, low, seen.shape[1])
        inverse = np.where(mass > _NEGLIGIBLE, 1.0 / np.maximum(mass, _NEGLIGIBLE), 0.0)
        information = np.einsum("nbi,nbj->nij", slopes * inverse[:, :, None], slopes)
        covariance = np.linalg.pinv(information * total[:, None, None], hermitian=True)
        move = np.einsum("nij,nj->ni", covariance, np.einsum("nbi,nb->ni", slopes, inverse * seen))
        stderr = np.sqrt(np.maximum(np.diagonal(covariance, 0, 1, 2), 1e-300))
        arrived = np.all(np.abs(move) <= _ARRIVED * stderr, axis=1)
        if step == _STEPS - 1 or arrived.all():
            break
        move = np.clip(move, -_LONGEST * stderr, _LONGEST * stderr)
        for i in (0, 1, 3):  # positive
            move[:, i] = np.clip(move[:, i], -0.3 * theta[:, i], 0.3 * theta[:, i])
        theta = theta + move
    return _AtMaximum(mass, slopes, covariance, arrived)


def _alike(seen: FloatArray, mass: FloatArray) -> NDArray[np.bool_]:
    """Return which pixels fit about as well as most: others may be at a wrong maximum, (n,)."""
    expected = seen.sum(axis=1)[:, None] * mass
    chi2 = ((seen - expected) ** 2 / np.maximum(expected, 1.0)).sum(axis=1)
    return np.asarray(chi2 <= _POOR * np.median(chi2))


def _add(sample: CodeSample, first: int, sums: _Residuals) -> None:
    """Add pixels: their samples, those expected at the exact estimate, and the variance that is left."""
    at, counts, origin = _climbed(sample), sample.counts, sample.origin
    kept = at.arrived & _alike(counts.astype(np.float64), at.mass)
    seen, origin, bins = counts[kept].astype(np.float64), origin[kept], counts.shape[1]
    mass, slopes, total = at.mass[kept], at.slopes[kept], seen.sum(axis=1)
    covariance = at.covariance[kept] * total[:, None, None] ** 2
    expected = total[:, None] * mass
    absorbed = np.einsum("nbi,nbi->nb", slopes @ covariance, slopes)
    variance = np.maximum(expected * (1.0 - mass) - absorbed, 0.0)
    code = (origin - first)[:, None] + np.arange(bins)
    for target, values in ((sums.observed, seen), (sums.expected, expected), (sums.variance, variance)):
        target += np.bincount(code.ravel(), values.ravel(), minlength=target.size)
    for phase in range(16):  # pixels with the same origin modulo 16 have their codes in the same places
        mine = origin % 16 == phase
        if mine.any():
            onto = np.eye(16)[(phase + np.arange(bins)) % 16]
            folded, slope = mass[mine] @ onto, np.einsum("nbi,bf->nfi", slopes[mine], onto)
            sums.fold += (seen[mine] - expected[mine]).sum(axis=0) @ onto
            sums.fold_covariance += np.diag((expected[mine] @ onto).sum(axis=0))
            sums.fold_covariance -= np.einsum("nf,n,ng->fg", folded, total[mine], folded)
            sums.fold_covariance -= np.einsum("nfi,nij,ngj->fg", slope, covariance[mine], slope)


def _widths(sums: _Residuals, first: int) -> Check | None:
    """Return whether widths of codes differ, against the mean of both neighbours.

    A width that is larger by d has ``1 + d`` times the samples.
    """
    expected = sums.expected
    judged = expected >= _ENOUGH
    some = judged[:-2] & judged[1:-1] & judged[2:]
    if some.sum() < _FEWEST_CODES:
        return None
    variance = np.maximum(sums.variance, 0.05 * sums.expected)
    z = np.where(judged, (sums.observed - expected) / np.sqrt(np.where(judged, variance, 1.0)), 0.0)
    second = (z[1:-1] - 0.5 * (z[:-2] + z[2:]))[some]
    m = second.size
    found = period_statistics(sums.fold, sums.fold_covariance) if sums.fold_covariance.trace() > 0 else {}
    # white noise under the weights (-1/2, 1, -1/2), whose autocorrelation is (1, -2/3, 1/6)
    found["rough"] = float(chi_square(np.sum(second**2) / 1.5, m, 2.0 * m * (1.0 + 8.0 / 9.0 + 1.0 / 18.0)))
    found["largest"] = largest_normal(z[judged])
    p = {
        name: normal_p(found[name], two_sided=name == "code.alternating") for name in _WORDS if name in found
    }
    worst = min(p, key=lambda name: p[name])
    code = first + int(np.argmax(np.abs(z)))
    safe = np.where(judged, expected, 1.0)
    deviation, noise = sums.observed / safe - 1.0, variance / safe**2
    rough = (deviation[1:-1] - 0.5 * (deviation[:-2] + deviation[2:]))[some]
    chance = (noise[1:-1] + 0.25 * (noise[:-2] + noise[2:]))[some]
    weight = chance**-2 / np.sum(chance**-2)
    excess = float(weight @ (rough**2 - chance)) / 1.5
    error = math.sqrt(float(weight**2 @ (4.0 * chance**2))) / 1.5
    return Check(
        "codes",
        "codes have different widths",
        min(_CAUTION * of_many(p[worst], len(p)), 1.0),
        math.sqrt(max(excess, 0.0)),
        "LSB",
        limit=math.sqrt(5.4 * error),
        where=_WORDS[worst].format(code=code),
        advice="the histograms of all pixels deviate from the model at the same DN",
    )


def _pile_up(sums: _Residuals, first: int) -> Check | None:
    """Return whether so many samples lie on the highest code, and none beyond, that it cuts off."""
    if not sums.observed.any():
        return None
    top = int(np.flatnonzero(sums.observed)[-1])
    z = extreme(int(sums.observed[top]), float(sums.expected[top]), float(sums.expected[top + 1 :].sum()))
    return Check(
        "top_code",
        "samples pile up at the highest code",
        normal_p(z),
        float(sums.observed[top] / sums.observed.sum()),
        "1",
        where=f"{first + top} DN",
        advice="larger signals are cut off there: exposures of bright pixels come out too low",
    )
