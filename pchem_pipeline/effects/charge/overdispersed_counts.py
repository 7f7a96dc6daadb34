"""Over-dispersed counts: each pixel's exposure differs from frame to frame, independently of its neighbours.

Thermal light and speckle (Mandel 1959; Goodman 1985), dark-current blinking that is too fast to be resolved,
and a jitter of each pixel's integration time mix Poisson laws: ``Var K = H + a H^2`` at a relative variance
a of the exposure. One that is Gamma-distributed gives the negative binomial law (Greenwood and Yule 1920),
which is drawn as what it also is: Poisson many clusters of logarithmic size (Quenouille 1949). One that is
log-normal, a product of many small factors, is more skewed, which strong mixing shows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.estimators.electrons import binomial_upper, regrouped
from pchem_pipeline.effects.framework.effect import Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import (
    AnyArray,
    EffectContext,
    Evidence,
    FloatArray,
    IntArray,
    PixelMaps,
    SampleLaw,
)
from pchem_pipeline.model.arithmetic.significance import CLEAR

# nodes of a law of log-normal exposures, from so many times the variance of shot noise on
_NODES, _BEYOND = (3, 5, 7, 11, 17), (0.05, 0.3, 0.7, 1.3)


@register_effect
class OverdispersedCounts(Effect):
    """Relative variance of the exposure of a pixel from frame to frame.

    Signature: the score of the second Charlier polynomial is positive in all pixels, and per sample grows
    like H; nothing in time, nothing between neighbours, nothing in the readout channel.
    """

    tag: Literal["overdispersed_counts"] = Field(
        default="overdispersed_counts", description="name of the effect"
    )
    plane = Plane.CHARGE
    title = "over-dispersed counts"
    source = "Mandel 1959, Proc. Phys. Soc. 74, 233; Goodman 1985, Statistical Optics, ch. 9"
    signature = ("shape.C2.mean", "shape.C2.slope", "code.smooth", "shape.C3.mean")
    strength = "relative_variance"
    separate: ClassVar[Mapping[str, str]] = {
        "branching_counts": "several exposures: excess variance grows as H^2, by branching as H",
        "exposure_flicker": "pixels of one frame: correlated by flicker only",
        "dark_current_rts": "slower frames and longer runs: blinking pixels are correlated in time",
    }
    relative_variance: Ratio = Field(
        ge=0, le=1, description="variance of the exposure divided by its squared mean (a), no unit"
    )
    exposures: Literal["gamma", "lognormal"] = Field(
        default="gamma",
        description="how the exposures are distributed; gamma: electron numbers are negative binomial",
    )

    #: at a = 0.0064, an exposure that jitters by 8 %
    typical_values = ({"relative_variance": 0.0064},)

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return electron numbers (frame, y, x), e-, made of Poisson ones of mean ``context.exposure``."""
        assert context.exposure is not None  # the chain gives it from this plane on
        a, exposure = self.relative_variance, context.exposure
        if a == 0:
            return values.copy()
        if self.exposures == "lognormal":
            return self._thinned_or_added(values, exposure, context)
        u = context.random.uniform(("frame", "y", "x"))
        flat = exposure.reshape(-1)

        def law(index: IntArray) -> tuple[FloatArray, FloatArray]:
            x = np.maximum(a * flat[index], 1e-300)
            log = np.log1p(x)
            return np.maximum(1.0 - log / x, 0.0), np.maximum(1.0 - x / ((1.0 + x) * log), 0.0)

        def extra(v: FloatArray, index: IntArray) -> IntArray:
            return _logarithmic_beyond_one(v, a * flat[index])

        # both probabilities are below a H / 2
        return regrouped(values, u, (0.5 * a) * exposure, law, extra)

    def added_scatter_e(self, exposure: FloatArray) -> FloatArray:
        """Return the scatter of the exposure, e- rms: which electrons it moves differs from draw to draw."""
        return np.asarray(np.sqrt(self.relative_variance) * exposure)

    def _thinned_or_added(self, values: AnyArray, exposure: FloatArray, context: EffectContext) -> AnyArray:
        """Return Poisson numbers of the mean of each sample, made of those of the mean of all."""
        width = _width(self.relative_variance)
        normal = context.random.normal(("frame", "y", "x"))
        factor = np.exp(width * normal - 0.5 * width**2)
        u = context.random.uniform(("frame", "y", "x"), draw=1)
        lost = binomial_upper(
            u.ravel(), values.ravel().astype(np.int64), np.maximum(1.0 - factor, 0.0).ravel()
        )
        added = context.random.poisson(
            np.broadcast_to(exposure, values.shape) * np.maximum(factor - 1.0, 0.0), 2
        )
        return np.asarray(values - lost.reshape(values.shape) + added, values.dtype)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return what is typical, as strong as the second Charlier polynomial has it.

        Both kinds of exposures where the third polynomial, in which they differ by ``a^2 H^3`` in all, would
        tell them apart.
        """
        found = super().estimate(evidence)
        exposure = evidence.maps.quanta_exposure[evidence.maps.usable]
        differ = np.sqrt(evidence.n_frames * np.nansum(exposure**3.0) / 6.0)
        apart = [one for one in found if one.relative_variance**2 * differ > CLEAR]
        return [*found, *(one.model_copy(update={"exposures": "lognormal"}) for one in apart)]

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with negative binomial electron numbers, or mixed over log-normal exposures."""
        if self.exposures == "gamma":
            return model.with_counts("negative_binomial", self.relative_variance)
        # Gauss-Hermite in the logarithm, more nodes where exposures differ by more than shot noise does
        beyond = self.relative_variance * float(np.nanmax(maps.quanta_exposure, initial=0.0))
        number = _NODES[int(np.searchsorted(_BEYOND, beyond))]
        nodes, weights = np.polynomial.hermite_e.hermegauss(number)
        factors = np.exp(_width(self.relative_variance) * nodes)
        weights = weights / weights.sum()
        return model.with_exposures(weights, factors / (weights @ factors))


def _width(relative_variance: float) -> float:
    """Return the standard deviation of the logarithm of log-normal exposures."""
    return float(np.sqrt(np.log1p(relative_variance)))


def _logarithmic_beyond_one(v: FloatArray, x: FloatArray) -> IntArray:
    """Return n - 1 for logarithmic n >= 2, P(n) ~ theta^n / n with theta = x / (1 + x)."""
    theta = x / (1.0 + x)
    extra = np.ones(v.size, np.int64)
    mass = 0.5 * theta / (np.log1p(x) / theta - 1.0) if v.size else v
    active, below, n = np.arange(v.size), mass, 2
    while active.size and n < 100_000:
        more = v[active] > below
        active, below, mass, theta = active[more], below[more], mass[more], theta[more]
        extra[active] += 1
        mass = mass * theta * (n / (n + 1))
        below = below + mass
        # rounding must not keep the last few alive for ever
        active = np.where(mass > 1e-17, active, -1)
        keep = active >= 0
        active, below, mass, theta = active[keep], below[keep], mass[keep], theta[keep]
        n += 1
    return extra
