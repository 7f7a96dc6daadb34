"""Names and quantiles of confidence intervals."""

from __future__ import annotations

from scipy.special import ndtri

__all__ = ["INTERVAL_NAMES", "quantile_of"]

#: What has an interval, in the order of the axis ``quantity``.
INTERVAL_NAMES = ("quanta_exposure", "conversion_gain", "bias", "read_noise_dn", "read_noise_e")


def quantile_of(level: float) -> float:
    """Return z such that a standard normal lies within -+ z with probability ``level``.

    Example:
        >>> round(quantile_of(0.95), 3)
        1.96
    """
    return float(ndtri(0.5 * (1.0 + level)))
