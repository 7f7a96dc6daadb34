"""The word that says, for every pixel, why its fit failed or deserves caution."""

from __future__ import annotations

from enum import IntFlag


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
    EXCLUDED = 4096


#: Bits for which the parameters of the pixel are NaN.
FAILED = (
    FitStatus.NO_DATA
    | FitStatus.TOO_FEW_BINS
    | FitStatus.NOT_CONVERGED
    | FitStatus.GAIN_NOT_IDENTIFIED
    | FitStatus.EXPOSURE_AT_BOUND
    | FitStatus.EXCLUDED
)

#: Bits of pixels whose value the data leave open by whole electrons, or altogether, whatever its standard
#: error says. Medians and tables over the sensor are of the other pixels.
FLAGGED = FitStatus.BIAS_AMBIGUOUS | FitStatus.NOT_INFORMATIVE | FitStatus.WEAKLY_IDENTIFIED

#: A sentence for every bit.
MEANINGS: dict[FitStatus, str] = {
    FitStatus.NO_DATA: "too few frames inside the histogram window",
    FitStatus.TOO_FEW_BINS: "fewer than 3 occupied bins",
    FitStatus.NOT_CONVERGED: "the fit did not converge",
    FitStatus.GAIN_NOT_IDENTIFIED: "one Gaussian fits as well: the conversion gain is not identified",
    FitStatus.EXPOSURE_AT_BOUND: "quanta exposure at its lower bound: no electrons seen",
    FitStatus.BIAS_AMBIGUOUS: "bias ambiguous by one electron or more",
    FitStatus.NOT_INFORMATIVE: "read noise too high for one sample; take several exposures",
    FitStatus.ADC_LIMIT: "values at the limits of the ADC",
    FitStatus.OUTSIDE_WINDOW: "frames outside the histogram window were left out",
    FitStatus.POOR_FIT: "poor goodness of fit: the model does not describe the pixel",
    FitStatus.COARSE_STEPS: "DN too coarse (sigma < 0.6 DN or g > 0.4 e-/DN): rounding biases the estimates",
    FitStatus.WEAKLY_IDENTIFIED: "too few frames at this sensor's read noise: the bias is clear by chance "
    "only, or the standard errors are rough",
    FitStatus.EXCLUDED: "excluded by input.mask, or by the camera's marker",
}


def describe(word: int) -> str:
    """Return the sentences of all bits set in a status word, joined by ``"; "``; ``"good fit"`` for 0.

    Args:
        word: status word, as stored in ``fit/fit_status``.

    Example:
        >>> describe(0)
        'good fit'
        >>> describe(32)
        'bias ambiguous by one electron or more'
    """
    sentences = [meaning for bit, meaning in MEANINGS.items() if word & bit]
    return "; ".join(sentences) if sentences else "good fit"
