"""The word that says, for every pixel, why its fit failed or deserves caution."""

from __future__ import annotations

from enum import IntFlag
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pchem_pipeline.base.arrays import BoolArray, FloatArray, IntArray
from pchem_pipeline.base.variables import CHARGE_RATES


class FitStatus(IntFlag):
    """Bits of ``fit/fit_status``; 0 means a good fit.

    The bits in :data:`FAILED` come with NaN parameters, the others with parameters to be used with caution.
    """

    OK = 0
    NO_DATA = 1
    TOO_FEW_BINS = 2
    NOT_CONVERGED = 4
    GAIN_NOT_IDENTIFIED = 8
    EXPOSURE_AT_BOUND = 16
    BIAS_AMBIGUOUS = 32
    NOT_INFORMATIVE = 64
    ADC_LIMIT = 128
    OUTSIDE_WINDOW = 256
    POOR_FIT = 512
    COARSE_STEPS = 1024
    WEAKLY_IDENTIFIED = 2048
    GAIN_AMBIGUOUS = 4096
    BIAS_UNSURE = 8192
    NOT_FITTED = 16384
    EXCLUDED = 32768


#: Bits for which the parameters of the pixel are NaN.
FAILED = (
    FitStatus.NO_DATA
    | FitStatus.TOO_FEW_BINS
    | FitStatus.NOT_CONVERGED
    | FitStatus.GAIN_NOT_IDENTIFIED
    | FitStatus.EXPOSURE_AT_BOUND
    | FitStatus.NOT_FITTED
    | FitStatus.EXCLUDED
)

#: Bits of pixels with a rival maximum that is nearly as likely.
AMBIGUOUS = FitStatus.BIAS_AMBIGUOUS | FitStatus.GAIN_AMBIGUOUS

#: Bits of pixels of which the data leave a quantity open by whole electrons, or altogether, whatever its
#: standard error says.
FLAGGED = AMBIGUOUS | FitStatus.BIAS_UNSURE | FitStatus.NOT_INFORMATIVE | FitStatus.WEAKLY_IDENTIFIED

#: What a bias that is an electron off concerns; the distance of the peaks and their width stay.
_COUNTS_ELECTRONS = ("quanta_exposure", "bias", "spurious_charge", "dark_signal", *CHARGE_RATES)

_LARGEST_GAIN_CHANGE = 0.03  # relative; a rival that differs by less has the same gain


def flags_of(name: str) -> FitStatus:
    """Return the bits of pixels that medians and tables of a map leave out; its name without ``_stderr``."""
    of_bias = FitStatus.BIAS_AMBIGUOUS | FitStatus.BIAS_UNSURE
    return FLAGGED if name in _COUNTS_ELECTRONS else FLAGGED & ~of_bias


def flagged(words: NDArray[np.integer[Any]], name: str) -> BoolArray:
    """Return which pixels with a value the data leave open in a map, of status words of any shape."""
    return np.asarray((words & int(FAILED) == 0) & (words & int(flags_of(name)) != 0))


def flagged_share(words: NDArray[np.integer[Any]], name: str) -> float:
    """Return the share of these pixels among those with a value."""
    return int(flagged(words, name).sum()) / max(int((words & int(FAILED) == 0).sum()), 1)


def with_rivals_named(words: IntArray, *, dark: bool, several: bool = False) -> IntArray:
    """Return status words that say of ambiguous pixels whether their rival differs in bias, gain or both.

    The search says so of one sample. Where bias frames hold the bias (``dark``), the rival differs in gain
    alone. ``several`` samples have a gain of small error, and a rival's differs by many of these.
    """
    ambiguous = (words & FitStatus.BIAS_AMBIGUOUS) != 0
    named = words | AMBIGUOUS if dark or several else words
    named = named & ~int(FitStatus.BIAS_AMBIGUOUS) if dark else named
    return np.where(ambiguous, named, words)


def moves_gain(exposure: FloatArray, noise: FloatArray) -> BoolArray:
    """Return where a bias that is an electron off has a gain of its own, too, off by more than 3 %.

    With one electron more or less, mean and variance of the sample ask for a gain changed by ``1 / (2 H)``;
    the peaks hold the gain with ``4 pi^2 H exp(-4 pi^2 s_e^2)`` times that information. H and the read noise
    s_e, e-, have one shape.
    """
    square = 4.0 * np.pi**2
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        change = 0.5 / exposure / (1.0 + square * exposure * np.exp(-square * noise**2))
    return np.asarray(change > _LARGEST_GAIN_CHANGE)


#: A sentence for every bit.
MEANINGS: dict[FitStatus, str] = {
    FitStatus.NO_DATA: "too few frames inside the histogram window",
    FitStatus.TOO_FEW_BINS: "fewer than 3 occupied bins",
    FitStatus.NOT_FITTED: "not fitted: the tile failed or was not selected",
    FitStatus.NOT_CONVERGED: "the fit did not converge",
    FitStatus.GAIN_NOT_IDENTIFIED: "one Gaussian fits as well: the data do not fix the conversion gain",
    FitStatus.EXPOSURE_AT_BOUND: "quanta exposure at its lower bound: no electrons",
    FitStatus.BIAS_AMBIGUOUS: "bias may be off by one electron (1/g in DN) or more, and H by as many",
    FitStatus.GAIN_AMBIGUOUS: "gain ambiguous: another gain is nearly as likely",
    FitStatus.NOT_INFORMATIVE: "read noise too high for one sample; take several exposures",
    FitStatus.ADC_LIMIT: "samples at the limits of the ADC",
    FitStatus.OUTSIDE_WINDOW: "frames outside the histogram window excluded",
    FitStatus.POOR_FIT: "poor goodness of fit: the model does not describe the pixel",
    FitStatus.COARSE_STEPS: "DN too coarse (sigma < 0.6 DN or g > 0.4 e-/DN): rounding biases the estimates",
    FitStatus.BIAS_UNSURE: "bias not certain: in such pixels often off by one electron (1/g in DN)",
    FitStatus.WEAKLY_IDENTIFIED: "too few frames for this sensor's read noise: bias not certain, standard "
    "errors approximate",
    FitStatus.EXCLUDED: "excluded by input.mask, as overscan, or by the camera's marker",
}


def describe(word: int) -> str:
    """Return the sentences of all bits set in a status word, joined by ``"; "``; ``"good fit"`` for 0.

    Example:
        >>> describe(0)
        'good fit'
        >>> describe(32)
        'bias may be off by one electron (1/g in DN) or more, and H by as many'
    """
    return "; ".join(meaning for bit, meaning in MEANINGS.items() if word & bit) or "good fit"


def words_of(flags: IntFlag) -> str:
    """Return the names of all bits that are set, in lower case, joined by spaces; of none the name of 0.

    Example:
        >>> words_of(FitStatus(2 + 128))
        'too_few_bins adc_limit'
    """
    return " ".join(str(bit.name).lower() for bit in flags) or (flags.name or "").lower()
