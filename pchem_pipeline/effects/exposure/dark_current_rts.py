"""Dark current that blinks: metastable defects switch a pixel's dark current between two levels.

Random telegraph signals of the dark current are found in few pixels of new sensors and in many irradiated
ones, with jumps that are exponentially distributed over the pixels (Hopkins and Hopkinson 1993; Goiffon et
al. 2009; Virmontois et al. 2013). The state is a Markov chain with exponential dwell times.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pchem_pipeline.effects.estimators.charge_sums import BlockCharge, block_charge
from pchem_pipeline.effects.estimators.regression import FEW_PIXELS
from pchem_pipeline.effects.framework.added_exposure import AddedExposure
from pchem_pipeline.effects.framework.effect import Effect, Electrons, Frames, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import (
    AnyArray,
    BoolArray,
    EffectContext,
    Evidence,
    FloatArray,
    IntArray,
    PixelMaps,
)
from pchem_pipeline.model.arithmetic.robust import chi_square

# a pixel stands out beyond this standard normal number: one in 150,000 by chance
_STANDS_OUT = 4.35
# share of the time in the upper level, and law of the steps
_KINDS: tuple[tuple[float, Literal["equal", "exponential"]], ...] = (
    (0.5, "equal"),
    (0.2, "equal"),
    (0.5, "exponential"),
)


@register_effect
class DarkCurrentRts(Effect):
    """Two levels of the exposure, H and H + step, in a fraction of the pixels.

    Signature: block means of the electron number wander in few pixels, strongly, and successive electron
    numbers are alike there; nothing in the readout residual, nothing in the other pixels.
    """

    tag: Literal["dark_current_rts"] = Field(default="dark_current_rts", description="name of the effect")
    plane = Plane.EXPOSURE
    title = "random telegraph signal of the dark current"
    source = (
        "Hopkins and Hopkinson 1993, IEEE Trans. Nucl. Sci. 40, 1567; Goiffon et al. 2009, ibid. 56, 2132"
    )
    signature = (
        "time.block.charge.cnt",
        "time.lag1.charge.cnt",
        "time.block.charge.chi",
        "shape.C2.cnt",
    )
    strength = "fraction"
    resample_pixels = True
    separate: ClassVar[Mapping[str, str]] = {
        "rts_noise": "several exposure times: jumps of the dark current grow with it",
        "flicker_noise": "dark current jumps in the electron numbers, 1/f noise in the readout residuals",
        "persistence": "a longer run: persistence fades once in regions, single pixels blink repeatedly",
        "overdispersed_counts": "slower and longer runs: blinking is correlated in time",
    }
    fraction: Ratio = Field(ge=0, le=1, description="fraction of the pixels that blink, no unit")
    step_e: Electrons = Field(
        default=1.0,
        ge=0,
        le=1e6,
        description="additional exposure of the upper level, mean over these pixels, e-",
    )
    steps: Literal["equal", "exponential"] = Field(
        default="equal", description="equal: step_e in each of these pixels; exponential: distributed so"
    )
    dwell_low_frames: Frames = Field(
        default=200.0, ge=0.5, description="mean time in the lower level, frames"
    )
    dwell_high_frames: Frames = Field(
        default=200.0, ge=0.5, description="mean time in the upper level, frames"
    )

    #: in 1.1 % of the pixels, slow and fast
    typical_values = (
        {"fraction": 0.011},
        {"fraction": 0.011, "dwell_low_frames": 20.0, "dwell_high_frames": 20.0},
    )

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return the blinking exposure (frame, y, x), e-; touches the pixels that blink only."""
        result = values.copy()
        u = context.random.uniform(("y", "x"))[0]
        blinks = u < self.fraction
        for row in np.flatnonzero(blinks.any(axis=1)):
            # pixels that blink at a small fraction come first, so that they keep their numbers at a larger
            # one
            columns = np.flatnonzero(blinks[row])
            columns = columns[np.argsort(u[row, columns])]
            random = context.random.generator(y=int(context.rows[row]))
            for column in columns:
                result[:, row, column] += self._added(context, random)
        return result

    def _added(self, context: EffectContext, random: np.random.Generator) -> FloatArray:
        """Return the additional exposure of one pixel in each frame of the block, e-."""
        low, high = self.dwell_low_frames, self.dwell_high_frames
        step = self.step_e * (random.exponential() if self.steps == "exponential" else 1.0)
        starts_high = random.random() < high / (low + high)
        # an even number of dwell times, well above what the run holds; the same whatever the block
        pairs = int(
            2.0 + context.n_frames / (low + high) * 1.5 + 6.0 * (context.n_frames / (low + high)) ** 0.5
        )
        dwell = random.exponential(size=(pairs, 2)) * ((high, low) if starts_high else (low, high))
        changes = np.cumsum(dwell.reshape(-1))
        # frames before the run are as the first one
        passed = np.searchsorted(changes, np.maximum(context.frames, 0), side="right")
        added: FloatArray = step * ((passed % 2 == 0) == starts_high)
        return added

    def added_exposure(
        self, frames: NDArray[np.unsignedinteger], numbers: IntArray, maps: PixelMaps
    ) -> AddedExposure | None:
        """Return the levels above the lowest one, and the time spent there, of the pixels seen to blink.

        Each is fitted by itself, whatever the mean step of all: with up to two defects and their own steps.
        """
        from pchem_pipeline.model.law.telegraph import Telegraph, find_telegraph

        if self.fraction == 0 or self.step_e == 0:
            return None
        found: dict[tuple[int, int], Telegraph] = {}
        good = maps.usable
        columns = maps.maps
        for y in np.flatnonzero(good.any(axis=1)):
            row = np.ascontiguousarray(frames[:, y].T)
            for x in np.flatnonzero(good[y]):
                telegraph = find_telegraph(row[x], numbers, np.array([values[y, x] for values in columns]))
                if telegraph is not None:
                    found[int(y), int(x)] = telegraph
        # where most of them seem to blink, it is something else
        if not 0 < len(found) <= FEW_PIXELS * good.size:
            return None
        levels = max(telegraph.added.size for telegraph in found.values())
        exposure, weight = np.zeros((levels, *good.shape)), np.zeros((levels, *good.shape))
        weight[0] = 1.0
        for place, telegraph in found.items():
            own = (slice(telegraph.added.size), *place)
            exposure[own], weight[own] = telegraph.added, telegraph.weight
        return AddedExposure(exposure, weight)

    def details(self) -> tuple[str, ...]:
        """Return the step and both dwell times: second moments tell only what they come to together."""
        return ("step_e", "dwell_low_frames", "dwell_high_frames") if self.step_e > 0.0 else ()

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return it from the pixels that stand out by block means or by lagged correlations.

        Their excess variance of block means and their autocovariances give the variance of the exposure and
        the time constant; a share of the time in the upper level of one half and of a fifth, and exponential
        steps, are tried, since the second moments do not tell them apart.
        """
        blocks = block_charge(evidence)
        if blocks is None or evidence.time is None:
            return ()
        found = _outliers(evidence, blocks)
        n = int(found.sum())
        if n < 3 or n > FEW_PIXELS * found.size:
            return ()
        variance, tau = _telegraph(evidence, blocks, found)
        if not variance > 0:
            return ()
        return [cls(**_guess(n / found.size, variance, tau, *kind)) for kind in _KINDS]


def _guess(
    fraction: float, variance: float, tau: float, share: float, steps: Literal["equal", "exponential"]
) -> dict[str, Any]:
    """Return the fields for a share of the time in the upper level and a law of the steps."""
    spread = 2.0 if steps == "exponential" else 1.0
    return {
        # small ones of exponential steps stay hidden: some 1.5 times as many as stand out
        "fraction": min(fraction * (1.5 if steps == "exponential" else 1.0), 1.0),
        "step_e": float(np.sqrt(variance / (share * (1.0 - share)) / spread)),
        "steps": steps,
        "dwell_low_frames": max(float(tau / share), 0.5),
        "dwell_high_frames": max(float(tau / (1.0 - share)), 0.5),
    }


def _outliers(evidence: Evidence, blocks: BlockCharge) -> BoolArray:
    """Return which of the blocks' pixels wander by themselves, shape (n,)."""
    assert evidence.time is not None
    freedom = blocks.length.size - 1
    chi2 = np.sum(blocks.length[:, None] * blocks.deviation**2, axis=0) / blocks.variance
    wander = chi_square(chi2, freedom)
    lags = np.asarray(evidence.time.lag_charge, np.float64)[:, blocks.y, blocks.x]
    alike = lags.sum(axis=0) * np.sqrt(evidence.time.n_pairs / lags.shape[0])
    outliers: BoolArray = np.fmax(wander, alike) > _STANDS_OUT
    return outliers


class _Telegraph(NamedTuple):
    """Mean variance of the exposure of the pixels that blink, e-^2, and its time constant, frames."""

    variance: float
    tau: float


def _telegraph(evidence: Evidence, blocks: BlockCharge, found: BoolArray) -> _Telegraph:
    """Fit ``S exp(-lag / tau)`` to the autocovariances and to the variogram of the block means."""
    assert evidence.time is not None
    single = blocks.variance[found]
    lags = np.asarray(evidence.time.lag_charge, np.float64)[:, blocks.y[found], blocks.x[found]]
    length = float(np.median(blocks.length))
    run = float(blocks.start[-1] + blocks.length[-1] - blocks.start[0])
    distance, variogram = _variogram(blocks, found)
    seen = np.append((lags * single).mean(axis=1), variogram - float(single.mean()) / length)
    noise = np.append(
        np.full(lags.shape[0], evidence.time.n_pairs**-0.5),
        np.full(distance.size, blocks.length.size**-0.5 / length),
    ) * np.sqrt(np.mean(single**2) / single.size)
    # few jumps make the walk itself uncertain
    errors = np.hypot(noise, 0.1 * np.abs(seen).max())
    tau = np.geomspace(0.5, run, 120)[:, None]
    # the mean over the run is taken out of the autocovariances, and cancels in a variogram
    short = np.exp(-np.arange(1.0, lags.shape[0] + 1) / tau) - _averaged(run / tau)
    apart = np.exp(-distance / tau) * _averaged_apart(length / tau)
    shape = np.maximum(np.hstack([short, _averaged(length / tau) - apart]), 1e-12)
    weight = errors**-2.0
    variance = (shape * weight) @ seen / ((shape**2) @ weight)
    misfit = ((seen - variance[:, None] * shape) ** 2) @ weight
    best = int(np.argmin(np.where(variance > 0, misfit, np.inf)))
    return _Telegraph(float(variance[best]), float(tau[best, 0]))


def _variogram(blocks: BlockCharge, found: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return distances in time, frames, and half the mean squared difference of block means so far apart."""
    deviation = blocks.deviation[:, found]
    products = deviation @ deviation.T / deviation.shape[1]
    power = np.diag(products)
    first, second = np.triu_indices(power.size, 1)
    half = 0.5 * (power[first] + power[second]) - products[first, second]
    apart = blocks.start[second] - blocks.start[first]
    group = np.floor(2.0 * np.log2(apart / apart.min())).astype(np.int64)
    held = np.bincount(group)
    kept = held > 0
    distance = np.bincount(group, apart)[kept] / held[kept]
    return distance, np.bincount(group, half)[kept] / held[kept]


def _averaged(x: FloatArray) -> FloatArray:
    """Return the variance of the mean over x time constants of an exponential memory of variance 1."""
    return np.where(x > 1e-4, 2.0 * (x + np.expm1(-x)) / np.maximum(x, 1e-4) ** 2, 1.0)


def _averaged_apart(x: FloatArray) -> FloatArray:
    """Return the covariance of two such means over its value for points in their centres."""
    x = np.minimum(x, 50.0)
    return np.where(x > 1e-3, 2.0 * (np.cosh(x) - 1.0) / np.maximum(x, 1e-3) ** 2, 1.0)
