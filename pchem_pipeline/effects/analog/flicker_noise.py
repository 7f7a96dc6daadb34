"""Flicker noise: part of a pixel's read noise stays for many frames.

The low-frequency noise of a source follower that correlated double sampling does not remove (1/f noise; van
Vliet 1976; Kansy 1980 for its passage through double sampling) correlates successive frames of a pixel,
each pixel by itself: ``R_t = (1 - share)^(1/2) sigma Z_t + share^(1/2) sigma U_t``. U is a stationary
Ornstein-Uhlenbeck process, ``cov(U_t, U_{t+l}) = exp(-l / tau)``, whose spectrum is a Lorentzian, or the
sum of three of them with tau spaced by factors of 8, nearly 1/f in between (McWhorter 1957).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self, TypeVar

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.estimators.long_memory import between_grid_points, frame_key
from pchem_pipeline.effects.estimators.regression import SIGNIFICANT, multiple_of
from pchem_pipeline.effects.framework.context import RandomSource
from pchem_pipeline.effects.framework.effect import Effect, Frames, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import (
    AnyArray,
    BoolArray,
    EffectContext,
    Evidence,
    FloatArray,
    IntArray,
    TimeSeries,
)

_Flicker = TypeVar("_Flicker", bound="FlickerNoise")

# correlation times, frames, among which the estimator looks
_TIMES = np.array([0.7, 1.5, 3.0, 6.0, 12.0, 25.0, 50.0, 100.0, 200.0, 400.0, 1000.0])
_SPACING = (1.0, 1 / 8, 1 / 64)


@register_effect
class FlickerNoise(Effect):
    """Part of the power of the read noise that is correlated in time; the power of all stays as it is.

    Signature: residuals of successive frames are alike and block means wander, each pixel by itself: neither
    frame means nor neighbours show anything, and a pixel's own histogram does not either.
    """

    tag: Literal["flicker_noise"] = Field(default="flicker_noise", description="name of the effect")
    plane = Plane.ANALOG
    title = "flicker (1/f) noise of the pixels"
    source = "van Vliet 1976; Kansy 1980 (double sampling of 1/f noise); McWhorter 1957"
    signature = (
        "time.block.readout.chi", "time.lag1.readout.mean", "time.lag2.readout.mean",
        "time.lag3.readout.mean",
    )  # fmt: skip
    strength = "share"
    separate: ClassVar[Mapping[str, str]] = {
        "analog_memory": "frames without exposure: 1/f noise remains, memory vanishes",
        "dark_current_rts": "a sweep of the exposure time: blinking grows with it, 1/f noise does not",
        "bias_drift": "pairs of distant pixels: a bias drift is common to them",
        "bias_jumps": "pairs of pixels of a quadrant: bias jumps are common to them",
        "gain_drift": "dark and bright pixels: a gain drift is proportional to the signal",
        "rts_noise": "longer runs: slow RTS noise has two levels, in the same few pixels",
    }
    share: Ratio = Field(ge=0, le=1, description="share of the read noise power, no unit")
    correlation_frames: Frames = Field(
        default=30.0,
        gt=0,
        le=1e6,
        description="correlation time, frames; one_over_f: the longest one",
    )
    spectrum: Literal["lorentzian", "one_over_f"] = Field(
        default="lorentzian",
        description="lorentzian: one correlation time; one_over_f: it, an eighth and a 64th, of equal power",
    )

    #: from some frames to hundreds of frames long, and 1/f
    typical_values = (
        *({"share": 0.0036, "correlation_frames": tau} for tau in (3.0, 30.0, 300.0)),
        {"share": 0.0036, "correlation_frames": 300.0, "spectrum": "one_over_f"},
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the signal (frame, y, x), e-, with a part of the noise exchanged for a correlated one."""
        times = self._times()
        noise = _ornstein_uhlenbeck(context.random, context.frames, times[0], 0)
        for process, tau in enumerate(times[1:], 1):
            noise += _ornstein_uhlenbeck(context.random, context.frames, tau, process)
        noise *= np.sqrt(self.share / len(times)) * context.truth["analog_read_noise_e"]
        if context.read_noise is not None:
            noise -= (1.0 - np.sqrt(1.0 - self.share)) * context.read_noise
        noise += values
        return noise

    def _times(self) -> tuple[float, ...]:
        """Return the correlation times, frames."""
        factors = (1.0,) if self.spectrum == "lorentzian" else _SPACING
        return tuple(self.correlation_frames * factor for factor in factors)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the least-squares fit of lag correlations and variance of block means, over a grid of tau.

        A shift by d changes ``E[R | x]`` by ``d Var(r) / sigma^2`` on average (a), so that residuals l frames
        apart are correlated by ``a share exp(-l / tau)``.
        """
        if evidence.time is None or not _good(evidence).any():
            return ()
        seen, error, response = _correlations(evidence, evidence.time)
        best: list[tuple[float, Self]] = []
        for spectrum in ("lorentzian", "one_over_f"):
            for tau in _TIMES if spectrum == "lorentzian" else _TIMES[_TIMES >= 25.0]:
                unit = cls(share=1.0, correlation_frames=float(tau), spectrum=spectrum)
                shape = response * _shape(evidence.time, unit._times())
                share = multiple_of(shape, seen, error**-2.0)
                if np.isfinite(share.error):
                    best.append((share.sigmas, unit.scaled(share.value)))
        best.sort(key=lambda item: item[0], reverse=True)
        return [effect for _, effect in _spread_out(best)] if best and best[0][0] > SIGNIFICANT else ()


def _spread_out(ranked: list[tuple[float, _Flicker]]) -> list[tuple[float, _Flicker]]:
    """Return the best of (sigmas, effect) and up to three others, nearly as good but far off in tau."""
    kept = [ranked[0]]
    for sigmas, effect in ranked[1:]:
        far = all(
            effect.spectrum != other.spectrum
            or abs(np.log(effect.correlation_frames / other.correlation_frames)) > 1.2
            for _, other in kept
        )
        if far and sigmas > 0.6 * ranked[0][0] and len(kept) < 4:
            kept.append((sigmas, effect))
    return kept


def _good(evidence: Evidence) -> BoolArray:
    """Return the pixels whose residuals vary, (y, x)."""
    return evidence.maps.usable & np.isfinite(evidence.readout_std) & (evidence.readout_std > 0)


def _correlations(evidence: Evidence, time: TimeSeries) -> tuple[FloatArray, FloatArray, float]:
    """Return lags 1 to 3 and the relative excess of block means, their standard errors, and the response."""
    maps = evidence.maps
    response = (evidence.readout_std / maps.read_noise_dn) ** 2
    good = _good(evidence)
    lags = np.asarray(time.lag_readout, np.float64)[:, good]
    n = max(good.sum(), 1)
    pairs = np.maximum(time.n_pairs * (1.0 - np.arange(3) / max(time.block_frames - 1, 1)), 1.0)
    seen, error = [np.nanmean(lags, axis=1)], [1.0 / np.sqrt(n * pairs)]
    means = np.asarray(time.block_readout, np.float64)[:, good] / evidence.readout_std[good]
    if means.shape[0] >= 2:
        # what all pixels share is another effect's
        means = means - np.nanmean(means, axis=1, keepdims=True)
        degrees = means.shape[0] - 1
        variance = float(np.nanmean(np.nanvar(means, axis=0, ddof=1))) * _frames_of_block(time)
        seen.append(np.array([variance * n / max(n - 1, 1) - 1.0]))
        error.append(np.array([np.sqrt(2.0 / (degrees * n))]))
    return np.concatenate(seen), np.concatenate(error), float(response[good].mean())


def _frames_of_block(time: TimeSeries) -> float:
    return float(time.frames.size / max(time.block_start.size, 1))


def _shape(time: TimeSeries, times: Sequence[float]) -> FloatArray:
    """Return what a share of 1 gives: correlations at lags 1 to 3, excess of the block means' variance."""
    found: FloatArray = np.mean([_lorentzian_shape(time, tau) for tau in times], axis=0)
    return found


def _lorentzian_shape(time: TimeSeries, tau: float) -> FloatArray:
    lags = np.exp(-np.arange(1, 4) / tau)
    if time.block_readout.shape[0] < 2:
        return lags
    frames = _frames_of_block(time)
    inside = np.arange(1, max(int(frames), 2))
    excess = 2.0 * np.sum((1.0 - inside / frames) * np.exp(-inside / tau))
    # blocks are compared with one another: what is common to all of them does not show
    starts = time.block_start / tau
    between = np.exp(-np.abs(starts[:, None] - starts[None, :]))
    np.fill_diagonal(between, 0.0)
    common = (excess + 1.0) * between.sum() / max(starts.size * (starts.size - 1), 1)
    return np.append(lags, max(excess - common, 0.0))


def _ornstein_uhlenbeck(
    random: RandomSource, frames: IntArray, correlation_frames: float, process: int
) -> FloatArray:
    """Return a stationary Gaussian process with covariance exp(-lag / tau), (frame, y, x), by pixel."""

    def normal(frame: int) -> FloatArray:
        return random.normal(("y", "x"), frame_key(frame, process))

    def midpoint(frame: int, before: FloatArray, after: FloatArray, half: int) -> FloatArray:
        rho = float(np.exp(-half / correlation_frames))
        state = normal(frame)
        state *= np.sqrt((1.0 - rho**2) / (1.0 + rho**2))
        state += rho / (1.0 + rho**2) * (before + after)
        return state

    return np.concatenate(between_grid_points(frames, correlation_frames, normal, midpoint))
