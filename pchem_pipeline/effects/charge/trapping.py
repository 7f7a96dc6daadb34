"""Trapping: a trap in the pixel catches an electron and gives it back in a later frame.

A trap holds one electron at most (Shockley and Read 1952). Where it is empty it takes one from a sample that
has any with a chance c, whatever their number: the charge reaches it or does not (Massey et al. 2010). Where
it is full it gives the electron to a later sample, with a chance r in each. Its capacity makes it visible in
frames of one exposure, other than a lag of electrons one by one (:mod:`.charge_lag`).

With the trap full or empty, s, sample t is ``K_t + s_t - s_{t+1}``. The trap is full in a share ``pi = a / (r
+ a)`` of the frames, ``a = c P(K >= 1)``, and its states of frames l apart are correlated by ``w^l`` with ``w
= 1 - r - a``. From Poisson electrons of mean H follow the law of a sample, with ``m = (1 - pi) c``,

    ``P(k) = P(k; H) + m P(K >= 1) [P(k-1; H) - P(k; H)] + m [P(k+1; H) - P(k; H) 1(k >= 1)]``,

its mean H, its variance ``H + 2 m P(K >= 2)`` and third factorial cumulant ``-6 m P(K >= 3)``, and the
covariance of samples l frames apart, ``-r c P(K >= 2) w^(l-1)``. No charge is lost: the sum of all of these
covariances is minus the excess of the variance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from pchem_pipeline.effects.estimators.long_memory import OF_PIXEL
from pchem_pipeline.effects.framework.effect import Effect, Plane, Ratio, register_effect
from pchem_pipeline.effects.types import (
    AnyArray,
    BoolArray,
    EffectContext,
    Evidence,
    FloatArray,
    IntArray,
    PixelMaps,
    SampleLaw,
)
from pchem_pipeline.model.arithmetic.significance import CERTAIN, POSSIBLE

# probability that the state of a trap goes back farther than the frames that are simulated for it
_RARE = 1e-6
_LIMITS = (0.02, 0.95)  # of a release, and the largest of a capture


@register_effect
class Trapping(Effect):
    """Chance that an empty trap of a pixel catches an electron of a sample.

    Signature: the electron numbers vary more than Poisson and are less skewed; successive ones are opposite,
    and so are those of some further frames, the less the longer apart. Nothing in the readout residual,
    nothing between neighbours, and block means are as even as those of Poisson electrons.
    """

    tag: Literal["trapping"] = Field(default="trapping", description="name of the effect")
    plane = Plane.CHARGE
    title = "charge trapping"
    source = (
        "Shockley and Read 1952, Phys. Rev. 87, 835; Massey et al. 2010, Mon. Not. R. Astron. Soc. 401, 371"
    )
    signature = (
        "time.lag1.charge.mean", "shape.C2.mean", "shape.C3.mean", "time.lag2.charge.mean",
    )  # fmt: skip
    strength = "capture"
    separate: ClassVar[Mapping[str, str]] = {
        "overdispersed_counts": "longer runs: trapping anticorrelates electron numbers of successive frames, "
        "over-dispersion does not",
        "branching_counts": "longer runs: trapping anticorrelates electron numbers of successive frames, "
        "branching does not",
        "analog_memory": "dark frames after a bright one: traps release single electrons, memory fades "
        "within a frame",
        "dark_current_rts": "longer runs: the sum over many frames is Poisson with trapping, over-dispersed "
        "with dark-current RTS",
    }
    capture: Ratio = Field(
        ge=0,
        le=_LIMITS[1],
        description="probability that an empty trap captures an electron of a sample that has any, no unit",
    )
    release: Ratio = Field(
        default=0.3,
        ge=_LIMITS[0],
        le=_LIMITS[1],
        description="probability per frame that a full trap releases its electron, no unit",
    )
    fraction: Ratio = Field(default=1.0, ge=0, le=1, description="share of the pixels with a trap, no unit")

    #: in all pixels, fast and slow, and in a tenth of them
    typical_values = (
        {"capture": 0.03, "release": 0.4},
        {"capture": 0.3, "release": 0.06},
        {"capture": 0.3, "release": 0.3, "fraction": 0.1},
    )

    def history(self) -> int:
        """Return how many frames ago a trap was last filled or emptied whatever its state was, at most."""
        # chances above one half also make it change places, which leaves its state open
        known = min(self.release, 1.0 - abs(1.0 - self.release - self.capture))
        return math.ceil(math.log(_RARE) / math.log1p(-known)) if self.capture > 0 else 0

    def apply(self, values: AnyArray, context: EffectContext) -> AnyArray:
        """Return electron numbers (frame, y, x), e-, as read: less what is caught, with what is released.

        A trap that was neither filled nor emptied for as long as :meth:`history` is taken for empty, so that
        it is the same whatever block is simulated.
        """
        u = context.random.uniform(("frame", "y", "x"))
        filled = (u > 1.0 - self.capture) & (values > 0)
        if self.fraction < 1:
            filled &= context.random.uniform(("y", "x"), OF_PIXEL[0]) < self.fraction
        emptied = u < self.release
        full = _states(filled, emptied, self.history())
        return values + full[:-1] - full[1:]

    @classmethod
    def estimate(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the trap of which the autocovariances of the electron numbers are, in some pixels or in all.

        The squares of the first one tell in how many. Two traps of which one catches as often as the other
        releases have the same moments: that which is more often empty is meant.
        """
        time, maps = evidence.time, evidence.maps
        if time is None or not evidence.z.get("time.lag1.charge.mean", 0.0) < -POSSIBLE:
            return ()
        good = maps.usable & (maps.quanta_exposure > 0) & np.isfinite(time.lag_charge[:2]).all(axis=0)
        exposure, first = maps.quanta_exposure[good], time.lag_charge[0][good].astype(np.float64)
        some = -np.expm1(-exposure)
        # the expected electron number answers to the electrons by Var(k) / H
        answer = (some - exposure * np.exp(-exposure)) * (evidence.charge_std[good] / exposure) ** 2
        mean = -float(answer @ first / (answer @ answer))
        if not mean > 0.0:
            return ()
        left = float(np.clip(-(answer @ time.lag_charge[1][good]) / (answer @ answer) / mean, 0.0, 0.95))
        weight = answer**2 / float((answer**4).sum())
        squares = float(weight @ (first**2 - 1.0 / time.n_pairs))
        beyond = squares - mean**2 > CERTAIN * (2.0 * float(weight @ weight)) ** 0.5 / time.n_pairs
        shares = (mean**2 / squares, 1.0) if beyond else (1.0,)
        return [cls._with(mean / share, 1.0 - left, float(some.mean()), share) for share in shares]

    @classmethod
    def _with(cls, product: float, total: float, some: float, fraction: float) -> Self:
        """Return it with the product ``r c`` of its chances and their sum ``r + c P(K >= 1)``."""
        low, high = _LIMITS
        release = 0.5 * (total + max(total**2 - 4.0 * product * some, 0.0) ** 0.5)
        capture = min((total - release) / some, high)
        return cls(capture=capture, release=min(max(release, low), high), fraction=fraction)

    def details(self) -> tuple[str, ...]:
        """Return the chance of a release, and the share of the pixels where not all have a trap."""
        return ("release", "fraction") if 0.0 < self.fraction < 1.0 else ("release",)

    def sample_law(self, model: SampleLaw, maps: PixelMaps) -> SampleLaw:
        """Return the law with trapped electrons; the same one where only some pixels have a trap."""
        if self.fraction < 1:
            return model
        return model.with_counts("trapped", self.chance(np.nan_to_num(maps.quanta_exposure)))

    def chance(self, exposure: FloatArray) -> FloatArray:
        """Return m, the chance that a sample with electrons loses one, for exposures H, e-."""
        return _chance(self.capture, self.release, -np.expm1(-exposure))


def _chance(capture: float, release: float, some: FloatArray) -> FloatArray:
    """Return m, the chance that a sample with electrons loses one, given how probable it is to have any."""
    return np.asarray(capture * release / (release + capture * some))


def _states(filled: BoolArray, emptied: BoolArray, history: int) -> IntArray:
    """Return whether traps are full before and behind each frame, (frame + 1, y, x), 0 or 1.

    Args:
        filled: in which frames an empty trap is filled, (frame, y, x).
        emptied: in which frames a full trap is emptied, (frame, y, x).
        history: frames beyond which a trap is taken for empty.
    """
    start = np.zeros((1, *filled.shape[1:]), np.bool_)
    frame = np.arange(filled.shape[0] + 1)[:, None, None]
    # where both happen it changes its state; else it is known afterwards
    changes = np.concatenate([start, np.logical_xor.accumulate(filled & emptied, axis=0)])
    known = np.concatenate([start, filled ^ emptied])
    last = np.maximum.accumulate(np.where(known, frame, 0), axis=0)
    then = np.take_along_axis(np.concatenate([start, filled]) ^ changes, last, axis=0)
    full = (then ^ changes) & (last > 0) & (frame - last < history)
    return np.asarray(full, np.int64)
