"""Maximum likelihood of (H, g, mu, sigma) of pixels: one exposure or several, any law, density or cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, chdtri

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IndexArray, IntegerArray
from pchem_pipeline.base.units import FEW_STEP
from pchem_pipeline.model.arithmetic.significance import BEYOND_DOUBT
from pchem_pipeline.model.errors import information_numba
from pchem_pipeline.model.errors.expected_information import (
    biased_by_rounding,
    expected_scores,
    inverse_information,
    rounding_may_matter,
)
from pchem_pipeline.model.fit import engine, search_numba, tile_numba
from pchem_pipeline.model.fit.climb_numba import ALIASED_STEP, Limits
from pchem_pipeline.model.fit.guard import (
    Interval,
    electrons_of,
    expected_counts,
    far_samples,
    fit_guarded,
    inside,
    leave_out,
)
from pchem_pipeline.model.fit.profile import Moments, Profile
from pchem_pipeline.model.fit.result import FitResult, quantile_of
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.status import FAILED, FitStatus, with_rivals_named
from pchem_pipeline.model.fit.tile_numba import Answers, Histograms, Starts
from pchem_pipeline.model.law.inputs import kernel_counts, pack
from pchem_pipeline.model.law.pixel_numba import COUNTED, LEFT_OUT, SET_ASIDE
from pchem_pipeline.model.law.sample_law import SampleLaw

#: EM steps before the first Newton step, of several samples; the start of one is good enough without.
_WARM_UP = 2
# Frames and degrees of freedom below which it matters that merging bins for the chi-square test hides part of
# what the parameters know: it is half a degree of freedom or so.
_FEW_FRAMES, _FEW_GROUPS = 5000, 40
_FEWEST_CODES = 5
#: Nats below which a rival an electron away counts in the moments, and the distance that holds it, e-.
_RIVAL_GAP, _RIVAL_REACH = 10.0, 1.5
_LOST_SHARE = 2e-3  # of the samples, outside of the window, from which exposure and bias are not known
_LOOSE = 0.1  # relative standard error of the gain beyond which several samples do not determine it
#: Bits about the data, whatever the fit, and those for which a fit with the cells may still find an answer.
_OF_DATA = FitStatus.ADC_LIMIT | FitStatus.OUTSIDE_WINDOW
_NO_FIT = FitStatus.NO_DATA | FitStatus.TOO_FEW_BINS


def fit_histograms(
    counts: IntegerArray | Sequence[IntegerArray],
    origin: IntegerArray | Sequence[IntegerArray],
    under: IntegerArray | None = None,
    over: IntegerArray | None = None,
    *,
    dark: Sequence[bool] | None = None,
    law: SampleLaw | Sequence[SampleLaw] | None = None,
    settings: FitSettings | None = None,
    adc_limits: tuple[int, int] | None = None,
    start: FitResult | FloatArray | None = None,
    excluding: Sequence[Interval] = (),
) -> FitResult:
    """Estimate (H, g, mu, sigma) of every pixel from its histograms by maximum likelihood.

    The likelihood is that of the PCD at whole DN (Hendrickson et al. 2023, eq. X_density), or the product
    over the exposures of a pixel, which share g, mu and sigma (Hendrickson and Haefner 2024). A start from
    the empirical characteristic function, or from the line of variance against mean, is improved by damped
    Newton steps with Louis' observed information, where these do not help by EM steps, eqs. (update_eqns) to
    (gamma_nk), until the expected rise is below the tolerance. The neighbours (H -+ 1, mu +- 1/g) are tried
    unless a good fit rules them out, and a suspicious goodness of fit or read noise asks for more starts; the
    likeliest maximum is kept. No pixel raises: what cannot be fitted holds NaN and a reason. The answer for a
    pixel does not depend on the others in the batch.

    Under another ``law``, and with the exact likelihood, a second fit starts from that one: each code has the
    integral over its cell, so that rounding, code edges and clipping are exact.

    Samples that the model does not expect at all are left out (setting ``tail_guard``).

    Args:
        counts: histograms, shape (n, B), any unsigned type; or one array (n, B_j) for each exposure.
        origin: DN of bin 0, shape (n,); or one array for each exposure.
        under: frames below bin 0, of all samples, shape (n,); such pixels are flagged.
        over: frames above the last bin, shape (n,).
        dark: which samples hold no electrons (H = 0 exactly); none by default.
        law: law of the samples, or one for each exposure; the PCD if None.
        settings: how to fit; the defaults if None.
        adc_limits: first and last code of the ADC, DN, unless samples lie beyond; pixels that reach them are
            flagged, and the exact likelihood counts what lies beyond there.
        start: a fit of the same histograms with the PCD; or (H_1 ... H_J, g, mu, sigma) near the answer,
            shape (n, J + 3), NaN where unknown. Where the maximum next to such parameters fits well, its
            neighbours are not tried: the likelihood gap is that to one Gaussian.
        excluding: intervals of e- on the comb of the fit with the PCD. The likelihood is conditional on the
            codes outside them (a truncated sample, Fisher 1931).

    Raises:
        ValueError: if there is no sample, their shapes disagree, or none holds electrons.
    """
    settings = settings or FitSettings()
    several = not isinstance(counts, np.ndarray)
    samples = [counts] if isinstance(counts, np.ndarray) else list(counts)
    origins = [origin] if isinstance(origin, np.ndarray) else list(origin)
    dark = [False] * len(samples) if dark is None else list(dark)
    _check(samples, origins, dark)
    batch = _Batch(samples, origins, dark, settings, adc_limits, under, over)
    laws = None if law is None else batch.between_limits(law)
    if not (laws is None or start is None or isinstance(start, FitResult)):
        found = batch.fit_cells(laws, start, warm=True)
        batch.by_cells[:] = True
    else:
        if isinstance(start, FitResult):
            plain = _shaped(start, -1)
            batch.leave_out_again(plain.columns, plain.outlier_share, None, np.zeros((batch.n, 2)))
        else:
            plain = batch.fit_density(start)
        batch.set_aside(plain, excluding)
        found = batch.refine(plain, laws)
    if settings.intervals == "profile":
        found = replace(found, intervals=batch.intervals(found, laws))
    return found if several else _shaped(found)


def likelihood_moments(
    counts: IntegerArray,
    origin: IntegerArray,
    known: FloatArray,
    outlier_share: FloatArray,
    *,
    law: SampleLaw | None = None,
    satellites: FloatArray | None = None,
    settings: FitSettings | None = None,
    adc_limits: tuple[int, int] | None = None,
) -> Moments:
    """Return mean square deviations of (H, g, mu, sigma) from their estimates, of pixels that are fitted.

    With high read noise, or few frames, the likelihood is no normal law, and may have a second maximum an
    electron away. So the moments are taken over the likelihood itself, as over a posterior: along the bias
    over its profile, and across it by Laplace's approximation (Tierney and Kadane 1986) under Jeffreys'
    prior, whose volume cancels that of the approximation. They are about the estimate, not the mean.

    Args:
        counts: histograms, shape (n, B).
        origin: DN of bin 0, shape (n,).
        known: (H, g, mu, sigma, likelihood gap) of the fit of these histograms, shape (n, 5).
        outlier_share: share of the samples that the tail guard left out, shape (n,).
        law: of the samples; the PCD if None.
        satellites: amplitude (e-) and weight of free satellites, shape (n, 2); none if None.
        settings: of that fit.
        adc_limits: first and last code of the ADC, DN.
    """
    settings = settings or FitSettings()
    cells = np.full(len(known), law is not None or settings.likelihood == "exact")
    if law is None and settings.likelihood == "auto":
        frames = counts.sum(axis=1, dtype=np.int64) * (1.0 - outlier_share)
        cells = biased_by_rounding([*known[:, :4].T], frames)
    free = np.zeros((len(known), 2)) if satellites is None else np.nan_to_num(satellites)
    n = len(known)
    found = Moments(np.full((n, 4, 4), np.nan), np.zeros((n, 2)), np.full((n, 2, 4), np.nan))
    for pixels in (np.flatnonzero(~cells), np.flatnonzero(cells)):
        if pixels.size:
            batch = _Batch([counts[pixels]], [origin[pixels]], [False], settings, adc_limits, None, None)
            given = SampleLaw() if law is None else law.of(pixels)
            own = batch.between_limits(given) if cells[pixels[0]] else None
            part = batch.moments(known[pixels], outlier_share[pixels], own, free[pixels])
            for whole, values in zip(found, part, strict=True):
                whole[pixels] = values
    return found


def satellite_threshold(law: SampleLaw) -> float:
    """Return the rise of the log-likelihood, nats, that free satellite peaks must bring to be kept.

    At a weight of 0, the border of what is allowed, twice the rise is 0 or, half of the time, chi-square
    with one degree of freedom. The largest of the rises at all amplitudes counts (Davies 1987); by
    Bonferroni's bound a pixel without satellites is given some with about the probability
    ``free_satellite_alarm``.
    """
    trials = max(len(law.free_satellites), 1)
    return 0.5 * float(chdtri(1.0, min(1.0, 2.0 * law.free_satellite_alarm / trials)))


def _check(samples: Sequence[IntegerArray], origins: Sequence[IntegerArray], dark: Sequence[bool]) -> None:
    if not samples or all(dark):
        raise ValueError("no sample has electrons")
    if len(samples) != len(origins) or len(samples) != len(dark):
        raise ValueError("counts, origins and dark must have one entry per sample")
    sizes = {sample.shape[0] for sample in samples} | {np.size(origin) for origin in origins}
    if len(sizes) != 1:
        raise ValueError(f"the samples have different numbers of pixels: {sorted(sizes)}")


def _shaped(result: FitResult, *columns: int) -> FitResult:
    """Return a result with the arrays of samples of shape (n, *columns)."""
    shape, names = (result.bias.size, *columns), ("quanta_exposure", "mean", "variance")
    return replace(result, **{name: getattr(result, name).reshape(shape) for name in names})


class _Batch:
    """The histograms of n pixels at J exposures, and how they are fitted."""

    def __init__(
        self,
        samples: Sequence[IntegerArray],
        origins: Sequence[IntegerArray],
        dark: Sequence[bool],
        settings: FitSettings,
        adc_limits: tuple[int, int] | None,
        under: IntegerArray | None,
        over: IntegerArray | None,
    ) -> None:
        together = np.concatenate(samples, axis=1) if len(samples) > 1 else samples[0]
        counts = kernel_counts(together)
        outside = sum(np.ravel(each).astype(np.int64) for each in (under, over) if each is not None)
        if (lost := outside > counts.sum(axis=1)).any():  # what little is inside is no law of the pixel
            counts = np.where(lost[:, None], counts.dtype.type(0), counts)
        self.given = Histograms(
            counts,
            np.concatenate([[0], np.cumsum([sample.shape[1] for sample in samples])]).astype(np.int64),
            np.ascontiguousarray(np.stack([np.ravel(each) for each in origins], axis=1), np.int64),
            np.array(dark, np.bool_),
            np.zeros(counts.shape, np.uint8),
        )
        self.n, self.n_samples = counts.shape[0], len(samples)
        self.settings, self.adc_limits = settings, adc_limits
        self.outside, self.by_cells = np.zeros(self.n, np.bool_) | (outside > 0), np.zeros(self.n, np.bool_)
        self.truncated = np.zeros(self.n, np.bool_) | (outside > _LOST_SHARE * counts.sum(axis=1))

    # -- the two fits

    def fit_density(self, near: FloatArray | None) -> FitResult:
        """Fit with the density; near: parameters, and perhaps the gap of that fit in a further column."""
        size = self.n_samples + 3
        gaps = np.full(self.n, np.inf)
        if near is not None and near.shape[1] > size:
            gaps = np.where(np.isnan(near[:, size]), np.inf, near[:, size])
        known = np.empty((0, size)) if near is None else np.ascontiguousarray(near[:, :size], np.float64)
        starts = Starts(known, gaps, np.empty(0), np.ones(1, np.bool_))
        laws = [SampleLaw()] * self.n_samples
        return self._result(self._fit(self.given, laws, starts, self.limits(None)), cells=False, adjust=True)

    def leave_out_again(
        self,
        columns: FloatArray,
        outlier_share: FloatArray,
        laws: Sequence[SampleLaw] | None,
        satellites: FloatArray,
    ) -> None:
        """Leave out the samples that a fit under these laws (None: with the density) left out."""
        pixels = np.flatnonzero(outlier_share > 0)
        if self.settings.tail_guard > 0 and pixels.size:
            gone = outlier_share[pixels] * self.given.counts[pixels].sum(axis=1, dtype=np.float64)
            expected = expected_counts(self.given, pixels, laws, columns[pixels], satellites[pixels], gone)
            leave_out(self.given, pixels, expected < self.settings.tail_guard)

    def set_aside(self, plain: FitResult, intervals: Sequence[Interval]) -> None:
        """Set codes aside, but for pixels of which too few would be left."""
        if not intervals:
            return
        mask, fewest = self.given.mask.copy(), np.full(self.n, _FEWEST_CODES)
        for j in range(self.n_samples):
            part = slice(self.given.places[j], self.given.places[j + 1])
            width = part.stop - part.start
            place = electrons_of(self.given.origin[:, j], width, plain.conversion_gain, plain.bias)
            mask[:, part][inside(intervals, place)] = SET_ASIDE
            used = ((self.given.counts[:, part] > 0) & (mask[:, part] == COUNTED)).sum(axis=1)
            fewest = np.minimum(fewest, used) if not self.given.dark[j] else fewest
        enough = (fewest >= _FEWEST_CODES) & ((plain.fit_status & int(FAILED)) == 0)
        self.given.mask[enough] = mask[enough]

    def refine(self, plain: FitResult, laws: Sequence[SampleLaw] | None) -> FitResult:
        """Fit again with the cells what the law or the settings ask for, from a fit with the density."""
        words, possible = plain.fit_status, (plain.fit_status & int(_NO_FIT)) == 0
        scan = laws is None and not (self.given.mask == SET_ASIDE).any()
        chosen = laws or self.between_limits(SampleLaw())
        if not scan:
            wanted = ((words & int(FAILED)) == 0) | (self._at_limits(chosen) & possible)
        elif self.settings.likelihood == "auto":
            wanted = self._coarse(plain) | (self._at_limits(chosen) & possible)
        else:
            wanted = possible & (self.settings.likelihood == "exact")
        pixels = np.flatnonzero(wanted)
        if pixels.size == 0:
            return plain
        self.by_cells[pixels] = True
        part = self.fit_cells(chosen, plain.columns, gaps=plain.likelihood_gap, pixels=pixels, scan=scan)
        part = replace(
            part,
            fit_status=part.fit_status | (words[pixels] & np.uint16(int(_OF_DATA))),
            n_iterations=part.n_iterations + plain.n_iterations[pixels],
        )
        return plain.with_pixels(pixels, part)

    def fit_cells(
        self,
        laws: Sequence[SampleLaw],
        near: FloatArray,
        *,
        gaps: FloatArray | None = None,
        pixels: IndexArray | None = None,
        warm: bool = False,
        scan: bool = False,
    ) -> FitResult:
        """Fit with the cells from parameters that are near; ``warm``: of a fit with nearly these laws."""
        some = np.arange(self.n) if pixels is None else pixels
        given, own = self._given_of(some), [each.of(some) for each in laws]
        gap = np.full(some.size, np.inf) if gaps is None else gaps[some]
        for each in own:  # the plain fit of an exposure that is not one may be an electron off
            mixed = ((each.added_weights > 0.0) & (each.added_exposure > 0.0)).any(axis=1)
            gap = np.where(mixed, np.minimum(gap, 0.999 * search_numba.CLEAR_GAP), gap)
        starts = Starts(
            np.ascontiguousarray(near[some], np.float64),
            np.ascontiguousarray(gap, np.float64),
            np.array(own[0].free_satellites, np.float64),
            np.ascontiguousarray(own[0].may_have_satellites),
        )
        limits = self.limits(own, warm=warm, scan=scan)
        adjust = all(each.neutral for each in own)
        if not adjust:  # another law may expect samples that the PCD did not: satellite peaks, tails
            connected = np.flatnonzero(~far_samples(given)[1])
            leave_out(given, connected, np.zeros((connected.size, given.counts.shape[1]), np.bool_))
        answers = self._fit(given, own, starts, limits)
        self.given.mask[some] = given.mask
        return self._result(answers, cells=True, adjust=adjust, pixels=some)

    def _given_of(self, some: IndexArray) -> Histograms:
        """Return copies of the histograms of some pixels."""
        counts, places, origin, dark, mask = self.given
        return Histograms(counts[some], places, origin[some], dark, mask[some])

    def _fit(self, given: Histograms, laws: Sequence[SampleLaw], starts: Starts, limits: Limits) -> Answers:
        n, size, cells = given.counts.shape[0], self.n_samples + 3, limits.cells
        answers = Answers(
            np.full((n, size), np.nan),
            np.full((n, size, size), np.nan),
            np.full((n, self.n_samples, 2), np.nan),
            np.zeros(n, search_numba.RESULT),
        )
        packed = pack(laws, n)
        plain = self.n_samples == 1 and not limits.sandwich
        fit_tile = tile_numba.fit_plain_tile if plain else tile_numba.fit_tile
        search = engine.cells_search(starts.amplitudes.size > 0) if cells else engine.density_search()
        tools = engine.likelihood(cells), engine.climb(), search, engine.regression_basis()

        def fit(pixels: IndexArray, quick: bool) -> None:
            answers.parameters[pixels] = np.nan
            answers.covariance[pixels] = np.nan
            # a few at a time: a signal is heard between kernels only
            for some in np.array_split(pixels, pixels.size // 1024 + 1):
                fit_tile(given, some, packed, starts, limits._replace(quick=quick), *tools, answers)

        def expect(pixels: IndexArray, gone: FloatArray) -> FloatArray:
            satellites = np.stack([answers.found[name][pixels] for name in ("amplitude", "weight")], axis=1)
            own = laws if cells else None
            return expected_counts(given, pixels, own, answers.parameters[pixels], satellites, gone)

        fit_guarded(fit, expect, given, limits, answers)
        return answers

    def moments(
        self,
        known: FloatArray,
        outlier_share: FloatArray,
        laws: Sequence[SampleLaw] | None,
        satellites: FloatArray,
    ) -> Moments:
        """Return moments over the likelihood of the cells under these laws, or of the density."""
        columns = np.ascontiguousarray(known[:, :4])
        self.leave_out_again(columns, outlier_share, laws, satellites)
        law, limits = pack(laws or [SampleLaw()], self.n), self.limits(laws)
        reach = np.where(known[:, 4] < _RIVAL_GAP, _RIVAL_REACH, 0.0)
        return Profile(self.given, law, limits, columns, satellites).moments(columns, reach)

    # -- what they are told

    def limits(self, laws: Sequence[SampleLaw] | None, *, warm: bool = False, scan: bool = False) -> Limits:
        settings = self.settings
        em = settings.algorithm == "em" and laws is None
        return Limits(
            bound=float(np.log(settings.minimum_quanta_exposure)),
            tolerance=settings.tolerance,
            most=settings.em_max_iterations if em else settings.max_iterations,
            warm_up=0 if self.n_samples == 1 else _WARM_UP,
            only_em=em,
            cells=laws is not None,
            gap=settings.gap_threshold,
            noise=settings.read_noise_limit,
            floor=settings.tail_guard,
            most_outliers=settings.tail_guard_share,
            satellite_rise=0.0 if laws is None else satellite_threshold(laws[0]),
            reshapes=laws is not None and any(_reshapes(each) for each in laws),
            warm=warm,
            scan=scan,
            quick=False,
            sandwich=settings.errors == "sandwich",
        )

    def between_limits(self, law: SampleLaw | Sequence[SampleLaw]) -> list[SampleLaw]:
        """Return laws without limits between those of the ADC, but in pixels with samples beyond them."""
        low: FloatArray | int | None
        high: FloatArray | int | None
        low, high = self.adc_limits or (None, None)
        if self.adc_limits is not None and (none := self._reaches_adc(beyond=1)).any():
            low, high = (np.where(none, np.nan, limit) for limit in self.adc_limits)
        laws = [law] * self.n_samples if isinstance(law, SampleLaw) else law
        return [each.between(low, high) for each in laws]

    @cached_property
    def _extremes(self) -> tuple[FloatArray, FloatArray]:
        """Smallest and largest code of each sample, those left out included, (n, J); NaN without any."""
        found = np.full((2, self.n, self.n_samples), np.nan)
        for j in np.flatnonzero(np.diff(self.given.places)):
            seen = self.given.counts[:, self.given.places[j] : self.given.places[j + 1]] > 0
            ends = np.stack([seen.argmax(axis=1), seen.shape[1] - 1 - seen[:, ::-1].argmax(axis=1)])
            found[:, :, j] = np.where(seen.any(axis=1), self.given.origin[:, j] + ends, np.nan)
        return found[0], found[1]

    def _at_limits(self, laws: Sequence[SampleLaw]) -> BoolArray:
        """Return in which pixels codes pile up at a limit of the law."""
        (low, high), found = self._extremes, np.zeros(self.n, np.bool_)
        for j, each in enumerate(laws):
            # of some pixels there may be no limit: NaN is below and above nothing
            found |= low[:, j] <= (np.nan if each.clip_low is None else each.clip_low)
            found |= high[:, j] >= (np.nan if each.clip_high is None else each.clip_high)
        return found

    def _coarse(self, plain: FitResult) -> BoolArray:
        """Return in which pixels rounding biases the density's estimates, of any sample, or may deny them."""
        columns, words = plain.columns, plain.fit_status
        found = (words & int(FitStatus.COARSE_STEPS | FitStatus.NOT_CONVERGED)) != 0
        found |= self._aliased(plain)
        denied = (words & int(FAILED & ~_NO_FIT)) != 0
        variance = plain.variance.reshape(self.n, -1)
        fewer = np.flatnonzero(plain.outlier_share > 0)
        for j in np.flatnonzero(~self.given.dark):
            part = slice(self.given.places[j], self.given.places[j + 1])
            frames = self.given.counts[:, part].sum(axis=1, dtype=np.int64)
            gone = self.given.mask[fewer, part] == LEFT_OUT
            frames[fewer] -= np.where(gone, self.given.counts[fewer, part], 0).sum(axis=1, dtype=np.int64)
            found |= biased_by_rounding([columns[:, j], *columns[:, self.n_samples :].T], frames)
            found |= denied & rounding_may_matter(variance[:, j], frames)
        return np.asarray(found)

    def _aliased(self, plain: FitResult) -> BoolArray:
        """Return in which pixels the comb of frequency ``1 - g`` may be the right one.

        With the same variance V its skewness is at most ``1 / (sqrt(V) (1 - g))``: it is ruled out where that
        of the fit, ``H / (g^3 V^1.5)``, is five standard errors higher, ``sqrt(6 / N)`` each and more.
        """
        if self.n_samples > 1:
            return np.zeros(self.n, np.bool_)
        gain, deviation = plain.conversion_gain, np.sqrt(plain.variance.reshape(self.n))
        with np.errstate(invalid="ignore", divide="ignore"):
            skewness = plain.quanta_exposure.reshape(self.n) / (gain * deviation) ** 3
            error = np.sqrt(6.0 / self.given.counts.sum(axis=1, dtype=np.int64)) * (1.0 + 3.0 * skewness)
            aliased = skewness < 1.0 / (deviation * (1.0 - gain)) + BEYOND_DOUBT * error
            aliased |= (plain.fit_status & int(FitStatus.POOR_FIT)) != 0
            return np.asarray((gain > 1.0 / FEW_STEP) | ((gain > 1.0 / ALIASED_STEP) & aliased))

    # -- what they found

    def _result(
        self, answers: Answers, *, cells: bool, adjust: bool, pixels: IndexArray | None = None
    ) -> FitResult:
        """Add to the status words what the loop over the pixels does not know, and blank what failed."""
        some = np.arange(self.n) if pixels is None else pixels
        parameters, covariance, moments, out = answers
        n = self.n_samples
        frames, left = out["frames"].astype(np.float64), np.nan_to_num(out["outlying"])
        chi2, dof = out["chi2"].copy(), out["freedom"].astype(np.float64)
        if n == 1 and adjust:
            dof = self._freedom(out, parameters, covariance)
        probability = np.asarray(chdtrc(np.where(dof > 0, dof, np.nan), chi2))
        status = out["status"].copy()
        status[probability < self.settings.goodness_limit] |= FitStatus.POOR_FIT
        status[self.outside[some]] |= FitStatus.OUTSIDE_WINDOW
        status[self.truncated[some]] |= FitStatus.BIAS_AMBIGUOUS
        if n > 1:
            with np.errstate(invalid="ignore"):
                loose = np.sqrt(covariance[:, n, n]) > _LOOSE * parameters[:, n]
            status[loose] |= FitStatus.NOT_INFORMATIVE
        if self.adc_limits is not None:
            status[self._reaches_adc()[some]] |= FitStatus.ADC_LIMIT
        status = with_rivals_named(status, dark=bool(np.any(self.given.dark)), several=n > 1)
        failed = (status & int(FAILED)) != 0
        parameters[failed] = np.nan
        covariance[failed] = np.nan
        weight = np.where(failed, np.nan, np.nan_to_num(out["weight"]))
        return FitResult(
            quanta_exposure=np.ascontiguousarray(parameters[:, :n]),
            conversion_gain=np.ascontiguousarray(parameters[:, n]),
            bias=np.ascontiguousarray(parameters[:, n + 1]),
            read_noise_dn=np.ascontiguousarray(parameters[:, n + 2]),
            covariance=covariance,
            mean=np.ascontiguousarray(moments[:, :, 0]),
            variance=np.ascontiguousarray(moments[:, :, 1]),
            log_likelihood=out["log_likelihood"].copy(),
            likelihood_gap=out["gap"].copy(),
            fit_status=status.astype(np.uint16),
            n_iterations=out["evaluations"].astype(np.int32),
            goodness_chi2=chi2,
            goodness_dof=dof,
            goodness_p=probability,
            outlier_share=left / np.maximum(frames + left, 1.0),
            satellite_amplitude_e=np.where(weight > 0, out["amplitude"], np.nan),
            satellite_weight=weight,
        )

    def _freedom(self, out: NDArray[np.void], parameters: FloatArray, covariance: FloatArray) -> FloatArray:
        """Return the degrees of freedom of chi-square, those that merged bins leave to it included.

        It loses as many of the four parameters as its groups determine (Chernoff and Lehmann 1954).
        """
        freedom, frames = out["freedom"].astype(np.float64), out["frames"].astype(np.float64)
        few = np.flatnonzero((freedom > 0) & (freedom < _FEW_GROUPS) & (frames < _FEW_FRAMES))
        if few.size:
            own = covariance[few]
            if self.settings.errors == "sandwich":
                _, information = expected_scores(list(parameters[few].T))
                own = inverse_information(frames[few, None, None] * information)
            known = np.empty(few.size)
            ends = out["lowest_dn"][few], out["highest_dn"][few]
            information_numba.grouped_trace(*ends, frames[few], parameters[few], own, known)
            freedom[few] += 4.0 - np.clip(np.nan_to_num(known, nan=4.0), 0.0, 4.0)
        return freedom

    def _reaches_adc(self, beyond: int = 0) -> BoolArray:
        """Return which pixels have samples at the limits of the ADC or ``beyond``, left out or not."""
        assert self.adc_limits is not None
        low, high = self._extremes
        first, last = self.adc_limits[0] - beyond, self.adc_limits[1] + beyond
        return np.asarray(((low <= first) | (high >= last)).any(axis=1))

    def intervals(self, found: FitResult, laws: Sequence[SampleLaw] | None) -> FloatArray:
        """Return the ends of profile-likelihood intervals, (n, J + 4, 2); NaN where there are none.

        At an end the profile likelihood has fallen by ``z^2 / 2`` nats (Venzon and Moolgavkar 1988). Pixels
        whose cells were integrated have the profile of that likelihood.
        """
        ends = np.full((self.n, self.n_samples + 4, 2), np.nan)
        fitted = np.isfinite(found.bias)
        for cells in (False, True):
            some = np.flatnonzero(fitted & (self.by_cells == cells))
            if some.size == 0:
                continue
            chosen = (laws or self.between_limits(SampleLaw())) if cells else [SampleLaw()] * self.n_samples
            satellites = np.stack([found.satellite_amplitude_e[some], found.satellite_weight[some]], axis=1)
            law = pack([each.of(some) for each in chosen], some.size)
            limits = self.limits(chosen if cells else None)
            near = Profile(self._given_of(some), law, limits, found.columns[some], np.nan_to_num(satellites))
            ends[some] = near.ends(quantile_of(self.settings.interval_level))
        return ends


def _reshapes(law: SampleLaw) -> bool:
    """Return whether a law changes more than the width of peaks: plain fits may be an electron off."""
    one_peak = law.satellite_weights.shape[1] == 1
    one_law = bool(np.all(np.asarray(law.law) == "poisson")) and law.exposure_weights.shape[-1] == 1
    return not (one_peak and one_law and not np.any(law.curvature) and not np.any(law.variance_per_electron2))
