"""Pixels that are not ordinary: which, of what kind, and how far from the usual one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntFlag
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import Arrays, BoolArray, FloatArray, IntArray
from pchem_pipeline.model.arithmetic.limits import SMALLEST_MASS
from pchem_pipeline.model.arithmetic.statistics import robust_sd
from pchem_pipeline.model.fit.status import FLAGGED, FitStatus, flags_of, words_of


class Defect(IntFlag):
    """Kinds of defects, as bits of a mask; a pixel may be of several."""

    EXCLUDED = 1
    STUCK = 2
    SATURATED = 4
    DEAD = 8
    HOT = 16
    NOISY = 32
    TELEGRAPH = 64
    NOT_FITTED = 128
    FLAGGED = 256


#: Faults that no setting of a run decides.
FAULTS = Defect.STUCK | Defect.SATURATED | Defect.DEAD | Defect.HOT | Defect.NOISY

#: Kinds that say what the data leave open, no fault of the pixel.
OPEN = Defect.NOT_FITTED | Defect.FLAGGED

#: Maps whose usual values pixels are compared with.
_COMPARED = ("quanta_exposure", "read_noise_e", "bias", "conversion_gain")
#: Maps that are read.
MAPS = (*_COMPARED, "quanta_exposure_stderr", "read_noise_e_stderr")

#: Pixels that a usual value is of, at least.
FEWEST = 30
#: Share of the samples at the highest code above which a pixel is saturated: its median is.
_SATURATED = 0.5


class Moments(NamedTuple):
    """What the histograms of n pixels say without a fit."""

    pixel: IntArray  # ``y * nx + x`` of each, shape (n,)
    n_frames: IntArray  # samples of each, shape (n,)
    mean: FloatArray  # DN, shape (n,)
    variance: FloatArray  # DN^2, shape (n,)
    top_share: FloatArray  # share of the samples at the highest code of the ADC, shape (n,)


@dataclass(frozen=True)
class Defects:
    """The defects of a sensor.

    Attributes:
        kinds: bits of :class:`Defect`, 0 for an ordinary pixel, (y, x).
        table: a row for each kind of each pixel, by column: ``x``, ``y`` (from 0), ``kind``; ``value`` with
            ``stderr`` in ``unit``, and ``usual``, the median of the sensor, NaN where there are none;
            ``fit_status`` in words.
    """

    kinds: NDArray[np.uint16]
    table: dict[str, NDArray[Any]]

    @property
    def mask(self) -> NDArray[np.uint8]:
        """Bits of excluded pixels and of faults; what the data leave open has none; (y, x)."""
        return (self.kinds & ~np.uint16(OPEN)).astype(np.uint8)

    def counts(self) -> dict[str, int]:
        """Return the number of pixels of each kind that occurs."""
        names, counts = np.unique(self.table["kind"], return_counts=True)
        found = dict(zip(names.tolist(), counts.tolist(), strict=True))
        return {name: found[name] for name in map(words_of, Defect) if name in found}


def needs_moments(status: NDArray[Any], conversion_gain: FloatArray) -> BoolArray:
    """Return which pixels :class:`Moments` are needed of: gain not known, or samples at a limit of the ADC.

    Status words and g, NaN where there is no value, may have any shape. Pixels without samples have none.
    """
    left_out = _has(status, FitStatus.EXCLUDED | FitStatus.NOT_FITTED | FitStatus.NO_DATA)
    return (_gain_unknown(status, conversion_gain) | _has(status, FitStatus.ADC_LIMIT)) & ~left_out


def find_defects(
    maps: Arrays,
    status: NDArray[Any],
    moments: Moments,
    telegraph_e: FloatArray | None,
    *,
    light: bool,
    sigmas: float,
) -> Defects:
    """Find the pixels that are not ordinary.

    Stuck: all samples are one code. Saturated: most are the highest one. Hot: H is above the median of the
    unflagged pixels by more than ``sigmas`` times ``1.4826 MAD``, or times its own standard error where that
    is larger. Noisy: so is the read noise. Dead: H, with ``sigmas`` standard errors added, is below the
    median by more than ``sigmas`` times ``1.4826 MAD`` of ln H, since light acts as a factor.

    A pixel whose fit does not know the gain is judged by mean and variance of its samples, with the median
    gain, bias and read noise of the sensor, whose scatter between pixels counts as error. Pixels without a
    value, or flagged, are listed as such if they have no fault, and only if most pixels are not so.

    Args:
        maps: :data:`MAPS` by name, in e-, e-/DN and DN, (y, x); NaN where there is no value.
        status: words of the fit, (y, x).
        moments: of the pixels that :func:`needs_moments` tells.
        telegraph_e: distance of the two levels of a pixel, e-, (y, x); NaN: one level; None: not known.
        light: whether light made the charge.
        sigmas: ``maps.outlier_sigmas``.
    """
    usual = {name: _usual(maps[name], _has(status, flags_of(name))) for name in _COMPARED}
    charges, noises = usual["quanta_exposure"], usual["read_noise_e"]
    known, shape = np.isfinite(maps["conversion_gain"]), status.shape
    seen = _quantities(maps, status, moments, usual, sigmas)
    seen[Defect.TELEGRAPH] = _Quantity("e-", np.nan, telegraph_e)
    logarithms = _usual(
        np.log(np.maximum(maps["quanta_exposure"], SMALLEST_MASS)), _has(status, flags_of("quanta_exposure"))
    )
    dimmest = np.exp(logarithms.median - sigmas * logarithms.spread)

    excluded = _has(status, FitStatus.EXCLUDED)
    saturated = seen[Defect.SATURATED].where(shape, lambda share, _: share > _SATURATED)
    stuck = seen[Defect.STUCK].where(shape, lambda _, error: error == 0.0) & ~saturated
    judged = ~(excluded | saturated | stuck)
    pixels = {
        Defect.EXCLUDED: excluded,
        Defect.STUCK: stuck,
        Defect.SATURATED: saturated,
        Defect.DEAD: judged
        & light
        & seen[Defect.DEAD].where(shape, lambda v, error: v + sigmas * error < dimmest),
        Defect.HOT: judged & seen[Defect.HOT].where(shape, charges.far_below(sigmas)),
        Defect.NOISY: judged & seen[Defect.NOISY].where(shape, noises.far_below(sigmas)),
        Defect.TELEGRAPH: judged
        & seen[Defect.TELEGRAPH].where(shape, lambda distance, _: np.isfinite(distance)),
    }
    faultless = ~np.logical_or.reduce(list(pixels.values()))
    for kind, such in (
        (Defect.NOT_FITTED, ~known & ~_has(status, FitStatus.NOT_FITTED)),
        (Defect.FLAGGED, known & _has(status, FLAGGED)),
    ):
        pixels[kind] = faultless & such & (such.mean() <= 0.5)
    kinds = np.zeros(status.shape, np.uint16)
    for kind, such in pixels.items():
        kinds[such] |= np.uint16(kind)
    rows = [_rows(kind, such, seen.get(kind, _Quantity("", np.nan)), status) for kind, such in pixels.items()]
    return Defects(kinds, {name: np.concatenate([each[name] for each in rows]) for name in rows[0]})


_Test = Callable[[Any, Any], BoolArray]


class _Usual(NamedTuple):
    """Median and robust standard deviation of a map."""

    median: float
    spread: float

    def far_below(self, sigmas: float) -> _Test:
        """Return the test whether a value is above by so many standard deviations, and its own errors."""
        return lambda value, error: value > self.median + sigmas * np.fmax(self.spread, error)


_NOTHING = np.empty(0)


class _Quantity(NamedTuple):
    """What a kind of defect is seen in: unit, usual value, and values with standard errors.

    These are maps, (y, x), or None; ``own`` are those of the pixels at the places ``pixel``, in their stead.
    """

    unit: str
    usual: float
    value: FloatArray | None = None
    stderr: FloatArray | None = None
    pixel: IntArray = _NOTHING.astype(np.int64)
    own: tuple[FloatArray, FloatArray] = (_NOTHING, _NOTHING)

    def where(self, shape: tuple[int, ...], test: _Test) -> BoolArray:
        """Return a map of the pixels whose value and standard error pass a test."""
        found = np.zeros(shape, np.bool_) if self.value is None else test(self.value, self.stderr)
        found.flat[self.pixel] = test(*self.own)
        return found

    def at(self, pixel: IntArray) -> list[FloatArray]:
        """Return value and standard error at some places, NaN where there is none."""
        _, here, mine = np.intersect1d(pixel, self.pixel, assume_unique=True, return_indices=True)
        found = []
        for values, own in zip((self.value, self.stderr), self.own, strict=True):
            found.append(np.full(pixel.size, np.nan) if values is None else values.flat[pixel])
            found[-1][here] = own[mine]
        return found


def _has(status: NDArray[Any], bits: FitStatus) -> BoolArray:
    return np.asarray((status & int(bits)) != 0)


def _gain_unknown(status: NDArray[Any], gain: FloatArray) -> BoolArray:
    return np.asarray(~np.isfinite(gain) | _has(status, flags_of("conversion_gain")))


def _usual(values: FloatArray, left_out: BoolArray) -> _Usual:
    """Describe the values of a map that count; NaN where these are few."""
    counted = values[np.isfinite(values) & ~left_out]
    if counted.size < FEWEST:
        return _Usual(np.nan, np.nan)
    return _Usual(float(np.median(counted)), robust_sd(counted))


def _quantities(
    maps: Arrays, status: NDArray[Any], moments: Moments, usual: dict[str, _Usual], sigmas: float
) -> dict[Defect, _Quantity]:
    """Return exposure, read noise, level and share of samples at the highest code, by kind of defect."""
    pixel, n, share = moments.pixel, moments.n_frames, moments.top_share
    by_moments = _estimates(moments, usual, sigmas)
    unknown = _gain_unknown(status, maps["conversion_gain"]).flat[pixel]
    exposure, noise = (
        _Quantity(
            "e-",
            usual[name].median,
            maps[name],
            maps[f"{name}_stderr"],
            pixel[unknown],
            (value[unknown], error[unknown]),
        )
        for name, (value, error) in zip(("quanta_exposure", "read_noise_e"), by_moments, strict=True)
    )
    level = usual["bias"].median + exposure.usual / usual["conversion_gain"].median
    return {
        Defect.STUCK: _Quantity("DN", level, pixel=pixel, own=(moments.mean, np.sqrt(moments.variance / n))),
        Defect.SATURATED: _Quantity("1", 0.0, pixel=pixel, own=(share, np.sqrt(share * (1.0 - share) / n))),
        Defect.DEAD: exposure,
        Defect.HOT: exposure,
        Defect.NOISY: noise,
    }


_Estimate = tuple[FloatArray, FloatArray]


def _estimates(given: Moments, usual: dict[str, _Usual], sigmas: float) -> tuple[_Estimate, _Estimate]:
    """Return H and read noise, e-, with standard errors, by mean and variance of the samples.

    The mean is ``mu + H / g``, the variance ``sigma^2 + H / g^2`` (Janesick 2007, *Photon Transfer*); the
    other parameters are the usual ones. H is what has the lower upper limit of the two: noise adds to the
    variance.
    """
    gain, noise, bias = (usual[name].median for name in ("conversion_gain", "read_noise_e", "bias"))
    relative = usual["conversion_gain"].spread / gain
    square = given.variance * gain**2
    # of a sample variance with the fourth cumulant of a Poisson law, and of g
    square_error = np.hypot(np.sqrt((2.0 * square**2 + square) / given.n_frames), 2.0 * relative * square)
    by_mean, by_variance = (given.mean - bias) * gain, square - noise**2
    error = np.hypot(np.sqrt(square / given.n_frames), gain * usual["bias"].spread)
    errors = (
        np.hypot(error, relative * by_mean),
        np.hypot(square_error, 2.0 * noise * usual["read_noise_e"].spread),
    )
    lower = by_variance + sigmas * errors[1] < by_mean + sigmas * errors[0]
    charge = np.where(lower, by_variance, by_mean), np.where(lower, errors[1], errors[0])
    found = np.sqrt(np.maximum(square - by_mean, 0.0))
    # the distance from the usual noise is as significant as that of the squares
    return charge, (found, np.hypot(square_error, errors[0]) / (found + noise))


def _rows(kind: Defect, pixels: BoolArray, seen: _Quantity, status: NDArray[Any]) -> dict[str, NDArray[Any]]:
    y, x = np.nonzero(pixels)
    value, error = seen.at(np.flatnonzero(pixels))
    words, place = np.unique(status[pixels], return_inverse=True)
    return {
        "x": x,
        "y": y,
        "kind": np.full(x.size, words_of(kind)),
        "value": value,
        "stderr": error,
        "unit": np.full(x.size, seen.unit),
        "usual": np.full(x.size, seen.usual),
        "fit_status": np.array([words_of(FitStatus(int(word))) for word in words], np.str_)[place],
    }
