"""Draw the parameter maps of a sensor: distributions, correlations, patterns and defects.

A pixel's values depend on the seed and on its own position only, so a larger sensor with the same seed
contains the smaller one (but for gradients, which are stretched).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import special

from pchem_pipeline.base.arrays import FloatArray
from pchem_pipeline.base.errors import ConfigError
from pchem_pipeline.simulate.distributions import (
    ColumnPattern,
    Constant,
    Distribution,
    Gamma,
    GradientPattern,
    LogNormal,
    LogUniform,
    Normal,
    Pattern,
    RadialPattern,
    RowPattern,
    Uniform,
)
from pchem_pipeline.simulate.streams import KeyedStreams
from pchem_pipeline.simulate.truth import Defect, TruthMaps

if TYPE_CHECKING:
    from pchem_pipeline.simulate.settings import SimulateSettings


def draw_truth(settings: SimulateSettings) -> TruthMaps:
    """Draw the true maps (y, x) of a sensor; ConfigError: H < 0, g <= 0 or read noise < 0 somewhere."""
    given = settings.parameters.given()
    maps = {
        name: _with_patterns(truncated_quantile(distribution, u), name, distribution, settings)
        for (name, distribution), u in zip(given.items(), _copula(settings), strict=True)
    }
    for name, values in maps.items():
        positive = name in ("conversion_gain", "dn_per_electron")
        lowest = float(values.min())
        if name != "bias" and (lowest < 0 or (positive and lowest == 0)):
            raise ConfigError(
                f"simulate.parameters.{name} is {lowest:.4g} in some pixels, which is impossible; set a "
                f"minimum {'above' if positive else 'of'} 0"
            )
    if "dark_current" in maps:
        maps["quanta_exposure"] = maps["dark_current"] * settings.integration_time
    if "dn_per_electron" in maps:
        maps["conversion_gain"] = 1.0 / maps["dn_per_electron"]
    names = ("quanta_exposure", "conversion_gain", "bias", "analog_read_noise_e")
    exposure, gain, bias, noise = (maps[name] for name in names)
    truth = TruthMaps(exposure, gain, bias, noise, np.zeros(settings.shape, np.uint8))
    return _with_defects(truth, settings)


def _streams(settings: SimulateSettings, purpose: str) -> KeyedStreams:
    return KeyedStreams(
        settings.seed if settings.sensor_seed is None else settings.sensor_seed,
        f"map/{purpose}",
        np.zeros(1, np.int64),
        np.arange(settings.shape[0]),
        np.arange(settings.shape[1]),
    )


def _copula(settings: SimulateSettings) -> FloatArray:
    """Return uniforms (parameter, y, x) with the rank correlations asked for."""
    factor = np.linalg.cholesky(np.array(settings.parameters.copula()))
    normals = [_streams(settings, f"parameter {i}").normal(("y", "x"))[0] for i in range(len(factor))]
    uniforms: FloatArray = special.ndtr(np.tensordot(factor, np.stack(normals), axes=1))
    return uniforms


def _with_patterns(
    values: FloatArray, name: str, distribution: Distribution, settings: SimulateSettings
) -> FloatArray:
    for i, pattern in enumerate(distribution.patterns):
        streams = _streams(settings, f"{name} pattern {i}")
        shift = _pattern(pattern, streams, settings.shape)
        values = values * (1.0 + shift) if pattern.relative else values + shift
    return np.clip(values, distribution.minimum, distribution.maximum)


def _pattern(pattern: Pattern, streams: KeyedStreams, shape: tuple[int, int]) -> FloatArray:
    """Return a pattern, broadcastable to (y, x)."""
    # position from -1/2 to 1/2 across the sensor; a single row or column is in the middle
    y = (streams.rows[:, None] - (shape[0] - 1) / 2) / max(shape[0] - 1, 1)
    x = (streams.columns[None, :] - (shape[1] - 1) / 2) / max(shape[1] - 1, 1)
    shift: Any
    match pattern:
        case ColumnPattern():
            shift = streams.normal(("x",))[0]
        case RowPattern():
            shift = streams.normal(("y",))[0]
        case GradientPattern():
            angle = np.deg2rad(pattern.angle)
            shift = x * np.cos(angle) + y * np.sin(angle)
        case RadialPattern():
            shift = 2.0 * (x**2 + y**2)
    return np.asarray(pattern.amplitude * shift, dtype=np.float64)


def _with_defects(truth: TruthMaps, settings: SimulateSettings) -> TruthMaps:
    """Return the maps with hot, dead and stuck pixels; a pixel has one defect at most."""
    parameters = settings.parameters
    streams = _streams(settings, "defect")
    lot = streams.uniform(("y", "x"), draw=0)[0]
    ends = np.cumsum([parameters.dead_fraction, parameters.stuck_fraction, parameters.hot_pixels.fraction])
    dead = lot < ends[0]
    stuck = (lot >= ends[0]) & (lot < ends[1])
    hot = (lot >= ends[1]) & (lot < ends[2])
    multiplier = truncated_quantile(parameters.hot_pixels.multiplier, streams.uniform(("y", "x"), draw=1)[0])
    code = np.floor(streams.uniform(("y", "x"), draw=2)[0] * 2.0**settings.bit_depth)
    exposure = np.where(hot, truth.quanta_exposure * multiplier, truth.quanta_exposure)
    defect = np.select([dead, stuck, hot], [Defect.DEAD, Defect.STUCK, Defect.HOT], Defect.NONE)
    return replace(
        truth,
        quanta_exposure=np.where(dead | stuck, 0.0, exposure),
        # without electrons and noise, the bias is what comes out, always
        bias=np.where(stuck, code, truth.bias),
        analog_read_noise_e=np.where(stuck, 0.0, truth.analog_read_noise_e),
        defect=defect.astype(np.uint8),
    )


def truncated_quantile(distribution: Distribution, u: FloatArray) -> FloatArray:
    """Return quantiles at ``u`` in (0, 1) within the bounds; ConfigError: nothing lies in these."""
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


def _quantile(d: Distribution, u: FloatArray) -> FloatArray:
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
    return float(result)
