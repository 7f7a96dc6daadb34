"""Maximum likelihood of (H, g, mu, sigma) under a grown model, cells integrated exactly.

Where effects change the law of a pixel's samples
(:class:`~pchem_pipeline.model.law.sample_law.MarginalModel`), the plain estimates of PCH-EM are biased. Here
the likelihood of the grown law is climbed from them by damped Newton steps with analytic derivatives. The
mass of every code is an integral over its cell, not a density at its middle: rounding, code edges and
clipping are exact, and the likelihood is bounded at any read noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtrc, chdtri

from pchem_pipeline.model.fit import grown_numba, grown_scan_numba, grown_tile_numba
from pchem_pipeline.model.fit.pchem import FitResult
from pchem_pipeline.model.fit.settings import FitSettings
from pchem_pipeline.model.fit.start import kernel_counts, starting_points
from pchem_pipeline.model.fit.status import FAILED, FitStatus
from pchem_pipeline.model.law.grown_cells_numba import EXACT, NEAR
from pchem_pipeline.model.law.grown_inputs import HasParameters, Parameters, columns_of, lobes_of, pack
from pchem_pipeline.model.law.sample_law import MarginalModel

__all__ = [
    "GrownFit",
    "HasParameters",
    "fit_grown",
    "lobe_threshold",
    "log_likelihood",
    "marginal_mass",
    "marginal_slopes",
]

FloatArray = NDArray[np.float64]

#: Bits about the data, whatever the fit.
_OF_DATA = FitStatus.ADC_LIMIT | FitStatus.OUTSIDE_WINDOW
_POOR = 1e-3  # probability of a larger chi-square below which a pixel at a limit is started anew
_CLEAR_GAP = 30.0  # nats: a neighbour this far below is not tried again


@dataclass(frozen=True)
class GrownFit(FitResult):
    """Estimates of a batch of ``n`` pixels under a grown model.

    As :class:`~pchem_pipeline.model.fit.pchem.FitResult`, but the read noise is that of the pixel alone,
    without the variance and the lobes of the named effects; ``log_likelihood`` is that of the exact masses,
    and ``likelihood_gap`` is renewed only where the plain one was below 30 nats.

    Attributes:
        lobe_amplitude_e: amplitude of the free lobes found in the pixel, e-, shape (n,); NaN without any.
        lobe_weight: weight q of these lobes, shape (n,); 0 without any.
    """

    lobe_amplitude_e: NDArray[np.float64]
    lobe_weight: NDArray[np.float64]


def fit_grown(
    counts: NDArray[np.integer],
    origin: NDArray[np.integer],
    start: Parameters,
    model: MarginalModel,
    settings: FitSettings | None = None,
    *,
    plain: FitResult | None = None,
    warm: bool = False,
) -> GrownFit:
    """Estimate (H, g, mu, sigma) of every pixel under a grown model by maximum likelihood.

    Damped Newton steps on the exact masses of the codes from ``start``; the neighbours (H -+ 1, mu +- 1/g)
    are tried where the plain fit does not exclude them, or where its law was too different to do so. Pixels
    that the limits of the codes led astray are started anew. Where the model has free lobes, each amplitude
    is tried in each pixel with a weight of its own, see
    :func:`lobe_threshold`. No pixel raises: what cannot be fitted holds NaN and a reason. The answer for a
    pixel does not depend on the others in the batch.

    Args:
        counts: histograms, shape (n, B), any unsigned type.
        origin: DN of bin 0, shape (n,).
        start: (H, g, mu, sigma) of the pixels, each (n,): usually the plain estimates; NaN: not fitted.
        model: the law.
        settings: how to fit; the defaults if None.
        plain: plain fit of the same pixels, from which status bits and gaps are carried over; by default the
            neighbours of every pixel are tried, unless ``warm``.
        warm: ``start`` comes from a fit with (nearly) this model, not from a plain one.

    Returns:
        Estimates, covariances (inverse of the observed information) and a status word per pixel.
    """
    settings = settings or FitSettings()
    counts = kernel_counts(counts)
    first = np.ascontiguousarray(origin, np.int64)
    beside = not warm and (plain is None or _reshapes(model))
    found = _climb(counts, first, columns_of(start), model, settings, plain, warm=warm, beside=beside)
    if not warm:
        found = _with_limits(found, counts, first, model, settings)
    parameters, covariance, out, words, carried = found
    chi2, dof = out[:, grown_numba.CHI2], words[:, grown_numba.FREEDOM]
    probability = np.asarray(chdtrc(np.where(dof > 0, dof, np.nan), chi2))
    status = _status(parameters, out, words, probability, settings, carried)
    if plain is not None:
        status |= plain.fit_status & int(_OF_DATA)
    failed = (status & int(FAILED)) != 0
    parameters[failed] = np.nan
    covariance[failed] = np.nan
    exposure, gain, bias, sigma = np.ascontiguousarray(parameters.T)
    weight = np.where(failed, np.nan, out[:, grown_numba.LOBE_WEIGHT])
    return GrownFit(
        quanta_exposure=exposure,
        conversion_gain=gain,
        bias=bias,
        read_noise_dn=sigma,
        covariance=covariance,
        log_likelihood=out[:, grown_numba.LOG_LIKELIHOOD].copy(),
        likelihood_gap=out[:, grown_numba.GAP].copy(),
        fit_status=status.astype(np.uint16),
        n_iterations=words[:, grown_numba.EVALUATIONS].astype(np.int32),
        goodness_chi2=chi2.copy(),
        goodness_dof=dof.astype(np.float64),
        goodness_p=probability,
        outlier_share=np.zeros(chi2.size),
        lobe_amplitude_e=np.where(weight > 0, out[:, grown_numba.AMPLITUDE], np.nan),
        lobe_weight=weight,
    )


def lobe_threshold(model: MarginalModel) -> float:
    """Return the rise of the log-likelihood, nats, that free lobes must bring to be kept.

    At a weight of 0, the border of what is allowed, twice the rise is 0 or, half of the time, chi-square
    with one degree of freedom. The amplitude means nothing there, so the largest of the rises at all
    amplitudes counts (Davies 1987); by Bonferroni's bound over them a pixel without lobes is given some with
    about the probability ``free_lobe_alarm``: neighbouring amplitudes rise together, which lowers it, and the
    best one is refined, which raises it.
    """
    trials = max(len(model.free_lobes), 1)
    return 0.5 * float(chdtri(1.0, min(1.0, 2.0 * model.free_lobe_alarm / trials)))


def log_likelihood(
    counts: NDArray[np.integer],
    origin: NDArray[np.integer],
    parameters: Parameters,
    model: MarginalModel,
    *,
    lobes: tuple[ArrayLike, ArrayLike] | None = None,
) -> FloatArray:
    """Return ``sum_i c_i log P(x_i)`` of every pixel, nats, shape (n,); NaN without parameters.

    Comparable between models, the neutral one included, and between frames that were and were not fitted.

    Args:
        counts: histograms, shape (n, B), any unsigned type.
        origin: DN of bin 0, shape (n,).
        parameters: (H, g, mu, sigma) of the pixels, each (n,).
        model: the law.
        lobes: ``lobe_amplitude_e`` and ``lobe_weight`` of the pixels; by default those of ``parameters``
            where it is a :class:`GrownFit`, else none.
    """
    counts = kernel_counts(counts)
    out = np.full(counts.shape[0], np.nan)
    grown_tile_numba.score_tile(
        counts,
        np.ascontiguousarray(origin, np.int64),
        columns_of(parameters),
        lobes_of(parameters, lobes, out.size),
        pack(model, out.size),
        out,
    )
    return out


def marginal_mass(
    model: MarginalModel,
    maps: Parameters,
    codes: ArrayLike,
    *,
    lobes: tuple[ArrayLike, ArrayLike] | None = None,
    far_tails: bool = True,
) -> FloatArray:
    """Return the probability of each code in each pixel, exact to the ends of the tails.

    Args:
        model: the law.
        maps: (H, g, mu, sigma) of n pixels (flattened where they are maps).
        codes: successive whole DN, shape (n_codes,) for all pixels alike or (n, n_codes).
        lobes: as in :func:`log_likelihood`.
        far_tails: also what is below 1e-50, which takes several times as long.

    Returns:
        P(x), shape (n, n_codes); NaN where a parameter is.

    Raises:
        ValueError: if the codes do not increase by 1.
    """
    wanted = np.atleast_2d(np.asarray(codes, np.int64))
    if (np.diff(wanted, axis=1) != 1).any():
        raise ValueError("codes must increase by 1")
    columns = columns_of(maps)
    n = columns.shape[0]
    out = np.full((n, wanted.shape[1]), np.nan)
    if out.size:
        first = np.array(np.broadcast_to(wanted[:, 0], (n,)))
        stage = EXACT if far_tails else NEAR
        grown_tile_numba.mass_tile(first, columns, lobes_of(maps, lobes, n), pack(model, n), stage, out)
    return out


def marginal_slopes(
    model: MarginalModel, maps: Parameters, first: NDArray[np.integer], n_codes: int
) -> tuple[FloatArray, FloatArray]:
    """Return the probability of successive codes down to 1e-50, and its slopes.

    Args:
        model: the law.
        maps: (H, g, mu, sigma) of n pixels.
        first: first code of each pixel, DN, shape (n,).
        n_codes: number of codes.

    Returns:
        P(x), shape (n, n_codes), and its derivatives in log H, 1/g, mu and log sigma_R^2, (n, 4, n_codes).
    """
    columns = columns_of(maps)
    n = columns.shape[0]
    mass, slopes = np.full((n, n_codes), np.nan), np.full((n, 4, n_codes), np.nan)
    start = np.ascontiguousarray(first, np.int64)
    grown_tile_numba.slope_tile(start, columns, lobes_of(maps, None, n), pack(model, n), NEAR, mass, slopes)
    return mass, slopes


class _Found(NamedTuple):
    """What the loops fill, and the status words that their start came with."""

    parameters: FloatArray
    covariance: FloatArray
    out: FloatArray
    words: NDArray[np.int64]
    carried: NDArray[np.int64]


def _climb(
    counts: NDArray[np.integer],
    origin: NDArray[np.int64],
    start: FloatArray,
    model: MarginalModel,
    settings: FitSettings,
    plain: FitResult | None,
    *,
    warm: bool,
    beside: bool,
) -> _Found:
    """Climb from one start in every pixel; ``beside``: and from its neighbours."""
    n = counts.shape[0]
    found = _Found(
        np.full((n, 4), np.nan),
        np.full((n, 4, 4), np.nan),
        np.full((n, grown_numba.N_OUT), np.nan),
        np.zeros((n, grown_numba.N_WORDS), np.int64),
        np.zeros(n, np.int64) if plain is None else plain.fit_status.astype(np.int64) & int(FAILED),
    )
    gaps = np.full(n, np.inf) if plain is None else plain.likelihood_gap
    # the plain fit of an exposure that is not one may be an electron off
    mixed = ((model.added_weights > 0.0) & (model.added_exposure > 0.0)).any(axis=1)
    gaps = np.where(mixed, np.minimum(gaps, 0.999 * _CLEAR_GAP), gaps)
    grown_tile_numba.fit_tile(
        counts,
        origin,
        start,
        np.ascontiguousarray(gaps, np.float64),
        pack(model, n),
        np.array(model.free_lobes, np.float64),
        _limits(settings, model, warm=warm, beside=beside),
        *found[:-1],
    )
    return found


def _better(found: _Found, again: _Found, pixels: NDArray[np.intp]) -> _Found:
    """Put the second fit of some pixels in the place of the first where it is likelier."""

    def height(fit: _Found) -> FloatArray:
        converged = fit.words[:, grown_numba.CONVERGED] > 0
        return np.where(converged, fit.out[:, grown_numba.LOG_LIKELIHOOD], -np.inf)

    higher = height(again) > height(found)[pixels]
    for mine, theirs in zip(found, again, strict=True):
        mine[pixels[higher]] = theirs[higher]
    return found


def _with_limits(
    found: _Found,
    counts: NDArray[np.integer],
    origin: NDArray[np.int64],
    model: MarginalModel,
    settings: FitSettings,
) -> _Found:
    """Start anew in pixels that the plain fit misjudged because codes pile up at a limit of the law."""
    codes = origin[:, None] + np.arange(counts.shape[1])
    beyond = np.zeros(codes.shape, bool)
    if model.clip_low is not None:
        beyond |= codes <= model.clip_low
    if model.clip_high is not None:
        beyond |= codes >= model.clip_high
    beyond &= counts > 0
    chi2, dof = found.out[:, grown_numba.CHI2], found.words[:, grown_numba.FREEDOM]
    poor = (found.words[:, grown_numba.CONVERGED] == 0) | (chdtrc(np.maximum(dof, 1), chi2) < _POOR)
    pixels = np.flatnonzero(poor & beyond.any(axis=1))
    if pixels.size == 0:
        return found
    part, first, own = counts[pixels], origin[pixels], model.of(pixels)
    inside = np.where(beyond[pixels], 0, part).astype(part.dtype)
    starts = starting_points(inside, first)
    chosen = np.full((pixels.size, 4), np.nan)
    gains = np.ascontiguousarray(starts[:, :, 1])
    grown_scan_numba.scan_tile(part, first, gains, pack(own, pixels.size), chosen)
    again = _climb(part, first, chosen, own, settings, None, warm=True, beside=True)
    return _better(found, again, pixels)


def _reshapes(model: MarginalModel) -> bool:
    """Tell whether a law changes more than the width of peaks: the plain fit may then be an electron off."""
    one_peak = model.lobe_weights.shape[1] == 1
    one_law = model.law == "poisson" and model.exposure_weights.size == 1
    return not (one_peak and one_law and model.curvature == 0.0 and model.variance_per_electron2 == 0.0)


def _limits(settings: FitSettings, model: MarginalModel, *, warm: bool, beside: bool) -> FloatArray:
    limits = np.zeros(grown_numba.N_LIMITS)
    limits[grown_numba.MIN_LOG_EXPOSURE] = np.log(settings.minimum_quanta_exposure)
    limits[grown_numba.TOLERANCE] = settings.tolerance
    limits[grown_numba.MAX_EVALUATIONS] = settings.max_iterations
    limits[grown_numba.CLEAR_GAP] = _CLEAR_GAP
    limits[grown_numba.LOBE_RISE] = lobe_threshold(model)
    limits[grown_numba.WARM] = warm
    limits[grown_numba.BESIDE] = beside
    return limits


def _status(
    parameters: FloatArray,
    out: FloatArray,
    words: NDArray[np.int64],
    probability: FloatArray,
    settings: FitSettings,
    carried: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Return the status words: what the plain fit said of the data, and what this fit says of itself.

    Rounding is exact here, so coarse steps bias nothing and their bit falls.
    """
    status = carried.copy()
    fitted = (status & int(FAILED)) == 0
    status[fitted & (words[:, grown_numba.CONVERGED] == 0)] |= FitStatus.NOT_CONVERGED
    with np.errstate(invalid="ignore"):
        exposure, gain, _, sigma = parameters.T
        flags = {
            FitStatus.EXPOSURE_AT_BOUND: exposure <= settings.minimum_quanta_exposure * (1 + 1e-9),
            FitStatus.BIAS_AMBIGUOUS: out[:, grown_numba.GAP] < settings.gap_threshold,
            FitStatus.NOT_INFORMATIVE: gain * sigma > settings.read_noise_limit,
            FitStatus.POOR_FIT: probability < settings.goodness_limit,
        }
    for bit, where in flags.items():
        status[fitted & where] |= bit
    return status
