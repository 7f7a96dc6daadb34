"""Quantiles of the distributions that the YAML can ask for."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import special

from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.simulate.distributions import (
    Constant,
    Distribution,
    Gamma,
    LogNormal,
    LogUniform,
    Normal,
    Uniform,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray


def truncated_quantile(distribution: Distribution, u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the quantiles of a distribution truncated to its bounds.

    Args:
        distribution: the settings.
        u: probabilities in (0, 1), any shape.

    Raises:
        ConfigError: if the bounds leave practically nothing of the distribution.
    """
    if isinstance(distribution, Constant):
        return np.full(u.shape, distribution.value)
    low = 0.0 if distribution.minimum is None else _cdf(distribution, distribution.minimum)
    high = 1.0 if distribution.maximum is None else _cdf(distribution, distribution.maximum)
    if not high - low > 1e-9:
        raise ConfigError(
            f"simulate: bounds {distribution.minimum} .. {distribution.maximum} exclude the whole "
            f"{distribution.kind} distribution; change them"
        )
    values = _quantile(distribution, low + u * (high - low))
    return np.clip(values, distribution.minimum, distribution.maximum)


def _quantile(d: Distribution, u: NDArray[np.float64]) -> NDArray[np.float64]:
    result: Any
    match d:
        case Normal():
            result = d.mean + d.std * special.ndtri(u)
        case LogNormal():
            result = d.median * np.exp(d.log_std * special.ndtri(u))
        case Gamma():
            shape = (d.mean / d.std) ** 2
            result = special.gammaincinv(shape, u) * d.mean / shape
        case Uniform():
            result = d.low + u * (d.high - d.low)
        case LogUniform():
            result = d.low * np.exp(u * np.log(d.high / d.low))
        case Constant():
            result = np.full(u.shape, d.value)
    return np.asarray(result, dtype=np.float64)


def _cdf(d: Distribution, x: float) -> float:
    result: Any
    match d:
        case Normal():
            result = special.ndtr((x - d.mean) / d.std)
        case LogNormal():
            result = special.ndtr(np.log(x / d.median) / d.log_std) if x > 0 else 0.0
        case Gamma():
            shape = (d.mean / d.std) ** 2
            result = special.gammainc(shape, max(x, 0.0) * shape / d.mean)
        case Uniform():
            result = np.clip((x - d.low) / (d.high - d.low), 0.0, 1.0)
        case LogUniform():
            result = np.clip(np.log(x / d.low) / np.log(d.high / d.low), 0.0, 1.0) if x > 0 else 0.0
        case Constant():
            result = x >= d.value
    return float(result)
