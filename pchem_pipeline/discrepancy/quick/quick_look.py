"""A quick look at a run: tests of independence of rows, columns, frames, neighbours and successive samples.

It uses sums that the run has anyway, takes a second, and covers every pixel and every frame. Given the
histograms, samples without any effect are in random order and independent of other pixels. This alone fixes
expectation and variance of all sums of products of different samples (permutation argument), so that a poor
fit, a hot pixel or a heavy tail gives no false alarm. Noise common to a frame, row, column or to neighbours
adds to the mean covariance of the pairs that share it; its components are separated as in an analysis of
variance. The cause is found by ``pchem discrepancy``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy import special

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.base.wording import first_few
from pchem_pipeline.discrepancy.observe.laws import chi_square, without_skew
from pchem_pipeline.discrepancy.observe.sums import MINIMUM_BLOCKS
from pchem_pipeline.discrepancy.quick.checks import KINDS, Check, QuickLook, check_of, graded
from pchem_pipeline.discrepancy.quick.codes import CodeSample, code_checks
from pchem_pipeline.discrepancy.quick.frames import levels_check, normal_p, odd_frame_checks, series_checks
from pchem_pipeline.discrepancy.quick.sums import Lines, StackSums, sensor_cells, sensor_places
from pchem_pipeline.discrepancy.scan import Suspect
from pchem_pipeline.effects.framework.evidence import PixelMaps
from pchem_pipeline.model.arithmetic.significance import BEYOND_DOUBT, SIGNIFICANCE
from pchem_pipeline.model.arithmetic.statistics import look_elsewhere, robust_sd
from pchem_pipeline.model.histogram.spectrum import SEEN_MIDWAY
from pchem_pipeline.model.maps.ordered import median_of

if TYPE_CHECKING:
    from pchem_pipeline.effects.framework.effect import Effect


#: Lines with a variance above this multiple of the median hold hot pixels, and are left out of frame means.
_LOUD = 4.0
#: Standard deviations from which on a check fails for sure (19 of 20), with a dozen checks.
_SURE = 5.4
_FEWEST_LINES = 4
_SHOWN = 6


def quick_look(
    sums: StackSums | None,
    maps: PixelMaps,
    codes: CodeSample | None = None,
    model: Sequence[Effect] = (),
    missing: dict[str, str] | None = None,
    command: str = "",
) -> QuickLook:
    """Return the checks of a run, of those of its sums and codes (histograms of some pixels) that there are.

    ``model``: effects of the fit; ``missing``: parts not looked at, and why; ``command``: for a search.
    """
    checks: list[Check] = []
    usable = maps.usable
    gain, noise = (median_of(values, ~usable) for values in (maps.conversion_gain, maps.read_noise_dn))
    if sums is not None and sums.freedom > 0:
        checks.append(levels_check(sums.all_means, sums.all_variances, gain, sums.odd.get("empty", ())))
        stack = _stack_checks(sums, maps)
        checks += [*odd_frame_checks(sums), *stack, *_wave(sums, stack)]
    if codes is not None:
        checks += code_checks(codes)
    samples = 0 if sums is None else sums.n_frames * int(np.prod(sums.shape))
    found, unseen = graded(checks, gain, noise, model), dict(missing or {})
    made = {check.name for check in found}
    unseen |= {} if sums is None else {part: why for name, (part, why) in _NEEDS.items() if name not in made}
    if found and found[0].name == "levels" and found[0].level == "serious":
        found, unseen = found[:1], {**unseen, "all else": "frames of several exposures"}
    return QuickLook(found, unseen, samples, command)


#: Checks that need a minimum size of the stack: what they test, and the size.
_NEEDS = {
    "wandering_pixels": ("pixels along the run", "fewer than four blocks of 32 or more frames"),
    "drift": ("frame means along the run", "fewer than 64 frames"),
    "wave": ("pickup in readout order", "fewer than 8 rows or columns"),
    "frame_noise": ("noise common to a frame", "fewer than 4 rows or columns"),
}


def _wave(sums: StackSums, others: Sequence[Check]) -> list[Check]:
    """Return whether noise has a frequency within frames: a wave across the frame, or one in each line."""
    line = sums.spectrum
    if not line:
        return []
    frames, cells = line["frames"], line["cells"]
    # of so many means of exponential numbers the largest
    sure = (math.sqrt(2.0 * math.log(cells)) + 3.0) / math.sqrt(frames)
    p = look_elsewhere(float(special.gammaincc(frames, frames * line["ratio"])), cells)
    limit = line["unit"] * math.sqrt(sure / SEEN_MIDWAY)
    # what pixels share more in a part of the sensor has all frequencies; runs of earlier versions lack p
    shared = any(check.p < SIGNIFICANCE for check in others if check.name.endswith("_noise"))
    in_lines = 1.0 if shared else look_elsewhere(line.get("line_p", 1.0), line.get("line_looks", 1.0))
    of, how = "", "; pchem discrepancy finds its frequency"
    if in_lines < p and p > SIGNIFICANCE:  # lines show a wave across the frame, too
        of, how = "line_", ""
    axes = [name for name in ("column", "row") if f"{of}cycles_per_{name}" in line]
    where = ", ".join(f"{line[f'{of}cycles_per_{name}']:+.3g} cycles per {name}" for name in axes)
    where += f", new in each {'row' if axes == ['column'] else 'column'}" if of else ""
    p = look_elsewhere(min(p, in_lines), 2.0)
    return [check_of("wave", p, line[f"{of}size"], limit=limit, where=where, how=how)]


@dataclass(frozen=True)
class _Estimate:
    """A mean covariance of pairs of pixels, DN^2, with its error and degrees of freedom."""

    value: float
    error: float
    freedom: float

    def __sub__(self, other: _Estimate) -> _Estimate:
        """Return the difference of independent estimates."""
        return _Estimate(self.value - other.value, math.hypot(self.error, other.error), self.freedom)

    @property
    def z(self) -> float:
        """Normal quantile of the deviation from 0."""
        return float(_normal(np.array(self.value / self.error), self.freedom))


_NOTHING = _Estimate(0.0, math.inf, 1.0)


def _normal(z: FloatArray, freedom: float) -> FloatArray:
    """Return normal quantiles of standardised sums of squares of so many degrees of freedom."""
    return chi_square(freedom + z * math.sqrt(2.0 * freedom), freedom)


def _stack_checks(sums: StackSums, maps: PixelMaps) -> list[Check]:
    common = _Common(sums)
    frame = common.frame if math.isfinite(common.frame.error) else _Estimate(0.0, 0.0, 1.0)
    checks = [
        _noise_check(name, found, *lines)
        for name, found, *lines in (
            ("frame_noise", common.frame),
            ("row_noise", common.rows - frame, sums.rows),
            ("column_noise", common.columns - frame, sums.columns, sums.shape[1]),
        )
        if math.isfinite(found.error)
    ]
    checks += series_checks(_frame_means(sums))
    checks += [*_lag_check(common), *_neighbour_checks(common), *_wandering(sums, maps)]
    return _located(checks, sums)


def _located(checks: list[Check], sums: StackSums) -> list[Check]:
    """Return checks with the part of the sensor that they are about, and one of parts that drift apart."""
    cells = sensor_cells(sums)
    places = sensor_places(cells, SIGNIFICANCE)
    found = [_placed(check, places.get(KINDS[check.name].map), sums) for check in checks]
    for noise, neighbours in (("row_noise", "neighbours_x"), ("column_noise", "neighbours_y")):
        found = _attributed(found, noise, neighbours)
    if "spread" in cells:
        found.append(_local_drift(sums, places.get("spread")))
    return found


def _attributed(checks: list[Check], noise: str, neighbours: str) -> list[Check]:
    """Attribute the correlation of neighbours to the noise of their line where both have the same region."""
    first = next((check for check in checks if check.name == noise), None)
    if first is None or first.region is None or first.p > SIGNIFICANCE / len(checks):
        return checks
    return [
        replace(check, advice="explained by the noise common to their line")
        if check.name == neighbours and check.region == first.region
        else check
        for check in checks
    ]


def _placed(check: Check, place: Suspect | None, sums: StackSums) -> Check:
    """Return a check with its place, if it has one; noise of lines has the size that it has there."""
    if place is None:
        return check
    p, size = check.p, check.size
    if check.name in ("neighbours_x", "neighbours_y", "lag"):  # a part of the sensor alone may fail
        p = look_elsewhere(min(check.p, place.p), 2.0)
    if check.name in ("row_noise", "column_noise") and place.only_there:
        shared = sums.next_x if check.name == "row_noise" else sums.next_y
        inside = place.region.mask(sums.shape)
        excess = float(np.nanmean(shared[inside]) - np.nanmean(shared[~inside]))
        size = max(size, math.sqrt(max(excess, 0.0)))
    where = check.where or place.region.describe()
    return replace(check, p=p, size=size, where=where, region=place.region.numbers())


def _local_drift(sums: StackSums, place: Suspect | None) -> Check:
    """Return whether a part of the sensor moves along the run, and the rest does not."""
    if place is None:
        return check_of("local_drift", 1.0, 0.0)
    inside = place.region.mask(sums.shape) & (sums.variance > 0)
    common = sums.block_means(apart=True)[:, inside].mean(axis=1)
    chance = float(sums.variance[inside].mean()) / (float(sums.lengths.mean()) * inside.sum())
    size = math.sqrt(max(float(np.average(common**2, weights=sums.lengths)) - chance, 0.0))
    return _placed(check_of("local_drift", place.p, size), place, sums)


# -- what is common to lines and frames ----------------------------------------------------------


def _of_lines(lines: Lines) -> _Estimate:
    """Return the mean covariance of the pixels of a line, a few odd lines not counted in full."""
    some, z, centre, spread = _deviations(lines)
    if some.size < _FEWEST_LINES:
        return _NOTHING
    error = lines.covariance[1][some]
    value = np.clip(z, centre - BEYOND_DOUBT * spread, centre + BEYOND_DOUBT * spread) * error
    weight = error**-2
    total = float(weight.sum())
    effective = total**2 / float((weight**2).sum())
    return _Estimate(float(weight @ value) / total, total**-0.5, effective * lines.freedom)


def _deviations(lines: Lines) -> tuple[IntArray, FloatArray, float, float]:
    """Return the lines with a covariance, it in standard errors, and the middle and spread of these."""
    value, error = lines.covariance
    some = np.flatnonzero(np.isfinite(error) & (lines.n_pairs > 0))
    z = value[some] / error[some]
    centre = float(np.median(z)) if some.size else 0.0
    return some, z, centre, max(1.0, robust_sd(z, centre)) if some.size else 1.0


def _quiet(sums: StackSums) -> BoolArray:
    """Return the rows that count in the means of frames, (y,)."""
    variance = sums.rows.variance
    some = variance > 0
    return np.asarray(some & (variance <= _LOUD * np.median(variance[some]))) if some.any() else some


def _noise_check(name: str, found: _Estimate, lines: Lines | None = None, width: int = 0) -> Check:
    """Return the check of a covariance that pixels share, and of single lines that share more than others."""
    p, where = normal_p(found.z), ""
    if lines is not None:
        single, where = _single_lines(lines, name.removesuffix("_noise"), width)
        p = look_elsewhere(min(p, single), 2.0)
    size, limit = math.sqrt(max(found.value, 0.0)), math.sqrt(_SURE * found.error)
    return check_of(name, p, size, limit=limit, where=where)


def _single_lines(lines: Lines, line: str, width: int) -> tuple[float, str]:
    """Return the probability of the line that stands out most, and those that stand out in words."""
    some, z, centre, spread = _deviations(lines)
    if some.size < _FEWEST_LINES:
        return 1.0, ""
    normal = _normal((z - centre) / spread, lines.freedom)
    p = special.ndtr(-normal)
    out = some[p < 1e-3 / p.size]
    if width:
        out = np.unique(out % width)
    words = f"mainly in {line}{'s' * (out.size > 1)} {first_few(out, _SHOWN)}" if out.size else ""
    return look_elsewhere(float(p.min()), p.size), words


def _frame_means(sums: StackSums) -> FloatArray:
    """Return the mean of each frame over the quiet rows; where sums of blocks are missing, over all rows."""
    quiet = _quiet(sums)
    if sums.lengths.size != sums.n_blocks or not quiet.any():
        return sums.frame_mean if quiet.any() else np.zeros(0)
    return np.asarray(sums.row_sum[:, quiet].sum(axis=1) / sums.n_varying(quiet))


# -- successive samples and neighbours -----------------------------------------------------------


@dataclass(frozen=True)
class _Common:
    """Mean covariances of the pixels that share a line or a frame, DN^2."""

    sums: StackSums

    @cached_property
    def rows(self) -> _Estimate:
        """Of pixels of a row."""
        return _of_lines(self.sums.rows)

    @cached_property
    def columns(self) -> _Estimate:
        """Of pixels of a column, in a group of rows."""
        return _of_lines(self.sums.columns)

    @cached_property
    def frame(self) -> _Estimate:
        """Of pixels in different rows and columns."""
        sums, quiet = self.sums, _quiet(self.sums)
        m = int(quiet.sum())
        nx = sums.n_varying(quiet) / max(m, 1)
        if m < _FEWEST_LINES or nx < _FEWEST_LINES:
            return _NOTHING
        rows, variance = sums.rows.centred()[:, quiet], sums.rows.variance[quiet]
        total = rows.sum(axis=1)
        products = total**2 - np.einsum("ty,ty->t", rows, rows)
        scale = float(variance.sum())
        # a few frames with a track of a particle do not count in full
        typical = max(1.0, float(np.median(total**2)) / (0.455 * scale))
        products = np.minimum(products, BEYOND_DOUBT**2 * typical * scale)
        freedom = sums.freedom
        value = float(products.sum()) / freedom
        chance = math.sqrt(2.0 / freedom * (scale**2 - float((variance**2).sum())))
        pairs, along = nx * m * (m - 1), 2.0 * nx * (m - 1)
        down = sums.next_y[quiet]
        neighbours = along * float(np.mean(down[np.isfinite(down)])) if np.isfinite(down).any() else 0.0
        others = pairs * nx - pairs
        estimate = (value - neighbours - (pairs - along) * self.columns.value) / others
        error = chance / others
        if math.isfinite(self.columns.error):
            error = math.hypot(error, pairs / others * self.columns.error)
        return _Estimate(estimate, error, freedom)

    @cached_property
    def inflation(self) -> float:
        """By how much correlated pixels raise the variance of a mean over them."""
        (ny, nx), variance = self.sums.shape, self.sums.variance
        typical = median_of(variance, ~(variance > 0))
        frame, lines = self.frame.value, (self.rows, self.columns)
        row, column = (each.value - frame if math.isfinite(each.error) else 0.0 for each in lines)
        return 1.0 + (ny * nx * frame**2 + nx * row**2 + ny * column**2) / typical**2


def _resemblance(
    name: str, covariance: FloatArray, size: FloatArray, common: _Common, shared: tuple[float, float]
) -> list[Check]:
    """Return whether pairs of samples are correlated, beyond what they share with others (and its error).

    The covariance of each pair, NaN where there is none, is compared with that of equal samples, DN^2.
    """
    some = (size > 0) & np.isfinite(covariance)
    if not some.any():
        return []
    size, freedom = size[some], common.sums.freedom_of_all
    z = covariance[some]
    z /= size
    z *= math.sqrt(freedom)
    # a few tracks of particles or blinking pixels are no property of the sensor
    np.clip(z, -BEYOND_DOUBT, BEYOND_DOUBT, out=z)
    ratio = float(np.mean(np.minimum(1.0 / size, 4.0 / median_of(size))))
    mean = float(z.mean()) / math.sqrt(freedom) - shared[0] * ratio
    error = math.hypot(math.sqrt(common.inflation / freedom / z.size), shared[1] * ratio)
    # charge that other samples take, or give, moves the fitted gain
    how, limit = "high" if mean > 0 else "low", (_SURE + 0.2) * error
    return [check_of(name, normal_p(mean / error, two_sided=True), mean, limit=limit, how=how)]


def _lag_check(common: _Common) -> list[Check]:
    """Return whether samples of a pixel resemble those of the frame before, beyond what frames share."""
    sums, shared, error = common.sums, 0.0, 0.0
    if common.frame.z > 3.0:
        quiet = _quiet(sums)
        total = sums.rows.centred()[:, quiet].sum(axis=1)
        inside = np.ones(total.size, np.bool_)
        inside[sums.starts] = False
        at = np.flatnonzero(inside)
        # a centred series is anticorrelated with itself
        shared = float(total[at] @ total[at - 1]) + float(np.mean(total**2)) * sums.lengths.size
        shared = shared / sums.freedom - float(np.nansum(sums.lag[quiet]))
        shared /= float(sums.n_varying(quiet)) ** 2
        error = math.sqrt(2.0 / sums.freedom) * abs(common.frame.value)
    return _resemblance("lag", sums.lag, sums.variance, common, (shared, error))


def _neighbour_checks(common: _Common) -> list[Check]:
    """Return whether neighbours resemble each other, beyond what their line shares."""
    sums, v, found = common.sums, common.sums.variance, []
    for name, one, other, covariance, line in (
        ("neighbours_x", v[:, :-1], v[:, 1:], sums.next_x[:, :-1], common.rows),
        ("neighbours_y", v[:-1], v[1:], sums.next_y[:-1], common.columns),
    ):
        shared = (line.value, line.error) if math.isfinite(line.error) else (0.0, 0.0)
        found += _resemblance(name, covariance, np.sqrt(one * other), common, shared)
    return found


def _wandering(sums: StackSums, maps: PixelMaps) -> list[Check]:
    """Return whether pixels change their level along the run, less what all pixels do."""
    lengths = sums.lengths
    if lengths.size < MINIMUM_BLOCKS:
        return []
    some = sums.variance > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        charge = np.where(maps.usable, maps.quanta_exposure / maps.conversion_gain, 0.0)[some]
        # the third central moment of the samples, H / g^3
        third = np.where(maps.usable, maps.quanta_exposure / maps.conversion_gain**3, 0.0)[some]
    weight = 1.0 / sums.variance[some]
    values = sums.block_means(apart=False)[:, some]
    basis = np.stack([np.ones(charge.size), charge])
    inner = (basis * weight) @ basis.T
    shared = np.linalg.lstsq(inner, (basis * weight) @ values.T, rcond=None)[0]
    skewness = third * weight**1.5
    chi2 = np.zeros(charge.size)
    for n, mean, common in zip(lengths.tolist(), values, shared.T @ basis, strict=True):
        # block by block: each is as large as a map; the mean of few samples is as skewed as they are
        chi2 += without_skew((mean - common) * np.sqrt(n * weight), skewness / math.sqrt(n)) ** 2
    p = special.chdtrc(lengths.size - 1.0, chi2)
    out = np.flatnonzero(p < SIGNIFICANCE / p.size)
    places = np.argwhere(some)[out[np.argsort(-chi2[out])][:3]]
    shown = "; ".join(f"{y}, {x}" for y, x in places)
    more = f" and {out.size - len(places):,} more" if out.size > len(places) else ""
    where = f"y, x = {shown}{more}" if out.size else ""
    p_any, share = look_elsewhere(float(p.min()), p.size), out.size / p.size
    return [check_of("wandering_pixels", p_any, share, limit=2.0 / p.size, where=where)]
