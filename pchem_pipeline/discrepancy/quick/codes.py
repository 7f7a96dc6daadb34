"""Checks of the ADC codes: differential nonlinearity, and saturation or clipping at the end codes.

Histograms of some pixels are compared with the exact probability of each code at the maximum of the exact
likelihood: the density at integer DN, with which the run may have been fitted, is less exact than the widths
detected here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, CodeArray, FloatArray
from pchem_pipeline.discrepancy.observe.laws import pile_up, poisson
from pchem_pipeline.discrepancy.observe.tables import PixelHistograms, pixel_laws
from pchem_pipeline.discrepancy.observe.tables_numba import CodeSums
from pchem_pipeline.discrepancy.observe.vector import width_statistics
from pchem_pipeline.discrepancy.quick.checks import Check, check_of
from pchem_pipeline.discrepancy.quick.frames import normal_p
from pchem_pipeline.model.arithmetic.statistics import look_elsewhere
from pchem_pipeline.model.fit.api import fit_histograms
from pchem_pipeline.model.fit.settings import FitSettings

#: Statistics of the codes in words.
_WORDS = {
    "code.alternating": "even and odd codes differ",
    "code.period4": "with a period of 4 DN",
    "code.period8": "with a period of 8 DN",
    "code.period16": "with a period of 16 DN",
    "code.rough": "from code to code",
    "code.largest": "mainly at {code} DN",
}
#: Samples expected at a code that is judged by itself.
_ENOUGH = 100.0
_FEWEST_CODES = 8
#: Bins x electrons of all pixels together: of more every second pixel is looked at, or every third, ...
_MOST_WORK = 1 << 24
#: The variance that fits leave to the codes is linear theory: on 150 stacks without any effect p-values below
#: 0.01 came in one of twenty.
_CAUTION = 10.0
#: Chi-squares above this multiple of the median are no matter of the codes, which all pixels share.
_POOR = 6.0


@dataclass(frozen=True)
class CodeSample:
    """Histograms of some pixels, with the fit of each."""

    counts: CodeArray  # samples at each DN, (n, bin)
    origin: NDArray[np.integer[Any]]  # DN of bin 0, (n,)
    parameters: FloatArray  # H, g, mu, sigma (with quantisation), (n, 4), all finite
    joint: bool = False  # they come from a joint fit of several exposures, and are taken as they are
    limits: tuple[int, int] | None = None  # first and last code of the ADC that the fit knows, DN; None: none

    def of(self, some: NDArray[Any] | slice) -> CodeSample:
        """Return some of the pixels."""
        return replace(
            self, counts=self.counts[some], origin=self.origin[some], parameters=self.parameters[some]
        )


def code_checks(sample: CodeSample) -> list[Check]:
    """Return the checks of the codes: whether samples pile up at an end, and else of their widths."""
    # pixels with samples, and of so many electrons that one of them is not too much
    most = _MOST_WORK // (2 * sample.counts.shape[1])
    kept = np.any(sample.counts, axis=1) & (sample.parameters[:, 0] < most)
    if not kept.any():
        return []
    sample = sample.of(kept)
    codes = _sums(sample)
    if codes is None:
        return []
    histograms = PixelHistograms.alone(sample.counts, sample.origin.astype(np.int64))
    low, high = histograms.extremes(np.ones(len(sample.counts), np.bool_))
    ends = [_pile_up(codes, sample, high, top=True), _pile_up(codes, sample, low, top=False)]
    # cut off, the law of all codes is another one
    widths = None if any(check.p < 1e-6 for check in ends) else _widths(codes)
    return [check for check in (widths, *ends) if check is not None]


def _sums(sample: CodeSample) -> CodeSums | None:
    """Return the samples of all pixels by code, and those expected; None where no pixel fits."""
    work = sample.counts.shape[1] * (5.0 + 2.0 * float(np.quantile(sample.parameters[:, 0], 0.95)))
    sample = sample.of(np.s_[:: max(int(len(sample.counts) * work / _MOST_WORK), 1)])
    counts, origin, found = sample.counts, sample.origin.astype(np.int64), sample.parameters
    if not sample.joint:
        exact = FitSettings(likelihood="exact")
        fit = fit_histograms(counts, origin, settings=exact, adc_limits=sample.limits, start=found)
        found = np.stack([fit.quanta_exposure, fit.conversion_gain, fit.bias, fit.read_noise_dn], axis=1)
    usable: BoolArray = np.asarray(np.isfinite(found).all(axis=1))
    for _ in range(2):  # of all pixels, then without those that may be at a wrong maximum
        laws = pixel_laws(PixelHistograms.alone(counts, origin), found, usable)
        if not laws.good.any():
            return None
        chi2, mean, _ = laws.moments["goodness"].T
        ratio = chi2 / np.maximum(mean, 1.0)
        usable = np.asarray(laws.good) & (ratio <= _POOR * np.median(ratio[laws.good]))
    return laws.codes


def _widths(codes: CodeSums) -> Check | None:
    """Return whether widths of codes (``1 + d``) differ, against the mean of both neighbours."""
    _, expected, residual, variance = codes.single
    judged = expected >= _ENOUGH
    some = judged[:-2] & judged[1:-1] & judged[2:]
    if some.sum() < _FEWEST_CODES:
        return None
    found, z = width_statistics(codes)
    p = {
        name: normal_p(found[name], two_sided=name == "code.alternating") for name in _WORDS if name in found
    }
    worst = min(p, key=lambda name: p[name])
    code = codes.first + int(np.argmax(np.abs(z)))
    safe = np.where(judged, expected, 1.0)
    deviation, noise = residual / safe, np.maximum(variance, 0.05 * expected) / safe**2
    rough = (deviation[1:-1] - 0.5 * (deviation[:-2] + deviation[2:]))[some]
    chance = (noise[1:-1] + 0.25 * (noise[:-2] + noise[2:]))[some]
    weight = chance**-2 / np.sum(chance**-2)
    excess = float(weight @ (rough**2 - chance)) / 1.5
    error = math.sqrt(float(weight**2 @ (4.0 * chance**2))) / 1.5
    p_any = min(_CAUTION * look_elsewhere(p[worst], len(p)), 1.0)
    size, limit = math.sqrt(max(excess, 0.0)), math.sqrt(5.4 * error)
    return check_of("codes", p_any, size, limit=limit, where=_WORDS[worst].format(code=code))


def _pile_up(codes: CodeSums, sample: CodeSample, code: int, top: bool) -> Check:
    """Test whether samples are cut off at ``code``, the lowest or highest of all pixels, DN."""
    # the end of the sums is no limit: they leave out pixels that fit badly, often with the farthest samples
    seen, expected = codes.single[:2]
    at = code - codes.first
    z = -math.inf
    if 0 <= at < seen.size and seen[at]:
        # a fit that expects too many beyond is poor; what is cut off is on the code
        z = min(pile_up(seen, expected, at, top=top), poisson(int(seen[at]), float(expected[at])))
    bins = sample.origin[:, None] + np.arange(sample.counts.shape[1])
    share = float(sample.counts[bins == code].sum() / sample.counts.sum())
    known = sample.limits is not None and code == sample.limits[top]
    name = f"{'top' if top else 'bottom'}_{'limit' if known else 'code'}"
    return check_of(name, normal_p(z), share, how=f"{code} DN", where=f"{code} DN")
